"""Workers and schedulers that cannot fly a campaign are refused in one line before the first flight."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from dart_flight.cli import main
from dart_flight.recording.about import software_version
from tests.lab.campaign.test_campaign import campaign_command

FIT, OTHER = "tcp://10.0.0.1:4001", "tcp://10.0.0.2:4002"
URL = "tcp://10.0.0.9:8786"
MISSING = ModuleNotFoundError("No module named 'dart_flight'")


class FakeFuture:
    """A future that is finished when it is submitted."""

    def __init__(self, error: Exception | None) -> None:
        self.status, self._error = "error", error

    def done(self) -> bool:
        return True

    def exception(self) -> Exception | None:
        return self._error


class FakeClient:
    """Dask's client as the campaign uses it, with answers from class attributes.

    Each test sets the errors of connection, waiting and scheduler, the answers and versions of workers, and
    the error of a flight.
    """

    connect: Exception | None = None
    waits: Exception | None = None
    scheduler: Exception | None = None
    imports: ClassVar[dict[str, object]] = {}
    versions: ClassVar[dict[str, str]] = {}
    flights: Exception | None = None
    submitted = 0

    def __init__(self, url: str, **_: object) -> None:
        if self.connect is not None:
            raise self.connect

    def wait_for_workers(self, count: int, timeout: float) -> None:
        if self.waits is not None:
            raise self.waits

    def run_on_scheduler(self, function: Callable[..., Any], *_: object) -> None:
        if self.scheduler is not None:
            raise self.scheduler

    def run(
        self, function: Callable[..., Any], *_: object, workers: object = None, on_error: str = "raise"
    ) -> Any:
        if function is importlib.import_module:
            assert on_error == "return"
            return dict(self.imports)
        return {worker: self.versions.get(worker, software_version()) for worker in self.imports}

    def nthreads(self) -> dict[str, int]:
        return dict.fromkeys(self.imports, 1)

    def submit(self, *_: object, **__: object) -> FakeFuture:
        type(self).submitted += 1
        return FakeFuture(self.flights)

    def close(self, timeout: float) -> None:
        pass


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[FakeClient]:
    class Client(FakeClient):
        imports: ClassVar[dict[str, object]] = {FIT: object()}

    fake = SimpleNamespace(Client=Client, __version__="2026.8.0")
    monkeypatch.setitem(sys.modules, "distributed", fake)
    return Client


@pytest.fixture
def campaign(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[], tuple[int, str]]:
    """Return a function that runs a campaign and returns its status and last line; check the other lines."""

    def run() -> tuple[int, str]:
        status = main(campaign_command(tmp_path / "c", 2, "--scheduler", URL))
        lines = capsys.readouterr().err.splitlines()
        assert [line for line in lines[:-1] if not line.startswith(("vehicle: ", "note: "))] == []
        return status, lines[-1]

    return run


@pytest.mark.parametrize(
    ("answer", "version", "message"),
    [
        (MISSING, None, f"worker {OTHER}: ModuleNotFoundError: No module named 'dart_flight'; install"),
        (ImportError("needs\nmsgspec"), None, f"worker {OTHER}: ImportError: needs msgspec; install"),
        (object(), "0.0.9", f"worker {OTHER} has dart-flight 0.0.9: install version {software_version()} on"),
    ],
)
def test_an_unfit_worker_is_reported_with_its_address(
    answer: object,
    version: str | None,
    message: str,
    client: type[FakeClient],
    campaign: Callable[[], tuple[int, str]],
) -> None:
    client.imports = {FIT: object(), OTHER: answer}
    client.versions = {} if version is None else {OTHER: version}
    status, line = campaign()
    assert status == 2
    assert line.startswith(f"--scheduler {URL}: {message}")
    assert client.submitted == 0


def test_a_scheduler_without_dart_flight_is_reported(
    client: type[FakeClient], campaign: Callable[[], tuple[int, str]]
) -> None:
    client.scheduler = MISSING
    status, line = campaign()
    assert (status, client.submitted) == (2, 0)
    assert "No module named 'dart_flight'; install dart-flight" in line
    assert line.endswith("on the scheduler, too")


@pytest.mark.parametrize("where", ["connect", "scheduler"])
def test_an_incompatible_version_of_dask_is_reported(
    where: str, client: type[FakeClient], campaign: Callable[[], tuple[int, str]]
) -> None:
    setattr(client, where, TypeError("identity() got an unexpected\nkeyword argument 'n_workers'"))
    status, line = campaign()
    assert status == 2
    assert (
        "unexpected keyword argument 'n_workers'; this computer uses version 2026.8.0 of the package" in line
    )


@pytest.mark.parametrize(
    ("where", "error"),
    [("connect", TimeoutError("timed out\nafter 30 s")), ("scheduler", TimeoutError("timed out")),
     ("waits", TimeoutError()), ("connect", ConnectionRefusedError("refused"))],
)  # fmt: skip
def test_an_unresponsive_scheduler_is_reported_in_one_line(
    where: str, error: Exception, client: type[FakeClient], campaign: Callable[[], tuple[int, str]]
) -> None:
    setattr(client, where, error)
    status, line = campaign()
    assert status == 1
    assert line.startswith(f"--scheduler {URL}: ")


def test_an_unfit_worker_that_joins_later_writes_no_row(
    client: type[FakeClient], campaign: Callable[[], tuple[int, str]], tmp_path: Path
) -> None:
    client.flights = MISSING
    status, line = campaign()
    assert status == 1
    assert "No module named 'dart_flight'; completed rows are kept; continue with --resume" in line
    assert (tmp_path / "c" / "flights.csv").read_text().count("\n") == 1
