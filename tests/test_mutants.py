"""The mutation campaign's own parts: what it draws compiles, is another program, and comes by a seed."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tools.campaigns import mutants
from tools.campaigns.mutants import Mutant, Result, all_mutants, draw, judged, mutants_of, report
from tools.campaigns.results import ROOT

SOURCE = '''"""A module."""

LIMIT = 0.5


def over(x: float, y: float | None = 2) -> bool:
    """Whether it is."""
    assert x == 1.0
    print(f"{x:.3f} {1 + 1}")
    zip((x,), (y,), strict=True)
    return not (x > -LIMIT and y is not None)
'''


@pytest.fixture(scope="module")
def everything() -> list[Mutant]:
    return all_mutants()


def test_every_mutant_is_another_program_that_compiles(everything: list[Mutant]) -> None:
    sources = {m.path: (ROOT / m.path).read_bytes() for m in everything}
    trees = {path: ast.dump(ast.parse(source)) for path, source in sources.items()}
    assert len(everything) > 1000
    for mutant in everything[::40]:
        changed = mutant.applied(sources[mutant.path])
        assert ast.dump(ast.parse(changed)) != trees[mutant.path], mutant


def test_what_is_mutated_and_what_is_not(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(SOURCE)
    found = {(m.line, m.kind, m.before) for m in mutants_of(path, tmp_path)}
    assert found == {
        (3, "constant", "0.5"),
        (6, "constant", "2"),
        (8, "early return", "def over"),  # before its first statement
        (9, "call dropped", "print(f'{x:.3f} {1 + 1}')"),
        (10, "call dropped", "zip((x,), (y,), strict=True)"),
        (11, "not", "not (x > -LIMIT and y is not None)"),
        (11, "and/or", "x > -LIMIT and y is not None"),
        (11, "comparison", "x > -LIMIT"),
        (11, "sign", "-LIMIT"),
        (11, "comparison", "y is not None"),
    }


def test_a_seed_draws_the_same_again() -> None:
    assert draw(30, 1) == draw(30, 1)
    assert draw(30, 1) != draw(30, 2)
    assert len(draw(30, 1)) == len({m.key for m in draw(30, 1)}) == 30
    kinds = [m.kind for m in draw(90, 1)]
    assert max(map(kinds.count, set(kinds))) - min(map(kinds.count, set(kinds))) <= 1


def test_the_core_thread_is_among_them_and_the_rest_of_the_app_is_not(everything: list[Mutant]) -> None:
    functions = {m.function.split(".")[0] for m in everything if m.path == "dart_flight/run/core_thread.py"}
    assert functions == {"CoreThread"}
    assert any(m.function.startswith("CoreRunner") for m in everything)


def test_what_must_notice_a_mutant_is_there(everything: list[Mutant]) -> None:
    """Tests that have moved would be missed by nobody but the mutants that survive."""
    asked = {test for m in everything for test in mutants.tests_of(m)}
    assert "tests/lock" in asked
    of_pulse = next(m for m in everything if m.path == "dart_flight/core/sense/pulse.py")
    assert "tests/core/test_force_estimate.py" in mutants.tests_of(of_pulse)[1:3]
    assert [test for test in asked if not (ROOT / test.partition("::")[0]).exists()] == []


def test_what_was_judged_is_still_there(everything: list[Mutant]) -> None:
    """A verdict on code that has changed since is none."""
    known = judged()
    assert set(known) <= {m.key for m in everything}
    assert all(verdict in ("equivalent", "accepted") and why for verdict, why in known.values())


def test_the_report_shows_who_survived() -> None:
    one, two = draw(2, 1)
    page = report([Result(one, "killed", "core/test_core.py::test_x"), Result(two, "survived")], 1, 100)
    assert "Survived: 1, " in page
    assert f"`{Path(two.path).name}:{two.line}`" in page
    assert "| `core/test_core.py::test_x` | 1 |" in page


def test_what_was_noticed_is_not_tried_again_and_survivors_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, kept = draw(3, 1), tmp_path / "build" / "mutants.jsonl"
    tried: list[list[Mutant]] = []

    def run_all(
        given: list[Mutant], jobs: int, tests: Sequence[str], keep: Callable[[Result], None]
    ) -> list[Result]:
        tried.append(given)
        results = [Result(m, "survived" if m is drawn[1] else "killed", "a_test") for m in given]
        for result in results:
            keep(result)
        return results

    monkeypatch.setattr(mutants, "run_all", run_all)
    first = mutants.run_missing(drawn, 1, [], kept)
    assert mutants.run_missing(drawn, 1, [], kept) == first
    assert [r.mutant for r in first] == drawn
    assert tried == [drawn, [drawn[1]]]


def test_a_tree_says_what_failed_in_it(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\n")
    (tmp_path / "test_it.py").write_text("def test_good(): pass\ndef test_bad(): assert 0\n")
    assert mutants.run_tests(tmp_path, ["test_it.py"]) == ("killed", "test_it.py::test_bad")
    (tmp_path / "test_it.py").write_text("def test_good(): pass\n")
    assert mutants.run_tests(tmp_path, ["test_it.py"]) == ("survived", "")
