"""The world of a real PX4: the plant in lockstep with PX4, in a process that starts and stops PX4.

The pipe to the app is the same as for the embedded autopilot (`pipe`). The process ends if it receives
SIGTERM, if PX4 fails or hangs, or if the app ends or closes the pipe; it always stops PX4 first. If PX4 is
armed when the app ends, PX4's failsafe acts first. If the process itself is killed, the kernel kills PX4.
"""

from __future__ import annotations

import math
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO

from dart_flight.base.errors import FlightError
from dart_flight.base.records import TruthSample
from dart_flight.config.document import InputError
from dart_flight.config.parameter_file import PositionSource, Value
from dart_flight.sim.draws import draw_world
from dart_flight.sim.embedded_autopilot import TICK_S
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.lockstep import Lockstep
from dart_flight.sim.pipe import LineWriter, Px4SimulatorSpec, Ready, SimulatorDied, SimulatorSpec
from dart_flight.sim.plant import Plant
from dart_flight.sim.pose_feed import EmulatedMotionCapture
from dart_flight.sim.px4.bridge import HilLink, Px4LostError, Px4Vehicle, with_motors
from dart_flight.sim.px4.installation import find_install
from dart_flight.sim.px4.launch import (
    ONBOARD_PORT,
    Instance,
    Px4,
    Px4Error,
    check_version,
    claim_instance,
    motors_from,
    values_of,
)
from dart_flight.sim.px4.relay import Relay
from dart_flight.sim.served_world import TerminatedError, WorldLog, raise_terminated, serve

SENDER_LAG_US = 16_000  # PX4 sends MAVLink in a separate thread, which sleeps in simulated time
_BOOT_TIMEOUT_S = 15.0
# Simulated time for the EKF to align after booting; it passes as fast as the computer allows.
_WARM_UP_S = {source: 6.0 if source is PositionSource.MOCAP else 15.0 for source in PositionSource}
_ORPHAN_S = 25.0  # host time for the failsafe after the app's end; with PX4's end, the total is below 30 s
_LANDED_S = 1.0  # host time after disarming for PX4 to write its log


class Px4Simulator:
    """The world of a real PX4, connected to the app's pipe and to PX4's sockets."""

    def __init__(self, spec: SimulatorSpec, px4: Px4SimulatorSpec) -> None:
        self._mission = draw_world(spec.mission, spec.seed, spec.spreads).mission
        self._spec, self._px4_spec = spec, px4
        self._log = WorldLog(spec.log)
        self._ticks = 0
        self._armed = False
        self._version: tuple[int, int, int] | None = None
        self._set: dict[str, Value] = {}
        self._disarmed_at_s: float | None = None
        self._mocap: EmulatedMotionCapture | None = None

    def run(self, commands: IO[bytes], truth: IO[bytes]) -> int:
        """Run PX4 until the app has ended and the vehicle has landed; return the exit status."""
        signal.signal(signal.SIGTERM, raise_terminated)
        px4: Px4 | None = None
        instance: Instance | None = None
        status = 0
        writer: LineWriter | None = None
        try:
            instance = claim_instance()
            # Start PX4 before any thread: the kernel kills PX4 when the thread that started it ends.
            px4 = Px4(find_install(self._px4_spec.directory), instance.number, Path(self._px4_spec.folder))
            self._report(f"PX4 instance {instance.number}, process {px4.pid}")
            self._prepare(px4)
            writer = LineWriter(truth)
            self._fly(px4, HilLink(px4.wait_connected(instance.listen())), writer, commands)
        except TerminatedError:
            self._report("terminated")
        except (FlightError, InputError) as error:
            status = 1
            cause = self._cause(px4, error)
            self._report(cause)
            writer = writer or LineWriter(truth)
            writer.put(SimulatorDied(cause))
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            if px4 is not None:
                px4.stop()
                kept = px4.keep_log()
                self._report(f"PX4 stopped, its log: {kept.name if kept else 'none'}")
            if instance is not None:
                instance.release()
            if self._mocap is not None:
                self._mocap.close()
            if writer is not None:
                writer.finish()
        return status

    @staticmethod
    def _cause(px4: Px4 | None, error: Exception) -> str:
        """Return how the PX4 process ended, or the text of the error if the process still runs."""
        if px4 is not None and isinstance(error, Px4LostError):
            time.sleep(0.05)  # wait for the process to exit
            return px4.ending() or str(error)
        return str(error)

    def _report(self, text: str) -> None:
        self._log.write(self._ticks * TICK_S, text)

    def _prepare(self, px4: Px4) -> None:
        """Check PX4's version and set its parameters while PX4 waits for the simulator."""
        px4.wait_waiting()
        self._version = px4.version()
        note = check_version(self._version, self._px4_spec.directory)
        if note is not None:
            self._report(note)
        self._set = px4.set_parameters(self._px4_spec.parameters)
        left_out = [name for name in self._px4_spec.parameters if name not in self._set]
        self._report(
            f"{len(self._set)} parameters set and read back"
            + (f"; this version has no {', '.join(left_out)}" if left_out else "")
        )

    # -- flight --

    def _fly(self, px4: Px4, link: HilLink, writer: LineWriter, commands: IO[bytes]) -> None:
        motors = motors_from(values_of(self._px4_spec.parameters), self._mission.vehicle)
        self._vehicle = Px4Vehicle(
            with_motors(self._mission, motors),
            self._spec.seed,
            link,
            self._px4_spec.position_from,
            sends_poses=self._spec.mocap is None,
        )
        if self._spec.mocap is not None:
            self._mocap = EmulatedMotionCapture(self._spec.mocap, self._spec.mission, self._vehicle.plant)
        self._boot(px4)
        text = ".".join(map(str, self._version)) if self._version else None
        self._free_run(_WARM_UP_S[self._px4_spec.position_from])
        self._report("ready")
        port = ONBOARD_PORT + px4.instance
        lockstep, wake = None, []
        if self._spec.lockstep:
            (app_port,) = self._spec.ports
            relay = Relay(port, app_port)
            port, wake = app_port, [relay.wake]
            lockstep = Lockstep(
                relay,
                answers_at_rest=False,
                waits_at_first=False,
                sender_lag_us=SENDER_LAG_US,
                log=self._report,
            )
        mocap_url = self._mocap.url if self._mocap is not None else None
        writer.put(Ready(self._vehicle.time_us, port, text, px4.pid, mocap_url))
        begun = time.monotonic()
        ticks = serve(self, writer, commands, self._spec.speed, lockstep, wake)
        factor = ticks * TICK_S / (time.monotonic() - begun)
        self._report(
            f"flown at {factor:.2f} times real time; "
            f"the accelerometer clipped in {self._vehicle.clipped} ticks"
        )

    def _boot(self, px4: Px4) -> None:
        """Advance the world while PX4 boots, then check that its start-up script kept the parameters."""
        deadline = time.monotonic() + _BOOT_TIMEOUT_S
        while not px4.booted():
            self._free_run(0.2)
            if time.monotonic() > deadline:
                raise Px4Error(f"PX4 did not boot within {_BOOT_TIMEOUT_S:g} s, see {px4.console}")
        asking = ThreadPoolExecutor(1)
        answer = asking.submit(px4.parameters)
        asking.shutdown(wait=False)
        while not answer.done():
            self._free_run(0.02)
            if time.monotonic() > deadline:
                raise Px4Error("PX4 does not report its parameters after booting")
        px4.check_parameters(self._set, answer.result())

    def _free_run(self, seconds: float) -> None:
        """Advance the world as fast as PX4 answers, without reports to the app."""
        for _ in range(round(seconds / TICK_S)):
            self._vehicle.step()
            self._ticks += 1

    @property
    def time_us(self) -> int:
        return self._vehicle.time_us

    def set_horn(self, pulse_us: float) -> None:
        self._vehicle.set_horn(pulse_us)

    def begin_fault(self, fault: Fault) -> None:
        """Begin a motion-capture fault; other faults are not available with a real PX4."""
        if self._mocap is not None:
            self._report(f"fault {fault.name} {fault.value:g}")
            self._mocap.feed.begin_fault(fault, self._vehicle.plant.time_s)

    def publish_pose(self) -> int | None:
        if self._mocap is None:
            return None
        return self._mocap.publish(self._vehicle.plant.time_s, self._vehicle.pose)

    def advance(self) -> Plant:
        self._vehicle.step()
        self._ticks += 1
        plant = self._vehicle.plant
        if self._vehicle.armed is not self._armed:
            self._armed = self._vehicle.armed
            self._disarmed_at_s = None if self._armed else time.monotonic()
            self._report("PX4 armed" if self._armed else f"PX4 disarmed at {_format_position(plant.truth())}")
        return plant

    def is_over(self, alone_s: float) -> bool:
        """Return whether PX4 has disarmed after its failsafe."""
        if not alone_s and self._armed:
            self._report("app disconnected; PX4 continues until its failsafe acts")
        if alone_s > _ORPHAN_S:
            self._report(f"PX4 has not landed within {_ORPHAN_S:g} s of the app's end")
            return True
        down_s = math.inf if self._disarmed_at_s is None else time.monotonic() - self._disarmed_at_s
        return not self._armed and down_s > _LANDED_S


def _format_position(truth: TruthSample) -> str:
    x, y, z = truth.position_mission
    return f"({x:.2f}, {y:.2f}, {z:.2f})"
