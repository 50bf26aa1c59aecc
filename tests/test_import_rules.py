"""Imports point one way (docs/architecture.md), and each external package is imported in few places."""

import ast
import functools
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "dart_flight"

# Subpackages from the lowest floor up; each may import itself and lower floors. All except the lab fly.
FLIGHT = (
    "base",
    "config",
    "contact",
    "core",
    "planning",
    "lock",
    "vehicle",
    "recording",
    "sim",
    "run",
    "check",
)
FLOORS = {
    name: floor for floor, name in enumerate(("lab_entries", *FLIGHT, "cli", "lab", "__main__", "__init__"))
}
# Subpackages of the lab, from the lowest floor up.
LAB = (
    "stepwise",
    "ulog",
    "figure_style",
    "statistics",
    "holes",
    "csv_text",
    "flight_arrays",
    "map_model",
    "mission_map",
    "track",
    "predict",
    "search",
    "identify",
    "series",
    "calibrate",
    "inspect",
    "campaign",
    "report",
    "scene",
    "paper",
    "studio",
    "api",
    "gym_shuttle",
    "commands",
)
# Folders and files that may import an external package.
ALLOWED = {
    "mavsdk": ("vehicle/",),
    "qtm_rt": ("vehicle/motion_capture/qualisys.py",),
    "serial": ("lock/drivers/", "sim/px4/"),
    "pymavlink": ("sim/",),
    "asyncio": ("vehicle/", "run/", "cli/"),
    "mcap": ("recording/",),
    "foxglove": ("lab/scene/",),
    "jinja2": ("lab/report/render.py",),
    "gymnasium": ("lab/gym_shuttle.py",),
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@functools.cache
def nodes_of(path: Path) -> list[ast.AST]:
    """Return the imports and constants of a file, which is parsed once for all tests."""
    kinds = ast.Import | ast.ImportFrom | ast.Constant
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds)]


@functools.cache
def module_names() -> frozenset[str]:
    paths = (path.relative_to(PACKAGE).with_suffix("") for path in modules())
    return frozenset(".".join(("dart_flight", *path.parts)) for path in paths)


def imports_of(path: Path) -> Iterator[str]:
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield node.module


def files_imported_by(path: Path) -> set[str]:
    """Return the package's files, without `__init__`, that a file imports anywhere, even for types only."""
    found = set[str]()
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & module_names()


def test_imports_have_no_cycles() -> None:
    graph = {
        ".".join(("dart_flight", *path.relative_to(PACKAGE).with_suffix("").parts)): files_imported_by(path)
        for path in modules()
        if path.name != "__init__.py"
    }
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle


def subpackage_of(module: str) -> str | None:
    parts = module.split(".")
    if parts[0] != "dart_flight":
        return None
    return parts[1] if len(parts) > 1 else "__init__"


def test_imports_point_down() -> None:
    upward = []
    for path in modules():
        relative = path.relative_to(PACKAGE)
        own = relative.parts[0].removesuffix(".py")
        assert own in FLOORS, f"{own} is a new subpackage: give it a floor"
        for module in imports_of(path):
            imported = subpackage_of(module)
            if imported is None or imported in (own, "__init__"):  # the package itself only has a version
                continue
            if FLOORS[imported] >= FLOORS[own]:
                upward.append(f"{relative} imports {module}")
    assert upward == []


def test_the_lab_imports_point_down() -> None:
    for path in (PACKAGE / "lab").rglob("*.py"):
        relative = path.relative_to(PACKAGE / "lab")
        own = relative.parts[0].removesuffix(".py")
        for module in imports_of(path):
            parts = module.split(".")
            if parts[:2] == ["dart_flight", "lab"] and len(parts) > 2 and parts[2] != own:
                assert LAB.index(parts[2]) < LAB.index(own), f"{relative} imports {module}"


def test_the_lab_is_named_outside_it_only_in_lab_entries() -> None:
    for path in modules():
        relative = path.relative_to(PACKAGE)
        if relative.parts[0] == "lab" or relative.name == "lab_entries.py":
            continue
        for node in nodes_of(path):
            if isinstance(node, ast.Constant):
                assert not str(node.value).startswith("dart_flight.lab."), relative


def test_external_packages_are_imported_only_where_allowed() -> None:
    elsewhere = []
    for path in modules():
        relative = str(path.relative_to(PACKAGE))
        for module in imports_of(path):
            allowed = ALLOWED.get(module.split(".")[0])
            if allowed is not None and not relative.startswith(allowed):
                elsewhere.append(f"{relative} imports {module}")
    assert elsewhere == []


def test_the_core_reads_no_clock_and_does_no_io() -> None:
    for path in (PACKAGE / "core").rglob("*.py"):
        for module in imports_of(path):
            top = module.split(".")[0]
            assert top not in {"time", "os", "io", "socket", "threading", "asyncio", "random", "pathlib"}, (
                path
            )


def test_the_package_imports_neither_tests_nor_tools_and_tests_import_no_tools() -> None:
    """Tests run tools as commands; what tools and tests both need is in `tests/`."""
    root = PACKAGE.parent
    for folder, other in (("tests", "tools"), ("dart_flight", "tests"), ("dart_flight", "tools")):
        for path in (root / folder).rglob("*.py"):
            for module in imports_of(path):
                assert module.split(".")[0] != other, f"{path.relative_to(root)} imports {module}"
