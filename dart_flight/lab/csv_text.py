"""CSV text: floats in full precision, a missing value as an empty cell."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import Any


def csv_text(rows: Iterable[Iterable[Any]], end: str = "\r\n") -> str:
    """Return rows as CSV text; open the output file with `newline=""`, which keeps the line ends `end`."""
    out = io.StringIO()
    csv.writer(out, lineterminator=end).writerows(rows)
    return out.getvalue()
