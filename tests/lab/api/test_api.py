"""The package as a library, by `import dart_flight` alone."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import dart_flight
from dart_flight.base.records import Outcome
from dart_flight.cli import main
from dart_flight.config.mission_file import CollisionSpec, GoalSpec, MissionFile, WallSpec
from dart_flight.lab import api
from dart_flight.recording.schema import RECORD_TYPES
from tests.extras import needs_ruckig
from tests.lab.search.test_quickest import scenario_between_walls
from tests.shared_flights import SharedFlights

SINGLE = dart_flight.packaged("missions", "paper_single_wall.yaml")
DUAL = dart_flight.packaged("missions", "paper_dual_collision.yaml")


@pytest.fixture(scope="module")
def flight() -> dart_flight.Flight:
    """Return a flight in memory, flown inside an event loop as in a notebook."""

    async def notebook() -> dart_flight.Flight:
        return dart_flight.simulate(SINGLE, seed=1)

    return asyncio.run(notebook())


# --- names ----------------------------------------------------------------------------------------------


def test_the_package_exports_the_names_of_the_api() -> None:
    assert dart_flight.__all__ == api.__all__
    assert all(getattr(dart_flight, name) is getattr(api, name) for name in dart_flight.__all__)
    assert set(dart_flight.__all__) <= set(dir(dart_flight))
    with pytest.raises(AttributeError, match="simulat"):
        dart_flight.simulat  # noqa: B018


def test_no_module_hides_an_exported_name() -> None:
    """`import dart_flight.plan` would replace the function of that name by the module."""
    folder = Path(dart_flight.__file__).parent
    modules = {path.stem for path in folder.glob("*.py")} | {
        path.name for path in folder.iterdir() if path.is_dir()
    }
    assert not modules & set(dart_flight.__all__)


def test_the_import_loads_no_dependencies() -> None:
    code = "import sys, dart_flight; print(sorted({'numpy', 'msgspec', 'yaml', 'rich'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.rest
def test_a_simulated_flight_needs_no_extra() -> None:
    code = (
        "import sys, dart_flight as d; d.simulate(d.packaged('missions', 'single_wall.yaml')).log.topics;"
        "heavy = {'scipy', 'matplotlib', 'pymavlink', 'mavsdk', 'asyncio', 'pandas'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# --- missions and vehicles without a file ---------------------------------------------------------------


def without_source(mission: dart_flight.Mission) -> dart_flight.Mission:
    """Return a mission without the paths of its files."""
    return msgspec.structs.replace(mission, source="", vehicle_source=None)


MISSIONS = sorted(path for path in SINGLE.parent.glob("**/*.yaml") if path.parent.name != "scenarios")


@pytest.mark.parametrize("path", MISSIONS, ids=lambda path: path.stem)
def test_a_mission_survives_its_dictionary(path: Path) -> None:
    mission = dart_flight.load_mission(path)
    tree = json.loads(json.dumps(mission.to_dict()))
    assert without_source(dart_flight.load_mission(tree)) == without_source(mission)
    assert dart_flight.load_vehicle(mission.vehicle.to_dict()) == mission.vehicle


def trajectory_to(
    begin: tuple[float, ...],
    end: tuple[float, ...],
    velocity: tuple[float, ...],
    begin_velocity: tuple[float, ...] = (0.0, 0.0),
    begin_acceleration: tuple[float, ...] = (0.0, 0.0),
) -> Any:
    """Return a trajectory of two pieces of 1 s that ends at a position and velocity."""
    p, q, v, w, a = (np.array(one) for one in (begin, end, begin_velocity, velocity, begin_acceleration))
    # The final velocity and position are linear in both jerks, with these coefficients.
    shares = np.array([[1.5, 0.5], [7.0 / 6.0, 1.0 / 6.0]])
    jerks = np.linalg.solve(shares, np.stack([w - v - 2.0 * a, q - p - 2.0 * v - 2.0 * a]))
    return {
        "position_m": p.tolist(),
        "velocity_m_s": v.tolist(),
        "acceleration_m_s2": a.tolist(),
        "pieces": [[1.0, *jerk] for jerk in jerks.tolist()],
    }


def every_key() -> dict[str, Any]:
    """Return a mission that sets every key to a value other than its default."""
    vehicle = dart_flight.load_vehicle(dart_flight.packaged("configs", "rigid_cage.yaml")).to_dict()
    vehicle["airframe"]["mass_kg"] = 0.93
    prediction = {
        "t_s": 1.5,
        "position_m": [0.4, -1.1],
        "normal_m_s": -0.6,
        "tangential_m_s": 0.4,
        "peak_force_n": 31.0,
        "contact_time_s": 0.06,
    }
    first = {
        "wall": "near",
        "mode": "rigid",
        "approach": {"normal_m_s": -0.6, "tangential_m_s": 0.4},
        "impact_point_m": [0.25, -1.1],
        "alpha_m_per_n": [0.03, 0.04],
        "peak_limit_n": 60.0,
        "predicted": prediction,
        "trajectory": trajectory_to((0.2, 0.4), (0.3, -1.1), (0.4, -0.6)),
    }
    far = {
        "point_m": [1.65, 0.0],
        "normal": [-1.0, 0.02],
        "length_m": 3.0,
        "material": sorted(vehicle["materials"])[0],
        "given_at": "surface",
        "position_sd_m": 0.13,
        "yaw_sd_deg": 4.3,
    }
    probe = {
        "from_m": [-0.2, 0.3],
        "from_here": True,
        "length_m": 1.2,
        "direction": [-1.0, 0.0],
        "speed_m_s": 0.6,
        "back_m": 0.45,
        "material": far["material"],
    }
    return {
        "version": 1,
        "name": "every key",
        "vehicle": vehicle,
        "frame": {
            "origin": "takeoff",
            "anchored_by": "touch",
            "north_m": 1.0,
            "east_m": -2.0,
            "heading_deg": 30.0,
        },
        "start": {"position_m": [0.1, 0.2], "altitude_m": 1.1},
        "goal": {"position_m": [1.0, -0.5], "capture_radius_m": 0.2, "hold_s": 3.0},
        "bounds_m": {"x": [-2.0, 2.2], "y": [-1.6, 2.0], "z": [0.3, 2.1]},
        "walls": {
            "near": far | {"point_m": [0.8, -1.1], "normal": [0.0, 1.0], "given_at": "centre"},
            "far": far,
            "board": far
            | {"point_m": [-1.4, 1.4], "normal": [1.0, 0.0], "length_m": 0.4, "thickness_m": 0.012},
        },
        "simulated_walls": {
            "unknown": far | {"point_m": [-1.9, 0.0], "normal": [1.0, 0.0], "thickness_m": 0.02}
        },
        "posts": {"pole": {"centre_m": [-1.5, -1.0], "radius_m": 0.05, "material": "acrylic"}},
        "transit_mode": "rigid",
        "collisions": [
            {"wall": "back", "mode": "rigid", "probe": probe},
            {"wall": "side", "mode": "rigid", "probe": probe, "if_met": "back"},
            {"wall": "other", "mode": "rigid", "probe": probe, "if_not_met": "side"},
            first,
            {key: value for key, value in first.items() if key != "trajectory"}
            | {"wall": "far", "impact_point_m": None, "impact_along_m": 0.1}
            | {"alpha_m_per_n": None, "alpha_wall_m_per_n": [0.02, 0.03]},
            {key: value for key, value in first.items() if key not in ("approach", "impact_point_m")}
            | {"trajectory": trajectory_to((0.5, 0.4), (0.3, -1.1), (0.4, -0.6), (0.1, 0.2), (0.0, 0.1))},
        ],
        "waypoints": [
            {"position_m": [0.2, 0.4], "altitude_m": 1.4, "speed_m_s": 0.4, "hold_s": 1.0},
            {"pause": "operator", "timeout_s": 33.0},
            {"position_m": [0.2, 0.1], "after": 1},
            {"position_m": [0.2, 0.2], "after": 1, "if_met": "back"},
            {"position_m": [0.2, 0.3], "after": 1, "if_not_met": "back"},
            {"at_wall": {"wall": "back", "away_m": 0.7, "along_m": 0.3}, "after": 2},
            {"position_m": [0.2, 0.4], "after": 3},
        ],
        "goal_trajectory": trajectory_to((0.4, 0.4), (1.0, -0.5), (0.0, 0.0), (0.3, 0.1), (0.0, 0.1)),
        "limits": {
            "motion": "position",
            "speed_m_s": 2.5,
            "acceleration_m_s2": 2.0,
            "jerk_m_s3": 9.0,
            "closing_m_s": 2.4,
            "sliding_m_s": 2.2,
            "friction_ratio": 3.0,
            "peak_force_n": 120.0,
            "collision_timeout_s": 7.0,
        },
        "predicted": {"goal_miss_m": 0.31},
        "after_impact": "replan",
        "tolerance": {"impact_m_s": 0.2, "peak_force_share": 0.3, "place_m": 0.3},
        "mode_mismatch": "land",
        "standoff_m": 0.4,
        "flown": {
            "software": "0.1.0",
            "digest": "0123abcd",
            "nominal": {
                "outcome": "aborted",
                "uncontrolled": True,
                "time_s": 14.2,
                "max_tilt_deg": 88.0,
                "reason": "tilt: 88 degrees",
            },
            "drawn": {
                "flights": 20,
                "first_seed": 700001,
                "completed": 17,
                "uncontrolled": 1,
                "ended_by": {"tilt": 3},
                "median_time_s": 14.1,
                "max_tilt_deg": 91.0,
            },
            "free_time_s": 15.5,
            "saving_s": 1.4,
        },
    }


def unset_keys(kind: Any, trees: list[Any], above: str) -> list[str]:
    """Return the keys of a section that the trees do not set or set only to their defaults."""
    out = []
    for field in msgspec.structs.fields(kind):
        name = field.encode_name
        values = [tree[name] for tree in trees if name in tree]
        plain = msgspec.to_builtins(field.default) if field.default is not msgspec.NODEFAULT else None
        if not values or (all(value == plain for value in values) and name != "transit_mode"):
            out.append(f"{above}{name}")
        below = [
            v
            for v in (getattr(field.type, "__args__", None) or (field.type,))
            if hasattr(v, "__struct_fields__")
        ]
        nested = [
            v
            for value in values
            for v in (
                value.values()
                if name in ("walls", "simulated_walls", "posts")
                else value
                if isinstance(value, list)
                else [value]
            )
        ]
        for section in below:
            out += unset_keys(section, nested, f"{above}{name}.")
    return out


def test_a_mission_with_every_key_and_its_vehicle_survives_its_dictionary() -> None:
    tree = every_key()
    assert unset_keys(MissionFile, [tree], "") == []
    mission = dart_flight.load_mission(tree)
    reloaded = dart_flight.load_mission(json.loads(json.dumps(mission.to_dict())))
    assert reloaded == mission
    assert (reloaded.vehicle.has_lock, reloaded.vehicle.airframe.mass_kg) == (False, 0.93)
    assert reloaded.standoff_m == 0.4


def test_a_mission_file_may_contain_its_vehicle(tmp_path: Path) -> None:
    text = SINGLE.read_text(encoding="utf-8")
    inline = "vehicle:\n  extends: dart.yaml\n  airframe:\n    mass_kg: 1.4\n"
    path = tmp_path / "mission.yaml"
    (tmp_path / "dart.yaml").write_bytes(dart_flight.packaged("configs", "dart.yaml").read_bytes())
    path.write_text(text.replace("vehicle: ../configs/dart.yaml\n", inline), encoding="utf-8")
    mission = dart_flight.load_mission(path, settings=["airframe.contact_distance_m=0.3"])
    assert mission.vehicle.airframe.mass_kg == 1.4
    assert mission.flown_vehicle().set == ("airframe.contact_distance_m=0.3",)
    path.write_text(path.read_text().replace("mass_kg: 1.4", "mas_kg: 1.4"), encoding="utf-8")
    line = next(i for i, row in enumerate(path.read_text().splitlines(), 1) if "mas_kg" in row)
    with pytest.raises(
        dart_flight.InputError, match=rf"mission.yaml:{line}: vehicle.airframe.mas_kg: unknown key"
    ):
        dart_flight.load_mission(path)


def test_a_dictionary_has_every_key_of_the_file() -> None:
    tree = dart_flight.load_mission(DUAL).to_dict()
    for node, kind in (
        (tree, MissionFile),
        (tree["walls"]["wood"], WallSpec),
        (tree["collisions"][0], CollisionSpec),
        (tree["goal"], GoalSpec),
    ):
        assert set(node) == {field.encode_name for field in msgspec.structs.fields(kind)}


def test_a_wall_survives_its_dictionary_exactly() -> None:
    tree = dart_flight.load_mission(SINGLE).to_dict()
    tree["walls"]["acrylic"] |= {"normal": [-3.0, 0.7], "position_sd_m": 0.13, "yaw_sd_deg": 4.3}
    first = dart_flight.load_mission(tree)
    assert dart_flight.load_mission(first.to_dict()).walls == first.walls


def test_dependent_values_follow_a_replaced_key() -> None:
    mission = dart_flight.load_mission(SINGLE)
    other = mission.replace({"collisions[0].approach.tangential_m_s": -0.5, "vehicle.airframe.mass_kg": 1.5})
    assert mission.collisions[0].impact_point != other.collisions[0].impact_point
    assert (mission.vehicle.airframe.mass_kg, other.vehicle.airframe.mass_kg) == (1.3, 1.5)
    source = other.flown_vehicle()
    assert source.mass_kg == 1.5
    assert source.set == ("airframe.mass_kg=1.5",)
    whole = mission.replace({"vehicle": other.vehicle})
    assert whole.vehicle == other.vehicle
    assert whole.flown_vehicle().source is None, "a replaced vehicle has no source file"
    assert dart_flight.load_mission(SINGLE, settings=["airframe.mass_kg=1.5"]).vehicle == other.vehicle
    assert dart_flight.load_mission(mission, settings=["airframe.mass_kg=1.5"]).vehicle == other.vehicle


def test_numpy_numbers_are_accepted() -> None:
    vehicle = dart_flight.load_vehicle().replace({"airframe.mass_kg": np.float64(1.4)})
    assert vehicle.airframe.mass_kg == 1.4
    goal = dart_flight.load_mission(SINGLE).replace({"goal.position_m": np.array([0.5, 0.9])}).goal
    assert goal.position_m == (0.5, 0.9)


def mission_tree_with(key: str, value: Any) -> dict[str, Any]:
    tree = dart_flight.load_mission(SINGLE).to_dict()
    node = tree
    for part in key.split(".")[:-1]:
        node = node[part]
    node[key.rpartition(".")[2]] = value
    return tree


def mission_with(key: str, value: Any) -> dart_flight.Mission:
    return dart_flight.load_mission(SINGLE).replace({key: value})


def vehicle_with(key: str, value: Any) -> dart_flight.VehicleConfig:
    return dart_flight.load_vehicle().replace({key: value})


def predict_acrylic(mode: str, normal_m_s: list[float]) -> Any:
    return dart_flight.predict(dart_flight.load_vehicle(), "acrylic", mode, normal_m_s)


WRONG: list[tuple[Callable[[], Any], str]] = [
    (
        lambda: dart_flight.load_mission(mission_tree_with("limits.sped", 1)),
        "<dict>: limits.sped: unknown key, did you mean speed_m_s?",
    ),
    (
        lambda: dart_flight.load_mission(mission_tree_with("goal.position_m", [9.0, 9.0])),
        "<dict>: goal.position_m: (9, 9) is outside",
    ),
    (
        lambda: dart_flight.load_mission(mission_tree_with("name", object())),
        "<dict>: name: object is not a value that a file can hold",
    ),
    (lambda: dart_flight.load_mission({"sequence": ["wood"]}), "<dict>: this is a scenario"),
    (lambda: vehicle_with("airframe.mass_kg", -1), "airframe.mass_kg=-1: expected a number"),
    (lambda: vehicle_with("airframe.mas_kg", 1), "airframe.mas_kg=1: unknown key, did you mean mass_kg?"),
    (lambda: vehicle_with("airframe.mass_kg", 8.0), "to hover 8 kg"),
    (lambda: mission_with("collisions[3].mode", "rigid"), "unknown key 3"),
    (lambda: mission_with("vehicle", "dart.yaml"), "vehicle: expected a vehicle configuration"),
    (lambda: dart_flight.simulate(mission_with("limits.peak_force_n", 20.0)), "peak_force_n"),
    (lambda: dart_flight.simulate(SINGLE, vary=["mas"]), "unknown mas, did you mean mass?"),
    (lambda: dart_flight.simulate(SINGLE, fault="wall-mising"), "did you mean wall-missing?"),
    (lambda: predict_acrylic("rigit", [-1.0]), "'rigit' is not allowed"),
    (lambda: predict_acrylic("rigid", [-1.0, 0.5]), "does not approach"),
    (lambda: dart_flight.plan(SINGLE), "this is a mission"),
    (lambda: dart_flight.identify([], mode="rigit"), "'rigit' is not allowed"),
]


@pytest.mark.parametrize(("call", "message"), WRONG, ids=[message for _, message in WRONG])
def test_invalid_input_raises_a_value_error_with_one_line(call: Any, message: str) -> None:
    with pytest.raises(dart_flight.InputError) as caught:
        call()
    assert isinstance(caught.value, ValueError)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- flights --------------------------------------------------------------------------------------------


def test_a_log_in_memory_equals_the_written_log(flight: dart_flight.Flight, flown: SharedFlights) -> None:
    on_disk, path = flown("paper_single_wall", 1)
    assert flight.verdict.log is None
    differing = {"log": None, "mission": flight.verdict.mission}
    assert msgspec.structs.replace(on_disk, **differing) == flight.verdict
    read = dart_flight.read_log(path)
    assert type(read) is type(flight.log)
    assert read.entries == flight.log.entries
    assert read.topics == flight.log.topics


def test_the_verdict_from_the_log_equals_the_flights_verdict(flight: dart_flight.Flight) -> None:
    assert dart_flight.verdict_of(flight.log) == flight.verdict


@pytest.mark.rest
def test_a_log_contains_the_changed_mission(tmp_path: Path) -> None:
    mission = dart_flight.load_mission(SINGLE).replace({"goal.hold_s": 0.5, "name": "changed"})
    flown = dart_flight.simulate(mission, log_dir=tmp_path)
    (path,) = tmp_path.glob("*/flight.mcap")
    read = dart_flight.read_log(path)
    assert "changed" in read.about["mission_text"]
    kept = {key: text for key, text in flown.log.about.items() if not key.startswith("started_")}
    assert kept.items() <= read.about.items()
    assert flown.log.entries == read.entries
    assert flown.verdict.outcome is Outcome.COMPLETED
    assert main(["replay", str(path), "--set", "goal.hold_s=0.5"]) == 0, "the log's text has the change"


@pytest.mark.rest
def test_draws_and_faults_are_simulated() -> None:
    lost, again = (
        dart_flight.simulate(SINGLE, seed=7, vary=vary, fault="imu-dropout@approach")
        for vary in ({"mass": 0.1, "wind_m_s": 0.2}, ["mass=0.1", "wind_m_s=0.2"])
    )
    assert set(lost.verdict.drawn) == {"mass", "wind_north_m_s", "wind_east_m_s"}
    assert again.verdict.drawn == lost.verdict.drawn
    assert lost.verdict.outcome is Outcome.ABORTED
    assert "aborted" in repr(lost)


# --- arrays ---------------------------------------------------------------------------------------------


def test_arrays_have_the_fields_of_the_records(flight: dart_flight.Flight) -> None:
    log = flight.log
    assert "/estimate/force" in log
    assert list(log) == list(log.topics)
    for name in log:
        topic = log[name]
        assert len(topic) == len(topic.t_s) == sum(e.record.topic == name for e in log.entries)
        for field in topic.fields:
            array = topic[field]
            assert len(array) == len(topic)
            for i in {0, len(topic) // 2, len(topic) - 1}:
                value, cell = getattr(topic.records[i], field), array[i]
                if value is None:
                    assert cell is None or np.isnan(cell).all()
                elif isinstance(value, tuple):
                    assert tuple(cell) == value
                else:
                    assert cell == value


def test_times_count_from_the_first_imu_sample(flight: dart_flight.Flight) -> None:
    log = flight.log
    assert log["/in/imu"].t_s[0] == 0.0
    force = log["/estimate/force"]
    assert force.t_s.shape == (len(force),)
    assert force.force_mission.shape == (len(force), 3)
    assert np.allclose(np.diff(force.t_s), 0.004)
    ticks = log["/in/tick"]  # a tick has the time of the record before it
    assert (np.diff(ticks.t_s) >= 0.0).all()
    assert ticks.t_s[-1] > 10.0


def test_a_channel_without_records_is_empty(flight: dart_flight.Flight) -> None:
    for kind in RECORD_TYPES:
        topic = flight.log[kind.topic]
        for name in topic.fields:
            assert len(topic[name]) == len(topic)
    assert flight.log["/in/actuator"].motors.shape[1] == 4
    esc = flight.log["/in/esc"]
    assert (len(esc), esc.rpm.shape) == (0, (0, 0))


def test_an_unknown_name_is_reported_with_the_closest_match(flight: dart_flight.Flight) -> None:
    with pytest.raises(KeyError, match="did you mean /estimate/force"):
        flight.log["/estimate/forces"]
    with pytest.raises(AttributeError, match="did you mean force_mission"):
        flight.log["/estimate/force"].force_misson  # noqa: B018


# --- prediction, plans, identification ------------------------------------------------------------------


def test_a_prediction_equals_the_commands_output(capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = dart_flight.load_vehicle()
    hit = dart_flight.predict(vehicle, "acrylic", "flexible", -1.0, 0.5)
    words = ["predict", "--surface", "acrylic", "--mode", "flexible", "--velocity", "-1.0", "0.5", "--json"]
    assert main(words) == 0
    printed = json.loads(capsys.readouterr().out)
    assert hit._asdict() == {name: printed[name] for name in hit._fields}
    drop = dart_flight.predict_drop(vehicle, "concrete", "rigid", 0.2)
    assert main(["predict", "--surface", "concrete", "--mode", "rigid", "--drop", "0.2", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert drop._asdict() == {name: printed[name] for name in drop._fields}


def test_arrays_of_velocities_give_arrays() -> None:
    vehicle = dart_flight.load_vehicle()
    normal = np.linspace(-2.0, -0.2, 7)
    many = dart_flight.predict(vehicle, "wood", "rigid", normal, 0.3)
    assert many.peak_normal_force_n.shape == (7,)
    for i, speed in enumerate(normal):
        one = dart_flight.predict(vehicle, "wood", "rigid", float(speed), 0.3)
        assert one == pytest.approx([part[i] for part in many], rel=1e-9)
    grid = dart_flight.predict(vehicle, "wood", "rigid", normal[:, None], [0.0, 0.5])
    assert grid.tangential_out_m_s.shape == (7, 2)


@needs_ruckig
def test_the_quickest_plan_of_a_scenario_is_a_mission() -> None:
    found = dart_flight.plan(scenario_between_walls())
    assert [plan.sequence for plan in found.plans] == [("east",), ()]
    assert found.mission.goal_trajectory is not None


def test_a_plan_completes_and_is_written(tmp_path: Path) -> None:
    found = dart_flight.plan(SINGLE.parent / "scenarios" / "one_wall.yaml", top=3)
    assert len(found.plans) == 3
    first = found.plans[0].collisions[0]
    assert found.mission.collisions[0].approach_m_s == (first.normal_m_s, first.tangential_m_s)
    assert dart_flight.simulate(found.mission).verdict.outcome is Outcome.COMPLETED
    written = dart_flight.load_mission(found.write(tmp_path / "second.yaml", rank=2, verify=False))
    assert written.collisions == found.mission_of(2).collisions
    with pytest.raises(dart_flight.InputError, match="expected 1 to 3"):
        found.mission_of(4)


def test_a_plan_uses_the_given_vehicle_and_objective() -> None:
    path = SINGLE.parent / "scenarios" / "one_wall.yaml"
    vehicle = dart_flight.load_vehicle().replace({"airframe.mass_kg": 1.5})
    heavy = dart_flight.plan(dart_flight.load_scenario(path, vehicle), top=1)
    assert heavy.mission.vehicle == vehicle
    gentle, near = (dart_flight.plan(path, objective=o, top=1).plans[0] for o in ("gentlest", "nearest"))
    assert gentle.peak_force_n < near.peak_force_n


@pytest.mark.rest
def test_identify_accepts_flights_logs_and_paths(flight: dart_flight.Flight, flown: SharedFlights) -> None:
    pytest.importorskip("scipy")
    path = flown("paper_single_wall", 1).log  # the same flight
    found, from_file = (dart_flight.identify(source, surface="acrylic") for source in (flight, [path]))
    assert [len(found.trials), list(found.coefficients)] == [1, ["flexible"]]
    assert from_file.coefficients == found.coefficients
    with pytest.raises(dart_flight.InputError, match="no collision with wood"):
        dart_flight.identify(flight.log, surface="wood")


def test_waypoints_follow_the_altitude_and_speed_they_default_to() -> None:
    mission = dart_flight.load_mission(SINGLE.parent / "square.yaml")
    lower = mission.replace({"start.altitude_m": 0.8, "vehicle.flying.transit_speed_m_s": 0.3})
    assert [w.position[2] for w in lower.waypoints[:3] if w.position] == [0.8, 0.8, 1.4]
    assert lower.waypoints[0].speed_m_s == 0.3
    assert lower.waypoints[-1].speed_m_s == 1.0, "a waypoint's own speed is kept"


def test_everything_that_the_package_offers_is_described() -> None:
    """The reference of the manual is built from these docstrings."""
    silent = []
    for name in dart_flight.__all__:
        offered = getattr(dart_flight, name)
        found = {name: offered}
        if isinstance(offered, type):
            own = (base for base in offered.__mro__ if base.__module__.startswith("dart_flight."))
            public = {key: value for base in own for key, value in vars(base).items() if key[0] != "_"}
            found |= {
                f"{name}.{key}": value
                for key, value in public.items()
                if callable(value) or isinstance(value, property)
            }
        silent += [path for path, value in found.items() if not (value.__doc__ or "").strip()]
    assert silent == []
