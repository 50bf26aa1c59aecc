"""What stands in a figure."""

from __future__ import annotations

import re


def texts_of(svg: str) -> list[str]:
    """The words in a figure."""
    return [t.strip() for t in re.findall(r"<text[^>]*>([^<]+)</text>", svg)]
