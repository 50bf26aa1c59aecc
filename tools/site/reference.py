"""The page of the site about the Python interface: every name of `import dart_flight`, from its docstring."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import dart_flight
from dart_flight.recording import topics


def page() -> str:
    """Return the page, in reStructuredText."""
    offered = {name: getattr(dart_flight, name) for name in dart_flight.__all__}
    functions = [name for name, value in offered.items() if not inspect.isclass(value)]
    classes = [name for name, value in offered.items() if inspect.isclass(value)]
    others = sorted({f"{kind.__module__}.{kind.__qualname__}" for kind in returned(offered)})
    return "\n".join(
        [
            *_title("Python interface", "="),
            "``import dart_flight`` offers these functions and classes. :doc:`python` shows how to use them.",
            *_title("Functions", "-"),
            *(f".. autofunction:: dart_flight.{name}\n" for name in functions),
            *_title("Classes", "-"),
            *(_class(f"dart_flight.{name}") for name in classes),
            *_title("Classes of returned objects", "-"),
            "The functions and classes above return objects of these classes.\n",
            *(_class(name) for name in others),
        ]
    )


def _title(text: str, line: str) -> list[str]:
    return ["", text, line * len(text), ""]


def _class(name: str) -> str:
    return f".. autoclass:: {name}\n   :members:\n"


def returned(offered: dict[str, object]) -> set[type]:
    """Return the classes of this package that functions, methods and properties return, without `offered`."""
    found = {kind for value in offered.values() for kind in _returned_by(value)}
    return {
        kind for kind in found if kind.__module__.startswith("dart_flight.") and kind not in offered.values()
    }


def _returned_by(value: object) -> Iterator[type]:
    members = vars(value).items() if inspect.isclass(value) else [("", value)]
    for name, member in members:
        if isinstance(member, property):
            member = member.fget
        elif isinstance(member, cached_property):
            member = member.func
        if inspect.isfunction(member) and not name.startswith("_"):
            yield from _classes_in(_return_type(member))


def _return_type(function: Any) -> object:
    """Return the annotation; `Log` imports `topics` for type checkers only."""
    return typing.get_type_hints(function, localns=vars(topics)).get("return")


def _classes_in(annotation: object) -> Iterator[type]:
    if inspect.isclass(origin := typing.get_origin(annotation) or annotation):
        yield origin
    for argument in typing.get_args(annotation):
        yield from _classes_in(argument)
