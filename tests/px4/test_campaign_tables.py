"""The tables of flights with a real PX4: a version flown again replaces its rows, the others stay."""

from __future__ import annotations

from tools.campaigns.px4 import PAGE, Flight, Hit, body_table, versions_table, with_table


def flight(part: str, seed: int, drawn: dict[str, float | str], final_m: float) -> Flight:
    hit = Hit("acrylic", "flexible", -1.0, -1.01, 0.5, 34.0, 34.6, 9.0, 1.0, 5.25, 8.5, 140.2)
    return Flight(
        part, "px4", 1.0, "mocap", "single", seed, "completed", None, False, 0, 9.0, 0.02, 0.5,
        final_m, [hit], [], "1.16.0", drawn,
    )  # fmt: skip


def test_a_hit_of_the_body_in_one_row() -> None:
    rows = body_table(
        [flight("body v1", 1, {}, 0.05), flight("body v1", 2, {"wall_yaw_deg.acrylic": -8.04}, 0.013)]
    ).splitlines()[2:]
    assert rows[0] == "| v1 | single | 1 | 0 | yes | 5.2 | -1.01 | 35 | 8.5 | 140 | 0.050 |"
    assert rows[1].startswith("| v1 | single | 2 | -8.0 | yes |")


def test_rows_of_versions_that_were_not_flown_again_stay() -> None:
    page = "before\n<!-- flown: body -->\n<!-- end -->\nafter\n"
    first = with_table(
        page, "body", body_table([flight("body v2", 1, {}, 0.01), flight("body a", 1, {}, 0.02)])
    )
    assert first.startswith("before\n<!-- flown: body -->\n| PX4 | mission")
    again = with_table(
        first, "body", body_table([flight("body v1", 1, {}, 0.04), flight("body a", 1, {}, 0.03)])
    )
    ends = [line.split(" | ")[0] + line[-9:] for line in again.splitlines() if line.endswith(" |")][2:]
    assert ends == ["| v1| 0.040 |", "| v2| 0.010 |", "| a| 0.030 |"]
    assert again.endswith("<!-- end -->\nafter\n")


def test_the_page_keeps_its_table_of_versions() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert with_table(page, "versions", versions_table([])) == page
