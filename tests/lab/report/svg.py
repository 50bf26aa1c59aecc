"""Text of SVG figures."""

from __future__ import annotations

import re


def texts_of(svg: str) -> list[str]:
    """Return the texts of a figure."""
    return [t.strip() for t in re.findall(r"<text[^>]*>([^<]+)</text>", svg)]
