"""Force campaign: estimate against the plant's truth, the detector's operating curve, the paper's check.

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

from dart_flight.base.records import (
    ContactEnd,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    Mode,
    TruthContact,
    TruthSample,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.core.sense.state import FlightState
from dart_flight.run.fast import FastFlight
from tests.oracles.point_law import contact_force
from tools.campaigns.force_hits import Hit, direction_error_deg, fly_hit, grid, judge_hit
from tools.campaigns.force_quiet import Quiet, fly_quiet

mpl.use("Agg")
from matplotlib import pyplot as plt

from tools.campaigns.results import RESULTS, measured_by

ROOT = Path(__file__).parents[2]
SPEEDS = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0)
WRONG_SPEEDS = (0.3, 0.75, 1.5, 3.0)
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


def missions() -> tuple[Mission, Mission]:
    """Dual collision and single wall."""
    return (
        load_mission(
            ROOT / "missions" / "paper_dual_collision.yaml", settings=["simulation.contact.body=point"]
        ),
        load_mission(
            ROOT / "missions" / "paper_single_wall.yaml", settings=["simulation.contact.body=point"]
        ),
    )


def judge(
    mission: Mission, hit: Hit, sigmas: Sequence[float], seed: int, believed: VehicleConfig | None = None
) -> list[Row]:
    """Fly one hit and estimate it under each noise; `believed` is the estimator's, where not the plant's."""
    vehicle = mission.vehicle
    flown = fly_hit(vehicle, hit)
    rows = []
    for sigma in sigmas:
        judged = judge_hit(vehicle, FlightState(), flown, sigma, seed, believed)
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
    return judge(missions()[0], hit, SIGMAS, 1000 + number)


def fly_grid() -> list[Row]:
    """Every hit of the grid and of the clipping speeds (rigid), on two processes."""
    hits = list(grid(SPEEDS, ORIENTATIONS, TILTS))
    hits += [h for h in grid(CLIPPED_SPEEDS, ORIENTATIONS[:4], TILTS) if h.mode is Mode.RIGID]
    with ProcessPoolExecutor(2) as pool:
        return [row for rows in pool.map(_job, enumerate(hits), chunksize=16) for row in rows]


def _quiet(arguments: tuple[float, int, bool]) -> Quiet:
    return fly_quiet(missions()[0], QUIET_S, *arguments)


def fly_hour(rough: bool = False) -> list[Quiet]:
    """An hour without contact for every noise level, in parts; half of it in rough weather."""
    seeds = QUIET_SEEDS[: len(QUIET_SEEDS) // 2] if rough else QUIET_SEEDS
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(_quiet, [(s, seed, rough) for s in SIGMAS for seed in seeds]))


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which a share of the finite ones lies; nan without any."""
    ordered = sorted(v for v in values if math.isfinite(v))
    return ordered[min(len(ordered) - 1, round(share * (len(ordered) - 1)))] if ordered else math.nan


# --- an estimator that is wrong about the vehicle ------------------------------------------------------


def wrong_beliefs(v: VehicleConfig) -> dict[str, VehicleConfig]:
    """What the estimator may be wrong about, by name."""
    replace = msgspec.structs.replace
    arms = v.estimation.arm_vibration
    assert arms is not None

    def of_arms(**what: float) -> VehicleConfig:
        return replace(v, estimation=replace(v.estimation, arm_vibration=replace(arms, **what)))

    def of_drag(factor: float) -> VehicleConfig:
        x, y, z = v.airframe.drag_per_s
        return replace(v, airframe=replace(v.airframe, drag_per_s=(factor * x, factor * y, factor * z)))

    found = {"nothing": v}
    for sign, part in (("+", 1.0), ("−", -1.0)):
        lag = v.thrust.motor_lag_s * (1.0 + 0.3 * part)
        found[f"motor lag {sign}30 %"] = replace(v, thrust=replace(v.thrust, motor_lag_s=lag))
        hz = v.imu.antialias_hz * (1.0 + 0.3 * part)
        found[f"anti-alias filter {sign}30 %"] = replace(v, imu=replace(v.imu, antialias_hz=hz))
        found[f"arms' frequency {sign}20 %"] = of_arms(frequency_hz=arms.frequency_hz * (1.0 + 0.2 * part))
        found[f"arms' damping {sign}50 %"] = of_arms(damping_ratio=arms.damping_ratio * (1.0 + 0.5 * part))
        found[f"arms' mass {sign}30 %"] = of_arms(mass_fraction=arms.mass_fraction * (1.0 + 0.3 * part))
        mass = v.airframe.mass_kg * (1.0 + 0.03 * part)
        found[f"mass {sign}3 %"] = replace(v, airframe=replace(v.airframe, mass_kg=mass))
        found[f"drag {sign}30 %"] = of_drag(1.0 + 0.3 * part)
    return found


def _wrong_job(arguments: tuple[int, Hit]) -> list[tuple[str, Row]]:
    number, hit = arguments
    mission = missions()[0]
    return [
        (name, judge(mission, hit, SIGMAS[:1], 5000 + number, believed)[0])
        for name, believed in wrong_beliefs(mission.vehicle).items()
    ]


def fly_wrong() -> list[tuple[str, Row]]:
    """A part of the grid under the least noise, for every wrong belief."""
    hits = list(grid(WRONG_SPEEDS, ORIENTATIONS[:2], TILTS))
    with ProcessPoolExecutor(2) as pool:
        return [row for rows in pool.map(_wrong_job, enumerate(hits), chunksize=8) for row in rows]


# --- the paper's check ---------------------------------------------------------------------------------


class InFlight(msgspec.Struct):
    """One simulated flight into acrylic at (-1, 0.5) m/s: peaks in newton, vertical means in newton."""

    mode: Mode
    seed: int
    plant: str
    predicted: float
    estimated: float
    true: float
    predicted_z: float
    estimated_z: float
    true_z: float


def predict(vehicle: VehicleConfig, c: Coefficients, normal: float, tangential: float) -> tuple[float, float]:
    """Peak normal force and mean vertical force of a contact by the law alone, stepped at 10 us."""
    x, vx, vy, h = 0.0, normal, tangential, 1e-5
    onset, mass = Onset(vehicle.onset), vehicle.airframe.mass_kg
    x = -c.f * normal / c.k if onset is Onset.LCP else 0.0
    peak = vertical = 0.0
    steps = 0
    for _ in range(100_000):
        x += h * vx
        force = contact_force(c, onset, x, (vx, vy, 0.0), vehicle.vertical_force_sign)
        if force[0] <= 0.0 and vx > 0.0:
            break
        vx, vy = vx + h * force[0] / mass, vy + h * force[1] / mass
        peak, vertical, steps = max(peak, force[0]), vertical - force[2], steps + 1
    return peak, vertical / max(1, steps)


def fly_check(mode: Mode, seed: int, factors: tuple[float, float, float], name: str) -> InFlight:
    """Fly the single wall with the plant's k, f, mu multiplied; prediction and core keep theirs."""
    mission = missions()[1]
    collision = msgspec.structs.replace(mission.collisions[0], mode=mode)
    mission = msgspec.structs.replace(mission, collisions=(collision,))
    records: list[object] = []
    flight = FastFlight(mission, seed, observe=lambda record, number: records.append(record))
    plant = flight.autopilot.plant
    acrylic = plant.vehicle.materials["acrylic"]
    c = acrylic.of(mode)
    other = msgspec.structs.replace(c, k=c.k * factors[0], f=c.f * factors[1], mu=c.mu * factors[2])
    changed = msgspec.structs.replace(acrylic, **{mode.value: other})
    plant.vehicle = msgspec.structs.replace(
        plant.vehicle, materials={**plant.vehicle.materials, "acrylic": changed}
    )
    flight.run()
    onset = next(r for r in records if isinstance(r, ImpactOnset))
    peak = next(r for r in records if isinstance(r, ImpactPeak))
    end = next(r for r in records if isinstance(r, ContactEnd))
    truth = next(r for r in records if isinstance(r, TruthContact))
    v = collision.wall.to_collision(onset.velocity_mission)
    predicted, predicted_z = predict(mission.vehicle, c, v[0], v[1])
    found = [
        r.force_mission[2]
        for r in records
        if isinstance(r, ForceEstimate) and end.first_us <= r.t_us < end.t_us
    ]
    real = [
        r.contact_force_mission[2]
        for r in records
        if isinstance(r, TruthSample) and truth.t_us <= r.t_us <= truth.end_us
    ]
    return InFlight(
        mode, seed, name, predicted, peak.normal_force_n, truth.peak_normal_force_n,
        predicted_z, statistics.mean(found), statistics.mean(real),
    )  # fmt: skip


def fly_checks() -> list[InFlight]:
    """Three seeds a mode with the plant as predicted, and with k, f, mu off by 20 % one at a time and all."""
    plants = {"as predicted": (1.0, 1.0, 1.0)}
    for sign, factor in (("+", 1.2), ("-", 0.8)):
        plants[f"k {sign}20 %"] = (factor, 1.0, 1.0)
        plants[f"f {sign}20 %"] = (1.0, factor, 1.0)
        plants[f"mu {sign}20 %"] = (1.0, 1.0, factor)
        plants[f"all {sign}20 %"] = (factor, factor, factor)
    jobs = [(mode, seed, f, name) for name, f in plants.items() for mode in Mode for seed in (1, 2, 3)]
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(fly_check, *zip(*jobs, strict=True)))


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


def _wrong_table(wrong: list[tuple[str, Row]]) -> str:
    lines = [
        "| the estimator is wrong about | arms | hits | detected | peak error median | 95th | mean (bias) "
        "| direction 95th |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(name for name, _ in wrong):
        for mode in Mode:
            some = [r for n, r in wrong if n == name and r.hit.mode is mode and r.reached]
            errors = [r.peak_error for r in some if math.isfinite(r.peak_error)]
            lines.append(
                f"| {name} | {mode.value} | {len(some)} | {sum(r.onsets > 0 for r in some)} "
                f"| {percentile([abs(e) for e in errors], 0.5):.1%} "
                f"| {percentile([abs(e) for e in errors], 0.95):.1%} | {statistics.mean(errors):+.1%} "
                f"| {percentile([r.direction_deg for r in some], 0.95):.1f}° |"
            )
    return "\n".join(lines)


def _roc(rows: list[Row], hour: list[Quiet]) -> list[tuple[float, float, list[float], list[float]]]:
    """(threshold, sigma) -> detected share and false hits per hour, by the detection statistic."""
    out = []
    for threshold in THRESHOLDS:
        found, false = [], []
        for sigma in SIGMAS:
            hits = [r for r in rows if r.sigma == sigma and r.reached]
            found.append(sum(r.statistic >= threshold for r in hits) / max(1, len(hits)))
            quiet = [q for q in hour if q.sigma == sigma]
            events = sum(m >= threshold for q in quiet for m in q.maxima)
            false.append(events * 3600.0 / sum(q.seconds for q in quiet))
        out.append((threshold, 0.0, found, false))
    return out


def _roc_table(rows: list[Row], hour: list[Quiet]) -> str:
    lines = [
        "| threshold N | " + " | ".join(f"detected, {s} | false per hour, {s}" for s in SIGMAS) + " |",
        "|---|" + "---|---|" * len(SIGMAS),
    ]
    for threshold, _, found, false in _roc(rows, hour):
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


def _agreement(a: float, b: float) -> float:
    """The paper's figure: one less the relative difference to the measured."""
    return 1.0 - abs(a - b) / abs(b)


def _check_table(checks: list[InFlight]) -> str:
    lines = [
        "| plant | mode | predicted peak | estimated peak (3 seeds) | prediction agrees "
        "| estimate against truth "
        "| vertical mean: predicted, estimated, true | prediction against estimate |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(c.plant for c in checks):
        for mode in Mode:
            some = [c for c in checks if c.plant == name and c.mode is mode]
            mean = statistics.mean
            errors = ", ".join(f"{c.estimated / c.true - 1.0:+.1%}" for c in some)
            pz, ez, tz = (mean(getattr(c, n) for c in some) for n in ("predicted_z", "estimated_z", "true_z"))
            lines.append(
                f"| {name} | {mode.value} | {mean(c.predicted for c in some) / 1.3:.1f} m/s² "
                f"| {', '.join(f'{c.estimated / 1.3:.1f}' for c in some)} m/s² "
                f"| {mean(_agreement(c.predicted, c.estimated) for c in some):.0%} | {errors} "
                f"| {pz:.2f}, {ez:.2f}, {tz:.2f} N | {pz / ez - 1.0:+.0%} |"
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
            [p[3][i] for p in points], [100.0 * p[2][i] for p in points], "o-", label=f"noise {sigma} m/s²"
        )
    for threshold, _, found, false in points:
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


def report(
    rows: list[Row],
    wrong: list[tuple[str, Row]],
    hour: list[Quiet],
    rough: list[Quiet],
    checks: list[InFlight],
) -> str:
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

### With wrong values

The simulated vehicle and the estimator above share mass, drag, motor lag, filter and arms. Here the
estimator's differ, one at a time; noise {SIGMAS[0]} m/s², a part of the grid (speeds
{", ".join(f"{v:g}" for v in WRONG_SPEEDS)} m/s, two orientations). A wrong mass makes the force wrong by as
much; a wrong curve of the motors is in the hour without contact below.

{_wrong_table(wrong)}

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

## The paper's check, in flight

Acrylic at (-1, 0.5) m/s, fast world, whole missions, three seeds a mode. Published agreement of predicted
with measured peak acceleration: 88 % flexible, 82 % rigid; vertical force within 10 %. Here plant and
prediction share the contact law: with the plant as predicted this tests the estimator, not the law. With the
plant's coefficients off, it shows how far the prediction then is off and that the estimate is not.

{_check_table(checks)}
"""


def run(docs: Path) -> None:
    """Everything, into `docs`/results/force.md and `docs`/img."""
    (docs / "img").mkdir(parents=True, exist_ok=True)
    checks = fly_checks()
    rows = fly_grid()
    wrong = fly_wrong()
    hour, rough = fly_hour(), fly_hour(rough=True)
    _plot_errors(rows, docs / "img" / "force_errors.png")
    _plot_roc(rows, hour, docs / "img" / "force_roc.png")
    (docs / "results" / "force.md").write_text(report(rows, wrong, hour, rough, checks), encoding="utf-8")


if __name__ == "__main__":
    run(RESULTS.parent)
