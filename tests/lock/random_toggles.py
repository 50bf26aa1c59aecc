"""Random toggles of the lock with random faults: does it ever report a wrong state?

There are two controllers: the mock in this process, and the serial driver against the emulated Maestro
behind a pseudo-terminal, where every byte is real. Time is simulated in both. After every reading the
reported state is compared with the modelled horn:

* `settled` with feedback and the horn elsewhere: a violation;
* `settled` without feedback and the horn elsewhere: counted, and a violation unless the servo itself has a
  fault, because the controller then reports the commanded position;
* an exception that escapes: a violation.
"""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import msgspec

from dart_flight.base.records import LockPhase, Mode
from dart_flight.config.vehicle import LimitSwitch, LockDriver, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lock.drivers import Driver
from dart_flight.lock.drivers.limit_switch import DriverWithLimitSwitch
from dart_flight.lock.drivers.maestro import MaestroDriver
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import NO_FAULTS, ServoFaults
from tests.lock.rigs import MaestroRig, MockRig

TOGGLES_PER_RIG = 25
SWITCHES = (
    None,
    LimitSwitch(chip="/dev/gpiochip0", rigid_line=23),
    LimitSwitch(chip="/dev/gpiochip0", flexible_line=24),
    LimitSwitch(chip="/dev/gpiochip0", rigid_line=23, flexible_line=24),
)
FAULTS = (
    "none",
    "none",
    "stuck",
    "slow",
    "stalled",
    "unplugged",
    "brown-out",
    "silent switch",
    "noise",
    "errors",
)


class Tally(msgspec.Struct):
    """Counts and violations of a campaign."""

    controller: str
    toggles: int = 0
    polls: int = 0
    refused: int = 0
    settled_with_feedback: int = 0
    settled_without_feedback: int = 0
    wrong_without_feedback: int = 0  # settled (no feedback) with a faulty servo elsewhere
    faults_reported: int = 0
    violations: list[str] = []


def _servo_faults(fault: str, rng: random.Random) -> ServoFaults:
    if fault == "stuck":
        return ServoFaults(stuck=True)
    if fault == "slow":
        return ServoFaults(slow=rng.uniform(1.2, 12.0))
    if fault == "stalled":
        return ServoFaults(stall_fraction=rng.uniform(0.05, 0.95))
    return NO_FAULTS


class RandomMock(MockRig):
    """The mock driver, with random faults."""

    def inject_fault(self, fault: str, rng: random.Random) -> None:
        """Inject a fault that acts now or during the next travel."""
        self.mock.inject(
            MockFaults(
                servo=_servo_faults(fault, rng),
                unplugged=fault == "unplugged",
                brown_out=fault == "brown-out",
                switch_silent=fault == "silent switch",
            )
        )

    def repair(self) -> None:
        """Clear every fault."""
        self.mock.inject(MockFaults())


class RandomMaestro(MaestroRig):
    """The serial driver with modelled limit switches and an emulated controller, with random faults."""

    _plugged, _silent = True, False

    def make_driver(self) -> Driver:
        return DriverWithLimitSwitch(MaestroDriver(self.config), self)

    def read(self) -> tuple[bool | None, bool | None]:
        """Return the states of the modelled limit switches."""
        mode, switch = self.horn(), self.config.limit_switch
        rigid = None if switch is None or switch.rigid_line is None else mode is Mode.RIGID
        flexible = None if switch is None or switch.flexible_line is None else mode is Mode.FLEXIBLE
        return (rigid and not self._silent), (flexible and not self._silent)

    def close(self) -> None:
        """Do nothing: modelled switches hold no resources."""

    def inject_fault(self, fault: str, rng: random.Random) -> None:
        """Inject a fault that acts now or during the next travel."""
        self.controller.set_servo_faults(_servo_faults(fault, rng))
        self._silent = fault == "silent switch"
        if fault == "unplugged":
            self._plugged = False
            self.controller.unplug(power_too=rng.random() < 0.5)
        elif fault == "brown-out":
            self.controller.restart_at(self.t_us + round(rng.uniform(0.0, 0.3) * 1e6))
        elif fault == "noise":
            bursts = (rng.randbytes(rng.randrange(0, 9)) for _ in range(rng.randrange(1, 12)))
            self.controller.add_noise(*bursts)
            self.controller.say(rng.randbytes(rng.randrange(0, 64)))
        elif fault == "errors":
            self.controller.set_errors(rng.randrange(1, 512))

    def repair(self) -> None:
        """Clear every fault."""
        self.controller.set_servo_faults()
        self.controller.restart_at(None)
        self._silent = False
        if not self._plugged:
            self._plugged = True
            self.controller.plug()


RandomRig = RandomMock | RandomMaestro


class _Watch:
    """Steps a session and compares its reported state with the horn."""

    def __init__(self, rig: RandomRig, tally: Tally) -> None:
        self.session, self.rig, self._tally = rig.session, rig, tally
        self.servo_may_be_faulty = False
        self.label = ""

    def run(self, polls: int) -> None:
        for _ in range(polls):
            before = self.session.state
            state = self.rig.run(1e-6 * self.rig.POLL_US)
            self._tally.polls += 1
            self._compare_with_horn(newly=state is not before)

    def _compare_with_horn(self, *, newly: bool) -> None:
        state, tally = self.session.state, self._tally
        if newly and state.phase is LockPhase.FAULT:
            tally.faults_reported += 1
        if state.phase is not LockPhase.SETTLED:
            return
        arrived = self.rig.horn() is state.mode
        if newly:
            tally.settled_with_feedback += state.feedback
            tally.settled_without_feedback += not state.feedback
            tally.wrong_without_feedback += not arrived and not state.feedback
        if not arrived and (state.feedback or not self.servo_may_be_faulty):
            tally.violations.append(f"{self.label}: {state} but the horn is at {self.rig.horn_us():.0f} us")


def run_campaign(controller: str, toggles: int, seed: int) -> Tally:
    """Run random toggles with faults; `controller` is `mock` or `maestro`; `seed` fixes the run."""
    tally = Tally(controller)
    rng = random.Random(f"{controller} {seed}")
    packaged_lock = load_vehicle(packaged("configs", "dart.yaml")).lock
    assert packaged_lock is not None
    while tally.toggles < toggles:
        config = msgspec.structs.replace(
            packaged_lock,
            driver=LockDriver(controller),
            limit_switch=rng.choice(SWITCHES),
            maestro=msgspec.structs.replace(
                packaged_lock.maestro, speed_limit_us_s=rng.choice((0.0, 0.0, 2500.0))
            ),
        )
        with tempfile.TemporaryDirectory() as folder:
            rig = RandomMock(config) if controller == "mock" else RandomMaestro(config, Path(folder))
            session, watch = rig.session, _Watch(rig, tally)
            session.start()
            watch.run(30)
            session.permit(True)
            for _ in range(min(TOGGLES_PER_RIG, toggles - tally.toggles)):
                _toggle(watch, tally, rng)
            rig.free()
    return tally


def _toggle(watch: _Watch, tally: Tally, rng: random.Random) -> None:
    fault = rng.choice(FAULTS)
    tally.toggles += 1
    watch.label = f"{tally.controller} toggle {tally.toggles} ({fault})"
    session = watch.session
    try:
        watch.servo_may_be_faulty |= fault in ("stuck", "slow", "stalled")
        fault_during_travel = rng.random() < 0.5
        if not fault_during_travel:
            watch.rig.inject_fault(fault, rng)
        session.permit(rng.random() < 0.9)
        tally.refused += session.command(rng.choice(tuple(Mode))) is not None
        watch.run(rng.randrange(0, 14))
        if fault_during_travel:
            watch.rig.inject_fault(fault, rng)
        if rng.random() < 0.2:
            session.permit(False)
        if rng.random() < 0.2:
            tally.refused += session.command(rng.choice(tuple(Mode))) is not None
        if rng.random() < 0.1:
            session.release()
        watch.run(rng.randrange(0, 90))
        watch.rig.repair()
        session.permit(True)
        if session.state.phase is LockPhase.FAULT or watch.servo_may_be_faulty:
            # A faulty servo reaches its commanded position only after a healthy travel in both directions.
            watch.run(80)
            for mode in (Mode.FLEXIBLE, Mode.RIGID, Mode.FLEXIBLE):
                session.command(mode)
                watch.run(40)
            watch.servo_may_be_faulty = False
            watch.run(1)
    except Exception as error:
        tally.violations.append(f"{watch.label}: {type(error).__name__}: {error}")
