"""Published recordings of real hits, read as trials, and what `identify` makes of them.

What came of it: docs/results/real_data.md.

The recordings have no licence and are not part of this repository: fetch them by name and give the folder.

python -m tools.real_data drops DIR     thecognifly/CrashLandingExperiments: *.bin in one folder per height
python -m tools.real_data walls DIR     mrl-abazari/mav_contact_lcs: experiment_data/*/*.db3 (ROS 2 bags)
"""

from __future__ import annotations

import argparse
import itertools
import math
import re
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.vehicle.airframe import Coefficients
from dart_flight.contact.coefficients import Array
from dart_flight.contact.contact_map import drop
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.held_out import hold_out
from dart_flight.lab.identify.hit_fit import HitFit, HitTable, predict
from dart_flight.lab.identify.measured_impacts import MeasuredImpact, measure_impact
from dart_flight.lab.identify.trials import Series, Trial

DROP_MASS_KG = 0.241
WALL_MASS_KG = 1.234
_FARTHEST_M = 0.625  # where the centre is at first touch, along x of the room, to a centimetre or two
DROP_FOLDERS = {"SoftBottom_50cm": 0.5, "SoftBottom_100cm": 1.0, "SoftBottom_150cm": 1.5}
ASIDE_FOLDERS = {"RigidBottom_30cm": 0.3}
# Calibration of the accelerometer (ADXL377, 12 bit), from the notebook that comes with the recordings.
_ZERO, _PER_G = (2019.93872, 2020.0, 2020.77284438), (8.50151, 8.50151, 8.87700438)


def is_aside(name: str) -> bool:
    """Whether a drop is kept aside: looked at once, after everything else was fixed."""
    number = int(re.findall(r"(\d+)\.bin$", name)[0])
    return number % 9 in (0, 5)


def read_drop(path: Path) -> tuple[Array, Array]:
    """Times in s (n,) and specific force in m/s² along the body's axes (n, 3)."""
    raw = np.frombuffer(path.read_bytes()[: path.stat().st_size // 10 * 10], dtype="<u4,<u2,<u2,<u2")
    time = (raw["f0"] - raw["f0"][0]) * 1e-6
    axes = [
        (raw[f"f{i + 1}"] - zero) / per_g * GRAVITY_M_S2
        for i, (zero, per_g) in enumerate(zip(_ZERO, _PER_G, strict=True))
    ]
    keep = np.concatenate(([True], np.diff(np.maximum.accumulate(time)) > 0.0))
    return time[keep], np.stack(axes, axis=1)[keep]


def lands_flat(time: Array, axes: Array) -> bool:
    """Whether a drop lands on its belly, by what it does afterwards and by how its impulse is shared.

    The peak itself does not decide: it lies on its belly at the end, and in the first 25 ms of contact the
    velocity across the normal changes by less than a quarter of that along it.
    """
    rest = axes[time > time[-1] - 0.1].mean(axis=0)
    if not 0.7 * GRAVITY_M_S2 < rest[2] < 1.2 * GRAVITY_M_S2:
        return False
    strong = np.flatnonzero(np.linalg.norm(axes, axis=1) > 8.0 * GRAVITY_M_S2)
    if not strong.size:
        return False
    begin = time[strong[0]] - 0.002
    inside = (time >= begin) & (time < begin + 0.025)
    change = np.trapezoid(axes[inside], time[inside], axis=0)
    return bool(np.hypot(change[0], change[1]) < 0.25 * change[2])


def drops(folder: Path, *, aside: bool = False, flat_only: bool = True) -> dict[str, list[Trial]]:
    """Trials by folder: specific force along the body's z, height given."""
    found: dict[str, list[Trial]] = {}
    for name, height in (DROP_FOLDERS | (ASIDE_FOLDERS if aside else {})).items():
        for path in sorted((folder / name).glob("*.bin")):
            if name not in ASIDE_FOLDERS and is_aside(path.name) != aside:
                continue
            time, axes = read_drop(path)
            if flat_only and not lands_flat(time, axes):
                continue
            trial = Trial(
                f"{name}/{path.name}",
                {"specific_force_m_s2": Series(time, axes[:, 2])},
                "flexible",
                -GRAVITY_M_S2,
                height_m=height,
            )
            found.setdefault(name, []).append(trial)
    return found


# --- wall hits ------------------------------------------------------------------------------------------


def _stamp(message: bytes) -> tuple[float, int]:
    """Time of a message with a header, and where its content begins (CDR, little endian)."""
    seconds, nanoseconds, length = struct.unpack_from("<iII", message, 4)
    return seconds + 1e-9 * nanoseconds, 16 + length


def read_bag(path: Path) -> tuple[Array, Array]:
    """Pose rows (time, x, y, z, qx, qy, qz, qw) and wrench rows (time, fx, fy, fz), on the recorder's clock.

    Stamps are the senders', and their clocks differ by a day; messages arrive in bursts. Each stream is moved
    to the recorder's clock by its smallest delay, and within an unbroken stretch its samples are put at equal
    distances (motion capture: 120 frames per second, read by a program that looks 100 times per second).
    What is left between the two is some milliseconds.
    """
    connection = sqlite3.connect(path)
    topics = dict(connection.execute("select id, name from topics"))
    rows: dict[str, list[tuple[float, ...]]] = {"pose": [], "wrench": []}
    for topic, received, message in connection.execute(
        "select topic_id, timestamp, data from messages order by timestamp"
    ):
        kind = "pose" if topics[topic].endswith("/pose") else "wrench" if "wrench" in topics[topic] else ""
        if kind:
            stamp, offset = _stamp(message)
            content = struct.unpack_from(
                "<7d" if kind == "pose" else "<3d", message, 4 + -(-(offset - 4) // 8) * 8
            )
            rows[kind].append((stamp, received * 1e-9, *content))
    result = []
    for values in rows.values():
        table = np.array(values)
        table = table[np.argsort(table[:, 0])]
        delay = float(np.min(table[:, 1] - table[:, 0]))
        result.append(np.column_stack((_even(table[:, 0] + delay), table[:, 2:])))
    return result[0], result[1]


def _even(time: Array) -> Array:
    """Equally spaced times within every stretch without a pause of more than 60 ms."""
    even = np.empty_like(time)
    cuts = [0, *(np.flatnonzero(np.diff(time) > 0.06) + 1), time.size]
    for begin, end in itertools.pairwise(cuts):
        index = np.arange(end - begin)
        slope, offset = np.polyfit(index, time[begin:end], 1) if end - begin > 20 else (0.0, 0.0)
        even[begin:end] = slope * index + offset if slope > 0.0 else time[begin:end]
    return even


def walls(folder: Path, *, with_force: bool = True) -> list[Trial]:
    """The wall hits: position from motion capture at 100 Hz, normal force from the sensor on the vehicle.

    The wall is met along +x of the room; the plane is where each recording's own contact begins to within
    some centimetres, because the two shapes that meet it (edge, corner) reach out differently.
    """
    trials = []
    for path in sorted(folder.glob("experiment_data/*/*.db3")):
        pose, wrench = read_bag(path)
        name = path.parent.name.split("_rosbag")[0]
        # Only the time about the strongest force: the vehicle starts near the wall and bounces on afterwards.
        force = wrench[:, 1:3] - np.median(wrench[:, 1:3], axis=0)
        strongest = wrench[int(np.argmax(np.hypot(force[:, 0], force[:, 1]))), 0]
        pose = pose[np.abs(pose[:, 0] - strongest) < 0.8]
        near = np.abs(wrench[:, 0] - strongest) < 0.8
        time, force = wrench[near, 0], force[near]
        # Where a corner leads, the sensor's axes stand at 45 degrees to the wall.
        normal = (force[:, 0] - force[:, 1]) / math.sqrt(2.0) if "NonAligned" in name else force[:, 0]
        series = {
            "normal_m": Series(pose[:, 0] - strongest, _FARTHEST_M - pose[:, 1]),
            "tangential_m": Series(pose[:, 0] - strongest, -pose[:, 2]),
        }
        if with_force:
            series["normal_force_n"] = Series(time - strongest, normal)
        trials.append(Trial(name, series, "rigid"))
    return trials


# --- what comes out -------------------------------------------------------------------------------------


def _percent(value: float) -> str:
    return f"{100.0 * value:+.1f} %"


def judge_drops(by_height: dict[str, list[Trial]]) -> None:
    """Each height as the training one: peak force and rebound at the others, with law and baselines."""
    hits = {
        name: [measure_impact(trial, DROP_MASS_KG) for trial in trials] for name, trials in by_height.items()
    }
    for name, members in hits.items():
        peaks = np.array([h.peak_force_n for h in members if h.peak_force_n is not None])
        outs = np.array([h.normal_out_m_s for h in members if h.normal_out_m_s is not None])
        print(
            f"{name}: {len(members)} drops, in {members[0].normal_in_m_s:.2f} m/s, peak "
            f"{np.median(peaks):.1f} N (spread of repeats {np.std(peaks) / np.mean(peaks):.0%}, "
            f"{sum(h.clipped for h in members)} clipped), "
            f"rebound {np.median(outs):.2f} m/s ({np.std(outs) / np.mean(outs):.0%}, "
            f"{len(members) - outs.size} unknown)"
        )
    for training, trials in by_height.items():
        found = identify(trials, DROP_MASS_KG, Onset.LCP)
        fitted = found.coefficients[trials[0].mode]
        k, f = fitted["k"], fitted["f"]
        own = hits[training]
        slope = np.median([h.peak_force_n / h.normal_in_m_s for h in own if h.peak_force_n is not None])
        ratio = found.restitution[trials[0].mode]
        if k is None or f is None or ratio is None:
            print(f"from {training}: unknown")
            continue
        print(f"from {training}: k {k.value:.0f} ({k.low:.0f} to {k.high:.0f}), f {f.value:.2f}")
        for other, members in hits.items():
            if other == training:
                continue
            height = by_height[other][0].height_m
            assert height is not None
            said = drop(Coefficients(k=k.value, f=f.value, mu=0.0, nu=0.0), DROP_MASS_KG, height, Onset.LCP)
            peak = float(np.median([h.peak_force_n for h in members if h.peak_force_n is not None]))
            out = float(np.median([h.normal_out_m_s for h in members if h.normal_out_m_s is not None]))
            speed = members[0].normal_in_m_s
            print(
                f"  {other}: peak {said.peak_force_n:.1f} N of {peak:.1f} "
                f"({_percent(said.peak_force_n / peak - 1.0)}; "
                f"force-proportional {_percent(float(slope) * speed / peak - 1.0)}), rebound "
                f"{said.max_rebound_speed_m_s:.2f} m/s of {out:.2f} "
                f"({_percent(said.max_rebound_speed_m_s / out - 1.0)}; "
                f"constant-restitution {_percent(ratio.value * speed / out - 1.0)})"
            )
    print(_compared([h for members in hits.values() for h in members], DROP_MASS_KG))


def _compared(hits: Sequence[MeasuredImpact], mass_kg: float) -> str:
    found = hold_out(hits, mass_kg, Onset.LCP)
    rows = {"law": found.law, **found.baselines, "scatter": found.scatter}
    cells = [f"  {name}: peak {e.peak_force}, out {e.outgoing_speed}" for name, e in rows.items() if e]
    return "\n".join([found.sentence, *cells])


def judge_walls(trials: Sequence[Trial]) -> None:
    """Every half of the hits as the training one: outgoing speed and peak of the other half."""
    hits = [measure_impact(trial, WALL_MASS_KG) for trial in trials]
    for h in hits:
        print(
            f"{h.name}: in {h.normal_in_m_s:.3f}, out {h.normal_out_m_s:.3f} m/s, along "
            f"{h.tangential_in_m_s:.2f} to {h.tangential_out_m_s:.2f}, peak {h.peak_force_n}, "
            f"{h.samples_in_contact} samples"
        )
    table = HitTable.of(hits)
    halves = list(itertools.combinations(range(len(hits)), len(hits) // 2))
    weights = np.zeros((len(halves), len(hits)))
    for row, half in enumerate(halves):
        weights[row, list(half)] = 1.0
    rest = weights == 0.0
    errors: dict[str, tuple[Array, Array]] = {}
    if table.is_enough:
        fits = [np.exp(HitFit(table.only(row > 0.0), WALL_MASS_KG, Onset.LCP).solve()) for row in weights]
        outcomes = [predict(k, f, table, WALL_MASS_KG, Onset.LCP) for k, f in fits]
        errors["law"] = (
            np.array([one.peak_normal_force_n for one in outcomes]) / table.peak - 1.0,
            np.array([one.normal_out_m_s for one in outcomes]) - table.speed_out,
        )
    share = np.array([np.median((table.speed_out / table.speed_in)[row > 0.0]) for row in weights])
    slope = np.array([np.median((table.peak / table.speed_in)[row > 0.0]) for row in weights])
    errors["baselines"] = (
        slope[:, None] * table.speed_in / table.peak - 1.0,
        share[:, None] * table.speed_in - table.speed_out,
    )
    for name, (peak, out) in errors.items():
        off = np.abs(peak[rest])
        said = f"{np.nanmedian(off):.1%}" if np.isfinite(off).any() else "(unknown)"
        print(
            f"{len(halves)} halves, {name}: peak force off by {said}, "
            f"outgoing speed by {np.median(np.abs(out[rest])):.3f} m/s in the median"
        )
    print(_compared(hits, WALL_MASS_KG))
    found = identify(trials, WALL_MASS_KG, Onset.LCP)
    print({name: found.coefficients["rigid"][name] for name in ("k", "f", "mu")})
    print(f"restitution {found.restitution['rigid']}, tangential ratio {found.tangential_ratio['rigid']}")


def main() -> None:
    """Read, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("drops", "walls"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--aside", action="store_true", help="the drops that were kept aside")
    given = parser.parse_args()
    if given.what == "walls":
        hits = walls(given.folder)
        if not hits:
            parser.error(f"no experiment_data/*/*.db3 in {given.folder}")
        judge_walls(hits)
        return
    found = drops(given.folder, aside=given.aside)
    if not found:
        parser.error(f"no drops in {given.folder}")
    judge_drops({name: trials for name, trials in found.items() if name in DROP_FOLDERS})
    for name in ASIDE_FOLDERS:
        if name in found:
            judge_drops({name: found[name]})


if __name__ == "__main__":
    main()
