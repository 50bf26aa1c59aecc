"""The same flights on the workers of a Dask scheduler (the extra `cluster`), beyond one machine.

The scheduler hands the flights out, replaces those of a worker that dies, and tells of a flight that keeps
killing its workers. The rows are those of a local run: a flight hangs on its mission and seed, not on where
it is flown.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

from dart_flight.base.errors import FlightError
from dart_flight.config.packages import missing_package
from dart_flight.lab.campaign.campaign_folder import Engine, Landings
from dart_flight.lab.campaign.campaign_spec import Item
from dart_flight.lab.campaign.flight_job import Flown, ItemFlyer
from dart_flight.recording.about import software_version
from dart_flight.run.workers import Failure, FinishedItem, Interrupt, attempt

_PATIENCE_S = 30.0  # for the scheduler to answer, and for a first worker
_POLL_S = 0.05
_END_S = 2.0
_COUNT_S = 5.0  # how often it is asked for its workers
_AHEAD = 2  # flights given out for each thread: the next one is there when one lands


def on_cluster(url: str) -> Engine:
    """Flights on the workers of the scheduler at a URL (`tcp://host:8786`).

    Raises:
        InputError: Dask's distributed is not installed.
    """
    try:
        import distributed  # noqa: F401, PLC0415
    except ImportError:
        raise missing_package("needs Dask", "cluster", key=("--scheduler",)) from None
    return partial(_work, url)


def _work(url: str, flyer: ItemFlyer, items: Iterable[Item], interrupt: Interrupt) -> Landings:
    """As `worlds.workers.work`.

    Raises:
        FlightError: the scheduler does not answer, has no worker, or one with another version.
    """
    import distributed  # noqa: PLC0415

    for name in ("distributed", "distributed.client"):  # what it would say at length is said here in a line
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(url, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FlightError(f"--scheduler {url}: {error}") from None
    try:
        _refuse_others(client, url)
        yield from _hand_out(client, flyer, iter(items), interrupt)
    except OSError as error:
        raise FlightError(
            f"--scheduler {url}: {error}; completed rows are kept; continue with --resume"
        ) from None
    finally:
        client.close(timeout=_END_S)


def _refuse_others(client: Any, url: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except TimeoutError:
        raise FlightError(f"--scheduler {url}: no worker connected within {_PATIENCE_S:g} s") from None
    own = software_version()
    for worker, version in client.run(software_version).items():
        if version != own:
            raise FlightError(f"--scheduler {url}: {worker} has dart-flight {version}, this is {own}")


def _hand_out(client: Any, flyer: ItemFlyer, waiting: Iterator[Item], interrupt: Interrupt) -> Landings:
    # A result of its own, so that it goes to each worker once and is made again where that worker dies.
    shared = client.submit(_same, flyer, pure=False)
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
        if not under_way:
            return
        landed = [future for future in under_way if future.done()]
        if not landed:
            time.sleep(_POLL_S)
        for future in landed:
            yield FinishedItem(under_way.pop(future), _result(future))


def _result(future: Any) -> Flown | Failure:
    """Raises OSError: lost connection to the scheduler."""
    if future.status in ("cancelled", "lost"):
        raise OSError("lost connection to the scheduler")
    error = future.exception()
    if error is not None:  # the flights' own are results: this is the scheduler's
        return Failure(" ".join(f"{type(error).__name__}: {error}".split()))
    result: Flown | Failure = future.result()
    return result


def _same(flyer: ItemFlyer) -> ItemFlyer:
    return flyer
