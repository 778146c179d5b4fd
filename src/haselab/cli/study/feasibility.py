"""`haselab plan feasibility`: check whether a bench can play a study."""

from __future__ import annotations

import json
import math
import textwrap
from dataclasses import asdict
from pathlib import Path

import click
import numpy as np

from haselab.base import InputError, to_plain
from haselab.base.chart import Chart, Curve, Panel
from haselab.cli.common import actuator_option, answer_options
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.study.run import load_study_with_actuator
from haselab.rig.rig_file import load_rig
from haselab.safety.feasibility import Feasibility
from haselab.store.folder import write_json
from haselab.study.experiments.steps import unplayed_trials
from haselab.study.feasibility import check_study, rated_rig

__all__ = ["command"]


def _page(found: Feasibility) -> str:
    lines = [f"{'':32s} {'requested':>10s} {'limit':>10s}        in"]
    for c in found.checks:
        word = "" if c.ok else f"TOO {'LOW' if c.lower else 'HIGH'}. {c.advice}"
        value = "unknown" if math.isnan(c.requested) else f"{c.requested:.4g}"
        value = "infinite" if math.isinf(c.requested) else value
        row = f"{c.name:32s} {value:>10s} {c.allowed:10.4g} {c.unit:5s}  {c.where}  {word}"
        lines.append(row.rstrip())
    return "\n".join([*lines, "", "feasible" if found.ok else "not feasible"])


@click.command("feasibility")
@click.argument("study", type=click.Path(path_type=Path))
@shared_option("--rig", required=True, type=click.Path(path_type=Path))
@shared_option("--quick", is_flag=True, detail="The table [quick] of STUDY describes it.")
@actuator_option(
    "The command uses its voltage of zero strain and its controller, as haselab run does."
)
@answer_options(plot=True)
def command(
    study: Path,
    rig: Path,
    quick: bool,
    actuator: Path | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Check whether a bench can play STUDY.

    The command compares current, slew rate, bandwidth, electric field and stretch with the limits
    of the bench. It does not connect to any instrument and applies no voltage. The exit code is 2
    if the bench cannot play the study. STUDY is a TOML file.
    """
    plan = load_study_with_actuator(study, actuator, quick=quick)
    if not quick:
        try:
            load_study_with_actuator(study, actuator, quick=True)
        except InputError as error:
            raise InputError(f"With the changes of [quick]: {error}") from None
    if note := unplayed_trials(plan):
        click.echo(f"haselab: {note}", err=True)
    file = load_rig(rig)
    rated = rated_rig(file, plan, rig)
    if rated is None:
        raise InputError(
            f"The rig file, of kind {file.kind!r}, has no table [rating]. Add one with the limits "
            f"of amplifier and actuator, or use a twin. {rig}"
        )
    found = check_study(plan, *rated)
    answer = {
        "feasible": found.ok,
        "checks": [asdict(check) | {"ok": check.ok} for check in found.checks],
        "rating": asdict(rated[1]),
    }
    if out is not None:
        write_json(out, answer)
    click.echo(json.dumps(to_plain(answer), indent=2) if as_json else _page(found))
    save_plot(plot, lambda: _chart(found))
    found.require()


def _chart(found: Feasibility) -> Chart:
    """Draw each requested value as a fraction of its limit."""
    shown = [c for c in found.checks if c.allowed > 0.0 and math.isfinite(c.requested)]
    at = np.arange(len(shown), dtype=np.float64)
    share = np.array([check.requested / check.allowed for check in shown])
    names = [textwrap.fill(check.name, 12) for check in shown]
    bars = Curve(at, share, "requested", "bars")
    limit = Curve(np.array([-0.5, len(shown) - 0.5]), np.ones(2), "limit")
    panel = Panel("", "Requested over limit", (bars, limit), ticks=names)
    return Chart("Feasibility: requested value over limit", (panel,))
