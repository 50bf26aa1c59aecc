"""An engine that flies a campaign on several machines, through a Dask scheduler (extra `cluster`).

If a worker dies, another worker repeats its flights. If several workers die in the same flight, the scheduler
gives up and reports this flight. The rows equal those of a local run, because a flight depends only on its
mission and seed.
"""

from __future__ import annotations

import importlib
import logging
import time
import warnings
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.config.packages import missing_package
from dart_flight.lab.campaign.campaign_folder import Engine, Landings
from dart_flight.lab.campaign.campaign_spec import Item
from dart_flight.lab.campaign.flight_job import Flown, ItemFlyer
from dart_flight.recording.about import software_version
from dart_flight.run.workers import Failure, FinishedItem, Interrupt, attempt

_TIMEOUT_S = 30.0  # timeout for the scheduler's response and for the connection of the first worker
_POLL_S = 0.05
_END_S = 2.0
_COUNT_S = 5.0  # interval between counts of the scheduler's workers
_ABOUT = "dart_flight.recording.about"
_AHEAD = 2  # submitted flights per thread, so that no thread waits for its next flight


def on_cluster(url: str) -> Engine:
    """Return an engine that flies on the workers of the scheduler at a URL (`tcp://host:8786`)."""
    try:
        import distributed  # noqa: F401, PLC0415
    except ImportError:
        raise missing_package("needs Dask", "cluster", key=("--scheduler",)) from None
    return partial(_work, url)


def _work(url: str, flyer: ItemFlyer, items: Iterable[Item], interrupt: Interrupt) -> Landings:
    """Fly the items on the scheduler's workers; `run.workers.work` does the same in local processes.

    Raises:
        FlightError: the scheduler does not answer or has no worker.
        InputError: a worker cannot fly; no flight has begun.
    """
    client = _connect(url)
    try:
        _refuse_unfit(client, url)
        yield from _hand_out(client, url, flyer, iter(items), interrupt)
    except OSError as error:
        raise FlightError(
            f"--scheduler {url}: {_one_line(error)}; completed rows are kept; continue with --resume"
        ) from None
    finally:
        client.close(timeout=_END_S)


def _connect(url: str) -> Any:
    import distributed  # noqa: PLC0415

    class Client(distributed.Client):  # type: ignore[misc]
        def __del__(self) -> None:
            """Do nothing: `_work` closes the client, and closing an unconnected client takes a minute."""

    for name in ("distributed", "distributed.client"):  # the errors below report the same
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # distributed warns about packages that no flight needs
            return Client(url, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FlightError(f"--scheduler {url}: {_one_line(error)}") from None
    except Exception as error:  # a version mismatch can raise any exception
        raise InputError(f"--scheduler {url}: {_one_line(error)}; {_own_version()}") from None


def _refuse_unfit(client: Any, url: str) -> None:
    """Reject a scheduler without workers, or with a worker that lacks this version of this program."""
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT_S)
    except TimeoutError:
        raise FlightError(f"--scheduler {url}: no worker connected within {_TIMEOUT_S:g} s") from None
    own = software_version()
    try:
        # Workers without dart-flight can run `import_module`, so they return the error of the import.
        client.run_on_scheduler(importlib.import_module, _ABOUT)
        imported = client.run(importlib.import_module, _ABOUT, on_error="return")
        lacking = [worker for worker, answer in imported.items() if isinstance(answer, Exception)]
        fit = [worker for worker in imported if worker not in lacking]
        versions = client.run(software_version, workers=fit) if fit else {}
    except ModuleNotFoundError as error:
        raise InputError(
            f"--scheduler {url}: {error}; install dart-flight {own} on the scheduler, too"
        ) from None
    except OSError:
        raise  # connection lost
    except Exception as error:  # a version mismatch can raise any exception
        raise InputError(f"--scheduler {url}: {_one_line(error)}; {_own_version()}") from None
    for worker in lacking:
        raise InputError(
            f"--scheduler {url}: worker {worker}: {_one_line(imported[worker])}; install dart-flight {own} "
            "on this worker, or stop the worker"
        )
    for worker, version in versions.items():
        if version != own:
            raise InputError(
                f"--scheduler {url}: worker {worker} has dart-flight {version}: install version {own} on "
                "this worker"
            )


def _own_version() -> str:
    import distributed  # noqa: PLC0415

    return (
        f"this computer uses version {distributed.__version__} of the package `distributed`: install the "
        "same version on scheduler and workers"
    )


def _one_line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _hand_out(
    client: Any, url: str, flyer: ItemFlyer, waiting: Iterator[Item], interrupt: Interrupt
) -> Landings:
    # The scheduler sends this shared result to each worker once, and recomputes it if its worker dies.
    shared = client.submit(_identity, flyer, pure=False)
    under_way: dict[Any, Item] = {}
    threads, counted_s = 0, -_COUNT_S
    while interrupt.count < 2:
        if time.monotonic() - counted_s >= _COUNT_S:
            threads, counted_s = sum(client.nthreads().values()), time.monotonic()
        while not interrupt.count and len(under_way) < _AHEAD * max(1, threads):
            item = next(waiting, None)
            if item is None:
                break
            under_way[client.submit(attempt, shared, item, pure=False)] = item
        interrupt.report(len(under_way))
        if not under_way:
            return
        landed = [future for future in under_way if future.done()]
        if not landed:
            time.sleep(_POLL_S)
        for future in landed:
            try:
                result = _result(future)
            except _UnfitWorkerError as error:  # this worker joined after the check
                _refuse_unfit(client, url)
                raise FlightError(
                    f"--scheduler {url}: {error}; completed rows are kept; continue with --resume"
                ) from None
            yield FinishedItem(under_way.pop(future), result)


class _UnfitWorkerError(Exception):
    """A worker could not begin a flight."""


def _result(future: Any) -> Flown | Failure:
    """Return the result of a flight, or raise an OSError if the connection to the scheduler is lost."""
    if future.status in ("cancelled", "lost"):
        raise OSError("lost connection to the scheduler")
    error = future.exception()
    if error is not None:  # from the scheduler or a worker; a flight's own errors are returned as results
        if type(error).__name__ != "KilledWorker":
            raise _UnfitWorkerError(_one_line(error))
        return Failure(_one_line(error))
    result: Flown | Failure = future.result()
    return result


def _identity(flyer: ItemFlyer) -> ItemFlyer:
    return flyer
