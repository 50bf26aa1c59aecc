"""Random scripts with random faults, which never make the lock report a wrong state.

They run with the modelled servo, and with the serial driver and an emulated Maestro, where bytes are real.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.records import LockPhase, Mode
from dart_flight.config.vehicle import LimitSwitch, LockConfig, LockStartup
from dart_flight.lock.drivers import Driver
from dart_flight.lock.drivers.limit_switch import DriverWithLimitSwitch
from dart_flight.lock.drivers.maestro import MaestroDriver
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.servo import NO_FAULTS, ServoFaults
from dart_flight.lock.state_machine import DriverReading, LockStateMachine, SetPulse
from tests.lock.conftest import BOTH_SWITCHES, RIGID_SWITCH
from tests.lock.rigs import MaestroRig, MockRig, Rig, Vary

Script = list[tuple[str, object]]


class SwitchedMaestro(MaestroRig):
    """The serial driver with an emulated controller and modelled limit switches."""

    _silent = False

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

    def inject(self, faults: MockFaults) -> None:
        """Replace the active faults; a brown-out happens once."""
        self.controller.set_servo_faults(faults.servo)
        self._silent = faults.switch_silent
        self.controller.restart_at(
            self.t_us + round(MockDriver.BROWN_OUT_S * 1e6) if faults.brown_out else None
        )
        self.controller.unplug()
        if not faults.unplugged:
            self.controller.plug()


fault = st.one_of(
    st.just(MockFaults()),
    st.builds(ServoFaults, slow=st.floats(1.2, 12.0)).map(lambda servo: MockFaults(servo=servo)),
    st.builds(ServoFaults, stall_fraction=st.floats(0.05, 0.95)).map(lambda servo: MockFaults(servo=servo)),
    st.sampled_from(
        [
            MockFaults(servo=ServoFaults(stuck=True)),
            MockFaults(unplugged=True),
            MockFaults(brown_out=True),
            MockFaults(switch_silent=True),
        ]
    ),
)
travel = st.tuples(st.just("travel"), st.sampled_from(Mode))
steps = st.one_of(
    travel,
    travel,
    st.tuples(st.just("command"), st.sampled_from(Mode)),
    st.tuples(st.just("permit"), st.booleans()),
    st.tuples(st.just("inject"), fault),
    st.tuples(st.just("repair"), st.none()),
    st.tuples(st.just("release"), st.none()),
    st.tuples(st.just("run"), st.floats(0.0, 0.7)),
)
serial_steps = st.one_of(
    st.tuples(st.just("noise"), st.lists(st.binary(max_size=8), max_size=11)),
    st.tuples(st.just("garbage"), st.binary(max_size=63)),
    st.tuples(st.just("errors"), st.integers(1, 511)),
    st.tuples(st.just("restart"), st.none()),
)
switches = st.sampled_from(
    [None, BOTH_SWITCHES, RIGID_SWITCH, LimitSwitch(chip="/dev/gpiochip0", flexible_line=24)]
)


def check_state(rig: Rig, *, faulty_servo: bool) -> None:
    """Compare the reported state with the horn. Without feedback, a faulty servo may be anywhere."""
    state = rig.session.state
    assert (state.phase is LockPhase.SETTLED) == (state.settled_us is not None)
    assert (state.mode is None) == (state.phase in (LockPhase.UNKNOWN, LockPhase.FAULT))
    assert state.feedback <= (state.phase is LockPhase.SETTLED)
    if state.phase is LockPhase.SETTLED and (state.feedback or not faulty_servo):
        assert rig.horn() is state.mode
    if state.phase is LockPhase.TRAVELLING:
        assert state.t_us >= rig.t_us - round(rig.config.timeout_s * 1e6)


class Player:
    """Runs a script with a rig, and checks the state at every poll."""

    def __init__(self, rig: MockRig | SwitchedMaestro) -> None:
        self.rig = rig
        self.permitted = self.faulty_servo = False
        rig.session.start()

    def play(self, script: Script) -> None:
        """Execute every step of a script."""
        for action, value in script:
            self.step(action, value)

    def step(self, action: str, value: object) -> None:
        rig, session = self.rig, self.rig.session
        if isinstance(value, Mode):
            before = session.state
            refused = session.command(value)
            if value is Mode.RIGID and not self.permitted and refused is None:
                assert session.state is before  # no new travel has begun
            if action == "travel":
                self.step("run", 0.5)
        elif action == "permit":
            self.permitted = bool(value)
            session.permit(self.permitted)
        elif isinstance(value, MockFaults):
            self.faulty_servo |= value.servo != NO_FAULTS
            (rig.mock if isinstance(rig, MockRig) else rig).inject(value)
        elif action == "repair":  # a repaired servo follows the pulses again after a travel to each end
            repaired = [("inject", MockFaults()), ("permit", True), ("run", 1.6)]
            self.play([*repaired, *(("travel", mode) for mode in (Mode.FLEXIBLE, Mode.RIGID, Mode.FLEXIBLE))])
            self.faulty_servo = False
        elif action == "release":
            session.release()
        elif isinstance(value, float):
            for _ in range(round(value * 1e6 / rig.POLL_US)):
                rig.run(1e-6 * rig.POLL_US)
                check_state(rig, faulty_servo=self.faulty_servo)
        elif isinstance(rig, SwitchedMaestro):
            disturb(rig, action, value)


def disturb(rig: SwitchedMaestro, action: str, value: object) -> None:
    """Disturb the serial line or restart the controller."""
    if isinstance(value, list):
        rig.controller.add_noise(*value)
    elif isinstance(value, bytes):
        rig.controller.say(value)
    elif isinstance(value, int):
        rig.controller.set_errors(value)
    else:
        rig.controller.restart()


@given(
    script=st.lists(steps, max_size=25),
    switch=switches,
    adopt=st.booleans(),
    horn_us=st.floats(1020.0, 1980.0),
)
def test_the_reported_state_of_the_modelled_lock_is_true(
    *, vary: Vary, script: Script, switch: LimitSwitch | None, adopt: bool, horn_us: float
) -> None:
    startup = LockStartup.ADOPT if adopt else LockStartup.HOME
    Player(MockRig(vary(limit_switch=switch, startup=startup), pulse_us=horn_us)).play(script)


@settings(max_examples=20)
@given(
    script=st.lists(steps | serial_steps, min_size=10, max_size=30),
    switch=switches,
    speed_us_s=st.sampled_from([0.0, 2500.0]),
)
def test_the_reported_state_of_a_lock_on_a_serial_line_is_true(
    vary: Vary, script: Script, switch: LimitSwitch | None, speed_us_s: float
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        config = vary(limit_switch=switch, maestro={"speed_limit_us_s": speed_us_s})
        rig = SwitchedMaestro(config, Path(folder))
        try:
            Player(rig).play([("permit", True), *script])
        finally:
            rig.free()


@given(
    events=st.lists(st.tuples(st.sampled_from(["rigid", "flexible", "on", "off"]), st.integers(0, 400_000)))
)
def test_a_rigid_pulse_is_never_sent_without_permission(
    lock_config: LockConfig, events: list[tuple[str, int]]
) -> None:
    machine = LockStateMachine(lock_config)
    t_us, permitted, pulse = 0, False, 1020.0
    for event, elapsed in events:
        t_us += elapsed
        machine.reading(t_us, DriverReading(pulse))
        if event in ("on", "off"):
            permitted = event == "on"
            actions = machine.permit(t_us, permitted)
        else:
            actions = machine.command(t_us, Mode(event))
        for action in actions:
            if isinstance(action, SetPulse):
                assert permitted or action.mode is Mode.FLEXIBLE
                pulse = action.pulse_us
                machine.confirm_sent(t_us, pulse)
        if not permitted and machine.state.phase is LockPhase.TRAVELLING:
            assert machine.state.mode is Mode.FLEXIBLE
