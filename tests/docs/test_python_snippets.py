"""Python in the documentation runs as it stands."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPETS = [
    pytest.param(
        page, match.group(1), id=f"{page.name}:{page.read_text()[: match.start()].count(chr(10)) + 1}"
    )
    for page in PAGES
    for match in re.finditer(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
]


def test_the_quickstart_has_one() -> None:
    assert any("core.step" in str(snippet.values[1]) for snippet in SNIPPETS)


@pytest.mark.parametrize(("page", "code"), SNIPPETS)
def test_it_runs(
    page: Path, code: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(code, str(page), "exec"), {})
    if "print(" in code:
        assert "/out/lock" in capsys.readouterr().out or page.name != "quickstart.md"
