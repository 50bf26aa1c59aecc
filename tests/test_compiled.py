"""The modules that `make compiled` compiles: what mypyc would spoil without a word is not in them."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MODULES: list[str] = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["custom"]["modules"]


@pytest.mark.parametrize("module", MODULES)
def test_a_compiled_module_has_no_struct_and_no_arrays(module: str) -> None:
    """mypyc drops a Struct's options (frozen, gc, dict), and refuses an array where a float is declared."""
    tree = ast.parse((ROOT / module).read_text(encoding="utf-8"))
    bases = {
        ast.unparse(base) for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for base in node.bases
    }
    assert not {base for base in bases if base.endswith(("Struct", "Section", "Record"))}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    # `Arithmetic` and `Number` are those of a rule for numbers and for arrays.
    assert not {alias.name for node in imports for alias in node.names} & {"numpy", "Arithmetic", "Number"}


def test_no_compiled_module_stands_beside_its_source() -> None:
    """It would be imported instead of the source, and hide every change."""
    assert not [path for path in (ROOT / "dart_flight").rglob("*") if path.suffix in (".so", ".pyd")]
