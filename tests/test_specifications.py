"""Every specification in `tools/campaigns` can be loaded, and everything it names exists."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from dart_flight.lab.campaign.campaign_spec import load_specification, row_type

ROOT = Path(__file__).parents[1]
SPECIFICATIONS = sorted((ROOT / "tools" / "campaigns").glob("*.yaml"))


def functions_of(path: Path) -> set[str]:
    """Return the functions of a module and the names that it imports."""
    tree = ast.parse(path.read_text("utf-8"))
    found = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return found | {alias.asname or alias.name for node in imports for alias in node.names}


@pytest.mark.parametrize("path", SPECIFICATIONS, ids=lambda path: path.stem)
def test_everything_named_in_a_specification_exists(path: Path) -> None:
    specification = load_specification(path)
    assert specification.makes_row, "the specification names no function that makes a row"
    assert all((ROOT / mission).exists() for mission in specification.missions)
    named = [
        specification.fly,
        specification.judge,
        specification.cases if isinstance(specification.cases, str) else "",
    ]
    for module, _, function in (name.partition(":") for name in named if name):
        assert function in functions_of(ROOT / f"{module.replace('.', '/')}.py"), (module, function)
    assert "page" in functions_of(path.with_suffix(".py"))
    if specification.makes_row.startswith("dart_flight."):
        assert row_type(specification.makes_row).__struct_fields__
