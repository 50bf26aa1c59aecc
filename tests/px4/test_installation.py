"""Finding PX4 in made folders, and the messages if there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.cli import build_parser, main
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged
from dart_flight.sim.px4.installation import ENVIRONMENT, find_install
from tests.command_fixtures import Refuse
from tests.doubles.px4_install import install

MISSION = packaged("missions", "paper_dual_collision.yaml")


def link(place: Path, target: Path) -> Path:
    """Make a symbolic link, and the folders above it."""
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)
    return place


def test_the_search_takes_the_first_place_with_a_px4(tmp_path: Path) -> None:
    named, on_path = install(tmp_path / "named"), install(tmp_path / "elsewhere")
    environ = {"HOME": str(tmp_path / "home"), "PATH": str(tmp_path / "usr" / "bin")}
    environ[ENVIRONMENT] = str(named)
    program = link(tmp_path / "usr" / "bin" / "px4", on_path / "bin" / "px4")
    package, gazebo = install(tmp_path / "opt" / "px4"), install(tmp_path / "opt" / "px4-gazebo")
    build = install(tmp_path / "home" / "PX4-Autopilot" / "build" / "px4_sitl_default")

    def found() -> Path:
        return find_install(None, environ, tmp_path).folder

    assert found() == named
    del environ[ENVIRONMENT]
    assert found() == on_path, "the link is resolved"
    program.unlink()
    assert found() == package
    (package / "bin" / "px4-param").unlink()
    assert found() == gazebo, "an unusable PX4 is passed over"
    (gazebo / "bin" / "px4").unlink()
    assert found() == build


@pytest.mark.parametrize(
    ("made", "named"),
    [
        ("px4", "px4"),
        ("px4", "px4/bin"),
        ("px4", "px4/bin/px4"),
        ("source/build/px4_sitl_sih", "source"),
        ("source/build/px4_sitl_sih", "source/build"),
        ("source/build/px4_sitl_sih", "source/build/px4_sitl_sih"),
        ("unpacked/opt/px4", "unpacked"),
        ("unpacked/opt/px4-gazebo", "unpacked"),
    ],
)
def test_every_kind_of_folder_is_accepted(made: str, named: str, tmp_path: Path) -> None:
    folder = install(tmp_path / made)
    found = find_install(tmp_path / named, {})
    assert (found.program, found.etc, found.folder) == (folder / "bin" / "px4", folder / "etc", folder)


def test_the_links_of_the_packages_are_accepted(tmp_path: Path) -> None:
    """The package px4-gazebo has a script bin/px4-gazebo, and both packages a link in /usr/bin."""
    folder = install(tmp_path / "opt" / "px4-gazebo")
    (folder / "bin" / "px4-gazebo").touch()
    for name in ("px4", "px4-gazebo"):
        program = link(tmp_path / "usr" / name, folder / "bin" / name)
        assert find_install(program, {}).folder == folder


def test_of_several_builds_default_wins_and_then_the_newest(tmp_path: Path) -> None:
    ages = {"px4_sitl_default": 900, "px4_sitl_old": 800, "px4_sitl_sih": 700, "px4_sitl_nolockstep": 10}
    builds = {name: install(tmp_path / "build" / name) for name in ages}
    (tmp_path / "build" / "px4_sitl_allyes").mkdir()  # configured, not built
    for name, age_s in ages.items():
        os.utime(builds[name] / "bin" / "px4", (2e9 - age_s, 2e9 - age_s))
    order = []
    for _ in ages:
        order.append(find_install(tmp_path, {}).folder.name)
        (builds[order[-1]] / "bin" / "px4").unlink()
    assert order == ["px4_sitl_default", "px4_sitl_sih", "px4_sitl_old", "px4_sitl_nolockstep"]


def test_a_missing_part_of_an_install_is_named(tmp_path: Path) -> None:
    folder = install(tmp_path / "px4")
    (folder / "etc/init.d-posix/airframes/10016_none_iris").unlink()
    with pytest.raises(InputError, match="no airframe none_iris"):
        find_install(folder)
    (folder / "etc/init.d-posix/rcS").unlink()
    with pytest.raises(InputError, match="rcS"):
        find_install(folder)
    (folder / "bin/px4-param").unlink()
    with pytest.raises(InputError, match="no bin/px4-param"):
        find_install(folder)
    (folder / "bin/px4").chmod(0o644)
    with pytest.raises(InputError, match="not executable"):
        find_install(folder)


def test_a_wrong_place_is_named_with_its_origin(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no PX4 SITL in this folder"):
        find_install(tmp_path, {})
    with pytest.raises(InputError, match=f"^{ENVIRONMENT}={tmp_path}: no PX4 SITL"):
        find_install(None, {ENVIRONMENT: str(tmp_path)}, install(tmp_path / "root/opt/px4").parents[1])
    with pytest.raises(InputError, match="this file is not PX4's program"):
        find_install(MISSION, {})


def test_without_a_px4_three_lines_say_how_to_get_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unusable = install(tmp_path / "PX4-Autopilot" / "build" / "px4_fmu-v6x")
    install(tmp_path / "PX4-Autopilot" / "build" / "px4_sitl_default").joinpath("bin/px4").chmod(0o644)
    with pytest.raises(InputError, match="bin/px4 is not executable") as caught:
        find_install(None, {"HOME": str(tmp_path)}, tmp_path / "nowhere")
    assert str(unusable) not in str(caught.value)

    def nothing(*_: object) -> None:
        raise caught.value

    monkeypatch.setattr("dart_flight.sim.px4.installation.find_install", nothing)
    assert main(["dry-run", str(MISSION), "--px4"]) == 2
    error, *hints = capsys.readouterr().err.splitlines()[-4:]
    assert error.startswith(
        "no PX4 found: not in $DART_PX4_DIR, on the PATH, in /opt/px4, /opt/px4-gazebo or"
    )
    assert [hint.split(":")[0].strip() for hint in hints] == ["package for Ubuntu", "container", "build"]


def test_a_mission_after_px4_is_named(refusal_of: Refuse) -> None:
    line = refusal_of("dry-run", "--px4", "missions/x.yaml")
    assert "missions/x.yaml is a mission, not a PX4: write it before --px4" in line


@pytest.mark.parametrize("there", [True, False])
def test_the_next_step_is_printed_only_if_there_is_a_px4(there: bool, tmp_path: Path) -> None:
    folder = install(tmp_path / "px4") if there else tmp_path
    call = [sys.executable, "-m", "dart_flight.sim.px4.installation"]
    done = subprocess.run(
        call, env={**os.environ, ENVIRONMENT: str(folder)}, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == int(there)
    assert (str(folder) in done.stdout) is there


def test_a_series_flies_the_px4_that_is_found(tmp_path: Path) -> None:
    """The value goes on to `dry-run`, where an empty text means the search."""
    arguments = build_parser(["series"]).parse_args(["series", "fly", str(tmp_path), "--px4"])
    assert arguments.px4 == ""
