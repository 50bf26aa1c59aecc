"""The plant's end of a flight controller's port: whole messages or none, silence, outputs that move."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import time
import tty
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.config.document import InputError
from dart_flight.sim.px4 import hitl_link
from dart_flight.sim.px4.bridge import Controls, Px4LostError
from dart_flight.sim.px4.hitl_link import HitlLink, open_port
from tests.doubles.ports import free_udp_port

ARMED, DISARMED = 128 | 32, 32
MARK_US = 10**9  # stamps from here on are the test's own


def sensor(t_us: int = 0) -> Any:
    return mavlink.MAVLink_hil_sensor_message(t_us, *[0.0] * 13, 0x3F, 0)


def controls(t_us: int, mode: int, *motors: float) -> Any:
    return mavlink.MAVLink_hil_actuator_controls_message(
        t_us, [*motors, *[0.0] * (16 - len(motors))], mode, 0
    )


def shell_answer(*outputs: str) -> list[Any]:
    """What PX4's shell says to `listener actuator_outputs`, in pieces of 70 bytes as it comes."""
    kinds = "".join(f"Instance {k}:\n    noutputs: 4\n    output: [{o}]\n" for k, o in enumerate(outputs))
    text = f"\nTOPIC: actuator_outputs {len(outputs)} instances\n{kinds}pxh> ".encode()
    pieces = [text[i : i + 70] for i in range(0, len(text), 70)]
    return [
        mavlink.MAVLink_serial_control_message(10, 1, 0, 0, len(p), list(p.ljust(70, b"\0"))) for p in pieces
    ]


class FlightControllersEnd:
    """The other end. The kernel passes bytes on when it likes, so a mark goes with them."""

    def __init__(self, master: int, link: HitlLink) -> None:
        self._master, self._link, self._marks = master, link, 0
        self._pack, self._parser = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAVLink(None)
        os.set_blocking(master, False)

    def say(self, *messages: Any, noise: bytes = b"") -> None:
        """Send, and wait until the link has taken it; the mark is the outputs' time stamp."""
        link, mode = self._link, ARMED if self._link.controls.armed else DISARMED
        for message in messages:
            mode = message.mode if message.get_type() == "HIL_ACTUATOR_CONTROLS" else mode
        self._marks += 1
        mark = controls(self._marks, mode, *([0.5] if mode == ARMED else []))
        os.write(self._master, noise)
        self.say_bare(*messages, mark)
        until(link, self._marks)

    def say_bare(self, *messages: Any) -> None:
        """Send."""
        os.write(self._master, b"".join(m.pack(self._pack) for m in messages))

    def heard(self) -> list[Any]:
        """Everything since the last time; what is no whole message raises."""
        self._marks += 1
        mark, got, end_s = MARK_US + self._marks, list[Any](), time.monotonic() + 10.0
        while not any(m.get_type() == "HIL_SENSOR" and m.time_usec == mark for m in got):
            assert time.monotonic() < end_s
            with contextlib.suppress(BlockingIOError):
                got += self._parser.parse_buffer(os.read(self._master, 65536)) or []
            self._link.send(sensor(mark))
        return [m for m in got if m.get_type() != "HIL_SENSOR" or m.time_usec < MARK_US]

    def heard_of(self, kind: str) -> list[Any]:
        return [m for m in self.heard() if m.get_type() == kind]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds of the link's clock."""
    now = [100.0]
    monkeypatch.setattr(hitl_link, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.fixture
def cable(clock: list[float]) -> Iterator[tuple[HitlLink, FlightControllersEnd]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = HitlLink(open_port(f"serial://{os.ttyname(slave)}:921600"))
    yield link, FlightControllersEnd(master, link)
    link.close()
    os.close(slave)
    os.close(master)


Cable = tuple[HitlLink, FlightControllersEnd]


def test_a_full_port_takes_whole_messages_or_none(cable: Cable) -> None:
    link, px4 = cable
    heard, sent = [], 0
    for _ in range(3):
        before = link.sent, link.dropped
        while link.dropped < before[1] + 5:
            link.send(sensor())
        sent += link.sent - before[0]
        heard += px4.heard()
    assert link.dropped >= 15
    assert len(heard) == sent
    assert {m.get_type() for m in heard} == {"HIL_SENSOR"}


def test_actuator_outputs_are_parsed_and_the_last_hold(cable: Cable) -> None:
    link, px4 = cable
    assert link.exchange(sensor()) == Controls(0, False, (0.0,) * 16)
    px4.say(controls(4000, DISARMED), controls(8000, ARMED, 0.25))
    for _ in range(2):
        got = link.exchange(sensor())
        assert (got.armed, got.values[:2]) == (True, (0.5, 0.0))
    assert link.answered


def test_garbage_between_messages_is_passed_over(cable: Cable) -> None:
    link, px4 = cable
    px4.say(*(controls(4000, ARMED) for _ in range(8)), noise=b"\xfd\x10garbage" * 5)
    assert link.controls.armed


def test_a_second_without_outputs_ends_it_once_there_were_some(cable: Cable, clock: list[float]) -> None:
    link, px4 = cable
    clock[0] += 30.0
    link.exchange(sensor())  # not answered yet: it may still boot
    px4.say()
    link.exchange(sensor())
    clock[0] += 0.9
    px4.say()
    link.exchange(sensor())
    clock[0] += 1.01
    with pytest.raises(Px4LostError, match="sent no actuator outputs for 1 s"):
        link.exchange(sensor())


@pytest.mark.parametrize("gap_ms", [60, 80])
def test_a_gap_in_px4s_samples_ends_it_only_in_flight(cable: Cable, gap_ms: int) -> None:
    link, px4 = cable
    px4.say_bare(controls(2000, DISARMED), controls(902_000, DISARMED), controls(1_000_000, ARMED))
    until(link, 1_000_000)
    assert link.longest_gap_s == pytest.approx(0.9)
    px4.say_bare(controls(1_000_000 + gap_ms * 1000, ARMED))
    if gap_ms > 70:
        with pytest.raises(Px4LostError, match="without simulated sensors for 80 ms"):
            until(link, 0)
    else:
        until(link, 1_060_000)


def test_a_plant_that_stalls_in_flight_ends_it(cable: Cable, clock: list[float]) -> None:
    link, px4 = cable
    px4.say(controls(4000, ARMED))
    for pause_s in (0.06, 0.004):
        clock[0] += pause_s
        link.exchange(sensor())
    clock[0] += 0.09
    with pytest.raises(Px4LostError, match="without simulated sensors for 90 ms"):
        link.exchange(sensor())


def test_an_unplugged_port_is_a_named_end() -> None:
    master, slave = pty.openpty()
    link = HitlLink(open_port(f"serial://{os.ttyname(slave)}:921600"))
    os.close(master)
    os.close(slave)
    with pytest.raises(Px4LostError, match="port to the flight controller is gone"):
        link.exchange(sensor())
    link.close()


def test_a_heartbeat_once_a_second_of_no_ground_station(cable: Cable, clock: list[float]) -> None:
    link, px4 = cable
    beats = []
    for _ in range(750):
        link.exchange(sensor())
        clock[0] += 0.004
        beats += px4.heard_of("HEARTBEAT")
    assert len(beats) == 3
    assert {beat.type for beat in beats} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}


def test_outputs_are_asked_for_once_it_answers(cable: Cable, clock: list[float]) -> None:
    link, px4 = cable
    link.exchange(sensor())
    assert not px4.heard_of("SERIAL_CONTROL")
    px4.say()
    link.exchange(sensor())
    heard = px4.heard()
    (wanted,) = [m for m in heard if m.get_type() == "COMMAND_LONG"]
    assert (wanted.command, wanted.param1, wanted.param2) == (511, 93.0, 4000.0)
    asked = [bytes(m.data[: m.count]) for m in heard if m.get_type() == "SERIAL_CONTROL"]
    assert asked == [b"listener actuator_outputs -n 1\n"]


def arm(px4: FlightControllersEnd, at_rest: list[str], in_flight: list[str]) -> None:
    """The shell is asked before and after arming."""
    px4.say(*shell_answer(*at_rest))
    px4.say(controls(8000, ARMED))
    px4.say(*shell_answer(*in_flight))


def test_the_simulated_outputs_may_move(cable: Cable) -> None:
    link, px4 = cable
    arm(px4, ["900, 900", "1500, 1500"], ["1553, 1553", "1500, 1500"])
    assert link.outputs_seen == 2
    assert not px4.heard_of("COMMAND_LONG")


@pytest.mark.parametrize("at_rest", [["900, 900", "1000, 1000"], []], ids=["at rest", "never asked at rest"])
def test_other_outputs_that_move_are_disarmed_and_named(cable: Cable, at_rest: list[str]) -> None:
    _, px4 = cable
    with pytest.raises(Px4LostError, match=r"moves real outputs.*PWM_MAIN_FUNC1"):
        arm(px4, at_rest, ["1553, 1553", "1510, 1510"])
    (told,) = px4.heard_of("COMMAND_LONG")
    assert (told.command, told.param1, told.param2) == (400, 0.0, 21196.0)


def until(link: HitlLink, time_us: int) -> None:
    end_s = time.monotonic() + 10.0
    while link.controls.time_us != time_us:
        link.receive()
        assert time.monotonic() < end_s


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
def test_the_same_over_udp(kind: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as px4:
        px4.bind(("127.0.0.1", 0))
        px4.settimeout(5.0)
        port = px4.getsockname()[1] if kind == "udpout" else free_udp_port()
        link = HitlLink(open_port(f"{kind}://127.0.0.1:{port}"))
        pack = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        if kind == "udpin":
            link.send(sensor())  # nobody to send to yet
            assert link.dropped == 1
            px4.sendto(controls(4000, ARMED, 0.5).pack(pack), ("127.0.0.1", port))
            until(link, 4000)
        link.send(sensor(12))
        data, sender = px4.recvfrom(65536)
        (message,) = mavlink.MAVLink(None).parse_buffer(data)
        assert message.time_usec == 12
        px4.sendto(controls(8000, DISARMED).pack(pack), sender)
        until(link, 8000)
        link.close()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("tcpout://127.0.0.1:5760", "allowed are serial"),
        ("serial:///dev/no-such-port:921600", "No such file"),
        ("rubbish", "allowed are serial"),
    ],
)
def test_a_port_that_cannot_be_is_refused_in_words(url: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        open_port(url)
