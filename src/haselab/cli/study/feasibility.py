"""`haselab plan feasibility`: whether a bench can do a study, before it is energised."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import click

from haselab.base import InputError, to_plain
from haselab.cli.common import answer_options
from haselab.rig.rig_file import load_rig
from haselab.safety.feasibility import Feasibility
from haselab.store.folder import write_json
from haselab.study.definition import load_study
from haselab.study.feasibility import judge_study, rated_rig

__all__ = ["command"]


def _page(found: Feasibility) -> str:
    lines = [f"{'':32s} {'requested':>10s} {'allowed':>10s}        in"]
    for c in found.checks:
        word = "" if c.ok else "TOO HIGH. " + c.advice
        value = "unknown" if math.isnan(c.requested) else f"{c.requested:.4g}"
        value = "infinite" if math.isinf(c.requested) else value
        lines.append(
            f"{c.name:32s} {value:>10s} {c.allowed:10.4g} {c.unit:5s}  {c.where}  {word}".rstrip()
        )
    return "\n".join([*lines, "", "feasible" if found.ok else "not feasible"])


@click.command("feasibility")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--rig", required=True, type=click.Path(path_type=Path), help="RIG.toml")
@click.option("--quick", is_flag=True, help="Apply the study's table `quick`.")
@answer_options(out_help="Also write the JSON result to this file.")
def command(study: Path, rig: Path, quick: bool, as_json: bool, out: Path | None) -> None:
    """Whether a bench can play STUDY.toml: current, slew, bandwidth, field, stretch.

    Connects to nothing and applies no voltage. Exits with 2 where the bench cannot.
    """
    plan = load_study(study, quick=quick)
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
    found.require()
