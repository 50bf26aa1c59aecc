"""The engine of a studio page: a kept warm process that checks, plans and flies texts.

The page's process loads neither `dart_flight.vehicle` nor mavsdk; the engine's process does. They exchange
JSON lines. If the process dies, it is started again, and the page gets `EngineDied`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from dart_flight.base.geometry import Vec3
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.studio.scene_model import Scene


class Finding(msgspec.Struct):
    """A finding of `check`, or the error that keeps a file from loading.

    Attributes:
        item: name of the finding, as `check` prints it; `file` for an error of the file.
        word: `go`, `NO-GO`, `remark` or `error`.
        says: the finding in the words of the command.
        object: id of the object in the scene, or "" if the finding concerns the whole mission.
    """

    item: str
    go: bool
    word: str
    says: str
    object: str = ""


class FlyRequest(msgspec.Struct):
    """What to fly.

    Attributes:
        seed: first seed.
        flights: number of flights with consecutive seeds, 1 to 1,000.
        vary: what differs at random from the nominal world, as `--vary` of `dry-run`; empty: nothing.
        fault: a fault as `--fault` of `dry-run`, only for a single flight, or None.
        log: whether each flight writes a log. A flight without a log can be repeated with its seed and a log.
    """

    seed: int = 1
    flights: int = 1
    vary: tuple[str, ...] = ()
    fault: str | None = None
    log: bool = True


class Event(msgspec.Struct, tag=True):
    """An event of the engine; `number` is that of the request, 0 without one."""

    number: int = 0


class Ready(Event):
    """The process is warm."""


class Checked(Event):
    """A text has been checked.

    Attributes:
        go: whether `check` of stage `file` says go; for a scenario, whether it loads.
        scene: scene with predicted path and hits.
        stale: why the plan of the mission is stale, or None.
        materials: materials of the vehicle, for menus.
        modes: modes of the vehicle.
    """

    go: bool = False
    findings: list[Finding] = []
    scene: Scene | None = None
    stale: str | None = None
    materials: list[str] = []
    modes: list[str] = []


class PlanProgress(Event):
    """Candidates tried so far, and in all (None: unknown); `says` names what is going on."""

    done: int = 0
    of: int | None = None
    says: str = ""


class PlanRow(msgspec.Struct):
    """A plan.

    Attributes:
        rank: 1 is the best; 0 is the free flight, without a hit.
        values: quantities by name, with unit, as the command's table shows them.
        path: predicted path, (n, 3).
        mission: text of the mission, or "" if it is refused.
        refused: why the mission is refused, or None.
    """

    rank: int
    says: str
    values: dict[str, str]
    path: Array
    mission: str
    refused: str | None = None
    time_s: float | None = None
    saving_s: float | None = None


class Planned(Event):
    """The search has ended.

    Attributes:
        refused: number of refused candidates by reason.
        free: the flight without a hit, or None.
        error: why there is no plan, or None.
    """

    plans: list[PlanRow] = []
    refused: dict[str, int] = {}
    free: PlanRow | None = None
    says: str = ""
    error: str | None = None
    cancelled: bool = False


class FlownOne(msgspec.Struct):
    """One flight.

    Attributes:
        outcome: completed, aborted or released.
        reason: why it did not complete, or None.
        path: true path, (n, 3).
        hits: places of the hits.
        log: the flight's log, or None without one.
    """

    seed: int
    outcome: str
    reason: str | None
    path: Array
    hits: list[Vec3] = []
    log: str | None = None
    goal_miss_m: float | None = None
    peak_force_n: float | None = None


class FlyProgress(Event):
    """Flights that have landed since the last event."""

    done: int = 0
    of: int = 0
    completed: int = 0
    landed: list[FlownOne] = []


class Flown(Event):
    """All flights have landed, or were cancelled.

    Attributes:
        says: result in one line.
        error: why the flights could not be flown, or None.
    """

    done: int = 0
    completed: int = 0
    reasons: dict[str, int] = {}
    says: str = ""
    error: str | None = None
    cancelled: bool = False


class EngineDied(Event):
    """The process has ended; it is started again. A plan or flights in progress are lost, the text is not."""

    says: str = ""


class Engine:
    """The engine of one page.

    Args:
        path: the open file; relative names in its text are relative to its folder.
        on_event: called with every event, on a thread of the engine, in order.
        log_dir: folder for logs of flights.
    """

    def __init__(self, path: Path, on_event: Callable[[Event], None], log_dir: Path = Path("logs")) -> None:
        raise NotImplementedError

    def check(self, text: str) -> int:
        """Check a text; return the number of the request. A newer request replaces one that waits."""
        raise NotImplementedError

    def plan(self, text: str, objective: str | None = None, within_s: float = 60.0, top: int = 10) -> int:
        """Plan a scenario's text; ends with `Planned`."""
        raise NotImplementedError

    def fly(self, text: str, request: FlyRequest) -> int:
        """Fly a mission's text in the fast world; ends with `Flown`."""
        raise NotImplementedError

    def cancel(self) -> None:
        """Cancel the plan or the flights in progress; `Planned` or `Flown` follows within a second."""
        raise NotImplementedError

    def close(self) -> None:
        """End the process."""
        raise NotImplementedError
