"""The settings of a trial series: `series.yaml` in the folder of the series, and the folder's other files.

The folder contains `series.yaml`, `mission.yaml` (the room), `batches/NN/mission.yaml`, and the logs in
`batches/NN/flights` and `added`. There is no other state, so an interrupted series continues anywhere.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from dart_flight.base.errors import FlightError
from dart_flight.base.records import Mode
from dart_flight.config.document import (
    Document,
    InputError,
    read_text,
    replace_file,
    report_write_errors,
    unknown_name,
)
from dart_flight.config.edit import update_text
from dart_flight.config.held_files import HeldError, HeldFile, program_name
from dart_flight.config.mission import Mission, load_empty_room, load_mission
from dart_flight.config.section import Metres, Section, Speed
from dart_flight.lab.identify.flight_trials import ALLOWANCE
from dart_flight.lab.identify.next_hits import FITTED
from dart_flight.recording.found import LOG_NAME

SETTINGS: Final = "series.yaml"
_MISSION: Final = "mission.yaml"
_BATCHES, _FLIGHTS, _ADDED, _LOCK = "batches", "flights", "added", ".series.lock"
Share = Annotated[float, Meta(gt=0.0, le=1.0)]


class Aims(Section, frozen=True):
    """The intended half width of each statistical 95 % interval, relative to the coefficient.

    The allowance for systematic errors comes on top of it, and no number of hits reduces the allowance.
    """

    k: Share = 0.03
    f: Share = 0.2
    mu: Share = 0.12


class ExcludedHit(Section, frozen=True):
    """A hit that the operator has excluded.

    Attributes:
        flight: name of the flight in the folder, such as `01/2026-05-04_10-11-12_acrylic`.
        hit: number of the hit in its flight, from 1.
    """

    flight: str
    hit: Annotated[int, Meta(ge=1, le=1000)]
    why: str


class DropTrial(Section, frozen=True):
    """A recorded drop in the folder `added`.

    Attributes:
        file: name of the CSV or ULog file.
        height_m: height of the drop; null: from the duration of the fall.
        contact_distance_m: distance of the recorded point from the ground at first touch.
    """

    file: str
    mode: Mode
    height_m: Metres | None = None
    contact_distance_m: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


class SeriesSettings(Section, frozen=True, kw_only=True):
    """The file `series.yaml`.

    Attributes:
        vehicle: vehicle configuration, relative to the folder; null: the default configuration.
        wall: name of the wall in mission.yaml; in a series of drops, the material of the ground.
        speeds_m_s: smallest and largest speed along the wall's normal.
        peak_force_n: largest contact force; a planned peak is at most 0.8 of it.
        held_out: share of the hits that only check the prediction.
        hits_per_flight: number of hits that one battery can fly.
        excluded: hits that the operator has excluded.
        added: flights in the folder `added`, which other commands flew.
        heights_m: smallest and largest height of a series of drops; null: hits on a wall.
        drops: the recorded drops.
    """

    version: Literal[1] = 1
    vehicle: str | None = None
    wall: str
    modes: tuple[Mode, ...]
    speeds_m_s: tuple[Speed, Speed] = (0.3, 1.5)
    peak_force_n: Annotated[float, Meta(gt=0.0, le=2000.0)]
    aims: Aims = Aims()
    held_out: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.2
    hits_per_flight: Annotated[int, Meta(ge=1, le=100)] = 8
    excluded: tuple[ExcludedHit, ...] = ()
    added: tuple[str, ...] = ()
    heights_m: tuple[Metres, Metres] | None = None
    drops: tuple[DropTrial, ...] = ()


class SeriesFolder:
    """The folder of a series.

    Attributes:
        settings: the settings, as read when the folder was opened or changed.
    """

    def __init__(self, path: Path, config: str | None = None) -> None:
        self.path, self._config = path, config
        self._file = path / SETTINGS
        if not self._file.exists():
            text = "no series here; create one with `dart-flight series new FOLDER --mission M --wall W`"
            raise InputError(text, source=str(path))
        document = Document.load(self._file)
        self.settings = document.convert(SeriesSettings)
        refuse_impossible(self.settings, document)

    def mission(self) -> Mission:
        """Return the mission of the room (for drops, an empty room), with the vehicle of the series."""
        if self.settings.heights_m is not None:
            mission = load_empty_room(self.config)
            known = list(mission.vehicle.materials)
        else:
            mission = load_mission(self.path / _MISSION, self.config)
            known = [wall.name for wall in mission.flat_walls]
        if self.settings.wall not in known:
            raise InputError(unknown_name(self.settings.wall, known), source=str(self._file), key=("wall",))
        return mission

    @property
    def config(self) -> Path | None:
        """The vehicle's configuration file, or None for the default one."""
        if self._config is not None:
            return Path(self._config)
        return None if self.settings.vehicle is None else self.path / self.settings.vehicle

    def logs(self) -> dict[str, Path]:
        """Return the logs by the flight's name, in the order of the batches, then the added flights."""
        found = {}
        for log in sorted((self.path / _BATCHES).glob(f"*/{_FLIGHTS}/*/{LOG_NAME}")):
            found[f"{log.parents[2].name}/{log.parent.name}"] = log
        for name in self.settings.added:
            found[f"{_ADDED}/{name}"] = self.path / _ADDED / name / LOG_NAME
        return found

    def batches(self) -> list[Path]:
        return sorted(path for path in (self.path / _BATCHES).glob("*") if path.name.isdigit())

    def next_batch(self) -> Path:
        """Return the folder of the next batch: the last one if nobody has flown it, else a new one."""
        batches = self.batches()
        if batches and not any((batches[-1] / _FLIGHTS).glob(f"*/{LOG_NAME}")):
            return batches[-1]
        return self.path / _BATCHES / f"{int(batches[-1].name) + 1 if batches else 1:02d}"

    def flights_of(self, batch: Path) -> Path:
        return batch / _FLIGHTS

    def write_batch(self, tree: Mapping[str, Any]) -> Path:
        """Write the mission of the next batch, and return its path."""
        path = self.next_batch() / _MISSION
        config = self.config
        if config is not None:
            tree = {**tree, "vehicle": os.path.relpath(config, path.parent)}
        _write(path, update_text("{}\n", tree))
        return path

    def change(self, **changes: Any) -> None:
        """Change settings in the file; its comments stay."""
        settings = msgspec.structs.replace(self.settings, **changes)
        tree = Document.load(self._file).tree | msgspec.to_builtins({n: changes[n] for n in changes})
        _write(self._file, update_text(read_text(self._file), tree, str(self._file)))
        self.settings = settings

    def add(self, log: Path) -> str:
        """Copy a flight's log into the folder, and return the name of the flight."""
        name = log.resolve().parent.name
        target = self.path / _ADDED / name / LOG_NAME
        if name in self.settings.added:
            raise InputError(f"the series has this flight already: {_ADDED}/{name}", source=str(log))
        _copy(log, target)
        self.change(added=(*self.settings.added, name))
        return f"{_ADDED}/{name}"

    def add_drop(self, path: Path, trial: DropTrial) -> str:
        """Copy the recording of a drop into the folder, and return its name."""
        target = self.path / _ADDED / trial.file
        if any(one.file == trial.file for one in self.settings.drops):
            raise InputError(f"the series has this drop already: {_ADDED}/{trial.file}", source=str(path))
        _copy(path, target)
        self.change(drops=(*self.settings.drops, trial))
        return f"{_ADDED}/{trial.file}"

    def drop_files(self) -> dict[str, tuple[Path, DropTrial]]:
        """Return the recordings of drops by name."""
        return {f"{_ADDED}/{one.file}": (self.path / _ADDED / one.file, one) for one in self.settings.drops}

    def flight_named(self, part: str) -> str:
        """Return the name of the only flight that contains `part`."""
        names = [*self.logs(), *self.drop_files()]
        found = [name for name in names if part in (name, *name.split("/"))]
        found = found or [name for name in names if part in name]
        if len(found) != 1:
            text = "several flights have" if found else "no flight of the series has"
            raise InputError(f"{text} {part!r} in the name; the series has: {', '.join(names) or 'none'}")
        return found[0]


def create_series(path: Path, mission: Path | None, settings: SeriesSettings) -> SeriesFolder:
    """Create the folder of a series.

    The folder gets a copy of the mission, whose walls, bounds and limits the series uses. A series of drops
    has no mission.
    """
    if (path / SETTINGS).exists():
        text = (
            "a series exists here already: continue it with `dart-flight series next`, or name a new folder"
        )
        raise InputError(text, source=str(path / SETTINGS))
    refuse_impossible(settings, Document.from_tree(msgspec.to_builtins(settings), str(path / SETTINGS)))
    if mission is not None:
        tree = {key: value for key, value in Document.load(mission).tree.items() if key != "vehicle"}
        copied, target = update_text(read_text(mission), tree, str(mission)), path / _MISSION
        if target.exists() and read_text(target) != copied:
            raise InputError("exists and is not of a series: name a new folder", source=str(target))
        _write(target, copied)
    # The settings come last: a folder without them is no series, so an interrupted command can be repeated.
    _write(path / SETTINGS, _HEAD + update_text("{}\n", msgspec.to_builtins(settings)))
    return SeriesFolder(path)


_HEAD: Final = "# Settings of a trial series (docs/series.md); `dart-flight series status` shows its state.\n"


def refuse_impossible(settings: SeriesSettings, document: Document) -> None:
    """Raise InputError if the speeds are in the wrong order, or an aim is below its allowance."""
    low, high = settings.speeds_m_s
    if not low < high:
        raise document.error(("speeds_m_s",), f"expected low < high, not {low:g} and {high:g}")
    if not settings.modes:
        raise document.error(("modes",), "name at least one mode")
    if settings.heights_m is not None:
        if not settings.heights_m[0] < settings.heights_m[1]:
            raise document.error(("heights_m",), "expected low < high")
        return  # recordings of drops have no allowance
    for name in FITTED:
        aim, allowance = getattr(settings.aims, name), ALLOWANCE[name]
        if aim < allowance:
            text = (
                f"{100.0 * aim:g} % is below the allowance for systematic errors of flights, "
                f"{100.0 * allowance:g} %, which more hits do not reduce"
            )
            raise document.error(("aims", name), text)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the folder for writing.

    Raises:
        FlightError: another program writes this series.
    """
    with report_write_errors(path):
        path.mkdir(parents=True, exist_ok=True)
    held = HeldFile(path / _LOCK, "put the series on a local disk with free space")
    try:
        held.acquire(f"{program_name()}, process {os.getpid()}".encode())
    except HeldError as error:
        holder = error.content.decode(errors="replace") or "another program"
        raise FlightError(f"{path}: {holder} writes this series; wait until it has ended") from None
    try:
        yield
    finally:
        held.release()


def _write(path: Path, text: str) -> None:
    with report_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode("utf-8"))


def _copy(recording: Path, target: Path) -> None:
    try:
        data = recording.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror}", source=str(recording)) from None
    with report_write_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        replace_file(target, data)
