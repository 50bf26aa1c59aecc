"""A folder with a PX4 installation whose program is `fake_px4`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.sim.px4.launch import flight_parameters

ROOT = Path(__file__).parents[2]
_CLIENT = """#!/bin/sh
store={folder}/parameters-$2
case "$3" in
set)
  case " {missing} " in *" $4 "*) echo "ERROR [param] Parameter $4 not found."; exit 0 ;; esac
  value=$5
  case " {stuck} " in *" $4 "*) value=0.0000 ;; esac
  echo "x * $4 [1,2] : $value" >> $store ;;
show)
  echo "Symbols: x = used, + = saved, * = unsaved"
  echo "x   SYS_AUTOSTART [1,2] : 10016"
  sed 's/^/    /; s/$/ [1,2] : 0.0000/' {folder}/known
  test ! -e $store || cat $store
  test ! -e {folder}/booted || cat {folder}/after_boot ;;
esac
"""


def install(
    folder: Path,
    behaviour: str = "fly",
    version: str = "Release 1.16.0",
    *,
    known: Iterable[str] = (),
    missing: str = "",
    stuck: str = "",
    overwritten: str = "",
) -> Path:
    """Write a PX4 installation whose program is `fake_px4`, and return its folder.

    Args:
        folder: folder of the installation.
        behaviour: `fly`, or the fault: `ends`, `stubborn`, `deaf` or `dies`.
        version: version that the program reports.
        known: additional parameters; those of an indoor flight always exist.
        missing: names of parameters that do not exist, separated by spaces.
        stuck: names of parameters that stay 0 when set.
        overwritten: parameter that the start-up script sets to 77.
    """
    (folder / "bin").mkdir(parents=True)
    airframes = folder / "etc" / "init.d-posix" / "airframes"
    airframes.mkdir(parents=True)
    (airframes / "10016_none_iris").touch()
    (airframes.parent / "rcS").touch()
    program = folder / "bin" / "px4"
    program.write_text(
        f"#!/bin/sh\nexport PYTHONPATH={ROOT}\n"
        f'exec {sys.executable} -m tests.doubles.fake_px4 {behaviour} "$@"\n'
    )
    program.chmod(0o755)
    reporter = folder / "bin" / "px4-ver"
    reporter.write_text(f"#!/bin/sh\necho 'HW arch: PX4_SITL'\necho 'PX4 version: {version} (17825792)'\n")
    reporter.chmod(0o755)
    vehicle = load_mission(packaged("missions", "paper_dual_collision.yaml")).vehicle
    names = {*known, *flight_parameters(vehicle, PositionSource.MOCAP)} - set(missing.split())
    (folder / "known").write_text("".join(f"{name}\n" for name in sorted(names)))
    (folder / "after_boot").write_text(f"x * {overwritten} [1,2] : 77\n" if overwritten else "")
    client = folder / "bin" / "px4-param"
    client.write_text(_CLIENT.format(folder=folder, missing=missing, stuck=stuck))
    client.chmod(0o755)
    return folder
