"""Property tests of the guard's watches: timeouts and rates of streams, and steps of the estimator."""

from __future__ import annotations

import math
from types import SimpleNamespace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EstimatorSample,
    ImuSample,
    OdometrySample,
    Phase,
    StatusSample,
)
from dart_flight.base.streams import BY_NAME, SAMPLED
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.core.guard.estimator_resets import REACH_US
from dart_flight.core.guard.estimator_watch import (
    ESTIMATOR_BAD_S,
    ESTIMATOR_RULES,
    RESET_POSITION_M,
    RESET_VELOCITY_M_S,
    VELOCITY_JUMP_M_S,
    EstimatorWatch,
)
from dart_flight.core.guard.rule import Rule
from dart_flight.core.guard.second_vehicle import POSITION_JUMP_M
from dart_flight.core.guard.stream_watch import (
    _OTHERS_SINCE,
    ACTUATOR_TIMEOUT_S,
    LINK_LOST_S,
    STATUS_TIMEOUT_S,
    STREAM_RULES,
    StreamWatch,
)
from tests.core.conftest import known

GUARD = load_vehicle(packaged("configs", "dart.yaml")).guard
NOW_US = 2_000_000_000
SAMPLES = {
    "imu": ImuSample(0, 0, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)),
    "attitude": AttitudeSample(0, 0, (1.0, 0.0, 0.0, 0.0)),
    "odometry": OdometrySample(0, 0, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)),
    "actuator": ActuatorSample(0, 0, (0.5,) * 4),
    "status": StatusSample(0, 0),
}
SAMPLED_NAMES = tuple(stream.name for stream in SAMPLED)
ages = st.one_of(st.floats(0.0, 0.6), st.floats(0.0, 7.0), st.floats(900.0, 1900.0))


def details_of(rules: tuple[Rule, ...], **conditions: object) -> dict[str, str]:
    found = {}
    for rule in rules:
        detail = known(rule.condition.cause)(SimpleNamespace(**conditions))
        if detail is not None:
            found[rule.name] = detail
    return found


def watch_with(ages_s: dict[str, float | None], others_since: int = 0) -> StreamWatch:
    """Return a watch of streams whose newest samples have these ages, or None if there is no sample.

    `others_since` is the number of samples of other streams since the newest one of the IMU.
    """
    watch = StreamWatch(GUARD)
    for _ in range(others_since):
        watch.add_sample("attitude", AttitudeSample(0, 0, (1.0, 0.0, 0.0, 0.0)), None)
    watch.state.host_us = NOW_US
    for name, age_s in ages_s.items():
        if age_s is not None:
            received_us = NOW_US - round(1e6 * age_s)
            setattr(watch.state, name, msgspec.structs.replace(SAMPLES[name], received_us=received_us))
    return watch


@given(
    st.fixed_dictionaries({**{name: st.one_of(st.none(), ages) for name in SAMPLED_NAMES}, "status": ages}),
    st.integers(0, 30),
)
def test_a_stream_is_silent_exactly_beyond_its_limit(
    ages_s: dict[str, float | None], others_since: int
) -> None:
    age_of = {name: math.inf if age is None else round(1e6 * age) * 1e-6 for name, age in ages_s.items()}
    imu_s = GUARD.imu_timeout_s if others_since >= _OTHERS_SINCE else GUARD.stream_timeout_s
    expected = {
        "link_lost": min(age_of[name] for name in ("imu", "attitude", "odometry", "status")) > LINK_LOST_S,
        "imu_silent": age_of["imu"] > imu_s,
        "attitude_silent": age_of["attitude"] > GUARD.stream_timeout_s,
        "odometry_silent": age_of["odometry"] > GUARD.stream_timeout_s,
        "actuator_silent": age_of["actuator"] > ACTUATOR_TIMEOUT_S,
        "status_silent": age_of["status"] > STATUS_TIMEOUT_S,
    }
    found = details_of(STREAM_RULES, streams=watch_with(ages_s, others_since))
    assert set(found) == {name for name, silent in expected.items() if silent}
    for name in found:
        if name in ("link_lost", "status_silent"):
            assert found[name].endswith(" s")
        else:
            stream = name.removesuffix("_silent")
            assert found[name] == f"no data for {min(age_of[stream], 999.0) * 1e3:.0f} ms"


@pytest.mark.parametrize(("others_since", "silent"), [(_OTHERS_SINCE - 1, False), (_OTHERS_SINCE, True)])
def test_the_imu_is_silent_sooner_if_other_streams_continue(others_since: int, silent: bool) -> None:
    ages_s = dict.fromkeys((*SAMPLED_NAMES, "status"), 0.0) | {
        "imu": 0.5 * (GUARD.imu_timeout_s + GUARD.stream_timeout_s)
    }
    found = details_of(STREAM_RULES, streams=watch_with(dict(ages_s), others_since))
    assert list(found) == ["imu_silent"] * silent


@given(st.sampled_from(SAMPLED_NAMES), st.integers(1, 400), st.integers(0, 2**40))
def test_the_rate_of_a_stream_comes_from_its_stamps_over_a_second(
    name: str, step_ms: int, start_us: int
) -> None:
    watch, item = StreamWatch(GUARD), SAMPLES[name]
    kind = type(item)
    fields = {f: getattr(item, f) for f in item.__struct_fields__ if f not in ("t_us", "received_us")}
    for i in range(2200 // step_ms + 2):
        t_us = start_us + 1000 * step_ms * i
        watch.add_sample(name, kind(t_us=t_us, received_us=t_us, **fields), None)  # type: ignore[arg-type]
    assert watch.rates_hz[name] == pytest.approx(1000.0 / step_ms, rel=1e-9)
    watch.state.host_us = start_us
    needed = BY_NAME[name].expected_hz
    found = details_of(tuple(r for r in STREAM_RULES if r.name == "stream_rate"), streams=watch)
    assert ("stream_rate" in found) is (1000.0 / step_ms < needed)


@given(
    st.floats(0.0, 1.0),
    st.floats(0.0, 3.0),
    st.booleans(),
    st.booleans(),
    st.floats(0.0, 0.5),
    st.floats(0.0, 1.0),
)
def test_estimator_rules_depend_on_the_step_and_pause_after_impacts(
    away_m: float, faster_m_s: float, counted: bool, excused: bool, after_s: float, invalid_s: float
) -> None:
    """Position and velocity step between two samples, perhaps with a reset count or PX4's flag."""
    watch, t_us = EstimatorWatch(), 10_000_000

    def step(item: OdometrySample | None, now_us: int, position_ok: bool = True) -> dict[str, str]:
        watch.begin(now_us, excused)
        if item is not None:
            watch.add_odometry(item)
        watch.finish(position_ok)
        return details_of(ESTIMATOR_RULES, estimator=watch)

    watch.begin(t_us, excused)
    watch.add_report(EstimatorSample(t_us, t_us, reset_counter=1), Phase.TRANSIT)
    assert step(OdometrySample(t_us, t_us, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), t_us) == {}
    later_us = t_us + 20_000
    moved_m = away_m + 0.5 * 0.02 * faster_m_s  # the mean of the two velocities explains the second part
    item = OdometrySample(later_us, later_us, (moved_m, 0.0, 0.0), (faster_m_s, 0.0, 0.0))
    found = step(item, later_us)
    if abs(away_m - POSITION_JUMP_M) > 1e-9 and not excused:
        assert ("estimator_jump" in found) is (away_m > POSITION_JUMP_M or faster_m_s > VELOCITY_JUMP_M_S)
    if counted:
        watch.add_report(EstimatorSample(later_us, later_us, reset_counter=2), Phase.TRANSIT)
    found = step(None, later_us + round(1e6 * after_s))
    assert "estimator_jump" not in found
    near = counted and round(1e6 * after_s) <= REACH_US
    if abs(away_m - RESET_POSITION_M) > 1e-9:
        stepped = away_m > RESET_POSITION_M or faster_m_s > RESET_VELOCITY_M_S
        assert ("estimator_reset" in found) is (near and stepped and not excused)
    begin_us = later_us + 1_000_000
    assert step(None, begin_us, position_ok=False) == {}
    lasting_us = round(1e6 * invalid_s)
    found = step(None, begin_us + lasting_us, position_ok=False)
    assert ("estimator_flags" in found) is (not excused and lasting_us * 1e-6 > ESTIMATOR_BAD_S)
    assert step(None, begin_us + lasting_us + 1, position_ok=True) == {}
