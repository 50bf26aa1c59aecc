"""A file is replaced completely or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.document import replace_file


def test_a_replaced_file_keeps_its_link_and_mode(tmp_path: Path) -> None:
    target, link = tmp_path / "target.yaml", tmp_path / "link.yaml"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    replace_file(link, b"new")
    assert link.is_symlink()
    assert (target.read_text(), target.stat().st_mode & 0o777) == ("new", 0o640)
    replace_file(tmp_path / "another.yaml", b"more")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["another.yaml", "link.yaml", "target.yaml"]


def test_a_failed_write_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text("old")
    with pytest.raises(TypeError):
        replace_file(tmp_path / "target.yaml", "text")  # type: ignore[arg-type]
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


def test_a_device_is_not_replaced() -> None:
    replace_file(Path("/dev/null"), b"text")
    assert Path("/dev/null").is_char_device()
