"""The parts of tools/arm64.py that need no emulator."""

from __future__ import annotations

import subprocess
import sys

from tools import arm64


def test_pip_goes_where_this_machine_goes_but_not_into_its_folders() -> None:
    listed = (
        ":env:.cert='/etc/a.pem'\n"
        ":env:.index-url='https://near.example/simple'\n"
        "global.cert='/etc/b.pem'\n"
        "global.extra-index-url='file:///opt/here https://far.example/simple'\n"
        "global.find-links='/opt/wheels'\n"
        "install.no-deps='true'\n"
    )
    assert arm64.pip_settings(listed) == {
        "PIP_CERT": "/etc/a.pem",
        "PIP_INDEX_URL": "https://near.example/simple",
        "PIP_EXTRA_INDEX_URL": "https://far.example/simple",
    }
    assert arm64.pip_settings("") == {}


def test_what_was_compiled_is_told_by_its_tag() -> None:
    packages = arm64.installed(
        "mavsdk 4.1.1 py3-none-manylinux_2_28_aarch64\n"
        "pyyaml 6.0 cp313-cp313-manylinux_2_17_aarch64,cp313-cp313-linux_aarch64\n"
        "rich 14.0 py3-none-any\n"
        "old 1.0 \n"
    )
    assert packages[2] == ("rich", "14.0", "py3-none-any")
    assert arm64.compiled(packages) == ["pyyaml", "old"]


def test_the_packages_are_listed_by_a_program_that_runs() -> None:
    done = subprocess.run([sys.executable, "-c", arm64.PACKAGES], capture_output=True, text=True, check=True)
    assert "numpy" in {name for name, _, _ in arm64.installed(done.stdout)}
    assert subprocess.run(["sh", "-n", "-c", arm64.SYSTEM], check=False).returncode == 0


def test_the_page_has_the_end_of_the_installation_and_no_address() -> None:
    text = "\n".join(f"line {i}" for i in range(40)) + "\nGet:1 http://mirror.example/debian trixie\n"
    install = arm64.Done(arm64.INSTALL, "root", 0, text, 1.0)
    assert arm64.quoted(install).startswith("```\nline 31\n")
    assert arm64.quoted(install).endswith("line 39\nGet:1 ... trixie\n```\n")
    assert arm64.quoted(install._replace(command="dart-flight check")).startswith("```\nline 0\n")
    link = arm64.Done(
        "dart-flight check --connection X", "pi", 0, "go        a: b\nremark    c: d\ngo\n", 1.0
    )
    assert arm64.quoted(link) == "```\nremark    c: d\ngo\n```\n"


def test_calls_that_proot_does_not_know_are_refused_and_others_are_not() -> None:
    # In a process of its own: a filter stays. It needs root or a process that can gain no privilege.
    program = (
        "import ctypes, errno, os\n"
        "from tools.arm64 import refuse_new_calls\n"
        "c = ctypes.CDLL(None, use_errno=True)\n"
        "c.prctl(38, 1, 0, 0, 0)\n"
        "refuse_new_calls()\n"
        "assert os.stat('/').st_mode\n"
        "assert c.syscall(439, -100, b'/', 0, 0) == -1 and ctypes.get_errno() == errno.ENOSYS\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
