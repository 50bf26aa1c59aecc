"""Campaigns on Dask's workers: the rows of a local run, and lost workers and schedulers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.packages import install_command
from tests.lab.campaign.test_campaign import ROOT, campaign_command, rows

distributed = pytest.importorskip("distributed", reason="needs Dask's distributed, the extra cluster")


def spawn(*command: str) -> subprocess.Popen[bytes]:
    quiet = os.environ | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__WORKER__DAEMON": "true"}
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + command[0], *command[1:]],
        env=quiet, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip


class Cluster:
    """A scheduler and two workers in separate processes."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "scheduler.json"
        listen = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(self._file))
        self.processes = [spawn("dask_scheduler", *listen)]
        until = time.monotonic() + 60.0
        while not self._file.exists() and time.monotonic() < until:
            time.sleep(0.05)
        self.workers = [self._worker(folder / str(i)) for i in range(2)]
        with distributed.Client(scheduler_file=str(self._file), timeout=60, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            self.url = client.scheduler.address

    def _worker(self, folder: Path) -> subprocess.Popen[bytes]:
        folder.mkdir()
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder))
        self.processes.append(spawn("dask_worker", "--scheduler-file", str(self._file), *options))
        return self.processes[-1]

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    try:
        yield made
    finally:
        made.close()


def start_campaign(out: Path, cluster: Cluster, runs: int) -> subprocess.Popen[str]:
    """Start a campaign and return its process after the first row."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dart_flight", *campaign_command(out, runs, "--scheduler", cluster.url)],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )  # fmt: skip
    table, until = out / "flights.csv", time.monotonic() + 120.0
    while process.poll() is None and time.monotonic() < until:
        if table.exists() and table.read_bytes().count(b"\n") > 1:
            break
        time.sleep(0.02)
    return process


def test_rows_equal_those_of_a_local_run_after_a_worker_is_killed(cluster: Cluster, tmp_path: Path) -> None:
    local, remote = tmp_path / "here", tmp_path / "there"
    assert main(campaign_command(local, 8)) == 0
    process = start_campaign(remote, cluster, 8)
    cluster.workers[0].send_signal(signal.SIGKILL)
    _, errors = process.communicate(timeout=300.0)
    assert process.returncode == 0, errors
    assert sorted((remote / "flights.csv").read_bytes().splitlines()) == sorted(
        (local / "flights.csv").read_bytes().splitlines()
    )
    assert {path.parent.name for path in remote.glob("logs/*/flight.mcap")} == {
        path.parent.name for path in local.glob("logs/*/flight.mcap")
    }


def test_ctrl_c_keeps_completed_rows(cluster: Cluster, tmp_path: Path) -> None:
    out = tmp_path / "stopped"
    process = start_campaign(out, cluster, 100)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120.0)
    assert process.returncode == 130, errors
    flown = len(rows(out))
    assert 1 <= flown < 100
    seeds = [int(row["seed"]) for row in rows(out)]
    assert len(set(seeds)) == flown


def test_the_death_of_the_scheduler_ends_the_campaign_in_one_line(cluster: Cluster, tmp_path: Path) -> None:
    out = tmp_path / "orphaned"
    process = start_campaign(out, cluster, 100)
    cluster.processes[0].kill()
    _, errors = process.communicate(timeout=120.0)
    assert process.returncode == 1, errors
    last = "lost connection to the scheduler; completed rows are kept; continue with --resume"
    assert errors.splitlines()[-1].endswith(last)
    assert "Traceback" not in errors
    assert {row["outcome"] for row in rows(out)} <= {"completed", "aborted"}, "an unflown item has no row"


def test_an_unreachable_scheduler_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dart_flight.lab.campaign.cluster._PATIENCE_S", 1.0)
    assert main(campaign_command(tmp_path / "none", 2, "--scheduler", "tcp://127.0.0.1:9")) == 1
    assert "--scheduler tcp://127.0.0.1:9: " in capsys.readouterr().err.splitlines()[-1]


def test_missing_dask_is_reported_with_the_extra_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(campaign_command(tmp_path / "none", 2, "--scheduler", "tcp://127.0.0.1:9")) == 2
    assert install_command("cluster") in capsys.readouterr().err
