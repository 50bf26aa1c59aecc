"""MAVSDK's messages are logged once; a bad file descriptor is an error only while the link is in use."""

import logging

import pytest

from dart_flight.vehicle import sdk_log

RACE = "Error from async_receive_from: Bad file descriptor"


@pytest.fixture(autouse=True)
def _clear_repeated_messages() -> None:
    with sdk_log.closing():
        pass


@pytest.mark.parametrize(
    ("message", "closing", "level"),
    [
        (RACE, False, logging.ERROR),
        (RACE, True, logging.DEBUG),
        ("Connection send error", True, logging.ERROR),
    ],
)
def test_a_socket_error_is_downgraded_only_while_the_link_closes(
    caplog: pytest.LogCaptureFixture, message: str, closing: bool, level: int
) -> None:
    with caplog.at_level(logging.DEBUG, "dart_flight.mavsdk"):
        if closing:
            with sdk_log.closing():
                assert sdk_log.log_message(3, message, None, 0)
            assert sdk_log.log_message(3, RACE, None, 0)  # afterwards it is an error again
        else:
            assert sdk_log.log_message(3, message, None, 0)
    assert [r.levelno for r in caplog.records] == [level, logging.ERROR][: 1 + closing]


def test_a_repeated_message_is_logged_once_and_at_the_end_with_its_count(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.DEBUG, "dart_flight.mavsdk"):
        for i in range(200):
            assert sdk_log.log_message(3, "Retrying failed", None, 0)
            assert sdk_log.log_message(2, f"Sending again, retries to do: {i}", None, 0)
        assert sdk_log.log_message(2, "Received unknown GPS fix type", None, 0)
        assert len(caplog.records) == 3
        with sdk_log.closing():
            pass
    assert [r.getMessage() for r in caplog.records[3:]] == [
        "Retrying failed (200 times)",
        "Sending again, retries to do: 0 (200 times)",
    ]
