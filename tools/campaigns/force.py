"""Force campaign: estimate against the plant's truth, and the detector's operating curve.

    python -m tools.campaigns.force

Writes docs/results/force.md and its pictures. `make test` takes a seeded sample of the same (tests/core).
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import matplotlib as mpl
import msgspec

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.sense.state import FlightState
from tools.campaigns.force_hits import Hit, direction_error_deg, fly_hit, grid, judge_hit
from tools.campaigns.force_quiet import Quiet, fly_quiet

mpl.use("Agg")
from matplotlib import pyplot as plt

from tools.campaigns.results import RESULTS, ROOT, measured_by

SPEEDS = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0)
CLIPPED_SPEEDS = (3.25, 3.5, 4.0, 4.5)
ORIENTATIONS = tuple(45.0 * i for i in range(8))
TILTS = (0.0, 15.0, 30.0)
SIGMAS = (0.2, 0.5, 1.0)
# An hour per noise level. The threshold was chosen on seeds 1 and 2 of an earlier run: these are others.
QUIET_S, QUIET_SEEDS = 600.0, tuple(range(101, 107))
THRESHOLDS = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.0, 10.0)


class Row(msgspec.Struct):
    """One hit under one noise, in figures; errors are nan where nothing was detected."""

    hit: Hit
    sigma: float
    clipped: bool
    reached: bool  # the true force of a tick reached the threshold
    onsets: int
    contacts: int
    delay_samples: int | None
    peak_error: float  # relative
    friction_error: float  # relative; nan where friction is below 3 N
    direction_deg: float
    fitted: bool
    statistic: float
    raw_error: float  # of the largest tick mean without noise: what averaging and sampling take away


def mission() -> Mission:
    """The dual collision, of a point."""
    path = ROOT / "missions" / "paper_dual_collision.yaml"
    return load_mission(path, settings=["simulation.contact.body=point"])


def judge(mission: Mission, hit: Hit, sigmas: Sequence[float], seed: int) -> list[Row]:
    """Fly one hit and estimate it under each noise."""
    vehicle = mission.vehicle
    flown = fly_hit(vehicle, hit)
    rows = []
    for sigma in sigmas:
        judged = judge_hit(vehicle, FlightState(), flown, sigma, seed)
        peak, nan = judged.peak, math.nan
        delay = None
        if judged.onsets and flown.cross_us is not None:
            delay = (judged.onsets[0].t_us - flown.cross_us) // 4000
        friction = abs(flown.peak_tangential(peak.detected_us)) if peak else 0.0
        clean = max((t.contact_n[0] for t in flown.ticks), default=0.0)
        rows.append(
            Row(
                hit=hit,
                sigma=sigma,
                clipped=peak.clipped if peak else False,
                reached=flown.cross_us is not None,
                onsets=len(judged.onsets),
                contacts=flown.contacts,
                delay_samples=delay,
                peak_error=peak.normal_force_n / flown.peak_normal - 1.0 if peak else nan,
                friction_error=abs(peak.tangential_force_n) / friction - 1.0
                if peak and friction > 3.0
                else nan,
                direction_deg=direction_error_deg(flown, peak) if peak else nan,
                fitted=peak.fitted if peak else False,
                statistic=judged.statistic,
                raw_error=clean / flown.peak_normal - 1.0 if flown.peak_normal > 0.0 else nan,
            )
        )
    return rows


def _job(arguments: tuple[int, Hit]) -> list[Row]:
    number, hit = arguments
    return judge(mission(), hit, SIGMAS, 1000 + number)


def fly_grid() -> list[Row]:
    """Every hit of the grid and of the clipping speeds (rigid), on two processes."""
    hits = list(grid(SPEEDS, ORIENTATIONS, TILTS))
    hits += [h for h in grid(CLIPPED_SPEEDS, ORIENTATIONS[:4], TILTS) if h.mode is Mode.RIGID]
    with ProcessPoolExecutor(2) as pool:
        return [row for rows in pool.map(_job, enumerate(hits), chunksize=16) for row in rows]


def _quiet(arguments: tuple[float, int, bool]) -> Quiet:
    return fly_quiet(mission(), QUIET_S, *arguments)


def fly_hour(rough: bool = False) -> list[Quiet]:
    """An hour without contact for every noise level, in parts; half of it in rough weather."""
    seeds = QUIET_SEEDS[: len(QUIET_SEEDS) // 2] if rough else QUIET_SEEDS
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(_quiet, [(s, seed, rough) for s in SIGMAS for seed in seeds]))


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which a share of the finite ones lies; nan without any."""
    ordered = sorted(v for v in values if math.isfinite(v))
    return ordered[min(len(ordered) - 1, round(share * (len(ordered) - 1)))] if ordered else math.nan


# --- report --------------------------------------------------------------------------------------------


def _accuracy_table(rows: list[Row]) -> str:
    lines = [
        "| noise m/s² | hits | peak error median | 95th | largest | mean (bias) | friction median | 95th "
        "| direction 95th | largest |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for clipped in (False, True):
        for sigma in SIGMAS:
            some = [
                r for r in rows if r.sigma == sigma and r.clipped is clipped and math.isfinite(r.peak_error)
            ]
            if not some:
                continue
            e = [abs(r.peak_error) for r in some]
            f = [abs(r.friction_error) for r in some]
            d = [r.direction_deg for r in some]
            lines.append(
                f"| {sigma}{', clipped' if clipped else ''} | {len(some)} | {percentile(e, 0.5):.2%} "
                f"| {percentile(e, 0.95):.2%} | {max(e):.2%} "
                f"| {statistics.mean(r.peak_error for r in some):+.2%} "
                f"| {percentile(f, 0.5):.1%} | {percentile(f, 0.95):.1%} | {percentile(d, 0.95):.2f}° "
                f"| {max(d):.2f}° |"
            )
    return "\n".join(lines)


def _detection_table(rows: list[Row]) -> str:
    lines = [
        "| noise m/s² | hits that reach the threshold | detected | more than one detection per contact "
        "| samples after the crossing: <= 0, 1, 2, more | hits below the threshold |",
        "|---|---|---|---|---|---|",
    ]
    for sigma in SIGMAS:
        some = [r for r in rows if r.sigma == sigma]
        reached = [r for r in some if r.reached]
        delays = [r.delay_samples for r in reached if r.delay_samples is not None]
        counts = (sum(d <= 0 for d in delays), delays.count(1), delays.count(2), sum(d > 2 for d in delays))
        lines.append(
            f"| {sigma} | {len(reached)} | {sum(r.onsets > 0 for r in reached)} "
            f"| {sum(r.onsets > r.contacts for r in reached)} | {', '.join(map(str, counts))} "
            f"| {len(some) - len(reached)} |"
        )
    return "\n".join(lines)


def _roc(rows: list[Row], hour: list[Quiet]) -> list[tuple[float, list[float], list[float]]]:
    """By the detection statistic: threshold, detected shares and false hits per hour, of each noise level."""
    out = []
    for threshold in THRESHOLDS:
        found, false = [], []
        for sigma in SIGMAS:
            hits = [r for r in rows if r.sigma == sigma and r.reached]
            found.append(sum(r.statistic >= threshold for r in hits) / max(1, len(hits)))
            quiet = [q for q in hour if q.sigma == sigma]
            events = sum(m >= threshold for q in quiet for m in q.maxima)
            false.append(events * 3600.0 / sum(q.seconds for q in quiet))
        out.append((threshold, found, false))
    return out


def _roc_table(rows: list[Row], hour: list[Quiet]) -> str:
    lines = [
        "| threshold N | " + " | ".join(f"detected, {s} | false per hour, {s}" for s in SIGMAS) + " |",
        "|---|" + "---|---|" * len(SIGMAS),
    ]
    for threshold, found, false in _roc(rows, hour):
        cells = " | ".join(f"{a:.1%} | {b:.0f}" for a, b in zip(found, false, strict=True))
        lines.append(f"| {threshold:g} | {cells} |")
    return "\n".join(lines)


def _hour_table(hour: list[Quiet], rough: list[Quiet]) -> str:
    lines = [
        "| noise m/s² | flight | false hits | largest statistic | largest tilt | landings "
        "| wind's force up to |",
        "|---|---|---|---|---|---|---|",
    ]
    for weather, sigma in itertools.product(("", ", rough"), SIGMAS):
        some = [q for q in (rough if weather else hour) if q.sigma == sigma]
        lines.append(
            f"| {sigma}{weather} | {sum(q.seconds for q in some) / 60:.0f} min "
            f"| {sum(len(q.false_hits) for q in some)} "
            f"| {max(max(q.maxima) for q in some):.2f} N | {max(q.max_tilt_deg for q in some):.0f}° "
            f"| {sum(q.landings for q in some)} | {max(q.wind_force_n for q in some):.1f} N |"
        )
    return "\n".join(lines)


def _plot_errors(rows: list[Row], path: Path) -> None:
    figure, axes = plt.subplots(1, len(SIGMAS), figsize=(10, 3.4), sharey=True)
    for axis, sigma in zip(axes, SIGMAS, strict=True):
        for mode, colour, shift in ((Mode.RIGID, "tab:blue", 0.99), (Mode.FLEXIBLE, "tab:orange", 1.01)):
            for clipped, mark in ((False, "o"), (True, "x")):
                some = [
                    r for r in rows if r.sigma == sigma and r.hit.mode is mode and r.clipped is clipped
                    and math.isfinite(r.peak_error)
                ]  # fmt: skip
                axis.plot(
                    [-r.hit.normal_m_s * shift for r in some],
                    [100.0 * r.peak_error for r in some],
                    mark,
                    color="tab:red" if clipped else colour,
                    markersize=3,
                    alpha=0.5,
                    label=f"{mode.value}{', clipped' if clipped else ''}" if some else None,
                )
        axis.axhspan(-5.0, 5.0, color="0.92", zorder=0)
        axis.set_xscale("log")
        axis.set_xticks([0.3, 0.5, 1.0, 2.0, 4.0], ["0.3", "0.5", "1", "2", "4"])
        axis.minorticks_off()
        axis.set_title(f"noise {sigma} m/s²")
        axis.set_xlabel("normal speed, m/s")
    axes[0].set_ylabel("peak force error, %")
    axes[-1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _plot_roc(rows: list[Row], hour: list[Quiet], path: Path) -> None:
    figure, axis = plt.subplots(figsize=(5.5, 3.6))
    points = _roc(rows, hour)
    for i, sigma in enumerate(SIGMAS):
        axis.plot(
            [p[2][i] for p in points], [100.0 * p[1][i] for p in points], "o-", label=f"noise {sigma} m/s²"
        )
    for threshold, found, false in points:
        if threshold in (3.0, 5.0, 8.0):
            axis.annotate(
                f"{threshold:g} N",
                (false[0], 100.0 * found[0]),
                (4, -12),
                textcoords="offset points",
                fontsize=8,
            )
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set_xlabel("false hits per hour of aggressive flight")
    axis.set_ylabel("hits detected, %")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def report(rows: list[Row], hour: list[Quiet], rough: list[Quiet]) -> str:
    """The results page."""
    averaging = [r.raw_error for r in rows if r.sigma == SIGMAS[0] and r.hit.mode is Mode.RIGID and r.reached]
    away = [r for r in rows if not r.reached and r.sigma == SIGMAS[0]]
    kinds = ", ".join(sorted({f"{-r.hit.normal_m_s:g} m/s at {r.hit.tilt_deg:g}°" for r in away}))
    leans = ", ".join(sorted({r.hit.lean for r in away}))
    return f"""# Force estimate and detection: results

{measured_by("tools.campaigns.force")}

What it means: [force.md](../force.md).

Grid: {len(SPEEDS)} speeds from {SPEEDS[0]} to {SPEEDS[-1]} m/s, both modes, wood and acrylic,
{len(ORIENTATIONS)} wall orientations, tilts of {", ".join(f"{t:g}°" for t in TILTS)} with the thrust leaning
into the wall, along it
or away from it, sliding at none or half of the normal speed either way; each hit at three noise levels of the
IMU (standard deviation of one 250 Hz sample and axis). Further rigid hits at {CLIPPED_SPEEDS[0]} to
{CLIPPED_SPEEDS[-1]} m/s clip the IMU at 16 g. Truth is the plant's, sampled every millisecond.

## Peak force

{_accuracy_table(rows)}

![Peak force error](../img/force_errors.png)

The largest tick mean of a rigid contact, without any noise, lies {-percentile(averaging, 0.5):.2%} (median)
and at most {-min(v for v in averaging if math.isfinite(v)):.2%} below its true peak: what averaging over the
tick and the sampling's phase take away. The fit puts it back.

## Detection

{_detection_table(rows)}

The crossing is the first tick whose true mean force reaches the threshold. Hits below the threshold: thrust
leaning {leans} ({kinds}), where the vehicle is braking so hard that it hardly touches.

An hour of aggressive flight without contact for every noise level, other seeds than the threshold was chosen
on (velocity reversals, braking, spins, climbs, landings, gusts, prop wash, thrust curve up to 8 % and drag up
to 30 % off, 1 % lost and 1 % late samples, pauses up to 48 ms); "rough": gusts of 4 to 6 m/s within half a
second instead of 2 to 4, and twice the turbulence, beyond what the threshold was chosen for:

{_hour_table(hour, rough)}

{_roc_table(rows, hour)}

![Receiver operating curve](../img/force_roc.png)

False hits here are crossings of the threshold by the detection statistic, counted once in 0.4 s.
"""


def run(docs: Path) -> None:
    """Everything, into `docs`/results/force.md and `docs`/img."""
    (docs / "img").mkdir(parents=True, exist_ok=True)
    rows = fly_grid()
    hour, rough = fly_hour(), fly_hour(rough=True)
    _plot_errors(rows, docs / "img" / "force_errors.png")
    _plot_roc(rows, hour, docs / "img" / "force_roc.png")
    (docs / "results" / "force.md").write_text(report(rows, hour, rough), encoding="utf-8")


if __name__ == "__main__":
    run(RESULTS.parent)
