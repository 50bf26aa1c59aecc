"""Values are written into a YAML file whose comments and layout stay."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.document import InputError
from dart_flight.config.edit import edit_values, write_values
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.configuration import load_vehicle


def test_writing_values_changes_nothing_else_in_the_file(tmp_path: Path) -> None:
    before = packaged("configs", "dart.yaml").read_text()
    path = tmp_path / "dart.yaml"
    path.write_text(before)
    path.chmod(0o640)
    write_values(
        path,
        {
            ("lock", "servo", "rigid_pulse_us"): 1932.25,
            ("lock", "servo", "flexible_pulse_us"): 987.0,
            ("lock", "servo", "direction"): 1,
        },
    )
    after = path.read_text()
    changed = [(a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]
    assert [b.split("#")[0].strip() for _, b in changed] == [
        "rigid_pulse_us: 1932.25",
        "flexible_pulse_us: 987.0",
    ]
    for a, b in changed:
        assert a.index("#") == b.index("#")
        assert a[a.index("#") :] == b[b.index("#") :]
    lock = load_vehicle(path).lock
    assert lock is not None
    servo = lock.servo
    assert (servo.rigid_pulse_us, servo.flexible_pulse_us) == (1932.25, 987.0)
    assert path.stat().st_mode & 0o777 == 0o640
    assert [entry.name for entry in tmp_path.iterdir()] == ["dart.yaml"]


@pytest.mark.parametrize(
    ("text", "key", "value", "expected"),
    [
        ("a: 1", ("a",), 12.5, "a: 12.5"),
        ("a:\nb: 1", ("a",), 2.0, "a: 2.0\nb: 1"),
        ("a: {b: 1, c: 2}  # é\n", ("a", "c"), 30.0, "a: {b: 1, c: 30.0}  # é\n"),
        ("a:\n  b: 12345.0 # tight\n", ("a", "b"), 1, "a:\n  b: 1       # tight\n"),
        ("a: 1 # tight\nb: 2\n", ("a",), 123456.5, "a: 123456.5 # tight\nb: 2\n"),
        ("é: 1\na: 'x'\n", ("a",), -3.0, "é: 1\na: -3.0\n"),
    ],
)
def test_an_edit_replaces_the_value_and_keeps_the_layout(
    text: str, key: tuple[str, ...], value: float, expected: str
) -> None:
    assert edit_values(text, {key: value}) == expected


@pytest.mark.parametrize(("text", "key"), [("a: 1", ("b",)), ("a: {b: 1}", ("a",))])
def test_an_edit_without_a_value_to_replace_is_refused(text: str, key: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="but the file has no such value"):
        edit_values(text, {key: 1.0}, "f.yaml")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read: No such file"):
        write_values(tmp_path / "none.yaml", {("a",): 2.0})
