"""A campaign as one self-contained HTML file: rates with intervals, causes of failure, failed flights."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from dart_flight.config.document import InputError
from dart_flight.lab.campaign.campaign_summary import CampaignSummary
from dart_flight.lab.report.figures.success import success_figure, varied_figure
from dart_flight.lab.report.render import PageTable, Row, picture, render

_SHOWN = 12  # number of figures and failed flights shown; the rest is folded


def campaign_page(summary: CampaignSummary) -> str:
    correlated = {trend.figure for trend in summary.varied}
    success = _pictures(
        (success_figure(drawn), f"{drawn.name}: fraction of completed flights over the drawn value")
        for drawn in summary.drawn
    )
    varied = _pictures(
        (
            varied_figure(trend, _words(trend.figure)),
            f"{_words(trend.figure)} over {trend.name}: rank correlation {trend.correlation:.2f}, "
            f"p {trend.p_value:.2g}",
        )
        for trend in summary.varied
    )
    figures: list[Row] = [
        [name, s.count, s.median, s.low_5, s.high_95, s.high] for name, s in summary.figures.items()
    ]
    return render(
        "campaign.html",
        "Campaign",
        missing=summary.asked - summary.flights,
        asked=summary.asked,
        shown=_tiles(summary),
        software=summary.software,
        vary=", ".join(f"{name}={sd:g}" for name, sd in summary.vary.items()),
        errors=summary.errors,
        points=_points(summary),
        rules=_rules(summary),
        not_followed=_not_followed(summary).folded(_SHOWN),
        failed=_failed(summary).folded(_SHOWN),
        unlisted=sum(rule.flights for rule in summary.rules) - len(summary.failed),
        figures_of_flights=PageTable(["", "flights", "median", "5 %", "95 %", "most"], figures),
        success=success if summary.drawn else None,
        varied=varied if summary.tried else None,
        unrelated=[(_words(name), n) for name, n in summary.tried.items() if name not in correlated],
    )


def _pictures(figures: Iterable[tuple[Any, str]]) -> dict[str, Any]:
    """Return pictures with their captions, or the reason for their absence."""
    try:
        drawn = [(picture(figure), caption) for figure, caption in figures]
    except InputError as error:
        return {"problem": error.message}
    return {"problem": None, "first": drawn[:_SHOWN], "others": drawn[_SHOWN:]}


def _words(figure: str) -> str:
    name, unit = (figure[:-2], "m") if figure.endswith("_m") else (figure[:-2], "N")
    return f"{name.replace('_', ' ')}, {unit}"


def _tiles(summary: CampaignSummary) -> list[tuple[str, str]]:
    completed, interval = summary.completed.words("–")
    tiles = [
        (completed, "completed"),
        (interval, "95 % interval"),
        (f"{summary.completed.count} of {summary.completed.of}", "flights"),
    ]
    if summary.plan_followed.of:
        followed, interval = summary.plan_followed.words("–")
        tiles.append((followed, f"followed the plan, {interval}"))
    return tiles


def _points(summary: CampaignSummary) -> PageTable:
    keys = list(summary.points[0].settings)
    rows: list[Row] = [
        [p.mission, *p.settings.values(), p.completed.of, *p.completed.words("–"),
         p.plan_followed.words("–")[0]]
        for p in summary.points
    ]  # fmt: skip
    return PageTable(["mission", *keys, "flights", "completed", "95 % interval", "followed the plan"], rows)


def _rules(summary: CampaignSummary) -> PageTable:
    rows: list[Row] = []
    for rule in summary.rules:
        rows.append(f"{rule.rule}: {rule.flights} flights")
        rows += [[t.name, t.failed, t.completed, f"{100.0 * t.chance:.0f} %"] for t in rule.telling]
    return PageTable(["", "in these flights", "in completed flights", "higher in these"], rows)


def _not_followed(summary: CampaignSummary) -> PageTable:
    rows: list[Row] = [
        [d.mission, d.what, f"{d.flights} of {d.of}", d.not_flown or "", d.planned,
         "–" if d.flown is None else d.flown, "must be equal" if d.tolerance is None else d.tolerance]
        for d in summary.not_followed
    ]  # fmt: skip
    return PageTable(["mission", "figure", "flights", "not flown", "planned", "flown", "tolerance"], rows)


def _failed(summary: CampaignSummary) -> PageTable:
    keys = list(summary.failed[0].settings) if summary.failed else []
    rows: list[Row] = [
        [flight.mission, *flight.settings.values(), flight.seed, flight.outcome, flight.reason,
         {"command": flight.command, "log": flight.log}]
        for flight in summary.failed
    ]  # fmt: skip
    return PageTable(["mission", *keys, "seed", "outcome", "reason", "command to reproduce it"], rows)
