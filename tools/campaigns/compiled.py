"""Comparison of flights with the compiled package and with the source tree, bit for bit.

    make compiled && python -m tools.campaigns.compiled [--seeds N]

It flies all shipped missions with the seeds 1 to N (default 5), and the dual collision in as many drawn
worlds. Each package runs in a separate process. The comparison covers every record with its number, and the
verdict. The program prints a line per flight, and exits with 1 if a flight differs.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import msgspec

from dart_flight.base.records import Record, World
from dart_flight.core.flight_core import FlightCore
from dart_flight.run.fast import FastFlight
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.draws import draw_world, parse_vary

ROOT = Path(__file__).parents[2]
COMPILED = ROOT / "build" / "compiled"
MISSIONS = ("paper_dual_collision", "dual_collision_replan", "dual_collision_stiff", "paper_single_wall")


class Flown(msgspec.Struct, frozen=True):
    """The flights of one package: a digest of records and verdict for each flight, by its name."""

    compiled: bool
    digests: dict[str, str]


def digest(mission_name: str, seed: int, vary: tuple[str, ...] = ()) -> str:
    """Return a digest of every record of a fast flight, in order, and of its verdict."""
    mission = load_flyable(ROOT / "missions" / f"{mission_name}.yaml", None, [])
    world = draw_world(mission, seed, parse_vary(vary, mission.vehicle))
    kept = FlightRecord(mission, World.FAST, seed, None, world.drawn)
    found = hashlib.sha256()

    def observe(record: Record, number: int) -> None:
        found.update(f"{number} {type(record).__name__} ".encode() + msgspec.json.encode(record))
        kept(record, number)

    FastFlight(mission, seed, observe=observe, world=world).run()
    found.update(msgspec.json.encode(kept.build()))
    return found.hexdigest()


def fly(seeds: int) -> Flown:
    """Fly in this process, with the package that it imports."""
    digests = {f"{name} {seed}": digest(name, seed) for name in MISSIONS for seed in range(1, seeds + 1)}
    for seed in range(1, seeds + 1):
        digests[f"{MISSIONS[0]} {seed}, drawn"] = digest(MISSIONS[0], seed, ("all",))
    return Flown(not str(sys.modules[FlightCore.__module__].__file__).endswith(".py"), digests)


def flown_with(package: Path, seeds: int) -> Flown:
    """Return the flights of a process that imports the package from this folder."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(package), str(ROOT)))}
    program = f"from tools.campaigns.compiled import print_digests; print_digests({seeds})"
    done = subprocess.run(
        [sys.executable, "-P", "-c", program], env=environment, cwd=ROOT, stdout=subprocess.PIPE, check=True
    )
    return msgspec.json.decode(done.stdout, type=Flown)


def print_digests(seeds: int) -> None:
    """Fly in this process and print the digests as JSON."""
    print(msgspec.json.encode(fly(seeds)).decode())


def main() -> int:
    """Fly with both packages and compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_args().seeds
    if not COMPILED.exists():
        sys.stderr.write("there is no compiled package: run `make compiled` first\n")
        return 2
    pure, compiled = flown_with(ROOT, seeds), flown_with(COMPILED, seeds)
    if pure.compiled or not compiled.compiled:
        sys.stderr.write("the wrong package was imported\n")
        return 2
    differing = [name for name in pure.digests if pure.digests[name] != compiled.digests[name]]
    for name in pure.digests:
        print(f"{name:32s} {'DIFFERS' if name in differing else 'the same'}")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
