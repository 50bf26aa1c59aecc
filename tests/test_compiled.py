"""The modules that `make compiled` compiles contain nothing that mypyc compiles wrongly without an error."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MODULES: list[str] = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["hooks"]["custom"]["modules"]


def test_a_compiled_module_has_no_struct_and_no_arrays() -> None:
    """mypyc drops a Struct's options (frozen, gc, dict) and rejects an array for a declared float."""
    for module in MODULES:
        nodes = list(ast.walk(ast.parse((ROOT / module).read_text(encoding="utf-8"))))
        bases = {ast.unparse(base) for node in nodes if isinstance(node, ast.ClassDef) for base in node.bases}
        assert not {base for base in bases if base.endswith(("Struct", "Section", "Record"))}, module
        imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
        # `Number` types a rule that accepts numbers and arrays.
        sources = {node.module for node in imports if isinstance(node, ast.ImportFrom)}
        names = {alias.name for node in imports for alias in node.names}
        assert not (names | sources) & {"numpy", "numpy.typing", "Number"}, module


def test_no_compiled_module_is_beside_its_source() -> None:
    """Python would import the compiled module instead of the source, and hide every change."""
    assert not [path for path in (ROOT / "dart_flight").rglob("*") if path.suffix in (".so", ".pyd")]


def test_final_names_have_values_that_mypyc_compiles_correctly() -> None:
    """mypyc may report a Final float, or tuple of floats, as unset if its value is not a literal."""
    for module in MODULES:
        for node in ast.parse((ROOT / module).read_text(encoding="utf-8")).body:
            if isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation).startswith("Final"):
                assert node.value is not None
                assert _is_safe(node.value), f"{module}: {ast.unparse(node)}"


def _is_safe(value: ast.expr) -> bool:
    """Return whether a value is a literal, a name, an enumeration member, or certainly no number."""
    if isinstance(value, ast.Tuple):
        return all(
            isinstance(e, ast.Name) or (isinstance(e, ast.Constant) and isinstance(e.value, str))
            for e in value.elts
        )
    if isinstance(value, ast.Call):
        name = ast.unparse(value.func)
        return name == "frozenset" or name[0].isupper()
    if isinstance(value, ast.Attribute):
        return ast.unparse(value.value) != "math"
    if isinstance(value, ast.BinOp | ast.UnaryOp):
        return all(not isinstance(n, ast.Name | ast.Call) for n in ast.walk(value))
    return isinstance(value, ast.Constant | ast.Name | ast.Dict | ast.List)
