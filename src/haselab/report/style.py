"""One style for all figures, and reproducible SVG output."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure, FigureBase
from numpy.typing import ArrayLike

from haselab.report.analysis import Array

__all__ = [
    "BLUE",
    "GREEN",
    "GREY",
    "PALETTE",
    "PURPLE",
    "RED",
    "SKY",
    "YELLOW",
    "band",
    "figure_style",
    "inline_svg",
    "label_text",
    "legend_below",
    "scale_by",
    "thinned",
    "to_svg",
]

# Okabe and Ito's palette: distinguishable with any colour vision.
BLUE, RED, GREEN = "#0072b2", "#d55e00", "#009e73"
YELLOW, PURPLE, SKY, GREY = "#f0e442", "#aa4499", "#56b4e9", "#555555"
PALETTE = (RED, BLUE, PURPLE, GREEN, "#e69f00", SKY)

_SETTINGS: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "figure.dpi": 100,
    "figure.facecolor": "white",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "grid.alpha": 0.5,
    "grid.color": "#cccccc",
    "grid.linewidth": 0.5,
    "legend.fontsize": 8,
    "legend.framealpha": 0.85,
    "lines.linewidth": 1.3,
    "savefig.dpi": 200,
    "svg.fonttype": "none",
    "svg.hashsalt": "haselab",
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}
_NO_METADATA = {"Creator": None, "Date": None, "Format": None, "Type": None}
_FALLBACK_FONTS = "'DejaVu Sans', Verdana, Arial, sans-serif"


@contextmanager
def figure_style() -> Iterator[None]:
    """Settings of all figures, independent of the user's own matplotlib settings."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)
        yield


def to_svg(figure: Figure, name: str, title: str) -> str:
    """Convert a figure to one SVG document; the same input gives the same bytes.

    Args:
        figure: drawn inside `figure_style`.
        name: prefix of each id, so that one page can contain several documents.
        title: what a screen reader says.

    Returns:
        The document; text stays text.
    """
    buffer = io.StringIO()
    canvas = FigureCanvasSVG(figure)  # whose texts have the sizes of the document
    _arrange(figure)
    figure.dpi = matplotlib.rcParams["savefig.dpi"]  # for parts that are drawn as images
    canvas.print_svg(buffer, metadata=_NO_METADATA)  # type: ignore[no-untyped-call]
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _named_ids(text, name)
    text = text.replace("'DejaVu Sans'", _FALLBACK_FONTS)
    head_end = text.index(">") + 1
    label = title.replace("&", "&amp;").replace("<", "&lt;")
    return f'{text[: head_end - 1]} role="img">\n <title>{label}</title>{text[head_end:]}'


def _arrange(figure: Figure) -> None:
    """Place axes and texts, once. `savefig` would draw everything twice."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


def _named_ids(text: str, name: str) -> str:
    """Prefix ids with the figure's name, and replace hashes in them by numbers.

    The hashes are those of clip paths before rounding, whose last bit is not reproducible.
    """
    counted: dict[str, str] = {}

    def renamed(match: re.Match[str]) -> str:
        start, old = match.groups()
        if re.fullmatch(r"[A-Za-z]+[0-9a-f]{10}", old):
            old = counted.setdefault(old, f"shape-{len(counted) + 1}")
        return f"{start}{name}-{old}"

    return re.sub(r'(\bid="|url\(#|xlink:href="#)([^")]+)', renamed, text)


def inline_svg(document: str) -> str:
    """Convert a document to a part of an HTML page: no name spaces, size from the style sheet."""
    head, rest = document.split(">", 1)
    head = re.sub(r'\s+(xmlns(:\w+)?|width|height|version)="[^"]*"', "", head)
    return f"{head}>{rest}"


def label_text(name: str) -> str:
    """Escape a name from a file as the label of a curve: no mathematics, never hidden."""
    text = name.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def legend_below(host: FigureBase, axes: Axes, columns: int) -> None:
    """Add the legend of `axes` below the panel, where it hides no data."""
    handles, labels = axes.get_legend_handles_labels()
    host.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)


def scale_by(factor: float) -> tuple[Callable[[ArrayLike], Array], Callable[[ArrayLike], Array]]:
    """Functions of a second axis in another unit: forward and inverse."""
    return (
        lambda values: np.asarray(values, dtype=np.float64) * factor,
        lambda values: np.asarray(values, dtype=np.float64) / factor,
    )


def thinned(count: int, limit: int) -> slice:
    """Stride that keeps at most `limit` of `count` samples, for drawing only."""
    return slice(None, None, max(1, -(-count // limit)))


def band(axes: Axes, x: Array, centre: Array, half_width: Array | None, colour: str) -> None:
    """Draw a faint band of one standard deviation around a curve; nothing without `half_width`."""
    if half_width is not None and np.isfinite(half_width).any():
        axes.fill_between(
            x, centre - half_width, centre + half_width, color=colour, alpha=0.2, linewidth=0
        )
