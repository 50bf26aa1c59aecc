"""The plant's end of a flight controller's port: whole messages only, silence, moving outputs."""

from __future__ import annotations

import contextlib
import os
import socket
import time
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
from tests.doubles.scripted_peer import PtyLink

ARMED, DISARMED = 128 | 32, 32
MARK_US = 10**9  # later timestamps mark the test's own messages


def sensor(t_us: int = 0) -> Any:
    return mavlink.MAVLink_hil_sensor_message(t_us, *[0.0] * 13, 0x3F, 0)


def controls(t_us: int, mode: int, *motors: float) -> Any:
    return mavlink.MAVLink_hil_actuator_controls_message(
        t_us, [*motors, *[0.0] * (16 - len(motors))], mode, 0
    )


def shell_answer(*outputs: str) -> list[Any]:
    """Return the answer of PX4's shell to `listener actuator_outputs`, in pieces of 70 bytes."""
    kinds = "".join(f"Instance {k}:\n    noutputs: 4\n    output: [{o}]\n" for k, o in enumerate(outputs))
    text = f"\nTOPIC: actuator_outputs {len(outputs)} instances\n{kinds}pxh> ".encode()
    pieces = [text[i : i + 70] for i in range(0, len(text), 70)]
    return [
        mavlink.MAVLink_serial_control_message(10, 1, 0, 0, len(p), list(p.ljust(70, b"\0"))) for p in pieces
    ]


class FlightControllersEnd:
    """The flight controller's end; it marks its messages because the kernel delivers them with delay."""

    def __init__(self, port: PtyLink, link: HitlLink) -> None:
        self._master, self._link, self._marks = port.fileno(), link, 0
        self._pack, self._parser = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAVLink(None)
        os.set_blocking(self._master, False)

    def send(self, *messages: Any, noise: bytes = b"") -> None:
        """Send messages and wait until the link has read them; the mark is the outputs' timestamp."""
        link, mode = self._link, ARMED if self._link.controls.armed else DISARMED
        for message in messages:
            mode = message.mode if message.get_type() == "HIL_ACTUATOR_CONTROLS" else mode
        self._marks += 1
        mark = controls(self._marks, mode, *([0.5] if mode == ARMED else []))
        os.write(self._master, noise)
        self.send_without_mark(*messages, mark)
        wait_until(link, self._marks)

    def send_without_mark(self, *messages: Any) -> None:
        """Send messages without a mark."""
        os.write(self._master, b"".join(m.pack(self._pack) for m in messages))

    def receive_all(self) -> list[Any]:
        """Return every message since the last call; incomplete messages raise an error."""
        self._marks += 1
        mark, received, end_s = MARK_US + self._marks, list[Any](), time.monotonic() + 10.0
        while not any(m.get_type() == "HIL_SENSOR" and m.time_usec == mark for m in received):
            assert time.monotonic() < end_s
            with contextlib.suppress(BlockingIOError):
                received += self._parser.parse_buffer(os.read(self._master, 65536)) or []
            self._link.send(sensor(mark))
        return [m for m in received if m.get_type() != "HIL_SENSOR" or m.time_usec < MARK_US]

    def receive_kind(self, kind: str) -> list[Any]:
        return [m for m in self.receive_all() if m.get_type() == kind]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Replace the link's clock by one that the test sets, in seconds."""
    now = [100.0]
    monkeypatch.setattr(hitl_link, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.fixture
def cable(clock: list[float]) -> Iterator[tuple[HitlLink, FlightControllersEnd]]:
    port = PtyLink()
    link = HitlLink(open_port(f"serial://{port.device}:921600"))
    yield link, FlightControllersEnd(port, link)
    link.close()
    port.close()


Cable = tuple[HitlLink, FlightControllersEnd]


def test_a_full_port_accepts_whole_messages_or_none(cable: Cable) -> None:
    link, px4 = cable
    received, sent = [], 0
    for _ in range(3):
        before = link.sent, link.dropped
        while link.dropped < before[1] + 5:
            link.send(sensor())
        sent += link.sent - before[0]
        received += px4.receive_all()
    assert link.dropped >= 15
    assert len(received) == sent
    assert {m.get_type() for m in received} == {"HIL_SENSOR"}


def test_the_last_actuator_outputs_are_held(cable: Cable) -> None:
    link, px4 = cable
    assert link.exchange(sensor()) == Controls(0, False, (0.0,) * 16)
    px4.send(controls(4000, DISARMED), controls(8000, ARMED, 0.25))
    for _ in range(2):
        received = link.exchange(sensor())
        assert (received.armed, received.values[:2]) == (True, (0.5, 0.0))
    assert link.answered


def test_garbage_between_messages_is_skipped(cable: Cable) -> None:
    link, px4 = cable
    px4.send(*(controls(4000, ARMED) for _ in range(8)), noise=b"\xfd\x10garbage" * 5)
    assert link.controls.armed


def test_one_second_without_outputs_ends_the_flight_once_px4_has_answered(
    cable: Cable, clock: list[float]
) -> None:
    link, px4 = cable
    clock[0] += 30.0
    link.exchange(sensor())  # no answer yet: PX4 may still boot
    px4.send()
    link.exchange(sensor())
    clock[0] += 0.9
    px4.send()
    link.exchange(sensor())
    clock[0] += 1.01
    with pytest.raises(Px4LostError, match="sent no actuator outputs for 1 s"):
        link.exchange(sensor())


@pytest.mark.parametrize("gap_ms", [60, 80])
def test_a_long_gap_in_px4s_samples_ends_the_flight_only_while_armed(cable: Cable, gap_ms: int) -> None:
    link, px4 = cable
    px4.send_without_mark(controls(2000, DISARMED), controls(902_000, DISARMED), controls(1_000_000, ARMED))
    wait_until(link, 1_000_000)
    assert link.longest_gap_s == pytest.approx(0.9)
    px4.send_without_mark(controls(1_000_000 + gap_ms * 1000, ARMED))
    if gap_ms > 70:
        with pytest.raises(Px4LostError, match="without simulated sensors for 80 ms"):
            wait_until(link, 0)
    else:
        wait_until(link, 1_060_000)


def test_a_stalled_plant_ends_the_flight(cable: Cable, clock: list[float]) -> None:
    link, px4 = cable
    px4.send(controls(4000, ARMED))
    for pause_s in (0.06, 0.004):
        clock[0] += pause_s
        link.exchange(sensor())
    clock[0] += 0.09
    with pytest.raises(Px4LostError, match="without simulated sensors for 90 ms"):
        link.exchange(sensor())


def test_an_unplugged_port_ends_the_flight_with_its_cause() -> None:
    port = PtyLink()
    link = HitlLink(open_port(f"serial://{port.device}:921600"))
    port.close()
    with pytest.raises(Px4LostError, match="lost the port to the flight controller"):
        link.exchange(sensor())
    link.close()


def test_the_link_sends_one_heartbeat_per_second_as_an_onboard_controller(
    cable: Cable, clock: list[float]
) -> None:
    link, px4 = cable
    beats = []
    for _ in range(750):
        link.exchange(sensor())
        clock[0] += 0.004
        beats += px4.receive_kind("HEARTBEAT")
    assert len(beats) == 3
    assert {beat.type for beat in beats} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}


def test_outputs_are_requested_once_px4_answers(cable: Cable, clock: list[float]) -> None:
    link, px4 = cable
    link.exchange(sensor())
    assert not px4.receive_kind("SERIAL_CONTROL")
    px4.send()
    link.exchange(sensor())
    received = px4.receive_all()
    (command,) = [m for m in received if m.get_type() == "COMMAND_LONG"]
    assert (command.command, command.param1, command.param2) == (511, 93.0, 4000.0)
    requests = [bytes(m.data[: m.count]) for m in received if m.get_type() == "SERIAL_CONTROL"]
    assert requests == [b"listener actuator_outputs -n 1\n"]


def arm(px4: FlightControllersEnd, at_rest: list[str], in_flight: list[str]) -> None:
    """Arm PX4; the shell answers before and after arming."""
    px4.send(*shell_answer(*at_rest))
    px4.send(controls(8000, ARMED))
    px4.send(*shell_answer(*in_flight))


def test_the_simulated_outputs_may_move(cable: Cable) -> None:
    link, px4 = cable
    arm(px4, ["900, 900", "1500, 1500"], ["1553, 1553", "1500, 1500"])
    assert link.outputs_seen == 2
    assert not px4.receive_kind("COMMAND_LONG")


@pytest.mark.parametrize("at_rest", [["900, 900", "1000, 1000"], []], ids=["at rest", "never asked at rest"])
def test_other_moving_outputs_disarm_the_vehicle_and_are_named(cable: Cable, at_rest: list[str]) -> None:
    _, px4 = cable
    with pytest.raises(Px4LostError, match=r"is driving real outputs.*PWM_MAIN_FUNC1"):
        arm(px4, at_rest, ["1553, 1553", "1510, 1510"])
    (disarm,) = px4.receive_kind("COMMAND_LONG")
    assert (disarm.command, disarm.param1, disarm.param2) == (400, 0.0, 21196.0)


def wait_until(link: HitlLink, time_us: int) -> None:
    end_s = time.monotonic() + 10.0
    while link.controls.time_us != time_us:
        link.receive()
        assert time.monotonic() < end_s


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
def test_messages_are_exchanged_over_udp(kind: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as px4:
        px4.bind(("127.0.0.1", 0))
        px4.settimeout(5.0)
        port = px4.getsockname()[1] if kind == "udpout" else free_udp_port()
        link = HitlLink(open_port(f"{kind}://127.0.0.1:{port}"))
        pack = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        if kind == "udpin":
            link.send(sensor())  # the peer is still unknown
            assert link.dropped == 1
            px4.sendto(controls(4000, ARMED, 0.5).pack(pack), ("127.0.0.1", port))
            wait_until(link, 4000)
        link.send(sensor(12))
        data, sender = px4.recvfrom(65536)
        (message,) = mavlink.MAVLink(None).parse_buffer(data)
        assert message.time_usec == 12
        px4.sendto(controls(8000, DISARMED).pack(pack), sender)
        wait_until(link, 8000)
        link.close()


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("tcpout://127.0.0.1:5760", "allowed are serial"),
        ("serial:///dev/no-such-port:921600", "No such file"),
        ("rubbish", "allowed are serial"),
    ],
)
def test_an_unusable_port_is_refused_with_its_reason(url: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        open_port(url)
