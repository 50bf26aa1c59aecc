"""A campaign as one self-contained HTML file: rates with intervals, what fails and why, failed flights."""

from __future__ import annotations

import html
from collections.abc import Sequence

from dart_flight.lab.campaign.statistics import Share
from dart_flight.lab.campaign.summary import Bin, CampaignSummary, Drawn, Failed, Varied
from dart_flight.lab.report.markup import Markup, Row, details, page, section, shown, table

_SHOWN = 12  # figures, failed flights; the others are folded away
_WIDTH, _HEIGHT = 360, 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 8, 10, 34
_BLUE, _INK, _LINE = "#0072B2", "#1a1a1a", "#d0d0d0"


def campaign_page(summary: CampaignSummary) -> str:
    """The page of a campaign."""
    parts = [
        _head(summary),
        section("By mission and setting", _points(summary)),
        section("Why flights did not complete", _rules(summary)),
        section("Flights that did not complete", _failed(summary)),
        section("Figures", _figures(summary)),
    ]
    if summary.drawn:
        parts.append(section("Success over what was drawn", _over_draws(summary)))
    if summary.varied:
        parts.append(section("What varied over what was drawn", _varied(summary)))
    return page("Campaign", parts)


def _over_draws(summary: CampaignSummary) -> str:
    drawn = [
        (success_figure(one), f"{one.name}: share of flights that completed, over what was drawn")
        for one in summary.drawn
    ]
    note = (
        "<p class=note>What tells most comes first. Bins of about equal numbers of flights; bars are 95 % "
        "intervals (Wilson).</p>"
    )
    first, others = drawn[:_SHOWN], drawn[_SHOWN:]
    return note + shown(*first) + (details(f"{len(others)} more", shown(*others)) if others else "")


def _varied(summary: CampaignSummary) -> str:
    figures = [
        (
            varied_figure(one),
            f"{_words(one.figure)} over {one.name}: rank correlation {one.correlation:.2f}",
        )
        for one in summary.varied
    ]
    note = (
        "<p class=note>Flights that completed, a point each; for every figure the two drawn quantities that "
        "it follows most.</p>"
    )
    return note + shown(*figures)


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
        notes.append(f"{summary.errors} flights ended by a fault of the program and count in no rate.")
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
    heads = ["mission", *keys, "seed", "outcome", "reason", "to see it again"]
    first, rest = rows[:_SHOWN], rows[_SHOWN:]
    return table(heads, first) + (details(f"{len(rest)} more", table(heads, rest) + note) if rest else "")


def _again(one: Failed) -> Markup:
    command = f"<code>{html.escape(one.command)}</code>"
    link = f' <a href="{html.escape(one.log)}">log</a>' if one.log else ""
    return Markup(command + link)


# --- the figure of one quantity --------------------------------------------------------------------------


def success_figure(drawn: Drawn) -> str:
    """Success over one drawn quantity, as SVG text."""
    numbers = [one for one in drawn.bins if one.low is not None and one.high is not None]
    return _svg(_axis() + (_over_numbers(numbers) if numbers else _over_words(drawn.bins)))


def varied_figure(varied: Varied) -> str:
    """A figure of the flights over one drawn quantity, as SVG text."""
    xs, ys = zip(*varied.points, strict=True)
    low_x, low_y = min(xs), min(ys)
    width, height = max(xs) - low_x or 1.0, max(ys) - low_y or 1.0
    parts = []
    for share in (0.0, 0.5, 1.0):
        y = _y(share)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="{_LINE}"/>')
        parts.append(
            f'<text x="{_LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{low_y + share * height:.2g}</text>'
        )
    for x, y in varied.points:
        at = _LEFT + (x - low_x) / width * (_WIDTH - _LEFT - _RIGHT)
        parts.append(f'<circle cx="{at:.1f}" cy="{_y((y - low_y) / height):.1f}" r="2" fill="{_BLUE}"/>')
    below = _HEIGHT - _BOTTOM + 16
    for share, anchor in ((0.0, "start"), (0.5, "middle"), (1.0, "end")):
        at = _LEFT + share * (_WIDTH - _LEFT - _RIGHT)
        parts.append(
            f'<text x="{at:.1f}" y="{below}" text-anchor="{anchor}">{low_x + share * width:.3g}</text>'
        )
    return _svg("".join(parts))


def _svg(inside: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-size="11" '
        f'font-family="DejaVu Sans, Arial, sans-serif" fill="{_INK}">{inside}</svg>'
    )


def _y(value: float) -> float:
    return _TOP + (1.0 - value) * (_HEIGHT - _TOP - _BOTTOM)


def _axis() -> str:
    parts = []
    for value in (0.0, 0.5, 1.0):
        y = _y(value)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="{_LINE}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{100 * value:.0f} %</text>')
    return "".join(parts)


def _over_numbers(bins: Sequence[Bin]) -> str:
    low, high = bins[0].low or 0.0, bins[-1].high or 0.0
    span = (high - low) or 1.0

    def x(value: float) -> float:
        return _LEFT + (value - low) / span * (_WIDTH - _LEFT - _RIGHT)

    parts, middles = [], []
    for one in bins:
        left, right = x(one.low or 0.0), x(one.high or 0.0)
        if one.completed.share is not None:
            middles.append(f"{(left + right) / 2:.1f} {_y(one.completed.share):.1f}")
            parts.append(_mark((left + right) / 2, one.completed))
    if len(middles) > 1:
        parts.insert(
            0, f'<path d="M{" L".join(middles)}" fill="none" stroke="{_BLUE}" stroke-opacity="0.4"/>'
        )
    below = _HEIGHT - _BOTTOM + 16
    for value, anchor in ((low, "start"), (low + span / 2, "middle"), (high, "end")):
        parts.append(f'<text x="{x(value):.1f}" y="{below}" text-anchor="{anchor}">{value:.3g}</text>')
    return "".join(parts)


def _over_words(bins: Sequence[Bin]) -> str:
    width = (_WIDTH - _LEFT - _RIGHT) / max(1, len(bins))
    parts = []
    for i, one in enumerate(bins):
        middle = _LEFT + (i + 0.5) * width
        parts.append(_mark(middle, one.completed))
        text = html.escape(f"{one.value} ({one.completed.of})")
        parts.append(
            f'<text x="{middle:.1f}" y="{_HEIGHT - _BOTTOM + 16}" text-anchor="middle">{text}</text>'
        )
    return "".join(parts)


def _mark(x: float, rate: Share) -> str:
    """A point with its interval."""
    if rate.share is None or rate.low is None or rate.high is None:
        return ""
    return (
        f'<path d="M{x:.1f} {_y(rate.low):.1f}V{_y(rate.high):.1f}" stroke="{_BLUE}" stroke-width="2"/>'
        f'<circle cx="{x:.1f}" cy="{_y(rate.share):.1f}" r="3.5" fill="{_BLUE}"/>'
    )
