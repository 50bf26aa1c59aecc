"""Wrong input is refused in one line with file, line and key; the exit status is 2 and nothing starts."""

import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import load_mission, parse_mission
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.run.prepare import load_flyable
from tests.command_fixtures import Refuse

ROOT = Path(__file__).parents[2]
DUAL = (ROOT / "missions/paper_dual_collision.yaml").read_text()
VEHICLE = load_vehicle(ROOT / "configs/dart.yaml")

# (replaced text, replacement, place in the error, words of the error)
WRONG: list[tuple[str, str, str, str]] = [
    ("length_m: 3.0", "lenght_m: 3.0", "12: walls.wood.lenght_m", "did you mean length_m?"),
    ("mode: flexible", "mode: flexibel", "16: collisions[0].mode", "only: rigid, flexible"),
    ("normal: [0.0, 1.0]", "normal: [0, 0]", "12: walls.wood.normal", "has length 0"),
    ("normal_m_s: -0.6", "normal_m_s: 0.6", "16: collisions[0].approach.normal_m_s", "a number <"),
    ("normal_m_s: -0.6", "normal_m_s: .nan", "16: collisions[0].approach.normal_m_s", "must be finite"),
    ("normal_m_s: -0.6", "normal_m_s: -1e999", "16: collisions[0].approach.normal_m_s", "must be finite"),
    ("normal_m_s: -0.6", "normal_m_s: fast", "16: collisions[0].approach.normal_m_s", "got text"),
    ("normal_m_s: -0.6", "normal_m_s: -6", "16: collisions[0].approach", "exceeds limits.speed_m_s"),
    ("version: 1", "version: 2", "4: version", "only: 1"),
    ("version: 1", "version: one", "4: version", "a whole number"),
    ("wall: wood", "wall: wod", "16: collisions[0].wall", "did you mean wood?"),
    ("material: wood", "material: granite", "12: walls.wood.material", "known: concrete, acrylic, wood"),
    ("[0.12, 0.025]}", "[0.12]}", "16: collisions[0].alpha_m_per_n", "length 2"),
    (", alpha_m_per_n: [0.12, 0.025]", "", "16: collisions[0]", "exactly one of alpha"),
    ("[0.12, 0.025]}", "[0.12, 0.0]}", "16: collisions[0]", "must be above 0"),
    ("goal: {position_m: [1.0", "goal: {position_m: [9.0", "9: goal.position_m", "outside bounds_m"),
    (
        "start: {position_m: [0.0, 0.0]",
        "start: {position_m: [0.0, -1.2]",
        "8: start.position_m",
        "behind wall",
    ),
    ("altitude_m: 1.0", "altitude_m: '1.0'", "8: start.altitude_m", "got text"),
    ("altitude_m: 1.0", "altitude_m: 5.0", "8: start.altitude_m", "within bounds_m z"),
    ("x: [-2.0, 2.2]", "x: [2.2, -2.0]", "10: bounds_m.x", "low < high"),
    ("name: paper-dual-collision\n", "", "missing key name", ""),
    ("name: paper-dual-collision", "name: ../../etc/passwd", "5: name", "letters, digits"),
    ("name: paper-dual-collision", "name: paper-dual-collision\nname: again", "6: name", "appears twice"),
    ("wood, mode", "wood, mode: rigid, mode", "16: collisions[0].mode", "appears twice"),
    ("version: 1", "version: &a 1", "4", "anchors and aliases"),
    ("version: 1", "version: !!int 1", "4", "tags are not supported"),
    ("limits: {", "limits: [", "18", "not valid YAML"),
    ("capture_radius_m: 0.15", "capture_radius_m: true", "9: goal.capture_radius_m", "got true or false"),
    ("capture_radius_m: 0.15", "capture_radius_m: -1", "9: goal.capture_radius_m", "a number >"),
    (
        "tangential_m_s: 0.5",
        "tangential_m_s: 2.9",
        "16: collisions[0].approach",
        "beyond the end of the wall",
    ),
    ("approach: {normal_m_s: -0.6, tangential_m_s: 0.5}, ", "", "16: collisions[0]", "needs an approach"),
    ("vehicle: ../configs/dart.yaml", "vehicle: ../configs/none.yaml", "none.yaml", "cannot read"),
    ("hold_s: 2.0", "hold_s: 123456789012345678901", "9: goal.hold_s", "number too large"),
]


@pytest.mark.parametrize(("old", "new", "place", "words"), WRONG, ids=lambda v: str(v)[:40])
def test_each_mistake_is_named_with_its_place(old: str, new: str, place: str, words: str) -> None:
    assert old in DUAL
    body = DUAL.split("\n", 2)  # the comment names some of the same words
    text = "\n".join([*body[:2], body[2].replace(old, new, 1)])
    with pytest.raises(InputError) as caught:
        parse_mission(Document(text, str(ROOT / "missions/paper_dual_collision.yaml")))
    line = caught.value.one_line()
    assert place in line
    assert words in line
    assert "\n" not in line


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\x00",
        b"- 1\n- 2\n",
        b"just text",
        b"a: b: c",
        b"a: 1\n---\nb: 2\n",
        b"{" * 5000,
        b"a: *x",
    ],
    ids=lambda c: repr(c[:12]),
)
def test_a_file_that_is_not_a_mission_is_refused(content: bytes, tmp_path: Path, refusal_of: Refuse) -> None:
    path = tmp_path / "m.yaml"
    path.write_bytes(content)
    assert str(path) in refusal_of("dry-run", path, "--fast", "--log-dir", tmp_path / "flights")
    assert not (tmp_path / "flights").exists()  # nothing has started


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path, refusal_of: Refuse) -> None:
    for path in (tmp_path / "none.yaml", tmp_path):
        assert str(path) in refusal_of("dry-run", path)


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly"],
        ["fli", "x"],
        ["dry-run", "missions/paper_dual_collision.yaml", "--seed", "x"],
        ["dry-run", "missions/paper_dual_collision.yaml", "--runs", "0"],
        ["dry-run", "missions/paper_dual_collision.yaml", "--driver", "hydraulic"],
        ["dry-run", "missions/paper_dual_collision.yaml", "--config", "none.yaml"],
        ["simulate", "--port", "99999"],
    ],
)
def test_wrong_arguments_are_refused_in_one_line_with_exit_status_2(
    arguments: list[str], refusal_of: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    refusal_of(*arguments)


def test_a_refusal_is_the_status_of_the_process() -> None:
    words = [sys.executable, "-m", "dart_flight", "fly"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)


def test_a_run_up_without_room_is_refused(tmp_path: Path) -> None:
    text = DUAL.replace("../configs", str(ROOT / "configs")).replace(
        "start: {position_m: [0.0, 0.0]", "start: {position_m: [0.9, -0.9]"
    )
    path = tmp_path / "m.yaml"
    path.write_text(
        text.replace("y: [-1.6, 2.0]", "y: [-1.6, -0.85]").replace(
            "position_m: [1.0, -0.5]", "position_m: [1.0, -0.9]"
        )
    )
    with pytest.raises(InputError, match="run-up to wall wood"):
        load_flyable(path)


def test_different_gains_on_a_slanted_wall_are_refused() -> None:
    text = DUAL.replace("normal: [0.0, 1.0]", "normal: [0.1, 1.0]")
    with pytest.raises(InputError, match="alpha_wall_m_per_n"):
        parse_mission(Document(text, str(ROOT / "missions/x.yaml")))


def test_surface_walls_are_moved_by_the_contact_distance() -> None:
    text = DUAL.replace(
        "point_m: [0.8, -1.1], normal: [0.0, 1.0],  length_m: 3.0, material: wood, given_at: centre",
        "point_m: [0.8, -1.3], normal: [0.0, 2.0],  length_m: 3.0, material: wood, given_at: surface",
    )
    assert text != DUAL
    mission = parse_mission(Document(text, str(ROOT / "missions/x.yaml")))
    assert mission.walls[0].point == pytest.approx((0.8, -1.1))
    assert mission.walls[0].normal == pytest.approx((0.0, 1.0))


def test_integers_and_exponents_are_accepted_as_numbers() -> None:
    text = DUAL.replace("hold_s: 2.0", "hold_s: 2e0").replace("altitude_m: 1.0", "altitude_m: 1")
    mission = parse_mission(Document(text, str(ROOT / "missions/x.yaml")))
    assert (mission.goal.hold_s, mission.altitude_m) == (2.0, 1.0)


# --- random input ---------------------------------------------------------------------------------------

scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**12), 10**12),
    st.floats(allow_nan=True, allow_infinity=True),
    st.text(max_size=8),
)
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
)


def _mutate(text: str, seed: int) -> str:
    """Damage a good file: remove, double, insert or shuffle characters or lines."""
    rng = random.Random(seed)
    for _ in range(rng.randint(1, 4)):
        i = rng.randrange(len(text))
        j = min(len(text), i + rng.randint(1, 12))
        damage = rng.randrange(5)
        if damage == 0:
            text = text[:i] + text[j:]
        elif damage == 1:
            text = text[:j] + text[i:]
        elif damage == 2:
            text = text[:i] + rng.choice("{}[]:,-#&*!|>'\"%@`\t\n\\0é") + text[i:]
        elif damage == 3:
            lines = text.splitlines()
            rng.shuffle(lines)
            text = "\n".join(lines) + "\n"
        else:
            text = text[:i] + rng.choice(["1e400", ".inf", "null", "~", "[]", "{}", "-0", "yes"]) + text[j:]
    return text


def check_text(text: str) -> None:
    """Require either a mission or one InputError."""
    try:
        parse_mission(Document(text, "m.yaml"), VEHICLE)
    except InputError as error:
        line = error.one_line()
    else:
        return
    assert "\n" not in line
    assert "m.yaml" in line


@settings(max_examples=300)
@given(st.integers(0, 2**32))
def test_a_mutated_mission_loads_or_is_refused(seed: int) -> None:
    check_text(_mutate(DUAL, seed))


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(max_size=200))
def test_arbitrary_text_loads_or_is_refused(text: str) -> None:
    check_text(text)


@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_any_value_at_any_key_loads_or_is_refused(data: st.DataObject) -> None:
    tree = yaml.safe_load(DUAL)
    node, trail = tree, list[tuple[Any, Any]]()
    while isinstance(node, dict | list) and node and (not trail or data.draw(st.booleans())):
        key = data.draw(
            st.sampled_from(sorted(node)) if isinstance(node, dict) else st.integers(0, len(node) - 1)
        )
        trail.append((node, key))
        node = node[key]
    parent, key = trail[-1]
    parent[key] = data.draw(trees)
    check_text(yaml.safe_dump(tree, allow_unicode=True))


def test_the_missions_in_the_repository_load() -> None:
    for path in sorted((ROOT / "missions").glob("*.yaml")):
        mission = load_mission(path)
        assert mission.collisions or path.stem in ("hover", "square", "transit", "unknown_room")
