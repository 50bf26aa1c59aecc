"""Campaign: mutants of the core by cosmic-ray, drawn by a seed, and the tests that detect them.

Within a file, every kind of change is drawn with the same probability. The mutant is written into a copy of
the tree. There, the tests of `make test` and then those of `make test-rest` run until a test fails. If no
test fails, the mutant has survived. The author then adds a test for it, or docs/results/mutants.md explains
why no test is needed. Tests with sockets, real time or PX4 do not run.
"""

from __future__ import annotations

import random
import shutil
import sys
import tempfile
from ast import literal_eval
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator
from cosmic_ray.testing import run_tests
from cosmic_ray.work_item import TestOutcome

from dart_flight.base.summary import wilson
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import ROOT, markdown

_MUTATED = ("dart_flight/core/*/*.py", "dart_flight/core/*.py", "dart_flight/run/core_thread.py")
# Operators by kind of change. The tests always detect cosmic-ray's others, such as a shift instead of a sum.
# No operator changes `<` into `<=`, because a measured number does not equal its limit.
_KINDS = {
    "comparison": [
        f"ReplaceComparisonOperator_{a}_{b}"
        for pair in ("Lt GtE", "LtE Gt", "Eq NotEq", "Is IsNot")
        for a, b in (pair.split(), pair.split()[::-1])
    ],
    "arithmetic": [f"ReplaceBinaryOperator_{name}" for name in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul")],
    "sign or not": ["ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Not"],
    "condition": ["AddNot", "ReplaceAndWithOr", "ReplaceOrWithAnd"],
    "constant": ["NumberReplacer", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue"],
    "loop": ["ZeroIterationForLoop", "ReplaceBreakWithContinue", "ReplaceContinueWithBreak"],
}
# Command -> mark of its tests, then groups of tests. The groups that detect most mutants in the shortest time
# come first; only a surviving mutant runs all groups.
_COMMANDS = {
    "test": (
        "not rest",
        "tests/recording/test_recorded_flights.py::test_a_replayed_flight_makes_the_recorded_decisions",
        "tests/core",
        "tests",
    ),
    "test-rest": ("rest", "tests"),
}
# Everything else is copied, because the tests of pages also read README, Makefile and deploy.
_LEFT_OUT = shutil.ignore_patterns(".git", ".venv", ".*_cache", "__pycache__")
_LONGEST_S = 3600.0
_LEAST_CHANGE = 1e-3  # least relative change of a number; no test can detect 1 us in 1 s


class Mutant(msgspec.Struct, frozen=True):
    """One mutant: place, line before and after the change, and the test that detected it, or "".

    `command` is the first of `_COMMANDS` that detected the mutant, or "".
    """

    place: str
    kind: str
    before: str
    after: str
    detected_by: str
    command: str


def mutations(file: Path) -> Iterator[tuple[str, str, int, int]]:
    """Yield every possible mutation: kind, operator, number of its occurrence in the file, and line."""
    nodes = list(ast_nodes(get_ast_from_path(file)))
    for kind, operators in _KINDS.items():
        for name in operators:
            operator = get_operator(f"core/{name}")()
            places = ((node, place) for node in nodes for place in operator.mutation_positions(node))
            for occurrence, (node, ((line, _), _end)) in enumerate(places):
                if name != "NumberReplacer" or abs(float(literal_eval(node.value))) < 1.0 / _LEAST_CHANGE:
                    yield kind, name, occurrence, line


def try_mutant(_: Point, seed: int) -> Mutant:
    """Draw the mutant of a seed and run the tests against it; seed 0 runs them against the original code."""
    rng = random.Random(seed)
    files = sorted(file for pattern in _MUTATED for file in ROOT.glob(pattern) if file.name != "__init__.py")
    file = rng.choices(files, [file.stat().st_size for file in files])[0]
    found = list(mutations(file))
    kind = rng.choice(sorted({mutation[0] for mutation in found}))
    drawn = rng.choice([mutation for mutation in found if mutation[0] == kind])
    path, before = file.relative_to(ROOT), file.read_text("utf-8")
    after = mutate_code(before, get_operator(f"core/{drawn[1]}")(), drawn[2]) if seed else before
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, symlinks=True, ignore=_LEFT_OUT)  # test data contain broken links
        (tree / ".venv").symlink_to(sys.prefix)  # advice on missing packages depends on this path
        (tree / path).write_text(after, "utf-8")
        command, detected_by = _first_detection(tree)
    if not seed:
        return Mutant("", "", "", "", detected_by, command)
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    old_line, new_line = next(((a.strip(), b.strip()) for a, b in pairs if a != b), ("", ""))
    return Mutant(f"{path}:{drawn[3]}", kind, old_line, new_line, detected_by, command)


def _first_detection(tree: Path) -> tuple[str, str]:
    """Return the first command whose tests fail in a tree, and the failed test, or two empty texts."""
    options = "-x -q -p no:cacheprovider --no-header --tb=no -n 0"
    environment = f"env --chdir={tree} PYTHONPATH={tree}"
    for command, (marks, *groups) in _COMMANDS.items():
        selected = f"-m '({marks}) and not mavlink and not px4 and not realtime'"
        for tests in groups:
            words = f"{environment} {tree}/.venv/bin/python -m pytest {options} {selected} {tests}"
            outcome, output = run_tests(words, _LONGEST_S)
            if outcome is not TestOutcome.SURVIVED:
                lines = output.splitlines()
                failed = [text.split()[1] for text in lines if text.startswith(("FAILED", "ERROR"))]
                return command, (failed or [output.strip()[-80:]])[0]
    return "", ""


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the number of detected mutants, and the survivors."""
    mutants = [r.row for r in rows if r.row.kind]
    undetected = [m for m in mutants if not m.detected_by]
    baseline_failures = [
        f"The tests fail without a mutant: {r.row.detected_by}"
        for r in rows
        if r.seed == 0 and r.row.detected_by
    ]
    survivors = [(m.place, m.kind, f"`{m.before}`", f"`{m.after}`") for m in undetected]
    by_command = [
        (f"`make {name}`", str(len(mutants)), str(found), f"{100 * low:.0f} to {100 * high:.0f} %")
        for name, commands in (("test", ("test",)), ("test-all", tuple(_COMMANDS)))
        for found in [sum(m.command in commands for m in mutants)]
        for low, high in [wilson(found, len(mutants))]
    ]
    return "\n".join(
        [
            *baseline_failures,
            markdown(("command", "mutants", "detected", "share, 95 % interval"), by_command),
            markdown(("survivor", "kind", "before", "after"), survivors),
        ]
    )
