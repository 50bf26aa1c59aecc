"""PX4's own package, made by `cpack -G DEB` in the build folder and unpacked into a scratch root."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dart_flight.sim.px4.installation import find_install
from dart_flight.sim.px4.launch import read_version
from tests.accounts import NOBODY, open_to_all
from tests.px4.real_px4 import MISSIONS

pytestmark = pytest.mark.px4


@pytest.fixture(scope="module")
def scratch_root(px4_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder into which the package was unpacked."""
    packages = sorted(px4_dir.glob("px4*.deb"), key=os.path.getmtime)
    if not packages or shutil.which("dpkg") is None:
        pytest.skip(f"no package px4*.deb in {px4_dir}: make one there with `cpack -G DEB`")
    root = tmp_path_factory.mktemp("root")
    subprocess.run(["dpkg", "-x", packages[-1], root], check=True)
    return root


def state_of(folder: Path) -> list[tuple[str, int, int]]:
    """Return name, mode and time of change of everything in a folder."""
    return sorted((str(p), p.lstat().st_mode, p.lstat().st_mtime_ns) for p in (folder, *folder.rglob("*")))


class AccountFlight:
    """A dry-run of another account, which reads everything and writes only into its own folder.

    The interpreter of the tests may be in root's home, so the account keeps the right to read.
    """

    def __init__(self, account: int, folder: Path, px4: Path) -> None:
        folder.mkdir()
        os.chown(folder, account, account)
        open_to_all(folder)
        words = ["setpriv", f"--reuid={account}", f"--regid={account}", "--clear-groups"]
        words += ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]
        words += [sys.executable, "-m", "dart_flight", "dry-run", str(MISSIONS / "single_wall.yaml")]
        words += ["--px4", str(px4), "--speed", "max", "--json"]
        environ = {**os.environ, "HOME": str(folder), "DART_FLIGHT_STATE_DIR": str(folder / "state")}
        environ["PYTHONPATH"] = str(MISSIONS.parent)
        self.folder = folder
        self.process = subprocess.Popen(
            words, cwd=folder, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def verdict(self) -> dict[str, Any]:
        out, error = self.process.communicate(timeout=120.0)
        assert out, error
        answer: dict[str, Any] = json.loads(out)
        return answer

    def instance(self) -> str:
        (log,) = self.folder.glob("flights/*/autopilot.log")
        return log.read_text().partition("PX4 instance ")[2].partition(",")[0]


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None, reason="needs other accounts")
def test_two_accounts_fly_at_once_and_leave_the_installation_as_it_was(
    scratch_root: Path, tmp_path: Path
) -> None:
    before = state_of(scratch_root)
    flights = [AccountFlight(NOBODY - k, tmp_path / str(k), scratch_root) for k in range(2)]
    for flight in flights:
        verdict = flight.verdict()
        assert verdict["outcome"] == "completed", verdict["reason"]
    assert len({flight.instance() for flight in flights}) == 2
    assert state_of(scratch_root) == before
    assert not [path for path in Path("/tmp").glob("px4[-_]*-[0-9]") if path.stat().st_uid >= NOBODY - 1]


def test_a_stripped_program_and_the_gazebo_package_start(scratch_root: Path, tmp_path: Path) -> None:
    """The containers have a stripped program. The Gazebo package adds a script and a link to this script."""
    there = find_install(scratch_root).folder
    folder = shutil.copytree(there, tmp_path / "opt" / "px4-gazebo", symlinks=True)
    if shutil.which("strip") is not None:
        subprocess.run(["strip", folder / "bin" / "px4"], check=True)
        assert (folder / "bin" / "px4").stat().st_size < (there / "bin" / "px4").stat().st_size
    script = folder / "bin" / "px4-gazebo"
    script.write_text('#!/bin/sh\nexec "$(dirname "$(readlink -f "$0")")/px4" "$@"\n')
    (folder / "share" / "gz" / "models").mkdir(parents=True)
    link = tmp_path / "px4-gazebo"
    link.symlink_to(script)
    install = find_install(link, {})
    assert install.folder == folder
    assert read_version(install) is not None
