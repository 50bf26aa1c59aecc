"""The folder of a series: settings, batches, lock, excluded hits, and application; nothing is flown here."""

from __future__ import annotations

import errno
import os
import signal
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.errors import FlightError
from dart_flight.base.records import Mode
from dart_flight.check.mission_check import check_materials
from dart_flight.cli import main
from dart_flight.config.document import Document, InputError
from dart_flight.config.material_history import history_path, newest_entry, read_history
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.core.flight_core import FlightCore
from dart_flight.lab.identify.body_fit import BodyImpact
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.series.evidence import Evidence, SeriesFlight, SeriesHit, _set_outliers_aside
from dart_flight.lab.series.history import apply_status
from dart_flight.lab.series.series_file import SeriesFolder, locked
from dart_flight.lab.series.status import status_of
from dart_flight.planning.contact_fit import Belief
from dart_flight.recording.flown_impact import CollisionVerdict
from tests.command_fixtures import Refuse, folder, refusal_of  # noqa: F401

ROOT = Path(__file__).parents[3]
MISSION = ROOT / "missions/single_wall.yaml"
SERIES = "afternoon"


@pytest.fixture
def series(folder: Path) -> SeriesFolder:  # noqa: F811
    assert main(["series", "new", SERIES, "--mission", str(MISSION), "--wall", "acrylic"]) == 0
    return SeriesFolder(Path(SERIES))


def with_bodies(ks: list[float], mode: Mode = Mode.FLEXIBLE) -> list[SeriesHit]:
    """Return hits whose contacts were fitted with these k, N/m, each to 1 %."""
    prior = Belief(1250.0, 8.5, 5.0, 10.0, 0.8, 0.8, 0.8, 0.8)
    return [
        SeriesHit(
            "01/flight",
            i,
            mode,
            CollisionVerdict(i, "acrylic", mode.value, i),
            body=BodyImpact(
                prior,
                Belief(k, 9.0, 5.0, 10.0, 0.01, 0.1, 0.05, 0.2),
                misfit=0.2,
                onset_s=0.0,
                normal_m_s=-1.0,
                plane_m=Estimate(0.0, -0.01, 0.01),
                force_errors_n=np.zeros(1),
                vertical_side=1,
            ),
        )
        for i, k in enumerate(ks, start=1)
    ]


def test_a_new_series_uses_the_wall_and_the_limits_of_the_mission(series: SeriesFolder) -> None:
    settings, mission = series.settings, series.mission()
    assert (settings.wall, settings.modes) == ("acrylic", (Mode.FLEXIBLE, Mode.RIGID))
    assert settings.peak_force_n == load_mission(MISSION).limits.peak_force_n
    assert mission.flat_walls == load_mission(MISSION).flat_walls
    assert mission.vehicle == load_mission(MISSION).vehicle


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--wall", "wood"], "no wall 'wood' in the mission; it has acrylic"),
        (["--speeds", "1.5..0.3"], "expected low < high"),
        (["--speeds", "1.5"], "is not LOW..HIGH"),
        (["--aim", "k=1"], "1 % is below the allowance for systematic errors of flights, 3 %"),
        (["--aim", "nu=80"], "no aim for 'nu'"),
        (["--modes", "soft"], "modes are rigid and flexible"),
    ],
)
def test_an_impossible_series_is_refused_and_leaves_no_series(
    options: list[str],
    message: str,
    folder: Path,  # noqa: F811
    refusal_of: Refuse,  # noqa: F811
) -> None:
    given = ["--mission", MISSION, "--wall", "acrylic", *options]
    assert message in refusal_of("series", "new", SERIES, *given)
    assert not (folder / SERIES / "series.yaml").exists()


def test_a_second_series_in_a_folder_is_refused(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    again = refusal_of("series", "new", SERIES, "--mission", MISSION, "--wall", "acrylic")
    assert "a series exists here already" in again


def test_a_batch_is_a_mission_that_can_be_flown(series: SeriesFolder) -> None:
    assert main(["series", "next", SERIES]) == 0
    batch = load_mission(series.path / "batches/01/mission.yaml")
    FlightCore(batch)  # every approach has its run-up
    assert len(batch.collisions) == series.settings.hits_per_flight
    assert {c.wall.name for c in batch.collisions} == {"acrylic"}
    assert {c.mode for c in batch.collisions} == {Mode.FLEXIBLE, Mode.RIGID}
    limits_n = [c.peak_limit_n for c in batch.collisions]
    assert limits_n == sorted(n for n in limits_n if n is not None)
    assert limits_n[-1] is not None
    assert limits_n[-1] <= 0.8 * batch.limits.peak_force_n + 0.1
    rests = [w for w in batch.waypoints if w.position is not None and w.position[:2] == batch.start]
    assert [w.after for w in rests] == list(range(1, len(batch.collisions) + 1))


def test_a_batch_that_was_not_flown_is_replaced(series: SeriesFolder) -> None:
    (series.path / "batches/01").mkdir(parents=True)  # a command was killed before it wrote the mission
    for _ in range(2):
        assert main(["series", "next", SERIES]) == 0
    assert [path.name for path in series.batches()] == ["01"]


def test_a_killed_flight_is_named_and_the_next_batch_follows(
    series: SeriesFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly(call: list[str]) -> int:
        log = Path(call[call.index("--log-dir") + 1]) / "killed/flight.mcap"
        log.parent.mkdir(parents=True)
        log.write_bytes(b"\x89MCAP0\r\n")
        return -signal.SIGKILL

    monkeypatch.setattr("dart_flight.lab.commands.series_command.run_child", fly)
    assert main(["series", "fly", SERIES, "--fast"]) == 1
    assert "SIGKILL has ended the flight's program; its hits are kept" in capsys.readouterr().err
    assert main(["series", "next", SERIES]) == 0
    assert [path.name for path in series.batches()] == ["01", "02"]


@pytest.mark.parametrize(
    ("options", "command", "passed_on"),
    [
        ([], "fly", []),
        (["--dry-run", "--speed", "max"], "dry-run", ["--speed", "max", "--seed", "1"]),
        (["--fast", "--seed", "3"], "dry-run", ["--fast", "--seed", "3"]),
        (["--connection", "udpin://0.0.0.0:14540"], "fly", ["--connection", "udpin://0.0.0.0:14540"]),
    ],
)
def test_a_batch_is_flown_by_the_command_of_its_world(
    series: SeriesFolder,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    command: str,
    passed_on: list[str],
) -> None:
    calls = list[list[str]]()

    def fly(call: list[str]) -> int:
        calls.append(call)
        return 0

    monkeypatch.setattr("dart_flight.lab.commands.series_command.run_child", fly)
    assert main(["series", "fly", SERIES, *options]) == 0
    (call,) = calls
    assert call[3] == command
    assert call[call.index("--log-dir") + 2 :] == passed_on


def test_a_file_of_another_use_is_not_overwritten(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    mine = Path("own/mission.yaml")
    mine.parent.mkdir()
    mine.write_text("mine\n")
    said = refusal_of("series", "new", "own", "--mission", MISSION, "--wall", "acrylic")
    assert "own/mission.yaml: exists and is not of a series" in said
    assert mine.read_text() == "mine\n"


def test_an_interrupted_new_can_be_repeated(series: SeriesFolder) -> None:
    (series.path / "series.yaml").unlink()  # killed after it had copied the mission
    assert main(["series", "new", SERIES, "--mission", str(MISSION), "--wall", "acrylic"]) == 0


def test_a_mistyped_wall_in_the_settings_is_named(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    settings = series.path / "series.yaml"
    settings.write_text(settings.read_text().replace("wall: acrylic", "wall: acrilyc"))
    for action in ("status", "next", "fly"):
        assert "unknown acrilyc" in refusal_of("series", action, SERIES)


def test_a_missing_recording_is_named_by_its_own_path(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    assert "nowhere/flight.mcap" in refusal_of("series", "add", SERIES, "nowhere/flight.mcap")


def test_the_configuration_to_write_is_named(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    assert "--config: name the configuration to write" in refusal_of("series", "apply", SERIES)


def test_coefficients_are_not_written_for_another_vehicle(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    config = packaged("configs") / "rigid_cage.yaml"
    assert "is another vehicle: its mass is" in refusal_of("series", "apply", SERIES, "--config", config)


def test_a_failed_flight_leaves_its_error_as_the_last_line(
    series: SeriesFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(call: list[str]) -> int:
        return 2

    monkeypatch.setattr("dart_flight.lab.commands.series_command.run_child", fail)
    assert main(["series", "fly", SERIES]) == 2
    out, err = capsys.readouterr()
    assert "the flight is in" not in err
    assert "hits used" not in out


def test_a_batch_is_flown_in_one_world(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    assert "only one of" in refusal_of("series", "fly", SERIES, "--fast", "--dry-run")


def test_two_programs_cannot_write_a_series(series: SeriesFolder, capsys: pytest.CaptureFixture[str]) -> None:
    with locked(series.path):
        assert main(["series", "next", SERIES]) == 1
    assert "writes this series; wait until it has ended" in capsys.readouterr().err
    with locked(series.path), pytest.raises(FlightError), locked(series.path):
        pass
    assert main(["series", "next", SERIES]) == 0


def test_on_a_full_disk_nothing_changes(
    series: SeriesFolder,
    monkeypatch: pytest.MonkeyPatch,
    refusal_of: Refuse,  # noqa: F811
) -> None:
    def full(descriptor: int, data: bytes, offset: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    before = (series.path / "series.yaml").read_bytes()
    line = refusal_of("series", "exclude", SERIES, "01:1", "--why", "a cable")
    assert "No space left on device; put the series on a local disk with free space" in line
    assert (series.path / "series.yaml").read_bytes() == before


def test_a_change_of_the_settings_keeps_comments(series: SeriesFolder) -> None:
    path = series.path / "series.yaml"
    path.write_text(path.read_text("utf-8").replace("wall:", "# the left one\nwall:"), "utf-8")
    series.change(added=("one flight",))
    text = path.read_text("utf-8")
    assert "# the left one\nwall: acrylic" in text
    assert SeriesFolder(series.path).settings.added == ("one flight",)


def test_an_unknown_flight_is_not_excluded(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    line = refusal_of("series", "exclude", SERIES, "04:1", "--why", "a cable")
    assert "no flight of the series has '04' in the name" in line


def test_an_unreadable_log_is_named_and_does_not_stop_the_others(
    series: SeriesFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    log = series.path / "batches/01/flights/first/flight.mcap"
    log.parent.mkdir(parents=True)
    log.write_bytes(b"\x89MCAP0\r\n")
    assert main(["series", "status", SERIES]) == 0
    assert "01/first: " in capsys.readouterr().out
    assert main(["series", "next", SERIES]) == 0
    assert [path.name for path in series.batches()] == ["01", "02"]


def test_hits_on_another_wall_are_set_aside() -> None:
    hits = with_bodies([1250.0, 1270.0, 3100.0, 1240.0, 1260.0])
    _set_outliers_aside(hits)
    assert [bool(hit.aside) for hit in hits] == [False, False, True, False, False]
    assert "k is 2." in hits[2].aside


def test_of_two_equal_groups_the_earlier_counts() -> None:
    hits = with_bodies([1250.0, 1270.0, 625.0, 630.0])
    _set_outliers_aside(hits)
    assert [bool(hit.aside) for hit in hits] == [False, False, True, True]


def test_the_status_weighs_prior_and_hits(series: SeriesFolder) -> None:
    mission = series.mission()
    none = status_of(series.settings, mission, Evidence()).modes["flexible"]
    assert none.coefficients["k"].prior_share == 1.0
    assert none.more_hits is None
    few = status_of(series.settings, mission, Evidence([], with_bodies([1500.0, 1510.0])))
    k = few.modes["flexible"].coefficients["k"]
    assert k.prior_share < 0.02
    assert k.statistical.value == pytest.approx(1505.0, rel=0.01)
    assert k.whole.low < k.statistical.low < k.statistical.high < k.whole.high
    many = status_of(series.settings, mission, Evidence([], with_bodies([1500.0] * 12)))
    more = [one.modes["flexible"].more_hits for one in (few, many)]
    assert more[0] is not None
    assert more[1] is not None
    assert more[0] > more[1]


def test_a_changed_mass_is_reported(series: SeriesFolder) -> None:
    vehicle = load_vehicle()
    heavier = vehicle.replace({"airframe.mass_kg": 1.4})
    flights = [
        SeriesFlight("01/a", Path(), began=datetime(2026, 5, 4, tzinfo=UTC), vehicle=vehicle, battery_v=16.4),
        SeriesFlight("02/b", Path(), began=datetime(2026, 5, 5, tzinfo=UTC), vehicle=heavier, battery_v=15.1),
    ]
    changes = status_of(series.settings, series.mission(), Evidence(flights)).changes
    assert changes[0] == "since 2026-05-04, airframe.mass_kg has changed from 1.3 to 1.4 kg"
    assert "battery has changed from 16.4 to 15.1 V" in changes[1]


def test_application_changes_only_the_material_and_dates_it(series: SeriesFolder) -> None:
    config = Path("mine.yaml")
    config.write_text((ROOT / "configs/dart.yaml").read_text("utf-8"), "utf-8")
    before = config.read_text("utf-8").splitlines()
    today = datetime.now(UTC)
    flight = SeriesFlight("01/flight", Path(), began=today, vehicle=load_vehicle(config))
    evidence = Evidence([flight], with_bodies([1500.0] * 4))
    status = status_of(series.settings, series.mission(), evidence)
    apply_status(status, evidence, config, series.path)
    changed = [
        pair
        for pair in zip(before, config.read_text("utf-8").splitlines(), strict=True)
        if pair[0] != pair[1]
    ]
    assert len(changed) == 2  # source and flexible
    applied = load_vehicle(config).materials["acrylic"]
    assert applied.flexible is not None
    assert applied.flexible.k == pytest.approx(1500.0, rel=0.01)
    assert applied.rigid == load_vehicle().materials["acrylic"].rigid
    entry = newest_entry(read_history(config), "acrylic", "flexible")
    assert entry is not None
    assert (entry.day, entry.hits) == (today.date(), 4)
    (finding,) = check_materials(load_mission(MISSION, config), config.parent)
    age = (date.today() - today.date()).days
    assert finding.message.endswith(f"coefficients: flexible {age} days old")


def test_a_series_without_hits_is_not_applied(series: SeriesFolder, refusal_of: Refuse) -> None:  # noqa: F811
    config = Path("mine.yaml")
    config.write_text((ROOT / "configs/dart.yaml").read_text("utf-8"), "utf-8")
    line = refusal_of("series", "apply", SERIES, "--config", config)
    assert "the series has no usable hits yet" in line
    assert not history_path(config).exists()


def test_an_invalid_history_is_refused_before_the_configuration_changes(series: SeriesFolder) -> None:
    config = Path("mine.yaml")
    text = (ROOT / "configs/dart.yaml").read_text("utf-8")
    config.write_text(text, "utf-8")
    history_path(config).write_text("applied: 3\n", "utf-8")
    evidence = Evidence([], with_bodies([1500.0] * 4))
    with pytest.raises(InputError):
        apply_status(status_of(series.settings, series.mission(), evidence), evidence, config, series.path)
    assert config.read_text("utf-8") == text
    assert Document.load(history_path(config)).tree == {"applied": 3}
