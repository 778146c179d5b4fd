"""`haselab plan feasibility`: whether a bench can do a study, before it is energised."""

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
from haselab.cli.plot import save_plot
from haselab.cli.study.run import planned
from haselab.rig.rig_file import load_rig
from haselab.safety.feasibility import Feasibility
from haselab.store.folder import write_json
from haselab.study.definition import load_study
from haselab.study.feasibility import judge_study, rated_rig

__all__ = ["command"]


def _page(found: Feasibility) -> str:
    lines = [f"{'':32s} {'asked':>10s} {'allowed':>10s}        in"]
    for c in found.checks:
        word = "" if c.ok else "TOO HIGH. " + c.advice
        asked = "not known" if math.isnan(c.asked) else f"{c.asked:.4g}"
        asked = "no end" if math.isinf(c.asked) else asked
        lines.append(
            f"{c.name:32s} {asked:>10s} {c.allowed:10.4g} {c.unit:5s}  {c.where}  {word}".rstrip()
        )
    return "\n".join([*lines, "", "feasible" if found.ok else "not feasible"])


@click.command("feasibility")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--rig", required=True, type=click.Path(path_type=Path), help="RIG.toml")
@click.option("--quick", is_flag=True, help="Apply the study's table `quick`.")
@actuator_option("its voltage of zero strain and its controller, as in haselab run.")
@answer_options(out_help="Also write the JSON result to this file.", plot=True)
def command(
    study: Path,
    rig: Path,
    quick: bool,
    actuator: Path | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Whether a bench can play STUDY.toml: current, slew, bandwidth, field, stretch.

    Connects to nothing and applies no voltage. Exits with 2 where the bench cannot.
    """
    plan = planned(load_study(study, quick=quick), actuator)
    file = load_rig(rig)
    rated = rated_rig(file, plan, rig)
    if rated is None:
        raise InputError(
            f"No table [rating] for a rig of kind {file.kind!r}; allowed are a twin, or a bench "
            f"with one. Say there what amplifier and actuator withstand. {rig}"
        )
    found = judge_study(plan, *rated)
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
    """What is asked as a part of what is allowed, check by check."""
    shown = [check for check in found.checks if check.allowed > 0.0 and math.isfinite(check.asked)]
    at = np.arange(len(shown), dtype=np.float64)
    share = np.array([check.asked / check.allowed for check in shown])
    names = [textwrap.fill(check.name, 12) for check in shown]
    limit = Curve(np.array([-0.5, len(shown) - 0.5]), np.ones(2), "allowed")
    panel = Panel("", "Asked over allowed", (Curve(at, share, "asked", "bars"), limit), ticks=names)
    return Chart("Feasibility: asked over allowed", (panel,))
