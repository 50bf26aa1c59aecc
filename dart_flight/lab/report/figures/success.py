"""What the flights of a campaign amount to over what was drawn for them."""

from __future__ import annotations

from typing import Any

from dart_flight.lab.campaign.campaign_summary import Drawn, FigureTrend
from dart_flight.lab.figure_style import ESTIMATED, PAGE, in_style, new_figure

_HIGH_IN = 2.3


@in_style
def success_figure(drawn: Drawn) -> Any:
    """Share of flights that completed over one drawn quantity, with its 95 % intervals."""
    figure, axis = new_figure(PAGE, _HIGH_IN)
    numbers = [one for one in drawn.bins if one.low is not None and one.high is not None]
    shown, places, line = [], [], ""
    for place, one in enumerate(numbers or drawn.bins):
        if one.completed.share is not None:
            shown.append(one.completed)
            places.append(place if one.low is None or one.high is None else 0.5 * (one.low + one.high))
    shares = [100.0 * (rate.share or 0.0) for rate in shown]
    # Rounding may put the share itself outside of its interval.
    below = [max(s - 100.0 * (rate.low or 0.0), 0.0) for s, rate in zip(shares, shown, strict=True)]
    above = [max(100.0 * (rate.high or 0.0) - s, 0.0) for s, rate in zip(shares, shown, strict=True)]
    if numbers:
        line = "-"
    else:
        names = [f"{one.value} ({one.completed.of})" for one in drawn.bins]
        axis.set_xticks(range(len(names)), names)
        axis.set_xlim(-0.5, len(names) - 0.5)
    axis.errorbar(places, shares, (below, above), fmt=f"o{line}", color=ESTIMATED["color"], capsize=3)
    axis.set(ylim=(-3.0, 103.0), xlabel=drawn.name, ylabel="completed, %")
    return figure


@in_style
def varied_figure(varied: FigureTrend, words: str) -> Any:
    """A figure of the flights, called so, over one drawn quantity: a point each."""
    figure, axis = new_figure(PAGE, _HIGH_IN)
    axis.plot(*zip(*varied.points, strict=True), ".", color=ESTIMATED["color"], markersize=4)
    axis.set(xlabel=varied.name, ylabel=words)
    return figure
