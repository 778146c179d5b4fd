"""`haselab plan feasibility`: check whether a bench can play a study."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import click

from haselab.base import InputError, to_plain
from haselab.cli.common import answer_options
from haselab.cli.options import shared_option
from haselab.rig.rig_file import load_rig
from haselab.safety.feasibility import Feasibility
from haselab.store.folder import write_json
from haselab.study.definition import load_study
from haselab.study.feasibility import judge_study, rated_rig

__all__ = ["command"]


def _page(found: Feasibility) -> str:
    lines = [f"{'':32s} {'requested':>10s} {'limit':>10s}        in"]
    for c in found.checks:
        word = "" if c.ok else "TOO HIGH. " + c.advice
        value = "unknown" if math.isnan(c.requested) else f"{c.requested:.4g}"
        value = "infinite" if math.isinf(c.requested) else value
        row = f"{c.name:32s} {value:>10s} {c.allowed:10.4g} {c.unit:5s}  {c.where}  {word}"
        lines.append(row.rstrip())
    return "\n".join([*lines, "", "feasible" if found.ok else "not feasible"])


@click.command("feasibility")
@click.argument("study", type=click.Path(path_type=Path))
@shared_option("--rig", required=True, type=click.Path(path_type=Path))
@shared_option("--quick", is_flag=True, detail="It is described by its table [quick].")
@answer_options()
def command(study: Path, rig: Path, quick: bool, as_json: bool, out: Path | None) -> None:
    """Check whether a bench can play STUDY.

    The command compares current, slew rate, bandwidth, electric field and stretch with the limits
    of the bench. It does not connect to any instrument and applies no voltage. The exit code is 2
    if the bench cannot play the study. STUDY is a TOML file.
    """
    plan = load_study(study, quick=quick)
    file = load_rig(rig)
    rated = rated_rig(file, plan, rig)
    if rated is None:
        raise InputError(
            f"The rig file, of kind {file.kind!r}, has no table [rating]. Add one with the limits "
            f"of amplifier and actuator, or use a twin. {rig}"
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
