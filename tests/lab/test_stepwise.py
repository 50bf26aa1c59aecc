"""The stepwise simulation and its Gymnasium environment."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.records import Mode
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.lab.api import Simulation
from dart_flight.lab.stepwise import FlightSetpoint


@pytest.fixture(scope="module")
def mission() -> Mission:
    return load_mission("missions/shuttle.yaml")


@pytest.fixture(scope="module")
def simulation(mission: Mission) -> Simulation:
    return Simulation(mission)


def test_a_reset_hovers_at_the_start_and_equal_seeds_give_equal_flights(simulation: Simulation) -> None:
    flown = []
    for seed in (3, 4, 3):
        first = simulation.reset(seed)
        assert first.time_s == 0.0
        assert np.abs(first.position - (0.0, 0.0, 1.0)).max() < 0.1
        assert not first.is_down
        for _ in range(20):
            observation = simulation.step(FlightSetpoint((0.3, 0.0, 1.0)))
        flown.append(observation)
    assert observation.time_s == pytest.approx(0.4)
    assert np.array_equal(flown[0].position, flown[2].position)
    assert np.array_equal(flown[0].force, flown[2].force)
    assert not np.array_equal(flown[0].position, flown[1].position)


def test_a_step_without_a_setpoint_keeps_the_previous_setpoint(simulation: Simulation) -> None:
    simulation.reset(1)
    simulation.step(FlightSetpoint((0.5, 0.2, 1.2)))
    for _ in range(200):
        observation = simulation.step()
    assert np.abs(observation.position - (0.5, 0.2, 1.2)).max() < 0.1


def test_a_contact_is_counted_and_its_force_is_estimated(simulation: Simulation) -> None:
    observation = simulation.reset(1)
    assert observation.walls.shape == (2, 5)
    assert observation.walls[0, 4] <= observation.walls[1, 4]
    nan = float("nan")
    largest = 0.0
    for _ in range(200):
        observation = simulation.step(FlightSetpoint((nan, nan, 1.0), (0.8, 0.0, nan)))
        largest = max(largest, -observation.force[0])
        if observation.contacts:
            break
    assert observation.contacts == 1
    assert largest > 10.0


def test_the_lock_takes_time_to_switch(simulation: Simulation) -> None:
    assert simulation.reset(1).mode is Mode.RIGID
    modes = [simulation.step(FlightSetpoint((0.0, 0.0, 1.0), mode=Mode.FLEXIBLE)).mode for _ in range(40)]
    assert modes[0] is not Mode.FLEXIBLE
    assert modes[-1] is Mode.FLEXIBLE
    assert None in modes


def test_only_walls_in_view_are_observed(mission: Mission) -> None:
    assert Simulation(mission, view_m=0.5).reset().walls.shape == (0, 5)


@pytest.mark.parametrize("period_s", [0.0, -0.02, 0.006, 1e-9])
def test_a_period_that_is_not_a_multiple_of_a_tick_is_refused(mission: Mission, period_s: float) -> None:
    with pytest.raises(InputError, match=r"expected a positive multiple of 0\.004 s"):
        Simulation(mission, period_s=period_s)


@pytest.mark.rest
def test_the_environment_passes_gymnasiums_checker_and_repeats_by_seed() -> None:
    gymnasium = pytest.importorskip("gymnasium")
    checker = pytest.importorskip("gymnasium.utils.env_checker")
    from dart_flight.lab.gym_shuttle import ShuttleEnv

    environment = gymnasium.make("DartShuttle-v0")
    checker.check_env(environment.unwrapped, skip_render_check=True)
    ends = []
    for _ in range(2):
        environment.reset(seed=5)
        for _ in range(30):
            numbers, *_ = environment.step(np.array([1.0, 0.0, -1.0], np.float32))
        ends.append(numbers)
    assert np.array_equal(ends[0], ends[1])
    assert isinstance(environment.unwrapped, ShuttleEnv)


def test_an_episode_ends_with_a_penalty_outside_of_the_room() -> None:
    pytest.importorskip("gymnasium")
    from dart_flight.lab.gym_shuttle import ShuttleEnv

    environment = ShuttleEnv()
    environment.reset(seed=1)
    for _ in range(200):
        _, reward, terminated, _, _ = environment.step(np.array([0.0, 1.0, 1.0], np.float32))
        if terminated:
            break
    assert terminated
    assert reward < -9.0


@pytest.mark.rest
def test_other_processes_make_the_environment_by_the_name_of_its_module(tmp_path: Path) -> None:
    """A process of a vector environment has not imported the module that registers the task."""
    pytest.importorskip("gymnasium")
    script = tmp_path / "vector.py"
    script.write_text(
        "import gymnasium\n"
        "if __name__ == '__main__':\n"
        "    name = 'dart_flight.lab.gym_shuttle:DartShuttle-v0'\n"
        "    made = gymnasium.make_vec(name, num_envs=2, vectorization_mode='async',\n"
        "                              vector_kwargs={'context': 'spawn'})\n"
        "    print(made.reset(seed=1)[0].shape)\n"
        "    made.close()\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout == "(2, 10)\n", done.stderr
