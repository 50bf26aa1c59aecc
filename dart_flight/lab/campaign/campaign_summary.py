"""What the rows of a campaign amount to: how often the mission succeeds, where not, and by which rule."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

import msgspec

from dart_flight.base.records import Outcome
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import VehicleSource
from dart_flight.lab.campaign.campaign_folder import TABLE, CampaignFolder
from dart_flight.lab.campaign.campaign_spec import Item, Point, command_of, keys_of
from dart_flight.lab.campaign.flight_job import ERROR
from dart_flight.lab.campaign.table import rows_in
from dart_flight.lab.statistics import (
    Separation,
    Share,
    bin_edges,
    bin_of,
    rank_correlation,
    rank_correlation_chance,
    separation,
    share,
)
from dart_flight.recording.plan_versus_flight import Deviation

_MAX_FAILED = 1000  # that are listed; the table has them all
_CLEAR_Z = 4.0  # from here on a quantity tells failed flights from others, also among fifty looked at
_MIN_FAILED = 5
_MAX_TOLD = 4
_MAX_OVER = 2  # drawn quantities for one figure
_MAX_POINTS = 400
_SIGNIFICANT = 0.05  # p value, corrected for the number of quantities tried
_OF_WALLS = ("contact", "wall_offset_m", "wall_yaw_deg")


class FigureSpread(msgspec.Struct, frozen=True):
    """A figure over the flights that have it."""

    flights: int
    median: float
    low_5: float
    high_95: float
    most: float


class Bin(msgspec.Struct, frozen=True):
    """Flights whose drawn quantity lies in a range, or has a value.

    Attributes:
        low, high: of a number.
        value: of a word.
        completed: of those flights.
    """

    completed: Share
    low: float | None = None
    high: float | None = None
    value: str | None = None


class Drawn(msgspec.Struct, frozen=True):
    """Success over one drawn quantity.

    Attributes:
        name: of the quantity.
        bins: of about equal counts; one for every word.
        z: how clearly it differs between flights that completed and others, in standard deviations under no
            difference (Mann and Whitney), positive where it is higher in the others; of words that of the
            clearest one; None where all or none completed.
    """

    name: str
    bins: list[Bin]
    z: float | None = None


class FigureTrend(msgspec.Struct, frozen=True):
    """A figure of the flights that completed, over a drawn quantity that it follows significantly.

    Attributes:
        figure, name: of the figure and of the drawn quantity.
        correlation: of their ranks (Spearman), -1 to 1; 0: the figure does not follow it.
        p_value: probability that chance alone correlates any tried quantity as much (Bonferroni).
        points: drawn and figure of each flight, of the first 400.
    """

    figure: str
    name: str
    correlation: float
    p_value: float
    points: list[tuple[float, float]]


class Departure(msgspec.Struct, frozen=True):
    """A planned figure that some flights missed by more than its tolerance.

    Attributes:
        mission: file of the mission.
        what: name of the figure with its unit.
        flights, of: number of flights out of tolerance, and number of flights with a plan.
        not_flown: number of flights out of tolerance in which the planned part was not flown.
        planned, flown: medians over the flights out of tolerance, or words; flown is None if never flown.
        tolerance: tolerance from the mission, or None if the values must be equal.
    """

    mission: str
    what: str
    flights: int
    of: int
    not_flown: int
    planned: float | str
    flown: float | str | None
    tolerance: float | None


class GridPoint(msgspec.Struct, frozen=True):
    """Success at one mission and value of what was set."""

    mission: str
    settings: dict[str, str]
    completed: Share
    plan_followed: Share


class DifferingQuantity(msgspec.Struct, frozen=True):
    """A drawn quantity that differs between flights that a rule ended and those that completed.

    Attributes:
        name: of the quantity.
        failed, completed: medians; of a word the share of the flights that drew it.
        chance: that it is higher in a failed flight than in a completed one; 0.5 tells nothing.
    """

    name: str
    failed: float
    completed: float
    chance: float


class EndCause(msgspec.Struct, frozen=True):
    """Why flights did not complete: the rule, or the first word of the reason."""

    rule: str
    flights: int
    telling: list[DifferingQuantity]


class FailedFlight(msgspec.Struct, frozen=True):
    """A flight that did not complete, and how to see it again."""

    mission: str
    settings: dict[str, str]
    seed: int
    outcome: str
    reason: str
    log: str | None
    command: str


class CampaignSummary(msgspec.Struct, frozen=True):
    """The object of `summary.json` and of `campaign --json`.

    Attributes:
        flights: rows in the table; asked: flights in all.
        errors: flights without a verdict, by a fault of the program; they count in no rate.
        completed, plan_followed: rates with their intervals.
        figures: by column.
        points: by mission and settings; rules: why flights did not complete.
        drawn: success over what was drawn; empty where all flights completed, or none.
        varied: miss and peak forces over what was drawn, of the flights that completed.
        tried: number of drawn quantities that can affect a figure, significant or not, by figure.
        not_followed: planned figures out of tolerance, the most frequent first.
        failed: flights that did not complete, at most 1000.
        unexplained_modes: those whose arms were in another mode than the lock although no fault of it was
            drawn; the campaign proves nothing while there are any.
        vary: what was drawn, standard deviations.
        software: version that flew; vehicle: of the first mission and setting.
    """

    flights: int
    asked: int
    errors: int
    completed: Share
    plan_followed: Share
    figures: dict[str, FigureSpread]
    points: list[GridPoint]
    rules: list[EndCause]
    drawn: list[Drawn]
    varied: list[FigureTrend]
    tried: dict[str, int]
    not_followed: list[Departure]
    failed: list[FailedFlight]
    unexplained_modes: list[FailedFlight]
    vary: dict[str, float]
    software: str
    vehicle: VehicleSource


class _SummaryRow(NamedTuple):
    """A row as far as the summary needs it."""

    item: Item
    point: Point
    outcome: str
    rule: str
    reason: str
    unexplained: str
    followed: bool | None
    departures: str
    drawn: tuple[float | str | None, ...]
    figures: tuple[float | None, ...]

    @property
    def completed(self) -> bool:
        return self.outcome == Outcome.COMPLETED


_FIGURES = ("goal_miss_m", "final_error_m", "max_tilt_deg", "flight_time_s")


def summarise(opened: CampaignFolder) -> CampaignSummary:
    """Read the table and sum it up.

    Raises:
        InputError: the table cannot be read.
    """
    columns = opened.campaign.columns
    names = columns[columns.index("seed") + 1 : columns.index("outcome")]
    figures = (*_FIGURES, *(c for c in columns if c.endswith(("_normal_m_s", "_peak_force_n"))))
    rows = list(_rows(opened, names, figures))
    judged = [row for row in rows if row.outcome != ERROR]
    varied, tried = _varied([row for row in judged if row.completed], names, figures)
    return CampaignSummary(
        flights=len(rows),
        asked=opened.flights,
        errors=len(rows) - len(judged),
        completed=_completed(judged),
        plan_followed=_followed(judged),
        figures={
            name: spread
            for i, name in enumerate(figures)
            if (spread := _spread([row.figures[i] for row in judged])) is not None
        },
        points=[_at_point(opened, point, judged) for point in opened.points],
        rules=_rules(rows, names),
        drawn=_drawn(judged, names),
        varied=varied,
        tried=tried,
        not_followed=_departures(judged),
        failed=[_failed(opened, row) for row in islice((r for r in rows if not r.completed), _MAX_FAILED)],
        unexplained_modes=[
            _failed(opened, row, row.unexplained)
            for row in islice((r for r in rows if r.unexplained), _MAX_FAILED)
        ],
        vary=opened.points[0].spreads,
        software=opened.campaign.software,
        vehicle=opened.points[0].mission.flown_vehicle(),
    )


def _rows(opened: CampaignFolder, names: Sequence[str], figures: Sequence[str]) -> Iterator[_SummaryRow]:
    keys = keys_of(opened.campaign.asked, opened.points)
    points = {(point.path, *point.values): point for point in opened.points}
    path = opened.folder / TABLE
    for row in rows_in(path) if path.exists() else ():
        point = points[(row["mission"], *(row[key] for key in keys))]
        yield _SummaryRow(
            Item(point.number, int(row["seed"])),
            point,
            row["outcome"],
            row["reason"].partition(":")[0],
            row["reason"],
            row["unexplained_modes"],
            {"true": True, "false": False}.get(row["plan_followed"]),
            row["not_followed"],
            tuple(_value(row[name]) for name in names),
            tuple(_number(row[name]) for name in figures),
        )


def _number(text: str) -> float | None:
    return float(text) if text else None


def _value(text: str) -> float | str | None:
    try:
        return _number(text)
    except ValueError:
        return text


def _completed(rows: Sequence[_SummaryRow]) -> Share:
    return share(sum(row.completed for row in rows), len(rows))


def _followed(rows: Sequence[_SummaryRow]) -> Share:
    known = [row.followed for row in rows if row.followed is not None]
    return share(sum(known), len(known))


def _spread(values: Sequence[float | None]) -> FigureSpread | None:
    known = sorted(v for v in values if v is not None and math.isfinite(v))
    if not known:
        return None
    last = len(known) - 1
    return FigureSpread(
        len(known), median(known), known[round(0.05 * last)], known[round(0.95 * last)], known[-1]
    )


def _at_point(opened: CampaignFolder, point: Point, rows: Sequence[_SummaryRow]) -> GridPoint:
    there = [row for row in rows if row.point is point]
    return GridPoint(point.path, _settings(opened, point), _completed(there), _followed(there))


def _settings(opened: CampaignFolder, point: Point) -> dict[str, str]:
    return dict(zip(keys_of(opened.campaign.asked, opened.points), point.values, strict=True))


def _drawn(rows: Sequence[_SummaryRow], names: Sequence[str]) -> list[Drawn]:
    """What was drawn, what tells most first; what is the same in all flights is left out."""
    fine, others = [r for r in rows if r.completed], [r for r in rows if not r.completed]
    if not fine or not others:
        return []
    found = []
    for i, name in enumerate(names):
        if len({row.drawn[i] for row in rows}) > 1:
            apart = [one.z for _, _, _, one in _apart(others, fine, i, name)]
            found.append(Drawn(name, _bins(rows, i), max(apart, key=abs, default=None)))
    return sorted(found, key=lambda drawn: -abs(drawn.z or 0.0))


def _varied(
    rows: Sequence[_SummaryRow], names: Sequence[str], figures: Sequence[str]
) -> tuple[list[FigureTrend], dict[str, int]]:
    """Return trends of miss and peak forces over their best correlated quantities, and the number tried."""
    found: list[FigureTrend] = []
    tried: dict[str, int] = {}
    for j, figure in enumerate(figures):
        if figure != "goal_miss_m" and not figure.endswith("_peak_force_n"):
            continue
        over: list[tuple[float, str, list[tuple[float, float]]]] = []
        for i, name in enumerate(names):
            known = [
                (x, y)
                for r in rows
                if isinstance(x := r.drawn[i], float)
                and (y := r.figures[j]) is not None
                and _can_matter(name, figure, r.point.mission)
            ]
            if len({x for x, _ in known}) > 1 and len({y for _, y in known}) > 1:
                over.append((rank_correlation(known), name, known))
        if not over:
            continue
        tried[figure] = len(over)
        over.sort(key=lambda one: -abs(one[0]))
        for correlation, name, known in over[:_MAX_OVER]:
            p_value = min(1.0, len(over) * rank_correlation_chance(correlation, len(known)))
            if p_value < _SIGNIFICANT:
                found.append(FigureTrend(figure, name, correlation, p_value, known[:_MAX_POINTS]))
    return found, tried


def _can_matter(name: str, figure: str, mission: Mission) -> bool:
    """Return whether a drawn quantity can affect a figure.

    A wall's quantity can if the wall is hit in that mode, at the figure's collision or before.
    """
    kind, _, rest = name.partition(".")
    if kind not in _OF_WALLS:
        return True
    collisions = mission.collisions
    if figure.startswith("c"):
        collisions = collisions[: int(figure[1 : figure.index("_")])]
    if any(c.wall.sought for c in collisions):
        return True  # only the flight determines which simulated wall is hit
    wall, mode = rest, None
    if kind == "contact":
        wall, mode, _ = rest.rsplit(".", 2)
    return any(c.wall.name == wall and mode in (None, c.mode.value) for c in collisions)


def _departures(rows: Sequence[_SummaryRow]) -> list[Departure]:
    """Collect the deviations out of tolerance by mission and figure."""
    planned = Counter(row.point.path for row in rows if row.followed is not None)
    by_figure: dict[tuple[str, str], list[Deviation]] = {}
    for row in rows:
        for one in msgspec.json.decode(row.departures, type=list[Deviation]) if row.departures else ():
            by_figure.setdefault((row.point.path, one.what), []).append(one)
    found = [
        Departure(
            mission, what, len(these), planned[mission], sum(one.flown is None for one in these),
            _middle([one.planned for one in these]) or 0.0, _middle([one.flown for one in these]),
            these[0].tolerance,
        )
        for (mission, what), these in by_figure.items()
    ]  # fmt: skip
    return sorted(found, key=lambda one: -one.flights)


def _middle(values: Sequence[float | str | None]) -> float | str | None:
    """Return the median of numbers, or else the most frequent word, or None without either."""
    numbers = [value for value in values if isinstance(value, float)]
    words = Counter(value for value in values if isinstance(value, str))
    return median(numbers) if numbers else words.most_common(1)[0][0] if words else None


def _bins(rows: Sequence[_SummaryRow], i: int) -> list[Bin]:
    """Success over one drawn quantity: bins of numbers, or one for every word."""
    words = {value for row in rows if isinstance(value := row.drawn[i], str)}
    bins = [
        Bin(_completed([row for row in rows if row.drawn[i] == word]), value=word) for word in sorted(words)
    ]
    numbers = [(value, row) for row in rows if isinstance(value := row.drawn[i], float)]
    if not numbers:
        return bins
    edges = bin_edges([value for value, _ in numbers])
    members: list[list[_SummaryRow]] = [[] for _ in edges[1:]]
    for value, row in numbers:
        members[bin_of(value, edges)].append(row)
    return bins + [
        Bin(_completed(inside), low, high)
        for inside, low, high in zip(members, edges, edges[1:], strict=False)
        if inside
    ]


def _rules(rows: Sequence[_SummaryRow], names: Sequence[str]) -> list[EndCause]:
    by_rule: dict[str, list[_SummaryRow]] = {}
    for row in rows:
        if not row.completed:
            by_rule.setdefault(row.rule or row.outcome, []).append(row)
    fine = [row for row in rows if row.completed]
    return [
        EndCause(rule, len(ended), _telling(ended, fine, names))
        for rule, ended in sorted(by_rule.items(), key=lambda entry: -len(entry[1]))
    ]


def _telling(
    ended: Sequence[_SummaryRow], fine: Sequence[_SummaryRow], names: Sequence[str]
) -> list[DifferingQuantity]:
    """The drawn quantities that tell flights that a rule ended from those that completed, clearest first."""
    if min(len(ended), len(fine)) < _MIN_FAILED:
        return []
    found: list[tuple[float, DifferingQuantity]] = []
    for i, name in enumerate(names):
        for shown, first, second, apart in _apart(ended, fine, i, name):
            is_word = shown != name
            # Of words that which the failed flights drew; that the others drew others is the same again.
            if abs(apart.z) < _CLEAR_Z or (is_word and apart.z < 0.0):
                continue
            middle = fmean if is_word else median
            found.append(
                (abs(apart.z), DifferingQuantity(shown, middle(first), middle(second), apart.chance))
            )
    found.sort(key=lambda entry: -entry[0])
    return [telling for _, telling in found[:_MAX_TOLD]]


def _apart(
    ended: Sequence[_SummaryRow], fine: Sequence[_SummaryRow], i: int, name: str
) -> Iterator[tuple[str, list[float], list[float], Separation]]:
    """A drawn quantity, or each word that was drawn, in two groups: name, values, how far they are apart."""
    words = sorted({value for row in (*ended, *fine) if isinstance(value := row.drawn[i], str)})
    of_words: dict[str, str | None] = {f"share of {name} {word}": word for word in words}
    for shown, word in (of_words or {name: None}).items():
        first, second = _numbers(ended, i, word), _numbers(fine, i, word)
        if first and second:
            yield shown, first, second, separation(first, second)


def _numbers(rows: Sequence[_SummaryRow], i: int, word: str | None) -> list[float]:
    """A drawn quantity of each flight; of a word whether it was drawn."""
    if word is not None:
        return [float(row.drawn[i] == word) for row in rows]
    return [value for row in rows if isinstance(value := row.drawn[i], float)]


def _failed(opened: CampaignFolder, row: _SummaryRow, reason: str | None = None) -> FailedFlight:
    log = opened.log_of(row.item)
    kept = log.exists() and row.outcome != ERROR
    again = command_of(opened.campaign.asked, row.point, row.item.seed)
    if kept:
        again = shlex.join(["dart-flight", "replay", str(log)])
    return FailedFlight(
        row.point.path,
        _settings(opened, row.point),
        row.item.seed,
        row.outcome,
        reason or row.reason,
        str(Path(log).relative_to(opened.folder)) if kept else None,
        again,
    )
