"""Raw motor outputs of any type are decoded to PX4's throttle."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.motor_outputs import (
    DSHOT,
    PWM,
    SHARE,
    UAVCAN,
    MotorOutputDecoder,
    OutputScale,
    identify_scale,
)

THROTTLE = st.floats(0.0, 1.0)


@pytest.mark.parametrize("scale", [PWM, DSHOT, UAVCAN])
@given(flown=st.lists(st.tuples(*[THROTTLE] * 4), min_size=1, max_size=20))
def test_throttle_is_decoded_from_any_output_type(scale: OutputScale, flown: list[tuple[float, ...]]) -> None:
    decoder = MotorOutputDecoder(4)
    # Before take-off, every motor spins up past a quarter of its range.
    for share in (0.02, 0.3):
        decoder.decode([scale.stop + share * (scale.full - scale.stop)] * 4, airborne=False)
    for throttles in flown:
        raw = [scale.stop + u * (scale.full - scale.stop) for u in throttles]
        assert decoder.decode([*raw, 1500.0], airborne=True) == pytest.approx(throttles, abs=1e-6)
    assert decoder.scale is scale


@given(st.lists(st.none() | st.floats(-300.0, 9000.0), max_size=8), st.booleans())
def test_decoding_returns_a_throttle_or_a_reason(raw: list[float | None], airborne: bool) -> None:
    found = MotorOutputDecoder(4).decode(raw, airborne)
    if not isinstance(found, str):
        assert len(found) == 4
        assert all(0.0 <= u <= 1.0 for u in found)


@pytest.mark.parametrize(
    ("lowest", "highest", "scale"),
    [
        (900.0, 2100.0, PWM), (110.0, 1999.0, DSHOT), (110.0, 3300.0, UAVCAN), (0.1, 0.9, SHARE),
        (0.0, 0.0, None), (900.0, 65535.0, None),
    ],
)  # fmt: skip
def test_the_output_type_is_identified_from_its_range(
    lowest: float, highest: float, scale: OutputScale | None
) -> None:
    assert identify_scale(lowest, highest) is scale


def test_a_stopped_motor_on_the_ground_identifies_no_output_type() -> None:
    decoder = MotorOutputDecoder(4)
    assert decoder.decode([0.0] * 4, airborne=False) == (0.0,) * 4
    assert decoder.scale is None
