"""Compose the report: results, figures and provenance in one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from haselab.report.charts import chart_plans
from haselab.report.figures import PLANS, DrawnFigure, FigurePlan, draw_figure
from haselab.report.folder import RunFolder, read_folder
from haselab.report.numbers import value_text
from haselab.report.overview.facts import facts
from haselab.report.overview.groups import is_empty, result_groups
from haselab.report.overview.loops import loop_table, prediction_table
from haselab.report.overview.summary import summary_text
from haselab.report.results import Results, named_ids
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import write_text

__all__ = ["Page", "compose_page", "save_page", "write_report"]

_TITLE = "Soft electrostatic actuator: identification and closed-loop control"
_METRICS = {
    "rise_time_s": "Rise time 10–90 %",
    "settling_time_s": "Settling time",
    "overshoot": "Overshoot, including ringing",
    "peak_excess": "Peak beyond desired strain",
    "error": "Final error, of the step",
    "delay_s": "Delay",
    "phase_margin_deg": "Phase margin (°)",
}
_LAST_FIGURE = 1 + len(PLANS)  # the paper's figure 1 has no data
# Read as one paragraph, in the table's order of columns.
_DEFINITIONS = {
    "rise_time_s": "The way of a step leads from the strain before it to the final strain, the "
    "mean of the record's last tenth. Rise time: from 10 to 90 % of the way, with the ringing "
    "averaged out.",
    "settling_time_s": "Settling time: from the step until the strain stays within 2 % of the "
    "way around the final strain.",
    "overshoot": "Overshoot: largest strain beyond the final strain, as a fraction of the way.",
    "peak_excess": "Peak beyond desired strain: largest strain beyond the desired strain, as a "
    "fraction of the desired step. Compare modes by it: in open loop, slow motion changes the "
    "final strain and with it the overshoot; creep hides the ringing.",
    "error": "Final error: desired minus final strain, as a fraction of the desired step.",
}


@dataclass(frozen=True)
class Page:
    """A composed report, not yet written.

    Args:
        html: the page.
        drawings: all figures in order, including those without data.
    """

    html: str
    drawings: tuple[DrawnFigure, ...]

    @property
    def left_out(self) -> dict[str, str]:
        """Why a figure, or a part of it, is missing; by figure name."""
        return {
            drawing.plan.name: " ".join(drawing.notes) for drawing in self.drawings if drawing.notes
        }


def write_report(folder: Path) -> Path:
    """Write `figures/*.svg` and `report.html` of a run.

    Args:
        folder: folder with results.json and, for the figures, analysis.json.

    Returns:
        Path of the page.

    Raises:
        InputError: the folder, results.json or analysis.json is missing or unreadable.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as name:
        ...     run = Path(name)
        ...     _ = (run / "results.json").write_text('{"quantities": [], "provenance": {}}')
        ...     write_report(run).name
        'report.html'
    """
    return save_page(compose_page(read_folder(folder)), folder, folder / "report.html")


def compose_page(run: RunFolder) -> Page:
    """Draw the figures and fill the page.

    Args:
        run: the contents of the folder.

    Returns:
        The page and its drawings; the same input gives the same bytes.
    """
    drawings = tuple(draw_figure(plan, run) for plan in _plans(run.analysis))
    rows, is_study = run.results.quantities, "only" not in run.analysis
    html = _template().render(
        title=_title(run.results, is_study),
        citation=str(run.analysis.get("citation") or ""),
        has_paper=any(row.has_paper for row in rows),
        verdict_rule=run.results.verdict_rule,
        style=_packaged("style.css"),
        summary=summary_text(run.results),
        unverified=str(run.results.provenance.get("unverified", "")),
        simulated=run.results.simulated,
        facts=facts(run),
        loops=loop_table(run),
        predictions=prediction_table(run),
        groups=result_groups(rows, run.analysis),
        empty=[row for row in rows if is_empty(row)],
        has_noise_free=any(row.noise_free is not None for row in rows),
        reading=_reading(run.analysis.get("reading")),
        figures=drawings,
        metrics={
            "fig6": _step_metrics(run.analysis.get("steps")),
            "chip": _step_metrics(run.analysis.get("chip")),
            "miniature": _step_metrics(run.analysis.get("miniature")),
        },
        d_rows=_mappings(run.analysis.get("d_rows")),
        reconciling=_mappings(run.analysis.get("reconciling")),
        study_rows=_mappings(run.analysis.get("rows")),
        rows_changed=str(run.analysis.get("rows_changed") or ""),
        not_played=run.results.not_played,
        is_study=is_study,
        provenance=tuple(_flat("", run.results.provenance)),
    )
    return Page(html, drawings)


def _title(results: Results, is_study: bool) -> str:
    """What was done, or the name of the study; and whether and how the bench was simulated."""
    study = results.provenance.get("study")
    name = study.get("name") if isinstance(study, Mapping) else None
    title = _TITLE if is_study or not name else str(name)
    if not results.simulated:
        return title
    rig = results.provenance.get("rig_config")
    if isinstance(rig, Mapping) and rig.get("origin"):
        return f"SIMULATED, {rig.get('name')}: {title}"
    return f"SIMULATED: {title}"


def _plans(analysis: Mapping[str, Any]) -> tuple[FigurePlan, ...]:
    """The figures of a run: all of them, or those that it names."""
    only = analysis.get("only")
    drawn = tuple(
        plan
        for plan in PLANS
        if (only is None or plan.name in only) and (not plan.needs or plan.needs in analysis)
    )
    return (
        *drawn,
        *chart_plans(analysis, frozenset(plan.name for plan in PLANS), _LAST_FIGURE),
    )


def save_page(page: Page, folder: Path, path: Path) -> Path:
    """Write the page, and the figures to `folder`/figures.

    Args:
        page: composed report.
        folder: folder of the run; a figure of an earlier report that is now left out is removed.
        path: file of the page.

    Returns:
        `path`.

    Raises:
        InputError: `figures` is a link; nothing was written.
        DeviceError: a file cannot be written.
    """
    refuse_linked_folders(folder, "figures")
    figures = folder / "figures"
    for drawing in page.drawings:
        file = figures / f"{drawing.plan.name}.svg"
        if drawing.document:
            write_text(file, drawing.document)
        else:
            file.unlink(missing_ok=True)
    write_text(path, page.html)
    return path


def _packaged(name: str) -> str:
    return resources.files("haselab.report").joinpath("templates", name).read_text(encoding="utf-8")


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["value"] = value_text
    environment.filters["named_ids"] = named_ids
    environment.filters["tone"] = _tone
    environment.filters["row"] = _row
    return environment.from_string(_packaged("run.html.j2"))


def _tone(verdict: Any) -> str:
    """Colour of a verdict, which is also shown as text."""
    word = str(verdict).split()[0] if str(verdict).split() else ""
    word = word.strip(".,:;").lower()
    return word if word in ("agrees", "disagrees", "inconclusive") else "neutral"


def _row(identifier: str) -> str:
    """Row of the study that a result belongs to: `S20` for `S20.zeta`."""
    return identifier.partition(".")[0]


def _mappings(items: Any) -> tuple[Mapping[str, Any], ...]:
    """The mappings of a list; a missing cell is `None`."""
    if not isinstance(items, Sequence) or isinstance(items, str):
        return ()
    return tuple(_Cells(item) for item in items if isinstance(item, Mapping))


class _Cells(dict[str, Any]):
    """A table row from a file: a missing cell is `None`."""

    def __missing__(self, key: str) -> None:
        return None


def _reading(data: Any) -> dict[str, Any] | None:
    if not isinstance(data, Mapping):
        return None
    return {
        "verdict": value_text(data.get("verdict")),
        "evidence": _mappings(data.get("evidence")),
    }


def _step_metrics(steps: Any) -> dict[str, Any] | None:
    """Rows and columns of the table of step metrics, below figure 6."""
    groups = steps.get("metrics") if isinstance(steps, Mapping) else None
    if not isinstance(groups, Mapping):
        return None
    named = {name: cells for name, cells in groups.items() if isinstance(cells, Mapping)}
    keys = [key for key in _METRICS if any(key in cells for cells in named.values())]
    rows = [(name, [cells.get(key) for key in keys]) for name, cells in named.items()]
    if not keys:
        return None
    return {
        "columns": [_METRICS[key] for key in keys],
        "rows": rows,
        "definitions": " ".join(_DEFINITIONS[key] for key in keys if key in _DEFINITIONS),
    }


def _flat(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """Nested provenance as dotted names, in the file's order."""
    if isinstance(value, Mapping) and value and not {"value", "ci95"} <= set(value):
        for key, item in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), item)
    elif name:
        is_list = isinstance(value, (list, tuple))
        yield name, ", ".join(map(value_text, value)) if is_list else _exact(value)


def _exact(value: Any) -> str:
    """Seeds and settings in full, not rounded as measurements are."""
    return str(value) if isinstance(value, (int, float)) else value_text(value)
