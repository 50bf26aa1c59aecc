"""What MAVSDK says goes to the log; a socket that complains of being closed is an error only in use."""

import logging

import pytest

from dart_flight.vehicle import sdk_log

RACE = "Error from async_receive_from: Bad file descriptor"


@pytest.mark.parametrize(
    ("message", "closing", "level"),
    [
        (RACE, False, logging.ERROR),
        (RACE, True, logging.DEBUG),
        ("Connection send error", True, logging.ERROR),
    ],
)
def test_only_a_closing_socket_may_complain(
    caplog: pytest.LogCaptureFixture, message: str, closing: bool, level: int
) -> None:
    with caplog.at_level(logging.DEBUG, "dart_flight.mavsdk"):
        if closing:
            with sdk_log.closing():
                assert sdk_log.take(3, message, None, 0)
        else:
            assert sdk_log.take(3, message, None, 0)
        assert sdk_log.take(3, RACE, None, 0)  # afterwards it is an error again
    assert [r.levelno for r in caplog.records] == [level, logging.ERROR]
