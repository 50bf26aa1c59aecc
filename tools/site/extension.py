"""What Sphinx lacks for this manual: formulas and diagrams without a network, and docstrings in our notation.

Formulas become MathML and Mermaid diagrams become SVG when the site is built, so the pages need no script
for them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import latex2mathml.converter
import mmdr
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import dart_flight
from tools.site import search_index

_QUOTED = re.compile(r"(?<!`)`([^`]+)`(?!`)(\w?)")
# `a, b: text`, which describes two attributes in one entry
_SHARED = re.compile(r"^( +)((?:\w+, )+\w+): (.+(?:\n\1 +\S.*)*)", re.MULTILINE)
_PAGE = re.compile(r"\bdocs/([\w/]+)\.md\b")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the parts of this extension."""
    app.add_html_math_renderer("mathml", (visit_inline_math, None), (visit_math, None))
    app.add_directive("mermaid", Mermaid)
    app.connect("autodoc-process-docstring", convert_docstring, priority=100)  # before napoleon
    app.connect("autodoc-process-signature", mend_signature)
    app.connect("autodoc-skip-member", skip_member)
    app.connect("build-finished", write_search_index)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_search_index(app: Sphinx, exception: Exception | None) -> None:
    """Write the index of the search once the pages exist."""
    if exception is None:
        search_index.write(Path(app.outdir))


def visit_inline_math(translator: Any, node: nodes.Node) -> None:
    """Write a formula in a line."""
    translator.body.append(latex2mathml.converter.convert(node.astext()))
    raise nodes.SkipNode


def visit_math(translator: Any, node: nodes.Node) -> None:
    """Write a formula that stands alone; its lines become rows."""
    formula = latex2mathml.converter.convert(node.astext().replace("aligned}", "align*}"), display="block")
    translator.body.append(f'<div class="formula">{formula}</div>\n')
    raise nodes.SkipNode


class Mermaid(SphinxDirective):  # type: ignore[misc]  # mypy does not follow Sphinx
    """The directive of a fenced block `mermaid`: an SVG drawn when the site is built."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the diagram."""
        svg = mmdr.render("\n".join(self.content)).svg()
        # A narrow screen scrolls; smaller labels could not be read.
        svg = re.sub(
            r"max-width:([\d.]+)px",
            lambda found: f"{found[0]};min-width:{0.6 * float(found[1]):.0f}px",
            svg,
            count=1,
        )
        return [nodes.raw("", f'<div class="diagram">{svg}</div>', format="html")]


def convert_docstring(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Convert backticks into code or links to classes of the reference, and names of pages into links."""
    text = _SHARED.sub(_split, "\n".join(lines))
    text = _QUOTED.sub(_quote, text.replace("|", "\\|"))
    lines[:] = _PAGE.sub(r":doc:`\1`", text).splitlines()


def _split(found: re.Match[str]) -> str:
    indent, names, text = found.groups()
    return "\n".join(f"{indent}{name}: {text}" for name in names.split(", "))


def _quote(found: re.Match[str]) -> str:
    quoted, following = found.groups()
    words = " ".join(quoted.split()).replace("\\|", "|")
    is_class = words in dart_flight.__all__ and words[0].isupper()
    code = f":py:class:`{words} <dart_flight.{words}>`" if is_class else f"``{words}``"
    return f"{code}\\ {following}" if following else code


def mend_signature(
    app: Sphinx,
    what: str,
    name: str,
    obj: object,
    options: object,
    signature: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Replace default values that are no Python, such as `<factory>`; Sphinx cannot parse them."""
    return (re.sub(r"= ?<[\w.]+>", "= ...", signature) if signature else signature), returned


def skip_member(app: Sphinx, what: str, name: str, obj: object, skip: bool, options: object) -> bool | None:
    """Skip fields without a text of their own; the class's docstring describes them."""
    text = getattr(obj, "__doc__", None) or ""
    return True if text.startswith("Alias for field number") else None
