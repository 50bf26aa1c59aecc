"""`dart-flight bringup [MISSION]`: bring up a vehicle on the bench, step by step, and evaluate each step."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from dart_flight.check.bringup import progress
from dart_flight.check.bringup.judgements import StepFinding, StepOutcome
from dart_flight.check.bringup.steps import STEPS, WAIT_S, Bringup
from dart_flight.cli.options import add_driver_option, add_mocap_option, link_of, number, refuse_unwritable
from dart_flight.cli.terminal import emit_json, print_status
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.edit import write_values
from dart_flight.config.mission import load_empty_room, load_mission
from dart_flight.config.state_folder import state_dir
from dart_flight.config.vehicle.configuration import default_config_path
from dart_flight.run.prepare import with_driver, with_mocap
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "mission", nargs="?", metavar="MISSION", help="mission file that specifies the vehicle and the frame"
    )
    parser.add_argument("--connection", metavar="URL", help="the vehicle's link (default: connection.url)")
    parser.add_argument(
        "--state", type=Path, metavar="DIR", help="folder in which progress and records are saved"
    )
    parser.add_argument("--again", action="store_true", help="repeat the steps that have already passed")
    parser.add_argument(
        "--wait",
        type=number(1.0, 600.0),
        default=WAIT_S,
        metavar="S",
        help="timeout for each of your actions (default 60 s)",
    )
    parser.add_argument("--yes", action="store_true", help="do only the steps that need no operator")
    add_driver_option(parser)
    add_mocap_option(parser)


class _Terminal:
    """The operator's terminal; questions are on standard error, so that they do not disturb `--json`."""

    def instruct(self, text: str) -> None:
        print_status(f"  {text}")

    def confirm(self, question: str) -> bool:
        sys.stderr.write(f"  {question} [y/N] ")
        sys.stderr.flush()
        return sys.stdin.readline().strip().lower() in ("y", "yes")


def _write_delay(arguments: argparse.Namespace, source: str | None, delay_ms: float) -> None:
    """Write the poses' measured age to the configuration; on failure, ask the operator to write it."""
    path = Path(source or default_config_path())
    try:
        refuse_unwritable(arguments, path)
        write_values(path, {("mocap", "delay_ms"): delay_ms})
    except InputError as error:
        print_status(f"  set mocap.delay_ms to {delay_ms:g} by hand: {error.one_line()}")
    else:
        print_status(
            f"  wrote mocap.delay_ms {delay_ms:g} into {path}; `parameters --write` sets EKF2_EV_DELAY"
        )


def run(arguments: argparse.Namespace) -> int:
    """Return 0 if no step has failed."""
    load = partial(load_mission, arguments.mission) if arguments.mission else load_empty_room
    mission = load(arguments.config)
    mission = with_mocap(with_driver(mission, arguments.driver), arguments.mocap)
    url = link_of(arguments, mission.vehicle.connection)
    folder = arguments.state or state_dir() / "bringup"
    print_vehicle(mission.flown_vehicle(), arguments)
    record = progress.load_record(folder, mission.flown_vehicle(), url)
    written = progress.save_record(record, folder)
    with LinkLease(url, "bringup") as lease:
        bringup = Bringup(mission, url, _Terminal(), arguments.wait, lease.lock_device)
        try:
            for k, (step, before) in enumerate(zip(STEPS, record.steps, strict=True), start=1):
                print_status(f"{k}. {step.name}: {step.subject}")
                if before.result is StepOutcome.PASS and not arguments.again:
                    print_status(f"  passed on {before.date}")
                    continue
                if arguments.yes and bringup.needs_operator(step):
                    finding = StepFinding(
                        StepOutcome.NEEDS_OPERATOR, "the step needs an operator at the vehicle"
                    )
                else:
                    finding = bringup.do(step)
                delay_ms = finding.measured.get("delay_ms")
                if finding.result is StepOutcome.PASS and isinstance(delay_ms, float):
                    _write_delay(arguments, mission.flown_vehicle().source, delay_ms)
                progress.store_finding(record, step.name, finding)
                written = progress.save_record(record, folder)
                print_status(f"  {finding.result.value}: {finding.message}")
        finally:
            bringup.close()
    print_status(
        "next: `dart-flight parameters` lists the parameters that differ from the measurements, and "
        "`dart-flight parameters --write` writes them"
    )
    if arguments.json:
        emit_json({"steps": record.steps, "vehicle": record.vehicle, "files": [str(p) for p in written]})
    else:
        print_status(*(f"wrote {path}" for path in written))
    return 1 if record.failed else 0
