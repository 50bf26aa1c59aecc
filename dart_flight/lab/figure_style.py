"""The style of every figure, and functions that save figures or convert them to SVG.

Lines differ in darkness and dash as well as in colour, so that a grey print stays readable. Letters are
not converted to outlines: SVG files contain text, and PDF files embed TrueType fonts (type 42).
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec

from dart_flight.config.document import InputError, report_write_errors
from dart_flight.config.packages import missing_package

TRUE = {"color": "#000000", "linestyle": "-", "linewidth": 1.8}
ESTIMATED = {"color": "#1f6fd0", "linestyle": (0, (5, 1.5)), "linewidth": 1.6}
PREDICTED = {"color": "#e8871e", "linestyle": (0, (1, 1.2)), "linewidth": 2.2}
REPLANNED = {"color": "#8a3fb5", "linestyle": (0, (4, 1.2, 1, 1.2)), "linewidth": 1.8}
FORCE, GUARD, SET_POINT = "#c2261d", "#b00020", "#1b7a3d"
GREY = "#666666"
LINES = (TRUE, ESTIMATED, PREDICTED)  # line styles if one axis shows several quantities of one source
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "dart-flight",
    "pdf.fonttype": 42,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Arial", "Helvetica", "sans-serif"],
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "legend.frameon": False,
    "hatch.linewidth": 0.6,
}
P = ParamSpec("P")
_DIGITS = re.compile(r"(\.\d)\d+")
_COORDINATES = re.compile(r'( d="[^"]*"|<use [^>]*>)')
_METADATA = re.compile(r"<metadata>.*?</metadata>", re.DOTALL)
_BREAKS = re.compile(r"\s*\n\s*")


class Look(NamedTuple):
    """The size of a figure and of its text.

    Attributes:
        width_in: width of the whole figure, inches.
        font_pt: size of labels and ticks, points; the other text sizes derive from this size.
    """

    width_in: float
    font_pt: float

    @property
    def small_pt(self) -> float:
        """The size of legends and of labels inside a plot."""
        return self.font_pt - 1.0


# A page for a phone is 4.6 inches wide, a column of a paper 3.5 inches.
PAGE, COLUMN = Look(4.6, 9.0), Look(3.5, 8.0)


def new_figure(look: Look, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    """Return a figure and its axes; `height` is the height in inches at the width of `PAGE`.

    The aspect ratio is the same for every `look`. `options` are those of `Figure.subplots`.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  (an extra, and slow)

    figure = Figure(figsize=(look.width_in, height * look.width_in / PAGE.width_in), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def panels(look: Look, rows: int) -> tuple[Any, Any]:
    """Return a figure of stacked panels that share a time axis."""
    figure, axes = new_figure(look, 1.4 * rows + 0.6, rows, 1, sharex=True, squeeze=False)
    for axis in axes[:, 0]:
        axis.axhline(0.0, color=GREY, linewidth=0.8)
    return figure, axes[:, 0]


def shade(axis: Any, begin: float, end: float) -> None:
    axis.axvspan(begin, end, color=ESTIMATED["color"], alpha=0.08, linewidth=0)


def in_style(draw: Callable[P, Any]) -> Callable[P, Any]:
    """Decorate a drawing function so that it draws in the style of its keyword `look` (default `PAGE`)."""

    @functools.wraps(draw)
    def drawn(*args: P.args, **options: P.kwargs) -> Any:
        look = options.get("look", PAGE)
        assert isinstance(look, Look)
        with _styled(look):
            return draw(*args, **options)

    return drawn


@contextlib.contextmanager
def _styled(look: Look) -> Iterator[None]:
    try:
        import matplotlib as mpl  # noqa: PLC0415
    except ImportError as error:
        raise missing_package(f"a picture needs {error.name}", "report") from None
    sizes = {
        "font.size": look.font_pt,
        "axes.titlesize": look.font_pt,
        "figure.titlesize": look.font_pt,
        "axes.labelsize": look.font_pt,
        "xtick.labelsize": look.font_pt,
        "ytick.labelsize": look.font_pt,
        "legend.fontsize": look.font_pt - 0.5,
    }
    with mpl.rc_context({**_STYLE, **sizes}):
        yield


def as_svg(figure: Any) -> str:
    """Return the figure as SVG text without a background, and round coordinates to a tenth of a point."""
    text = io.StringIO()
    with _styled(PAGE):
        figure.savefig(text, format="svg", metadata={"Date": None}, transparent=True)
    svg = text.getvalue()
    svg = _METADATA.sub("", svg[svg.index("<svg") :])
    return _BREAKS.sub("", _COORDINATES.sub(lambda part: _shorten(part[0]), svg))


def _shorten(coordinates: str) -> str:
    return _BREAKS.sub("", _DIGITS.sub(r"\1", coordinates)).replace(".0 ", " ").replace("L ", " ")


def save_figure(figure: Any, path: Path) -> None:
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError("the picture must be a .png, .svg or .pdf file", source=str(path))
    drawn = io.BytesIO()  # in memory first: if drawing fails, the file keeps the previous picture
    with _styled(PAGE):
        figure.savefig(drawn, format=path.suffix.lower()[1:], dpi=200)
    with report_write_errors(path):
        path.write_bytes(drawn.getvalue())


def save_pages(figures: Iterable[Any], path: Path) -> None:
    """Write figures into one PDF, each on a page of its own size."""
    with _styled(PAGE):
        from matplotlib.backends.backend_pdf import PdfPages  # noqa: PLC0415

        with report_write_errors(path), PdfPages(path, metadata={"CreationDate": None}) as pages:
            for figure in figures:
                pages.savefig(figure)


def legend_above(axis: Any, columns: int | None = None) -> None:
    """Put the legend in one row above the plot, where it does not cover a line."""
    labels = axis.get_legend_handles_labels()[1]
    if labels:
        axis.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns or len(labels), borderaxespad=0.2,
            columnspacing=1.2, handlelength=1.8,
        )  # fmt: skip
