"""Figures as lists of panels, drawn separately for the page and together for the file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure, FigureBase, SubFigure

from haselab.report.analysis import LeftOutError
from haselab.report.folder import RunFolder
from haselab.report.style import figure_style, inline_svg, to_svg

__all__ = ["DrawnFigure", "DrawnPanel", "FigurePlan", "Panel", "draw_figure"]

_POINTS = 72.0  # in an inch
_HALF_INCH, _WIDE_INCH = 3.4, 6.8


@dataclass(frozen=True)
class Panel:
    """One panel of a figure.

    Args:
        letter: `A`, `B` ..., or `""` for the only panel.
        title: what it shows, in a few words.
        draw: draws into a (sub)figure; raises `LeftOutError` if the folder lacks data.
        wide: takes the full width of the page, else half.
        height_in: height, in inch.
    """

    letter: str
    title: str
    draw: Callable[[FigureBase, RunFolder], None]
    wide: bool = False
    height_in: float = 2.8

    @property
    def heading(self) -> str:
        """Letter and title."""
        return f"{self.letter}  {self.title}" if self.letter else self.title


@dataclass(frozen=True)
class FigurePlan:
    """A figure of the report.

    Args:
        name: file name without its ending.
        label: such as `Figure 3`; figures 2 to 7 are those of the paper.
        topic: in a few words, for the list of contents.
        caption: what is shown, and how to read it.
        panels: in reading order.
        needs: section of analysis.json without which the report omits the figure; empty: the report
            always has the figure, with notes about missing data.
        plain_caption: for a study that is not compared with the paper; "": use `caption`.
    """

    name: str
    label: str
    topic: str
    caption: str
    panels: tuple[Panel, ...]
    needs: str = ""
    plain_caption: str = ""

    def caption_of(self, is_reference: bool) -> str:
        """The caption for the reference study, or for another study."""
        return self.caption if is_reference else self.plain_caption or self.caption


@dataclass(frozen=True)
class DrawnPanel:
    """A panel drawn for the page.

    Args:
        svg: inline SVG.
        wide: takes the full width of the page.
    """

    svg: str
    wide: bool


@dataclass(frozen=True)
class DrawnFigure:
    """A drawn figure.

    Args:
        plan: the figure's plan.
        document: SVG document of all panels that could be drawn, `""` when none could.
        panels: the same panels one by one, for the page.
        notes: one sentence for each panel left out.
    """

    plan: FigurePlan
    document: str
    panels: tuple[DrawnPanel, ...]
    notes: tuple[str, ...]


def draw_figure(plan: FigurePlan, run: RunFolder) -> DrawnFigure:
    """Draw the panels of a figure for which the folder has data.

    Args:
        plan: the figure.
        run: the folder.

    Returns:
        The drawing; panels without data are left out and noted.
    """
    drawn: list[tuple[Panel, str]] = []
    notes: list[str] = []
    with figure_style():
        for panel in plan.panels:
            try:
                document = _alone(plan, panel, run)
            except LeftOutError as reason:
                name = f"Panel {panel.letter}" if panel.letter else "The figure"
                notes.append(f"{name} was left out: {reason}")
            else:
                drawn.append((panel, document))
    inline = tuple(DrawnPanel(inline_svg(document), panel.wide) for panel, document in drawn)
    return DrawnFigure(plan, _together(plan, drawn) if drawn else "", inline, tuple(notes))


def _alone(plan: FigurePlan, panel: Panel, run: RunFolder) -> str:
    width = _WIDE_INCH if panel.wide else _HALF_INCH
    figure = Figure(figsize=(width, panel.height_in), layout="constrained")
    _draw(figure, panel, run)
    name = f"{plan.name}{panel.letter.lower()}"
    return to_svg(figure, name, f"{plan.label}: {panel.heading}")


def _together(plan: FigurePlan, drawn: Sequence[tuple[Panel, str]]) -> str:
    """One document: the panels' documents, placed side by side and below each other."""
    documents = {id(panel): document for panel, document in drawn}
    rows = _packed([panel for panel, _ in drawn])
    wide = any(len(row) == 2 or row[0].wide for row in rows)
    width_pt = _POINTS * (_WIDE_INCH if wide else _HALF_INCH)
    placed, top_pt = [], 0.0
    for row in rows:
        for column, panel in enumerate(row):
            left_pt = 0.5 * width_pt * column
            where = f'<svg x="{left_pt:g}" y="{top_pt:g}"'
            placed.append(documents[id(panel)].replace("<svg", where, 1))
        top_pt += _POINTS * max(panel.height_in for panel in row)
    title = f"{plan.label}: {'; '.join(panel.heading for panel, _ in drawn)}"
    label = title.replace("&", "&amp;").replace("<", "&lt;")
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'width="{width_pt:g}pt" height="{top_pt:g}pt" viewBox="0 0 {width_pt:g} {top_pt:g}" '
        f'role="img">\n <title>{label}</title>\n'
    )
    return head + "\n".join(placed) + "\n</svg>\n"


def _packed(panels: Sequence[Panel]) -> list[list[Panel]]:
    """Arrange wide panels in separate rows, and half panels in pairs."""
    rows: list[list[Panel]] = []
    for panel in panels:
        if not panel.wide and rows and len(rows[-1]) == 1 and not rows[-1][0].wide:
            rows[-1].append(panel)
        else:
            rows.append([panel])
    return rows


def _draw(host: Figure | SubFigure, panel: Panel, run: RunFolder) -> None:
    panel.draw(host, run)
    if host.axes[0].get_title(loc="left"):  # each row has a title of its own
        host.suptitle(panel.heading, x=0.01, ha="left", fontweight="bold")
    else:
        host.axes[0].set_title(panel.heading, loc="left", fontweight="bold")
