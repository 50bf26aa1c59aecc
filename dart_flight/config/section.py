"""Base of everything that is read from a YAML file.

A key's meaning stands once: under `Attributes:` in the docstring of its section, beside the types. From
there it goes into the JSON Schemas, the tables in docs/ and the comments of configs/dart.yaml (`make docs`).
It says what the key's name does not: what is meant, sign and frame, what null does; the unit where the name
has none. A key whose type is a section needs none where the section's own docstring says it.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every part of a file: frozen, unknown keys refused."""
