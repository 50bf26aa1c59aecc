"""`dart-flight room FILE`: measure the walls of a mission or scenario with the vehicle held by hand."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from dart_flight.base.geometry import MissionFrame, Quaternion
from dart_flight.base.records import AttitudeSample, Input, OdometrySample
from dart_flight.check.held_walls import SAMPLE_S, HeldPose, Pose, difference_from, mean_pose, wall_keys
from dart_flight.cli.options import link_of
from dart_flight.cli.terminal import emit_json, print_status
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import Document, InputError, read_text, replace_file, report_write_errors
from dart_flight.config.edit import update_text
from dart_flight.config.flight_space import resolve_walls
from dart_flight.config.mission_file import FrameSpec, WallSpec
from dart_flight.config.provenance import LoadedVehicle, find_vehicle
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.link import LinkLease
from dart_flight.vehicle.motion_capture.source import URLS, RawPose, checked_pose, open_source

Sampler = Callable[[], list[Pose | None]]  # returns the poses of `SAMPLE_S`; None: the body is not tracked


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="mission or scenario, in which walls are written"
    )
    parser.add_argument("--mocap", metavar="URL", help=f"motion capture that sees the vehicle: {URLS}")
    parser.add_argument("--connection", metavar="URL", help="use PX4's estimate from this link instead")
    parser.add_argument(
        "--wall",
        action="append",
        default=[],
        metavar="NAME",
        help="wall to measure; repeatable (default: all walls of the file)",
    )
    parser.add_argument(
        "--material", metavar="NAME", help="material of walls that the file does not have yet"
    )


def run(arguments: argparse.Namespace) -> int:
    """Measure all walls, and write the file after each; return 0 if no wall was skipped."""
    document = Document.load(arguments.file)
    vehicle = _vehicle(arguments, document)
    frame = _frame(document)
    walls = document.tree.get("walls", {})
    names = arguments.wall or list(walls)
    if not names:
        raise InputError(
            "the file has no walls: name the walls with --wall and --material", source=document.source
        )
    for name in names:
        material = walls.get(name, {}).get("material", arguments.material)
        if material not in vehicle.config.materials:
            known = ", ".join(vehicle.config.materials)
            raise InputError(f"wall {name}: give --material, one of {known}", key=("--material",))
    print_vehicle(vehicle.source, arguments)
    measured = {}
    with _sampler(arguments, vehicle) as sample:
        for name in names:
            keys = _measure(name, sample, frame, vehicle, document)
            if keys is None:
                print_status(f"{name}: skipped")
                continue
            measured[name] = keys
            _report(name, keys, document, vehicle)
            _write(arguments.file, name, keys, arguments.material)
    if arguments.json:
        emit_json({"walls": measured, "vehicle": vehicle.source})
    return 0 if len(measured) == len(names) else 1


def _vehicle(arguments: argparse.Namespace, document: Document) -> LoadedVehicle:
    config, own = arguments.config, document.tree.get("vehicle")
    if config is None and isinstance(own, str):
        config = arguments.file.parent / own
    return find_vehicle(config)


def _frame(document: Document) -> MissionFrame:
    spec = document.part("frame").convert(FrameSpec) if "frame" in document.tree else FrameSpec()
    if spec.origin != "local":
        raise document.error(("frame", "origin"), "walls can be measured only in a frame with origin local")
    return MissionFrame(spec.north_m, spec.east_m, 0.0, math.radians(spec.heading_deg))


# --- poses -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _sampler(arguments: argparse.Namespace, vehicle: LoadedVehicle) -> Iterator[Sampler]:
    """Open the cameras or the vehicle's link, and yield a function that samples poses."""
    mocap = vehicle.config.mocap
    if arguments.connection is None and (arguments.mocap or mocap.url) is not None:
        with _camera_poses(arguments.mocap or str(mocap.url), mocap) as sample:
            yield sample
        return
    url = link_of(arguments, vehicle.config.connection)
    with LinkLease(url, "room"), _estimated_poses(url, vehicle) as sample:
        yield sample


@contextlib.contextmanager
def _camera_poses(url: str, mocap: MotionCapture) -> Iterator[Sampler]:
    room, found = mocap.room_frame(), list[Pose | None]()

    def keep(raw: RawPose) -> None:
        pose, _ = checked_pose(raw)
        found.append(room.pose_to_ned(pose.position_room, pose.q_body_to_room) if pose.tracked else None)

    source = open_source(url)
    try:
        source.start(keep)

        def sample() -> list[Pose | None]:
            found.clear()
            time.sleep(SAMPLE_S)
            if not found:
                raise InputError(f"no poses: {source.problem or source.remedy}", source=source.place)
            return list(found)

        yield sample
    finally:
        source.stop()


@contextlib.contextmanager
def _estimated_poses(url: str, vehicle: LoadedVehicle) -> Iterator[Sampler]:
    """Sample PX4's estimate; each position gets the newest attitude."""
    found, attitude = list[Pose | None](), list[Quaternion]()

    def keep(record: Input) -> None:
        if isinstance(record, AttitudeSample):
            attitude[:] = [record.q_frd_to_ned]
        elif isinstance(record, OdometrySample) and attitude:
            found.append((record.position_ned, attitude[0]))

    config = vehicle.config
    with GroundLink(url, config.connection.timeout_s, keep, config.mocap) as link:
        link.require_disarmed()
        link.observe(config, 0.5)  # requests the streams

        def sample() -> list[Pose | None]:
            found.clear()
            time.sleep(SAMPLE_S)
            return list(found)

        yield sample


# --- one wall ----------------------------------------------------------------------------------------------


def _measure(
    name: str, sample: Sampler, frame: MissionFrame, vehicle: LoadedVehicle, document: Document
) -> dict[str, Any] | None:
    """Measure a wall; repeat it after a refusal. Return None if the operator skips the wall."""
    start = document.tree.get("start", {}).get("position_m")
    free = None if start is None else (float(start[0]), float(start[1]))
    while True:
        ends = list[HeldPose]()
        for end in ("left", "right"):
            held = _measure_end(f"{end} end of wall {name}", sample, frame)
            if held is None:
                return None
            ends.append(held)
        try:
            return wall_keys(ends[0], ends[1], vehicle.config.airframe, free)
        except InputError as refusal:
            print_status(f"  {refusal}; measure the wall again")


def _measure_end(place: str, sample: Sampler, frame: MissionFrame) -> HeldPose | None:
    while True:
        print_status(
            f"hold the vehicle with its guards against the {place}, level, then Enter (s: skip this wall)"
        )
        line = sys.stdin.readline()
        if not line or line.strip().lower() == "s":
            return None
        try:
            held = mean_pose(sample(), frame)
        except InputError as refusal:
            print_status(f"  {refusal}; measure again")
            continue
        print_status(f"  ({held.at[0]:.3f}, {held.at[1]:.3f}) m, scatter {1e3 * held.scatter_m:.1f} mm")
        return held


def _report(name: str, keys: dict[str, Any], document: Document, vehicle: LoadedVehicle) -> None:
    own = document.tree.get("walls", {}).get(name)
    text = "new"
    if own is not None:
        spec = Document.from_tree(own, document.source).convert(WallSpec)
        old = resolve_walls({name: spec}, vehicle.config, document, "walls")
        text = difference_from(next(iter(old.values())), keys)
    print_status(f"{name}: {text}")


def _write(path: Path, name: str, keys: dict[str, Any], material: str | None) -> None:
    """Write a wall into the file; comments and all other entries stay."""
    text = read_text(path)
    tree = Document(text, str(path)).tree
    walls = tree.get("walls", {})
    own = {"material": material, **walls.get(name, {})}
    wanted = {**tree, "walls": {**walls, name: {**own, **keys}}}
    with report_write_errors(path):
        replace_file(path, update_text(text, wanted, str(path)).encode("utf-8"))
