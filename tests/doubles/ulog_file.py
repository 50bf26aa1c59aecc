"""A writer of ULog files with given topics."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

_SIZES = {"float": "f", "uint8_t": "B", "uint32_t": "I", "bool": "?"}

# (topic, instance) -> fields such as "float[3] gyro_rad;bool landed;", and rows of (microseconds, values)
Topics = Mapping[tuple[str, int], tuple[str, Sequence[tuple[float, Sequence[float]]]]]


def _message(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<Hc", len(content), kind) + content


def _format(fields: str) -> str:
    out = ""
    for field in fields.rstrip(";").split(";"):
        kind = field.split()[0]
        name, _, count = kind.partition("[")
        out += _SIZES[name] * (int(count.rstrip("]")) if count else 1)
    return out


def write_ulog(
    path: Path, topics: Topics, parameters: Mapping[str, float] | None = None, release: int = 0
) -> Path:
    """Write a log whose rows of all topics are merged by their stamps, and return its path."""
    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + _message(b"B", bytes(40))
    if release:
        key = b"uint32_t ver_sw_release"
        out += _message(b"I", bytes([len(key)]) + key + struct.pack("<I", release))
    for name, value in (parameters or {}).items():
        key = f"float {name}".encode()
        out += _message(b"P", bytes([len(key)]) + key + struct.pack("<f", value))
    for name in dict.fromkeys(name for name, _ in topics):
        fields = next(f for (n, _), (f, _) in topics.items() if n == name)
        out += _message(b"F", f"{name}:uint64_t timestamp;{fields}".encode())
    data = []
    for index, ((name, instance), (fields, rows)) in enumerate(topics.items()):
        out += _message(b"A", struct.pack("<BH", instance, index) + name.encode())
        pack = f"<HQ{_format(fields)}"
        data += [(t, _message(b"D", struct.pack(pack, index, int(t), *values))) for t, values in rows]
    data.sort(key=lambda row: row[0])
    path.write_bytes(out + b"".join(content for _, content in data))
    return path
