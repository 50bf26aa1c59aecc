"""The folder in which the commands and the Python blocks of the pages run."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import load_vehicle
from dart_flight.contact.law import Onset
from tests.doubles.synthetic_trials import drop_trial, wall_trial, write_csv
from tests.shared_flights import SharedFlights


@pytest.fixture
def every_package() -> None:
    """Skip a test that needs packages of several extras if one of them is missing."""
    for name in ("scipy", "matplotlib", "jinja2", "ruckig", "foxglove"):
        pytest.importorskip(name, reason="a package of `make install` is missing")


@pytest.fixture(scope="session")
def laboratory(flown: SharedFlights) -> Path:
    """A folder made by `init`, with the files that pages assume: a flight, trials, a list of hits."""
    return flown.once("laboratory", lambda folder: prepare_laboratory(folder / "lab")) / "lab"


def prepare_laboratory(folder: Path) -> None:
    programs = folder.parent / "bin"
    programs.mkdir()
    for name, start in (("dart-flight", "-m dart_flight"), ("python", "")):
        program = programs / name
        program.write_text(f'#!/bin/sh\nexec {sys.executable} {start} "$@"\n')
        program.chmod(0o755)
    assert main(["init", str(folder)]) == 0
    with contextlib.chdir(folder):
        assert main(["dry-run", "missions/single_wall.yaml", "--fast"]) == 0
    (folder / "hits.csv").write_text("mode,normal_m_s,tangential_m_s\nrigid,-1.0,0.5\nflexible,-0.6,0.5\n")
    materials, random = load_vehicle(folder / "configs" / "dart.yaml").materials, np.random.default_rng(1)
    acrylic = materials["acrylic"].coefficients(Mode.FLEXIBLE)
    for i, speed in enumerate((-0.6, -1.2)):
        trial = wall_trial(acrylic, speed, random, tangential_m_s=0.5, with_vertical=True, onset=Onset.LCP)
        write_csv(trial, folder / f"hit_{i}.csv")
    for i, height in enumerate((0.05, 0.2)):
        trial = drop_trial(materials["concrete"].rigid, height, random, onset=Onset.LCP, plane_m=0.2)
        write_csv(trial, folder / f"drop_{i}.csv")
