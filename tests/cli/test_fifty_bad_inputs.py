"""Some fifty bad inputs: each is refused soon, in one line and with exit status 2."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dart_flight.config.vehicle import packaged
from tests.command_fixtures import Refuse

MISSION = packaged("missions", "single_wall.yaml")
SCENARIO = packaged("missions", "scenarios", "one_wall.yaml")
VEHICLE = packaged("configs", "dart.yaml")
FLIGHT = next((Path(__file__).parents[1] / "data" / "flights").rglob("*.mcap"))
ULOG = b"ULog\x01\x12\x35\x01" + bytes(8)
TRIAL = "time_s,normal_m\n" + "".join(f"{0.01 * i:.2f},{0.5 - 0.01 * i:.3f}\n" for i in range(60))

# Each name has arguments and a content. FILE has this content, OUT does not exist, and MISSION and SCENARIO
# are shipped. A content of three is a shipped file, a text in it and the replacement.
CASES: dict[str, tuple[list[str], object]] = {
    "tab for an indent": (["check", "FILE"], (MISSION, "walls:", "walls:\n\t- x")),
    "a key with a colon": (["check", "FILE"], (MISSION, "name: single-wall", "name: a: b")),
    "version as text": (["check", "FILE"], (MISSION, "version: 1", "version: '1'")),
    "no version": (["check", "FILE"], (MISSION, "version: 1", "")),
    "a wall without a normal": (["check", "FILE"], (MISSION, "normal: [-1.0, 0.0],", "")),
    "a normal of three": (["check", "FILE"], (MISSION, "normal: [-1.0, 0.0]", "normal: [-1.0, 0.0, 0.0]")),
    "an altitude of 1e9": (["check", "FILE"], (MISSION, "altitude_m: 1.0", "altitude_m: 1.0e+9")),
    "an altitude in text": (["check", "FILE"], (MISSION, "altitude_m: 1.0", "altitude_m: one metre")),
    "a list of collisions that is none": (["check", "FILE"], (MISSION, "collisions:", "collisions: 3\nx:")),
    "a vehicle that is not there": (["check", "FILE"], (MISSION, "../configs/dart.yaml", "no/such.yaml")),
    "a vehicle of keys that are none": (
        ["check", "FILE"],
        (MISSION, "vehicle: ../configs/dart.yaml", "vehicle: {wings: 2}"),
    ),
    "a vehicle that is a number": (
        ["check", "FILE"],
        (MISSION, "vehicle: ../configs/dart.yaml", "vehicle: 3"),
    ),
    "a rehearsal of 5 m": (["check", "FILE"], (MISSION, "version: 1", "version: 1\nstandoff_m: 5.0")),
    "control characters": (["check", "FILE"], b"version: 1\nname: \x07\x1b[2J\n"),
    "UTF-16": (["check", "FILE"], "version: 1\n".encode("utf-16")),
    "a thousand keys": (["check", "FILE"], "".join(f"k{i}: {i}\n" for i in range(1000))),
    "ten thousand brackets": (["check", "FILE"], "a: " + "[" * 10_000),
    "an anchor bomb": (["check", "FILE"], "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"),
    "a python object": (["check", "FILE"], "a: !!python/object/apply:os.system [ls]\n"),
    "a number of 400 digits": (["check", "FILE"], "version: " + "9" * 400),
    "only comments": (["check", "FILE"], "# nothing\n# at all\n"),
    "a configuration that extends itself": (
        ["check", "MISSION", "--config", "FILE"],
        "extends: input.yaml\n",
    ),
    "a configuration that extends a folder": (["check", "MISSION", "--config", "FILE"], "extends: .\n"),
    "a mass in grams": (["check", "MISSION", "--set", "airframe.mass_kg=1300"], b""),
    "a setting without a value": (["check", "MISSION", "--set", "airframe.mass_kg="], b""),
    "a setting of a list": (["check", "MISSION", "--set", "airframe.mass_kg=[1, 2]"], b""),
    "a setting below a number": (["check", "MISSION", "--set", "airframe.mass_kg.x=1"], b""),
    "a step of nothing": (["plan", "FILE"], (SCENARIO, "step: 0.05", "step: 0.0")),
    "a sequence of walls that are none": (
        ["plan", "FILE"],
        (SCENARIO, "sequence: [", "sequence: [nowhere, "),
    ),
    "more plans than can be": (["plan", "SCENARIO", "--top", "-3"], b""),
    "a rank that is none": (["plan", "SCENARIO", "--rank", "0"], b""),
    "a drop of nan": (["predict", "--surface", "wood", "--mode", "rigid", "--drop", "nan"], b""),
    "a hit of infinite speed": (
        ["predict", "--surface", "wood", "--mode", "rigid", "--velocity", "-inf", "0"],
        b"",
    ),
    "a batch with a hole": (
        ["predict", "--surface", "wood", "--batch", "FILE.csv"],
        "mode,normal_m_s,tangential_m_s\nrigid,,0\n",
    ),
    "a batch with a NUL": (
        ["predict", "--surface", "wood", "--batch", "FILE.csv"],
        "mode,normal_m_s,tangential_m_s\nrigid,\x00,0\n",
    ),
    "a trial that goes back in time": (["identify", "FILE.csv"], TRIAL + "0.10,0.2\n"),
    "a trial that stands still": (["identify", "FILE.csv"], re.sub(r",.*[0-9]", ",0.5", TRIAL)),
    "a trial with words": (["identify", "FILE.csv"], TRIAL.replace("0.400", "four")),
    "a trial with an open quote": (["identify", "FILE.csv"], TRIAL.replace("0.400", '"0.400')),
    "a ULog that ends in its header": (["inspect", "FILE.ulg"], ULOG[:12]),
    "a ULog of nothing": (["inspect", "FILE.ulg"], ULOG),
    "a ULog with a message of 65 kB that is not there": (["inspect", "FILE.ulg"], ULOG + b"\xff\xffF"),
    "a ULog of letters": (["calibrate", "thrust", "FILE.ulg"], ULOG + b"A" * 4000),
    "an MCAP of zeros": (["replay", "FILE.mcap"], b"\x89MCAP0\r\n" + bytes(4000)),
    "a flight log that was turned round": (["report", "FILE.mcap"], FLIGHT.read_bytes()[::-1][:100_000]),
    "a seed of 1e30": (["dry-run", "MISSION", "--fast", "--seed", "1e30"], b""),
    "a fault of nothing": (["dry-run", "MISSION", "--fast", "--fault", "delay="], b""),
    "a fault of nan": (["dry-run", "MISSION", "--fast", "--fault", "delay=nan"], b""),
    "a spread below nothing": (["dry-run", "MISSION", "--fast", "--vary", "mass=-1"], b""),
    "a spread of words": (["dry-run", "MISSION", "--fast", "--vary", "mass=heavy"], b""),
    "a campaign of a folder": (["campaign", ".", "--runs", "1", "--out", "OUT"], b""),
    "a campaign of a value that cannot be": (
        ["campaign", "MISSION", "--runs", "1", "--set", "airframe.mass_kg=1,-1", "--out", "OUT"],
        b"",
    ),
}


def write_input(folder: Path, name: str, content: object) -> Path:
    path = folder / name
    if isinstance(content, tuple):
        shipped, old, new = content
        text = shipped.read_text(encoding="utf-8")
        assert old in text, f"{old!r} is not in {shipped.name} any more"
        if "../configs" not in old:
            text = text.replace("../configs", str(VEHICLE.parent)).replace(
                "../" + str(VEHICLE.parent), str(VEHICLE.parent)
            )
        content = text.replace(old, new, 1)
    path.write_bytes(content if isinstance(content, bytes) else str(content).encode())
    return path


@pytest.mark.usefixtures("alarm")
@pytest.mark.parametrize("name", CASES)
def test_a_bad_input_is_refused_in_one_line(name: str, folder: Path, refusal_of: Refuse) -> None:
    arguments, content = CASES[name]
    shipped = {"MISSION": MISSION, "SCENARIO": SCENARIO, "OUT": folder / "out"}
    command: list[object] = []
    for word in arguments:
        if word.partition(".")[0] == "FILE":
            command.append(write_input(folder, "input" + (word[4:] or ".yaml"), content))
        else:
            command.append(shipped.get(word, word))
    line = refusal_of(*command)
    assert line.isprintable()
    assert "Traceback" not in line
