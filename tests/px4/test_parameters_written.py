"""The command `parameters` with a real PX4: from the defaults to a go, and back."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import msgspec
import pytest

from dart_flight.check.parameter_setting import load_restored, read_differences, save_previous, write_rows
from dart_flight.check.wanted_parameters import METADATA, RESTART, restart_names, wanted_parameters
from dart_flight.config.parameter_file import load_parameters
from dart_flight.config.vehicle import packaged
from dart_flight.sim.px4.installation import find_install
from dart_flight.vehicle.ground_link import GroundLink
from tests.px4.real_px4 import MOCAP, SINGLE, vehicle_findings, waiting_px4

pytestmark = pytest.mark.px4


def keep_saved(work: Path, kept: Path) -> None:
    """Copy PX4's parameter file once PX4, which saves up to 2 s late, has written nothing for 3 s."""
    file, before = work / "parameters.bson", -1
    while before != (before := file.stat().st_mtime_ns):
        time.sleep(3.0)
    for saved in work.glob("parameters*.bson"):
        shutil.copy(saved, kept)


def install_with_parameters(px4_dir: Path, kept: Path, folder: Path) -> Path:
    """Create an install that starts PX4 with the kept parameters, like a restart."""
    install = find_install(px4_dir)
    (folder / "bin").mkdir(parents=True)
    for program in install.program.parent.iterdir():
        (folder / "bin" / program.name).symlink_to(program)
    (folder / "etc").symlink_to(install.etc)
    script = folder / "bin" / "px4"
    script.unlink()
    script.write_text(f'#!/bin/sh\ncp {kept}/* .\nexec {install.program} "$@"\n')
    script.chmod(0o755)
    return folder


def test_written_parameters_make_the_vehicle_go_and_can_be_restored(px4_dir: Path, tmp_path: Path) -> None:
    measured = {"mocap.delay_ms": 12.5, "imu.position_m": [0.02, 0.0, -0.01]}
    mission = msgspec.structs.replace(SINGLE, vehicle=SINGLE.vehicle.replace(measured))
    kept = tmp_path / "kept"
    kept.mkdir()
    defaults = load_parameters(packaged("configs", "px4", "simulation.params"))
    with (
        waiting_px4(px4_dir, tmp_path / "first", mission=mission, base=defaults) as url,
        GroundLink(url, 30.0) as link,
    ):
        found = read_differences(link, mission, MOCAP, None)
        named = restart_names(link.read_file(METADATA))
        former = {row.name: row.vehicle for row in found.writable}
        saved = save_previous(found.writable, tmp_path, url, 1)
        assert write_rows(link, found.writable).refused == {}
        keep_saved(tmp_path / "first" / "px4", kept)
    assert {row.name for row in found.rows if row.restart} >= {"EKF2_EV_DELAY", "EKF2_HGT_REF"}
    assert found.restart_source == "the parameter metadata of this PX4"
    # The fallback list for unreadable metadata is that of the newest known version.
    if found.version.startswith("1.18"):
        assert RESTART & set(wanted_parameters(mission, MOCAP)) == named & set(
            wanted_parameters(mission, MOCAP)
        )

    restarted = install_with_parameters(px4_dir, kept, tmp_path / "install")
    with waiting_px4(restarted, tmp_path / "second", mission=mission, base=defaults) as url:
        findings = vehicle_findings(mission, url)
        assert {item for item, f in findings.items() if not f.go} == {"lock_driver"}  # the lock is the mock
        with GroundLink(url, 30.0) as link:
            assert read_differences(link, mission, None, None).writable == []
            restoring = read_differences(link, mission, None, load_restored(saved))
            assert write_rows(link, restoring.writable).refused == {}
            assert {name: link.read_parameters([name])[name] for name in former} == former
