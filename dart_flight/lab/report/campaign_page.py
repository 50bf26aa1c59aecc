"""A campaign as one self-contained HTML file: rates with intervals, what fails and why, failed flights."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import Any

from dart_flight.config.document import InputError
from dart_flight.lab.campaign.campaign_summary import CampaignSummary, FailedFlight
from dart_flight.lab.report.figures.success import success_figure, varied_figure
from dart_flight.lab.report.markup import Markup, Row, details, figure_block, page, section, table

_SHOWN = 12  # figures, failed flights; the others are folded away


def campaign_page(summary: CampaignSummary) -> str:
    """The page of a campaign."""
    parts = [
        _head(summary),
        section("By mission and setting", _points(summary)),
        section("Why flights did not complete", _rules(summary)),
        *([section("What was not followed", _not_followed(summary))] if summary.not_followed else []),
        section("Flights that did not complete", _failed(summary)),
        section("Figures", _figures(summary)),
    ]
    if summary.drawn:
        parts.append(section("Success versus drawn quantity", _over_draws(summary)))
    if summary.tried:
        parts.append(section("Figures versus drawn quantity", _varied(summary)))
    return page("Campaign", parts)


def _over_draws(summary: CampaignSummary) -> str:
    note = (
        "<p class=note>Strongest effect first. Bins of about equal numbers of flights; bars are 95 % "
        "intervals (Wilson).</p>"
    )
    return note + _pictures(
        (success_figure(one), f"{one.name}: share of flights that completed, over what was drawn")
        for one in summary.drawn
    )


def _varied(summary: CampaignSummary) -> str:
    note = (
        "<p class=note>One point for each completed flight; for every figure at most two drawn quantities "
        "that correlate significantly (rank correlation, p below 0.05 corrected for the number tried). "
        "Quantities of walls that are hit later, in another mode or not at all are not tried.</p>"
    )
    followed = {one.figure for one in summary.varied}
    for figure, count in summary.tried.items():
        if figure not in followed:
            note += f"<p>{_words(figure)}: none of {count} drawn quantities is significant.</p>"
    return note + _pictures(
        (
            varied_figure(one, _words(one.figure)),
            f"{_words(one.figure)} over {one.name}: rank correlation {one.correlation:.2f}, "
            f"p {one.p_value:.2g}",
        )
        for one in summary.varied
    )


def _pictures(figures: Iterable[tuple[Any, str]]) -> str:
    """Figures with their captions; in their place what is missing to draw them: a campaign does without."""
    try:
        drawn = list(figures)
    except InputError as error:
        return f"<p class=note>Not drawn: {html.escape(error.message)}.</p>"
    first, others = drawn[:_SHOWN], drawn[_SHOWN:]
    return figure_block(*first) + (details(f"{len(others)} more", figure_block(*others)) if others else "")


def _words(figure: str) -> str:
    """A column with its unit, as a person reads it."""
    name, unit = (figure[:-2], "m") if figure.endswith("_m") else (figure[:-2], "N")
    return f"{name.replace('_', ' ')}, {unit}"


def _head(summary: CampaignSummary) -> str:
    missing = summary.asked - summary.flights
    completed, interval = summary.completed.words("–")
    tiles = [
        (completed, "completed"),
        (interval, "95 % interval"),
        (f"{summary.completed.count} of {summary.completed.of}", "flights"),
    ]
    if summary.plan_followed.of:
        followed, interval = summary.plan_followed.words("–")
        tiles.append((followed, f"followed the plan, {interval}"))
    text = "".join(f"<div class=tile><b>{value}</b><span>{name}</span></div>" for value, name in tiles)
    notes = [f"Flown by dart-flight {html.escape(summary.software)}."]
    if summary.vary:
        drawn = ", ".join(f"{name}={sd:g}" for name, sd in summary.vary.items())
        notes.append(f"Drawn anew by every seed (standard deviations): {html.escape(drawn)}.")
    if summary.errors:
        notes.append(f"{summary.errors} flights ended by a software error and are excluded from all rates.")
    reason = f"<p class=reason>{missing} of {summary.asked} flights are not flown yet.</p>" if missing else ""
    return f"<section>{reason}<div class=tiles>{text}</div><p class=note>{' '.join(notes)}</p></section>"


def _points(summary: CampaignSummary) -> str:
    keys = list(summary.points[0].settings)
    rows: list[Row] = [
        [p.mission, *p.settings.values(), p.completed.of, *p.completed.words("–"),
         p.plan_followed.words("–")[0]]
        for p in summary.points
    ]  # fmt: skip
    return table(["mission", *keys, "flights", "completed", "95 % interval", "followed the plan"], rows)


def _rules(summary: CampaignSummary) -> str:
    if not summary.rules:
        return "<p>Every flight completed.</p>"
    rows: list[Row] = []
    for rule in summary.rules:
        rows.append(f"{rule.rule}: {rule.flights} flights")
        rows += [[t.name, t.failed, t.completed, f"{100.0 * t.chance:.0f} %"] for t in rule.telling]
    note = (
        "<p class=note>Below each rule what was drawn otherwise in its flights than in those that completed: "
        "medians (of words: shares), and the chance that it is higher in a flight that the rule ended (Mann "
        "and Whitney; told from four standard deviations on). Nothing below a rule: nothing stands out.</p>"
    )
    return table(["", "in these", "in completed ones", "higher in these"], rows) + note


def _not_followed(summary: CampaignSummary) -> str:
    rows: list[Row] = [
        [d.mission, d.what, f"{d.flights} of {d.of}", d.not_flown or "", d.planned,
         "–" if d.flown is None else d.flown, "the same" if d.tolerance is None else d.tolerance]
        for d in summary.not_followed
    ]  # fmt: skip
    note = "<p class=note>Planned and flown are medians over the flights that were out of tolerance.</p>"
    heads = ["mission", "figure", "flights", "not flown", "planned", "flown", "tolerance"]
    first, rest = rows[:_SHOWN], rows[_SHOWN:]
    return table(heads, first) + (details(f"{len(rest)} more", table(heads, rest)) if rest else "") + note


def _figures(summary: CampaignSummary) -> str:
    rows: list[Row] = [
        [name, s.flights, s.median, s.low_5, s.high_95, s.most] for name, s in summary.figures.items()
    ]
    return table(["", "flights", "median", "5 %", "95 %", "most"], rows)


def _failed(summary: CampaignSummary) -> str:
    if not summary.failed:
        return "<p>None.</p>"
    keys = list(summary.failed[0].settings)
    rows: list[Row] = [
        [one.mission, *one.settings.values(), one.seed, one.outcome, one.reason, _again(one)]
        for one in summary.failed
    ]
    others = sum(rule.flights for rule in summary.rules) - len(summary.failed)
    note = f"<p class=note>{others} more are in flights.csv.</p>" if others > 0 else ""
    heads = ["mission", *keys, "seed", "outcome", "reason", "command to reproduce it"]
    first, rest = rows[:_SHOWN], rows[_SHOWN:]
    return table(heads, first) + (details(f"{len(rest)} more", table(heads, rest) + note) if rest else "")


def _again(one: FailedFlight) -> Markup:
    command = f"<code>{html.escape(one.command)}</code>"
    link = f' <a href="{html.escape(one.log)}">log</a>' if one.log else ""
    return Markup(command + link)
