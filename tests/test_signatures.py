"""A constructor takes at most five arguments and a method at most six, so that collaborators stay few."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "dart_flight"
LONGEST = {"__init__": 5}
LONGEST_METHOD = 6


def methods() -> Iterator[tuple[str, str, int]]:
    """Yield place, name and number of arguments, without `self` or `cls`, of every method."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for owner in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(owner, ast.ClassDef):
                continue
            for node in owner.body:
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    a = node.args
                    count = len(a.posonlyargs) + len(a.args) + len(a.kwonlyargs)
                    static = any(
                        isinstance(d, ast.Name) and d.id == "staticmethod" for d in node.decorator_list
                    )
                    yield f"{path.relative_to(PACKAGE)}: {owner.name}", node.name, count - (not static)


def test_constructors_and_methods_take_few_arguments() -> None:
    long = [
        f"{place}.{name} takes {count}"
        for place, name, count in methods()
        if count > LONGEST.get(name, LONGEST_METHOD)
    ]
    assert long == []
