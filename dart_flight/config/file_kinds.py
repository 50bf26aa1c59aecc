"""The kinds of input files, for error messages about a file of the wrong kind."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from dart_flight.config.document import Document, InputError, open_file


class FileKind(Enum):
    """Kinds of input files; each value describes the files and their use."""

    MISSION = "a mission, which is an input of fly, dry-run, simulate and check"
    SCENARIO = "a scenario: `dart-flight plan` makes a mission from it"
    CONFIGURATION = "a vehicle configuration: pass it with --config"
    FLIGHT_LOG = "a flight log, which is an input of replay, report, export, identify and calibrate"
    ULOG = "a PX4 ULog, which is an input of inspect, identify and calibrate"
    ENCRYPTED = "an encrypted PX4 log: decrypt it first, PX4's Tools folder has the script"
    COMPRESSED = "a compressed file: unpack it first (gunzip, unzip or unzstd)"
    TRIAL = "a CSV file: `identify` reads trials from it, and `predict --batch` reads wall hits"


EXTENDS = "extends"  # with this key, a configuration contains only its differences from another file
HISTORY = ".history"  # in `NAME.history.yaml`, the history of `NAME.yaml`
# Top-level keys that occur in only one kind of file.
_MARKS = {
    FileKind.MISSION: ("collisions", "waypoints"),
    FileKind.SCENARIO: ("search", "sequence"),
    FileKind.CONFIGURATION: ("airframe", "thrust", EXTENDS),
}
_MAGIC = {
    b"\x89MCAP0\r\n": FileKind.FLIGHT_LOG,
    b"ULog\x01\x12\x35": FileKind.ULOG,
    b"ULogEnc": FileKind.ENCRYPTED,
    b"\x1f\x8b": FileKind.COMPRESSED,
    b"PK\x03\x04": FileKind.COMPRESSED,
    b"\x28\xb5\x2f\xfd": FileKind.COMPRESSED,
}


def kind_of_tree(tree: Mapping[str, Any]) -> FileKind | None:
    """Return the kind of a YAML file by its keys, or None if the keys match no kind or several kinds."""
    found = [kind for kind, marks in _MARKS.items() if any(mark in tree for mark in marks)]
    return found[0] if len(found) == 1 else None


def kind_of_file(path: str | Path) -> FileKind | None:
    """Return the kind of a file by its content, or by its name for a CSV file.

    The result is None if the kind is unknown or the file is unreadable.
    """
    try:
        with open_file(path) as file:
            start = file.read(8)
        for magic, kind in _MAGIC.items():
            if start.startswith(magic):
                return kind
        if Path(path).suffix.lower() == ".csv":
            return FileKind.TRIAL
        return kind_of_tree(Document.load(path).tree)
    except (OSError, InputError):
        return None


def load_document(path: str | Path | Mapping[str, Any], wanted: FileKind) -> Document:
    """Read a YAML file of an expected kind, or convert a mapping with the same content."""
    if isinstance(path, Mapping):
        document = Document.from_tree(path)
        refuse_other_keys(document, wanted)
        return document
    try:
        document = Document.load(path)
    except InputError:
        refuse_other_kind(path, wanted)
        raise
    refuse_other_keys(document, wanted)
    return document


def refuse_other_kind(path: str | Path, *wanted: FileKind) -> None:
    """Raise InputError if a file is of another known kind; the message explains the use of that kind."""
    kind = kind_of_file(path)
    if kind is not None and kind not in wanted:
        raise InputError(f"this is {kind.value}", source=str(path))


def refuse_other_keys(document: Document, wanted: FileKind) -> None:
    """Raise InputError if a parsed YAML file is of another known kind."""
    kind = kind_of_tree(document.tree)
    if kind is not None and kind is not wanted:
        raise InputError(f"this is {kind.value}", source=document.source)
