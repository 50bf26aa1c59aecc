"""Write synthetic trials with sensor noise, as a laboratory would record them, from known coefficients.

python -m tools.synthetic_trials DIR --surface acrylic --mode flexible --wall 0.5 1.0 1.5
python -m tools.synthetic_trials DIR --surface concrete --mode rigid --drop 0.05 0.05 0.05
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.law import Onset
from tests.doubles.synthetic_trials import drop_trial, wall_trial, write_csv


def main() -> None:
    """Write trials of the configuration's coefficients into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--surface", default="acrylic")
    parser.add_argument("--mode", choices=[m.value for m in Mode], default="flexible")
    parser.add_argument("--onset", choices=[o.value for o in Onset], default="lcp")
    events = parser.add_mutually_exclusive_group(required=True)
    events.add_argument("--wall", nargs="+", type=float, metavar="SPEED", help="approach speeds, m/s")
    events.add_argument("--drop", nargs="+", type=float, metavar="HEIGHT", help="heights, m")
    parser.add_argument("--tangential", type=float, default=0.5, help="velocity along the wall, m/s")
    parser.add_argument("--plane", type=float, default=0.0, help="position of the plane in the recording, m")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    vehicle = load_vehicle(packaged("configs", "dart.yaml"))
    c = vehicle.materials[options.surface].coefficients(Mode(options.mode))
    rng = np.random.default_rng(options.seed)
    options.folder.mkdir(parents=True, exist_ok=True)
    for i, size in enumerate(options.wall or options.drop, 1):
        path = options.folder / f"{options.mode}_{i}.csv"
        common = {"onset": Onset(options.onset), "plane_m": options.plane}
        if options.wall:
            trial = wall_trial(
                c, -abs(size), rng, tangential_m_s=options.tangential, with_vertical=True, **common
            )
        else:
            trial = drop_trial(c, size, rng, **common)
        write_csv(trial, path)
        print(path)


if __name__ == "__main__":
    main()
