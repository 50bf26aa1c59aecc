"""The world of a flight controller in hardware-in-the-loop mode: plant and sensors in real time.

This process and the flight controller do not wait for each other. Ticks follow the host's clock. If a busy
computer misses ticks, they are computed without a pause and reported as one tick (`hitl_link`). After a stall
of more than a quarter of a second, the plant does not catch up, as in the world of the embedded autopilot.
The plant also pauses while an armed flight controller is silent, because a vehicle with constant motor
outputs soon turns over.
"""

from __future__ import annotations

import math
import signal
import time
from typing import IO

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.config.parameter_file import PositionSource
from dart_flight.sim.draws import draw_world
from dart_flight.sim.embedded_autopilot import TICK_S
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.pipe import HitlSpec, LineWriter, Ready, SimulatorDied, SimulatorSpec
from dart_flight.sim.plant import Plant
from dart_flight.sim.px4.bridge import Px4LostError, Px4Vehicle, with_motors
from dart_flight.sim.px4.hitl_link import HitlLink, open_port
from dart_flight.sim.served_world import STALL_S, TerminatedError, WorldLog, raise_terminated, serve

_FIRST_S = 10.0  # longest wait for the first actuator outputs
# Time for PX4's estimator to align and its biases to settle, which arming requires.
_ALIGN_S = {source: 10.0 if source is PositionSource.MOCAP else 20.0 for source in PositionSource}
_ORPHAN_S = 25.0  # time for PX4's failsafe after the end of the app
_SILENT_S = 0.1  # the plant pauses after this time without outputs, which arrive at 200 Hz
_STALL_TICKS = round(STALL_S / TICK_S)


class HitlSimulator:
    """The world of a flight controller, connected to the app's pipe and to the flight controller's port."""

    def __init__(self, spec: SimulatorSpec, hitl: HitlSpec) -> None:
        self._spec, self._hitl = spec, hitl
        self._mission = draw_world(spec.mission, spec.seed, spec.spreads).mission
        self._log = WorldLog(spec.log)
        self._ticks = self._merged = 0
        self._start_s = 0.0
        self._armed = False
        self._link: HitlLink | None = None
        self._still_ticks = 0

    def run(self, commands: IO[bytes], truth: IO[bytes]) -> int:
        """Run until the app has ended and the flight controller has disarmed; return the exit status."""
        signal.signal(signal.SIGTERM, raise_terminated)
        writer, link = LineWriter(truth), None
        status = 0
        try:
            link = HitlLink(open_port(self._hitl.url))
            self._fly(link, writer, commands)
        except TerminatedError:
            self._report("terminated")
        except (FlightError, InputError) as error:
            status = 1
            self._report(str(error))
            writer.put(SimulatorDied(str(error)))
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            if link is not None:
                self._report_totals(link)
                link.close()
            writer.finish()
        return status

    def _report(self, text: str) -> None:
        self._log.write(self._ticks * TICK_S, text)

    def _report_totals(self, link: HitlLink) -> None:
        self._report(
            f"{link.sent} messages sent, {link.dropped} not accepted by the port; {self._merged} of "
            f"{self._ticks} ticks reported late; longest gap between actuator outputs "
            f"{link.longest_gap_s * 1e3:.0f} ms; plant paused for {self._still_ticks * TICK_S * 1e3:.0f} ms; "
            + ("real outputs stayed off" if link.outputs_seen else "real outputs could not be checked")
        )

    def _fly(self, link: HitlLink, writer: LineWriter, commands: IO[bytes]) -> None:
        self._link = link
        mission = self._mission
        if self._hitl.motors is not None:
            mission = with_motors(mission, self._hitl.motors)
        self._vehicle = Px4Vehicle(mission, self._spec.seed, link, self._hitl.position_from)
        self._start_s = time.monotonic()
        end_s = self._start_s + _FIRST_S
        while not link.answered:
            self.advance()
            if time.monotonic() > end_s:
                raise Px4LostError(
                    f"no actuator outputs on {self._hitl.url} within {_FIRST_S:g} s: set SYS_HITL to 1, "
                    "restart the flight controller, and connect to its USB port"
                )
        self._report("the flight controller answers")
        end_s = time.monotonic() + _ALIGN_S[self._hitl.position_from]
        plant, ahead_us = self._vehicle.plant, 0
        while time.monotonic() < end_s:
            self.advance()
            # The truth uses PX4's clock, which is estimated from the outputs with the smallest delay.
            ahead_us = max(ahead_us, link.controls.time_us - self._vehicle.time_us)
        plant.time_offset_us = ahead_us
        writer.put(Ready(self._vehicle.time_us))
        serve(self, writer, commands, math.inf)  # `advance` waits for each tick; a second pace would drift

    # -- as `ServedWorld` --

    def publish_pose(self) -> None:
        """Do nothing: the link to the flight controller carries the poses."""

    @property
    def time_us(self) -> int:
        return self._vehicle.time_us

    def set_horn(self, pulse_us: float) -> None:
        """Set the position of the simulated horn, which a model computes while the real servo moves."""
        self._vehicle.set_horn(pulse_us)

    def begin_fault(self, fault: Fault) -> None:
        """Do nothing: faults are not available with a flight controller."""

    def advance(self) -> Plant:
        """Advance when the next tick is due; if another tick is also due, report both together."""
        late_s = time.monotonic() - (self._start_s + (self._ticks + 1) * TICK_S)
        time.sleep(max(0.0, -late_s))
        behind = int(late_s / TICK_S)
        if behind > _STALL_TICKS:
            self._start_s += behind * TICK_S  # the plant has paused
            self._vehicle.plant.time_offset_us += round(behind * TICK_S * 1e6)
            behind = 0
        self._ticks += 1
        if self._armed and self._link is not None and self._link.silent_s > _SILENT_S:
            self._still_ticks += 1
            self._vehicle.plant.time_offset_us += round(TICK_S * 1e6)
            self._vehicle.stand_still()
            return self._vehicle.plant
        self._merged += behind > 0
        self._vehicle.step(report=behind <= 0)
        if self._vehicle.armed is not self._armed:
            self._armed = self._vehicle.armed
            self._report("PX4 armed" if self._armed else "PX4 disarmed")
        return self._vehicle.plant

    def is_over(self, alone_s: float) -> bool:
        return not self._armed or alone_s > _ORPHAN_S
