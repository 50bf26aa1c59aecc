"""Seeded mutants of the core and of what is around it: does a test notice each of them?

    python -m tools.campaigns.mutants --runs 60 --seed 1
    python -m tools.campaigns.mutants --at dart_flight/core/guard/guard.py:196

One change at a time (a comparison turned round, a constant scaled, `and` for `or`, a sign or a `not` lost, a
function that does nothing, a statement dropped) is written into a copy of the tree, and the tests that the
code is meant to answer to run there until the first failure. A mutant that no test notices has survived. Each
survivor is looked at: a test is written that kills it, or `mutants_judged.csv` says why none is needed.

Results go to build/mutants.jsonl as they come. Started again it takes from there what was noticed; what had
survived is tried again, against the tests as they are now. `--fresh` forgets all of it.
"""

from __future__ import annotations

import argparse
import ast
import csv
import functools
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec

from tools.campaigns.kept import kept_lines
from tools.campaigns.results import RESULTS, ROOT, measured_by

JUDGED = Path(__file__).with_name("mutants_judged.csv")
KEPT = ROOT / "build" / "mutants.jsonl"
# What is mutated: whole files, or the named classes of one.
CORE = "dart_flight/core"
CLASSES = {
    "dart_flight/run/core_thread.py": ("CoreThread",),
    "dart_flight/run/runner.py": ("CoreRunner",),
}
# Around the core, each with the tests that need no real time and must notice.
SHELL: dict[str, tuple[str, ...]] = {
    "dart_flight/run/app.py": ("tests/run/test_app.py", "tests/run/test_operator.py"),
    "dart_flight/run/deadman.py": ("tests/faults/test_deadman.py",),
    "dart_flight/vehicle/vehicle_session.py": ("tests/vehicle",),
    "dart_flight/planning/replanner.py": (
        "tests/planning/test_replanner.py",
        "tests/flights/test_replanned_flights.py",
    ),
    "dart_flight/lock": ("tests/lock",),
}
CORE_TESTS = "tests/core"
# What must notice of the core: first what notices most in the shortest time.
TESTS = (
    "tests/recording/test_recorded_flights.py::test_a_recorded_flight_is_decided_again",
    CORE_TESTS,
    "tests/run",
    "tests/recording/test_recorded_flights.py",
    "tests/flights/test_fast_flights.py",
    "tests/flights/test_lock_in_flight.py",
    "tests/flights/test_waypoints.py",
    "tests/flights/test_no_lock.py",
    "tests/flights/test_replanned_flights.py",
    "tests/faults/test_matrix.py",
)
COPIED = ("dart_flight", "tests", "tools", "configs", "missions", "docs", "pyproject.toml")
_PATIENCE = 3.0  # times as long as the tests take without a mutant: it hangs
_LONGEST_S = 3600.0
# Functions that write text for people: of them only that they run is tested.
_TEXT_ONLY = ("table",)
_FACTOR = 3

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}


Key = tuple[str, str, str, str, str]


class Mutant(msgspec.Struct, frozen=True):
    """One change of the source.

    Attributes:
        path: of the file, relative to the tree.
        line: where the changed code begins.
        function: it lies in, with its class; empty for the module's own level.
        kind: of the change.
        code: the line, without its indentation.
        before, after: the code, as Python writes it.
        start, end: of the changed code in the file, bytes.
    """

    path: str
    line: int
    function: str
    kind: str
    code: str
    before: str
    after: str
    start: int
    end: int

    @property
    def key(self) -> Key:
        """What identifies it when lines have moved: path, function, code, before, after."""
        return (self.path, self.function, self.code, self.before, self.after)

    def applied(self, source: bytes) -> bytes:
        """The file's text with the change in it."""
        return source[: self.start] + self.after.encode() + source[self.end :]


class Result(msgspec.Struct):
    """What became of a mutant: `killed` by a test, by `time-out`, or `survived`."""

    mutant: Mutant
    outcome: str
    by: str = ""


# --- drawing -----------------------------------------------------------------------------------------------


class _Finder:
    """Finds the places in one file where a change can be made."""

    def __init__(self, path: str, source: bytes) -> None:
        self._path, self._source = path, source
        self._offsets = [0]
        for line in source.splitlines(keepends=True):
            self._offsets.append(self._offsets[-1] + len(line))

    def find(self, node: ast.AST, function: str = "") -> Iterator[Mutant]:
        """All mutants below a node."""
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.JoinedStr | ast.Assert | ast.Import | ast.ImportFrom):
                continue  # words, what mypy is told, and what would not even load
            if isinstance(child, ast.keyword) and _only_forbids(child):
                continue
            inside = function
            if isinstance(child, ast.ClassDef | ast.FunctionDef):
                inside = f"{function}.{child.name}".lstrip(".")
            if isinstance(child, ast.FunctionDef):
                if child.name in _TEXT_ONLY:
                    continue
                yield from self._emptied(child, inside)
                for default in (*child.args.defaults, *child.args.kw_defaults):
                    if default is not None:
                        yield from self._here(default, inside)
                # Neither annotations nor decorators.
                yield from self.find(ast.Module(child.body, []), inside)
                continue
            if isinstance(child, ast.AnnAssign):
                if child.value is not None:
                    yield from self._here(child.value, inside)
                    yield from self.find(child.value, inside)
                continue
            yield from self._here(child, inside)
            yield from self.find(child, inside)

    def _here(self, node: ast.AST, function: str) -> Iterator[Mutant]:
        if isinstance(node, ast.Compare):
            operator = type(node.ops[0])
            turned = ast.Compare(node.left, [_COMPARISONS[operator](), *node.ops[1:]], node.comparators)
            yield self._mutant("comparison", node, turned, function)
        elif isinstance(node, ast.BoolOp):
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield self._mutant("and/or", node, ast.BoolOp(other, node.values), function)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            kind = "not" if isinstance(node.op, ast.Not) else "sign"
            yield self._mutant(kind, node, node.operand, function)
        elif isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            swapped = ast.BinOp(node.left, _ARITHMETIC[type(node.op)](), node.right)
            yield self._mutant("arithmetic", node, swapped, function)
        elif isinstance(node, ast.Constant):
            yield from self._scaled(node, function)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield self._mutant("call dropped", node, ast.Pass(), function)
        elif (
            isinstance(node, ast.Assign)
            and all(isinstance(target, ast.Attribute) for target in node.targets)
            and not function.endswith("__init__")  # dropped there it is an AttributeError at most
        ):
            yield self._mutant("assignment dropped", node, ast.Pass(), function)

    def _scaled(self, node: ast.Constant, function: str) -> Iterator[Mutant]:
        value = node.value
        if isinstance(value, bool):
            yield self._mutant("constant", node, ast.Constant(not value), function)
        elif isinstance(value, int | float):
            larger = value * _FACTOR if value else 1
            yield self._mutant("constant", node, ast.Constant(larger), function)
            if isinstance(value, float) and value:
                yield self._mutant("constant", node, ast.Constant(value / _FACTOR), function)

    def _emptied(self, node: ast.FunctionDef, function: str) -> Iterator[Mutant]:
        """The function that returns at once, with nothing, or with the least of its kind."""
        returns = ast.unparse(node.returns) if node.returns is not None else "None"
        at_once = ["None"] if "None" in returns else []
        at_once += {
            "bool": ["True", "False"],
            "float": ["0.0"],
            "int": ["0"],
            "str": ["''"],
            "list[Output]": ["[]"],
            "Events": ["[]"],
        }.get(returns, [])
        first = next((s for s in node.body if not _is_docstring(s)), None)
        if first is None or node.name == "__init__":
            return
        start, end = self._span(first)
        for value in at_once:
            before = f"def {node.name}"
            code = f"return {value}  # mutant\n{' ' * first.col_offset}"
            text = code + self._source[start:end].decode()
            line = self._line(node.lineno)
            yield Mutant(self._path, first.lineno, function, "early return", line, before, text, start, end)

    def _mutant(self, kind: str, node: ast.AST, changed: ast.AST, function: str) -> Mutant:
        start, end = self._span(node)
        text = ast.unparse(ast.fix_missing_locations(changed))
        if not isinstance(changed, ast.stmt):
            text = f"({text})"
        number: int = node.lineno  # type: ignore[attr-defined]
        before = ast.unparse(node)
        return Mutant(self._path, number, function, kind, self._line(number), before, text, start, end)

    def _line(self, number: int) -> str:
        return self._source[self._offsets[number - 1] : self._offsets[number]].decode().strip()

    def _span(self, node: ast.AST) -> tuple[int, int]:
        assert isinstance(node, ast.expr | ast.stmt)
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            self._offsets[node.lineno - 1] + node.col_offset,
            self._offsets[node.end_lineno - 1] + node.end_col_offset,
        )


def _only_forbids(keyword: ast.keyword) -> bool:
    """`strict=True` of a zip and `frozen=True` of a class: without them correct code does the same."""
    return keyword.arg in ("strict", "frozen") and ast.unparse(keyword.value) == "True"


def _is_docstring(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def mutants_of(path: Path, root: Path = ROOT) -> list[Mutant]:
    """Every mutant of one file, in the order of the file."""
    name, source = path.relative_to(root).as_posix(), path.read_bytes()
    tree: ast.AST = ast.parse(source)
    finder = _Finder(name, source)
    wanted = CLASSES.get(name)
    if wanted is None:
        return list(finder.find(tree))
    found = [n for n in ast.iter_child_nodes(tree) if isinstance(n, ast.ClassDef) and n.name in wanted]
    return [mutant for node in found for mutant in finder.find(node, node.name)]


def _files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(path.rglob("*.py"))


def tests_of(mutant: Mutant) -> tuple[str, ...]:
    """The tests that must notice it; of the core's those first that name its file."""
    shell = next((tests for name, tests in SHELL.items() if mutant.path.startswith(name)), None)
    return shell or _naming_first(mutant.path)


@functools.cache
def _naming_first(path: str) -> tuple[str, ...]:
    module = path.removesuffix(".py").replace("/", ".")
    files = sorted((ROOT / CORE_TESTS).glob("test_*.py"))
    files.sort(key=lambda file: f"from {module} import" not in file.read_text())
    names = [file.relative_to(ROOT).as_posix() for file in files]
    return tuple(name for test in TESTS for name in (names if test == CORE_TESTS else [test]))


@functools.cache
def all_mutants(root: Path = ROOT) -> list[Mutant]:
    """Every mutant of the core, of the core thread, and of what is around them."""
    files = [path for name in (CORE, *CLASSES, *SHELL) for path in _files_of(root / name)]
    return [mutant for path in files for mutant in mutants_of(path, root)]


def draw(runs: int, seed: int, under: str = "") -> list[Mutant]:
    """A sample without repetition; the same seed draws the same from the same code.

    Only of files whose path begins with `under`.

    Every kind of change is drawn as often as the others: there are more formulas than decisions.
    """
    generator = random.Random(seed)
    by_kind: dict[str, list[Mutant]] = {}
    for mutant in all_mutants():
        if not mutant.path.startswith(under):
            continue
        by_kind.setdefault(mutant.kind, []).append(mutant)
    for found in by_kind.values():
        generator.shuffle(found)
    drawn: list[Mutant] = []
    while len(drawn) < runs and any(by_kind.values()):
        for found in by_kind.values():
            if found and len(drawn) < runs:
                drawn.append(found.pop())
    return sorted(drawn, key=lambda m: (m.path, m.start))


# --- running -----------------------------------------------------------------------------------------------


def copy_tree(to: Path) -> Path:
    """A tree of its own for one worker."""
    to.mkdir(parents=True)
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, to / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, to / name)
    return to


def run_tests(tree: Path, tests: Sequence[str] = TESTS, timeout_s: float = _LONGEST_S) -> tuple[str, str]:
    """Run the tests in a tree until the first failure; returns the outcome and what failed."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header"]
    process = subprocess.Popen(
        [*command, "-m", "not mavlink and not px4", "--tb=no", *tests],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # a mutant may leave processes behind: they end with it
    )
    try:
        said, _ = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "time-out", ""
    if process.returncode == 0:
        return "survived", ""
    failed = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    test = failed[0].split(" ")[1] if failed else f"pytest ended with {process.returncode}"
    return "killed", test.removeprefix("tests/")


def _try(mutant: Mutant, tree: Path, tests: Sequence[str] | None, timeout_s: float) -> Result:
    path = tree / mutant.path
    source = path.read_bytes()
    changed = mutant.applied(source)
    compile(changed, mutant.path, "exec")
    # Python takes a compiled file for current by its source's time in seconds and length.
    stale = path.parent / "__pycache__"
    try:
        path.write_bytes(changed)
        shutil.rmtree(stale, ignore_errors=True)
        return Result(mutant, *run_tests(tree, tests or tests_of(mutant), timeout_s))
    finally:
        path.write_bytes(source)
        shutil.rmtree(stale, ignore_errors=True)


def noticed(kept: Path) -> dict[Mutant, Result]:
    """The mutants of a file of results that a test noticed, of code that has not changed or moved since."""
    return {result.mutant: result for result in kept_lines(kept, Result) if result.outcome != "survived"}


def run_missing(mutants: list[Mutant], jobs: int, tests: Sequence[str] | None, kept: Path) -> list[Result]:
    """Try what a file of results does not have as noticed; results in the order of the mutants."""
    have = noticed(kept)
    kept.parent.mkdir(parents=True, exist_ok=True)
    with open(kept, "ab", buffering=0) as file:

        def keep(result: Result) -> None:
            file.write(msgspec.json.encode(result) + b"\n")

        missing = [m for m in mutants if m not in have]
        have.update((r.mutant, r) for r in run_all(missing, jobs, tests, keep))
    return [have[m] for m in mutants]


def run_all(
    mutants: list[Mutant],
    jobs: int,
    tests: Sequence[str] | None = None,
    keep: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """Try every mutant, `jobs` at a time, each in a tree of its own; `keep` gets each result as it comes.

    Raises:
        RuntimeError: the tests fail without any mutant.
    """
    if not mutants:
        return []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(jobs) as pool:
        trees: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for number in range(jobs):
            trees.put(copy_tree(Path(folder) / str(number)))

        tree = trees.get()
        began = time.monotonic()
        needed = tests or tuple(dict.fromkeys(test for m in mutants for test in tests_of(m)))
        whole = run_tests(tree, needed)
        timeout_s = _PATIENCE * (time.monotonic() - began)
        trees.put(tree)
        if whole != ("survived", ""):
            raise RuntimeError(f"the tests fail without a mutant: {whole}")

        def one(mutant: Mutant) -> Result:
            tree = trees.get()
            try:
                return _try(mutant, tree, tests, timeout_s)
            finally:
                trees.put(tree)

        results = []
        for result in pool.map(one, mutants):
            results.append(result)
            keep(result)
            m = result.mutant
            sys.stderr.write(f"{result.outcome:8} {m.path}:{m.line} {m.before!r} -> {_shown(m)!r}\n")
    return results


# --- the report --------------------------------------------------------------------------------------------


def judged(path: Path = JUDGED) -> dict[Key, tuple[str, str]]:
    """What has been said of survivors: their keys to (verdict, why).

    A verdict is `equivalent` (nothing that the core does can show it) or `accepted` (a test would cost more
    than the change could do harm).
    """
    with open(path, encoding="utf-8", newline="") as file:
        return {
            (row["path"], row["function"], row["code"], row["before"], row["after"]): (
                row["verdict"],
                row["why"],
            )
            for row in csv.DictReader(file)
        }


def _shown(mutant: Mutant) -> str:
    return mutant.after.splitlines()[0].removesuffix("  # mutant") if mutant.after else ""


def _code(text: str) -> str:
    one_line = " ".join(text.split()).replace("|", "\\|")
    return f"`{one_line}`"


def report(results: list[Result], seed: int, total: int) -> str:
    """The page."""
    verdicts = judged()
    survivors = [r.mutant for r in results if r.outcome == "survived"]
    late = sum(r.outcome == "time-out" for r in results)
    known = [m for m in survivors if m.key in verdicts]
    lines = [
        "# Mutants",
        "",
        measured_by("tools.campaigns.mutants", "on the tests of this tree"),
        "",
        "Single changes of the code of `dart_flight/core` and of the thread that steps it, drawn by a seed,",
        "every kind of change as often; the tests of the core, of that thread, of fast flights, of recorded",
        "flights and of the fault matrix must notice each. Survivors are looked at:",
        "`tools/campaigns/mutants_judged.csv` says of those that stay why (`equivalent`: nothing that the",
        "core does can show it; `accepted`: no test is worth it).",
        "",
        f"Seed {seed}: {len(results)} of {total} possible mutants. Noticed:",
        f"{len(results) - len(survivors)} ({late} because the tests did not end). Survived: "
        f"{len(survivors)}, {len(survivors) - len(known)} of them not judged.",
        "",
        "| file | mutants | noticed | survived |",
        "|---|---|---|---|",
    ]
    for path in sorted({r.mutant.path for r in results}):
        mine = [r for r in results if r.mutant.path == path]
        alive = sum(r.outcome == "survived" for r in mine)
        lines.append(f"| `{path}` | {len(mine)} | {len(mine) - alive} | {alive} |")
    lines += ["", "## Survivors", ""]
    if survivors:
        lines += ["| place | before | after | verdict |", "|---|---|---|---|"]
    else:
        lines.append("None.")
    for m in survivors:
        verdict, why = verdicts.get(m.key, ("**not judged**", ""))
        place = f"`{Path(m.path).name}:{m.line}` {m.function}"
        lines.append(
            f"| {place} | {_code(m.before)} | {_code(_shown(m))} | {verdict}{': ' if why else ''}{why} |"
        )
    lines += ["", "## Who noticed", "", "| test | mutants |", "|---|---|"]
    by = Counter(r.by.split("[")[0] for r in results if r.outcome == "killed")
    lines += [f"| `{name}` | {count} |" for name, count in sorted(by.items(), key=lambda e: (-e[1], e[0]))]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run it from the command line; 1 where a survivor is not judged."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tests", nargs="+", help="only these, in this order")
    parser.add_argument("--under", default="", metavar="PATH", help="only mutants of files below it")
    parser.add_argument("--at", metavar="FILE:LINE", help="every mutant of one line, without a report")
    parser.add_argument("--report-dir", type=Path, default=RESULTS)
    parser.add_argument("--fresh", action="store_true", help="forget what was noticed before")
    arguments = parser.parse_args()
    if arguments.at is not None:
        path, _, line = arguments.at.rpartition(":")
        mutants = [m for m in all_mutants() if (m.path, m.line) == (path, int(line))]
        results = run_all(mutants, arguments.jobs, arguments.tests)
        return int(any(r.outcome == "survived" for r in results))
    if arguments.fresh:
        KEPT.unlink(missing_ok=True)
    drawn = draw(arguments.runs, arguments.seed, arguments.under)
    results = run_missing(drawn, arguments.jobs, arguments.tests, KEPT)
    page = report(results, arguments.seed, len(all_mutants()))
    (arguments.report_dir / "mutants.md").write_text(page, encoding="utf-8")
    known = judged()
    open_ones = [r for r in results if r.outcome == "survived" and r.mutant.key not in known]
    return int(bool(open_ones))


if __name__ == "__main__":
    sys.exit(main())
