"""Plots of a campaign over its random quantities (docs/draws.md): success rates and flight results."""

from __future__ import annotations

from typing import Any

from dart_flight.lab.campaign.campaign_summary import Drawn, FigureTrend
from dart_flight.lab.figure_style import ESTIMATED, PAGE, in_style, new_figure

_HIGH_IN = 2.3


@in_style
def success_figure(drawn: Drawn) -> Any:
    """Plot the fraction of completed flights over one random quantity, with 95 % intervals."""
    figure, axis = new_figure(PAGE, _HIGH_IN)
    numbers = [each for each in drawn.bins if each.low is not None and each.high is not None]
    shown, places, line = [], [], ""
    for place, each in enumerate(numbers or drawn.bins):
        if each.completed.share is not None:
            shown.append(each.completed)
            places.append(place if each.low is None or each.high is None else 0.5 * (each.low + each.high))
    shares = [100.0 * (rate.share or 0.0) for rate in shown]
    # Rounding may move the fraction outside of its interval.
    below = [max(s - 100.0 * (rate.low or 0.0), 0.0) for s, rate in zip(shares, shown, strict=True)]
    above = [max(100.0 * (rate.high or 0.0) - s, 0.0) for s, rate in zip(shares, shown, strict=True)]
    if numbers:
        line = "-"
    else:
        names = [f"{each.value} ({each.completed.of})" for each in drawn.bins]
        axis.set_xticks(range(len(names)), names)
        axis.set_xlim(-0.5, len(names) - 0.5)
    axis.errorbar(places, shares, (below, above), fmt=f"o{line}", color=ESTIMATED["color"], capsize=3)
    axis.set(ylim=(-3.0, 103.0), xlabel=drawn.name, ylabel="completed, %")
    return figure


@in_style
def varied_figure(varied: FigureTrend, words: str) -> Any:
    """Plot one result of the completed flights over one random quantity, one point per flight."""
    figure, axis = new_figure(PAGE, _HIGH_IN)
    axis.plot(*zip(*varied.points, strict=True), ".", color=ESTIMATED["color"], markersize=4)
    axis.set(xlabel=varied.name, ylabel=words)
    return figure
