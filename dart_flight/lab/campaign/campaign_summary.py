"""The summary of a campaign: success rates, causes of failure, and the influence of drawn quantities.

A drawn quantity has a random value in each flight (docs/draws.md).
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

import msgspec

from dart_flight.base.records import Outcome
from dart_flight.base.summary import Share, Spread, cause_of, share, spread
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import VehicleSource
from dart_flight.lab.campaign.campaign_folder import TABLE, CampaignFolder
from dart_flight.lab.campaign.campaign_spec import Item, Point, command_of, keys_of
from dart_flight.lab.campaign.flight_job import ERROR
from dart_flight.lab.campaign.table import rows_in
from dart_flight.lab.statistics import (
    Separation,
    bin_edges,
    bin_of,
    rank_correlation,
    rank_correlation_chance,
    separation,
)
from dart_flight.recording.plan_versus_flight import Deviation

_MAX_FAILED = 1000  # maximum number of listed flights; the table contains all flights
_CLEAR_Z = 4.0  # minimum `Separation.z` that is significant if fifty quantities are compared
_MIN_FAILED = 5
_MAX_QUANTITIES = 4
_MAX_OVER = 2  # maximum number of drawn quantities listed for one figure
_MAX_POINTS = 400
_SIGNIFICANT = 0.05  # upper limit of a significant p value, which is corrected for the number of quantities
_OF_WALLS = ("contact", "wall_offset_m", "wall_yaw_deg")


class Bin(msgspec.Struct, frozen=True):
    """The success rate of the flights in which a drawn quantity is in a range or is the word `value`."""

    completed: Share
    low: float | None = None
    high: float | None = None
    value: str | None = None


class Drawn(msgspec.Struct, frozen=True):
    """The success rate as a function of one drawn quantity.

    Attributes:
        bins: bins with about equally many flights; if the values are words, one bin for each word.
        z: Mann and Whitney's statistic, in standard deviations, positive if the quantity is higher in failed
            flights. If the values are words, every word has a statistic, and `z` is the statistic with the
            largest magnitude. None if all flights completed or no flight completed.
    """

    name: str
    bins: list[Bin]
    z: float | None = None


class FigureTrend(msgspec.Struct, frozen=True):
    """A significant correlation between a figure and a drawn quantity in the completed flights.

    Attributes:
        figure, name: names of the figure and of the drawn quantity.
        correlation: rank correlation (Spearman), -1 to 1.
        p_value: probability that, by chance alone, at least one of the tried quantities correlates so
            strongly (Bonferroni).
        points: (drawn quantity, figure) of the first 400 flights.
    """

    figure: str
    name: str
    correlation: float
    p_value: float
    points: list[tuple[float, float]]


class Departure(msgspec.Struct, frozen=True):
    """A planned value from which some flights deviated by more than the tolerance.

    Attributes:
        what: name of the figure with its unit.
        flights, of: number of flights out of tolerance, and number of flights with a plan.
        not_flown: number of flights out of tolerance in which the planned part was not flown.
        planned, flown: medians (for words, the most frequent word) over the flights out of tolerance. `flown`
            is None if the planned part was never flown.
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
    """The success rates of one mission with one combination of settings."""

    mission: str
    settings: dict[str, str]
    completed: Share
    plan_followed: Share


class DifferingQuantity(msgspec.Struct, frozen=True):
    """A drawn quantity that differs between the completed flights and the flights of one end cause.

    Attributes:
        failed, completed: median over the flights of each group; for a word, its frequency in the group.
        chance: probability that the quantity is higher in a failed flight than in a completed flight; 0.5
            means no difference.
    """

    name: str
    failed: float
    completed: float
    chance: float


class EndCause(msgspec.Struct, frozen=True):
    """A cause of failure: a flight's reason up to its first colon, such as a guard rule.

    A flight without a reason has its outcome as the cause.
    """

    rule: str
    flights: int
    telling: list[DifferingQuantity]


class FailedFlight(msgspec.Struct, frozen=True):
    """A flight that did not complete, with the command that repeats it."""

    mission: str
    settings: dict[str, str]
    seed: int
    outcome: str
    reason: str
    log: str | None
    command: str


class CampaignSummary(msgspec.Struct, frozen=True):
    """The contents of `summary.json`, which `campaign --json` prints.

    Attributes:
        flights, asked: number of rows in the table, and number of flights that the campaign asks for.
        errors: number of flights without a verdict, because a program error ended them. The rates exclude
            these flights.
        figures: distributions by column. Values are ordered by magnitude, so the `high` of the normal
            velocities is the fastest hit.
        rules: causes of failure.
        drawn: success rate as a function of each drawn quantity; empty if all or no flights completed.
        varied: goal miss and peak forces as functions of the drawn quantities, in the completed flights.
        tried: figure -> number of drawn quantities that can affect the figure, significant or not.
        not_followed: planned figures out of tolerance, the most frequent first.
        failed: flights that did not complete, at most 1000.
        unexplained_modes: flights in which arms and lock were in different modes although no lock fault was
            drawn. If there are such flights, the campaign proves nothing.
        vary: standard deviations of the drawn quantities.
        software: version of dart-flight that flew.
        vehicle: vehicle of the first mission and setting.
    """

    flights: int
    asked: int
    errors: int
    completed: Share
    plan_followed: Share
    figures: dict[str, Spread]
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
    """The cells that the summary needs from a row."""

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
    columns = opened.campaign.columns
    names = columns[columns.index("seed") + 1 : columns.index("outcome")]
    figures = (*_FIGURES, *(c for c in columns if c.endswith(("_normal_m_s", "_peak_force_n"))))
    rows = list(_rows(opened, names, figures))
    judged = [row for row in rows if row.outcome != ERROR]
    varied, tried = _figure_trends([row for row in judged if row.completed], names, figures)
    return CampaignSummary(
        flights=len(rows),
        asked=opened.flights,
        errors=len(rows) - len(judged),
        completed=_completed(judged),
        plan_followed=_followed(judged),
        figures={
            name: found
            for i, name in enumerate(figures)
            if (found := spread((row.figures[i] for row in judged), abs)) is not None
        },
        points=[_at_point(opened, point, judged) for point in opened.points],
        rules=_end_causes(rows, names),
        drawn=_success_by_quantity(judged, names),
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
            cause_of(row["reason"]),
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


def _at_point(opened: CampaignFolder, point: Point, rows: Sequence[_SummaryRow]) -> GridPoint:
    there = [row for row in rows if row.point is point]
    return GridPoint(point.path, _settings(opened, point), _completed(there), _followed(there))


def _settings(opened: CampaignFolder, point: Point) -> dict[str, str]:
    return dict(zip(keys_of(opened.campaign.asked, opened.points), point.values, strict=True))


def _success_by_quantity(rows: Sequence[_SummaryRow], names: Sequence[str]) -> list[Drawn]:
    """Return the success rate as a function of each quantity that varied, the most influential first."""
    fine, others = [r for r in rows if r.completed], [r for r in rows if not r.completed]
    if not fine or not others:
        return []
    found = []
    for i, name in enumerate(names):
        if len({row.drawn[i] for row in rows}) > 1:
            z_values = [separated.z for _, _, _, separated in _separations(others, fine, i, name)]
            found.append(Drawn(name, _bins(rows, i), max(z_values, key=abs, default=None)))
    return sorted(found, key=lambda drawn: -abs(drawn.z or 0.0))


def _figure_trends(
    rows: Sequence[_SummaryRow], names: Sequence[str], figures: Sequence[str]
) -> tuple[list[FigureTrend], dict[str, int]]:
    """Return the trends of goal miss and peak forces, and the dictionary `CampaignSummary.tried`."""
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
                and _can_affect(name, figure, r.point.mission)
            ]
            if len({x for x, _ in known}) > 1 and len({y for _, y in known}) > 1:
                over.append((rank_correlation(known), name, known))
        if not over:
            continue
        tried[figure] = len(over)
        over.sort(key=lambda entry: -abs(entry[0]))
        for correlation, name, known in over[:_MAX_OVER]:
            p_value = min(1.0, len(over) * rank_correlation_chance(correlation, len(known)))
            if p_value < _SIGNIFICANT:
                found.append(FigureTrend(figure, name, correlation, p_value, known[:_MAX_POINTS]))
    return found, tried


def _can_affect(name: str, figure: str, mission: Mission) -> bool:
    """Return whether a drawn quantity can affect a figure.

    A quantity that belongs to a wall and mode matters only if the vehicle hits that wall in that mode. The
    hit must be the collision that the figure describes, or an earlier collision.
    """
    kind, _, rest = name.partition(".")
    if kind not in _OF_WALLS:
        return True
    collisions = mission.collisions
    if figure.startswith("c"):
        collisions = collisions[: int(figure[1 : figure.index("_")])]
    if any(c.wall.sought for c in collisions):
        return True  # a probe searches for this wall and may hit any of the simulated walls
    wall, mode = rest, None
    if kind == "contact":
        wall, mode, _ = rest.rsplit(".", 2)
    return any(c.wall.name == wall and mode in (None, c.mode.value) for c in collisions)


def _departures(rows: Sequence[_SummaryRow]) -> list[Departure]:
    planned = Counter(row.point.path for row in rows if row.followed is not None)
    by_figure: dict[tuple[str, str], list[Deviation]] = {}
    for row in rows:
        for deviation in msgspec.json.decode(row.departures, type=list[Deviation]) if row.departures else ():
            by_figure.setdefault((row.point.path, deviation.what), []).append(deviation)
    found = [
        Departure(
            mission, what, len(these), planned[mission], sum(each.flown is None for each in these),
            _typical([each.planned for each in these]) or 0.0, _typical([each.flown for each in these]),
            these[0].tolerance,
        )
        for (mission, what), these in by_figure.items()
    ]  # fmt: skip
    return sorted(found, key=lambda departure: -departure.flights)


def _typical(values: Sequence[float | str | None]) -> float | str | None:
    numbers = [value for value in values if isinstance(value, float)]
    words = Counter(value for value in values if isinstance(value, str))
    return median(numbers) if numbers else words.most_common(1)[0][0] if words else None


def _bins(rows: Sequence[_SummaryRow], i: int) -> list[Bin]:
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


def _end_causes(rows: Sequence[_SummaryRow], names: Sequence[str]) -> list[EndCause]:
    by_rule: dict[str, list[_SummaryRow]] = {}
    for row in rows:
        if not row.completed:
            by_rule.setdefault(row.rule or row.outcome, []).append(row)
    fine = [row for row in rows if row.completed]
    return [
        EndCause(rule, len(ended), _differing_quantities(ended, fine, names))
        for rule, ended in sorted(by_rule.items(), key=lambda entry: -len(entry[1]))
    ]


def _differing_quantities(
    ended: Sequence[_SummaryRow], fine: Sequence[_SummaryRow], names: Sequence[str]
) -> list[DifferingQuantity]:
    """Return the drawn quantities that differ most between `ended` and completed (`fine`) flights."""
    if min(len(ended), len(fine)) < _MIN_FAILED:
        return []
    found: list[tuple[float, DifferingQuantity]] = []
    for i, name in enumerate(names):
        for shown, first, second, separated in _separations(ended, fine, i, name):
            is_word = shown != name
            # Omit the words that completed flights drew more often.
            if abs(separated.z) < _CLEAR_Z or (is_word and separated.z < 0.0):
                continue
            average = fmean if is_word else median
            found.append(
                (
                    abs(separated.z),
                    DifferingQuantity(shown, average(first), average(second), separated.chance),
                )
            )
    found.sort(key=lambda entry: -entry[0])
    return [quantity for _, quantity in found[:_MAX_QUANTITIES]]


def _separations(
    ended: Sequence[_SummaryRow], fine: Sequence[_SummaryRow], i: int, name: str
) -> Iterator[tuple[str, list[float], list[float], Separation]]:
    """For a quantity or each of its words, yield the name, both groups' values and their separation."""
    words = sorted({value for row in (*ended, *fine) if isinstance(value := row.drawn[i], str)})
    of_words: dict[str, str | None] = {f"share of {name} {word}": word for word in words}
    for shown, word in (of_words or {name: None}).items():
        first, second = _numbers(ended, i, word), _numbers(fine, i, word)
        if first and second:
            yield shown, first, second, separation(first, second)


def _numbers(rows: Sequence[_SummaryRow], i: int, word: str | None) -> list[float]:
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
