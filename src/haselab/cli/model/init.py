"""`haselab init`: write a commented actuator file to start from."""

from __future__ import annotations

import json
import re
from pathlib import Path

import click

from haselab.actuators import ACTUATORS
from haselab.base import InputError
from haselab.cli.actuator_file import unknown_kind
from haselab.cli.common import POSITIVE, REAL, answer_options, emit
from haselab.cli.options import shared_option
from haselab.store.folder import write_text

__all__ = ["command"]

_KIND = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_MEASURED = (
    "# For haselab identify actuator: starting values, and what you measured otherwise. Type those",
    "# that it does not fit, if they differ from these defaults.",
)
_PAGE = """\
# One physical actuator and everything known about it. SI units.
# Commands with --actuator write their results into their own section; you may type values, too.
# Your own comments and keys are kept.

[actuator]
name = {name}
kind = "{kind}"  # planar-hasel, peano-hasel, curling-hasel, dea-stack, ...
{mass}  # kg, hung mass

[actuator.geometry]
{zero}  # m, between the fiducials at zero strain
# width_m = 0.05
# gap_m = 1e-3  # m, thickness of the dielectric
{parameters}
[sensing]
# haselab calibrate writes the calibration of the monitors, haselab identify capacitance-map the
# map from capacitance to strain. To type a map:
# strain_map = {{slope_per_f = 4.9e8, offset = -0.27}}

[drive]
{low}  # V, lowest drive voltage, before the amplifier
{high}  # V, highest
# amplifier = "name"
{gain}  # of the amplifier
# highest_field_v_per_m = 2e7  # in gap_m; lowers high_v where that would be more
# haselab identify voltage-map writes the map from strain to drive voltage. To type it:
# voltage_map = {{a1_v = 1.324, b1 = 3.124, a2_v = -0.2805, b2 = -26.92}}

[model]
# haselab identify transfer writes the model with its covariance. To type a resonance:
# gain = 1.0
# natural_frequency_rad_s = 32.0
# damping_ratio = 0.12
# rate_hz = 100.0  # of the loop
# loop_delay_s = 0.0075  # age of a measurement when the output computed from it takes effect

[controller]
# haselab design writes the controller with its margins.
"""


@click.command("init")
@click.argument("name")
@shared_option(
    "--kind", default="planar-hasel", show_default=True, metavar="KIND",
    detail="It is planar-hasel, peano-hasel, curling-hasel, dea-stack or your own.",
)  # fmt: skip
@shared_option("--mass-kg", type=REAL, detail="Default: written as a comment.")
@shared_option("--zero-length-m", type=POSITIVE, detail="Default: written as a comment.")
@click.option(
    "--low-v",
    type=REAL,
    default=0.0,
    show_default=True,
    help="Write the lowest drive voltage, before the amplifier, in V.",
)
@click.option("--high-v", type=REAL,
              help="Write the highest drive voltage, before the amplifier, in V. Default: written "
              "as a comment.")  # fmt: skip
@shared_option("--gain-v-per-v", type=POSITIVE, detail="Default: written as a comment.")
@answer_options(None, "It is an actuator file, for example leg.toml.  [required]")
def command(
    name: str,
    kind: str,
    mass_kg: float | None,
    zero_length_m: float | None,
    low_v: float,
    high_v: float | None,
    gain_v_per_v: float | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Write an actuator file for NAME, with comments that explain each section."""
    if out is None:
        raise click.UsageError("Missing option '--out': the actuator file to write.")
    if not _KIND.fullmatch(kind):
        raise InputError(
            f"--kind is {kind!r}, but must consist of lower-case letters, digits and hyphens, for "
            "example peano-hasel."
        )
    page = _PAGE.format(
        name=_quoted(name),
        kind=kind,
        mass=_line("mass_kg", mass_kg, 0.25),
        zero=_line("zero_length_m", zero_length_m, 0.05),
        parameters=_parameters(kind),
        low=_line("low_v", low_v, 0.0),
        high=_line("high_v", high_v, 2.0),
        gain=_line("gain_v_per_v", gain_v_per_v, 5000.0),
    )
    for doubt in unknown_kind(kind):
        click.echo(f"haselab: warning: {doubt}", err=True)
    write_text(out, page)
    emit({"actuator": str(out), "kind": kind}, as_json=as_json, out=None)


def _parameters(kind: str) -> str:
    """Lines of the parameters of a known kind, as comments."""
    if kind not in ACTUATORS.packages():
        return ""
    law = ACTUATORS.find(kind)
    lines = ["", "[actuator.parameters]", *_MEASURED]
    for about in law.described():
        default = getattr(law, about.name)
        value = list(default) if isinstance(default, tuple) else default
        unit = f"{about.unit}, " if about.unit else ""
        measured = "" if about.fitted else "; not fitted"
        lines.append(f"# {about.key} = {json.dumps(value)}  # {unit}{about.description}{measured}")
    return "\n".join(lines) + "\n"


def _line(key: str, value: float | None, example: float) -> str:
    """A key with its value; without a value, an example as a comment."""
    return f"# {key} = {example!r}" if value is None else f"{key} = {value!r}"


def _quoted(text: str) -> str:
    """Quote a text as a basic string of TOML."""
    if not text.isprintable() or not text.strip():
        raise InputError(f"NAME is {text!r}. Give a name of printable characters.")
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
