"""`haselab identify`: identify models, with uncertainty, from recorded files."""

from __future__ import annotations

import click

from haselab.cli.identify.actuator import actuator
from haselab.cli.identify.arx import arx, subspace
from haselab.cli.identify.hysteresis import creep, hysteresis
from haselab.cli.identify.model_comparison import verdict
from haselab.cli.identify.plan_experiment import command as plan_experiment
from haselab.cli.identify.response import free_response, frequency_response
from haselab.cli.identify.static_map import spline_map
from haselab.cli.identify.statics import capacitance_map, hyperelastic, regions, voltage_map
from haselab.cli.identify.transfer import transfer

__all__ = ["command"]


@click.group("identify")
def command() -> None:
    """Identify models, with confidence intervals, from records.

    FILE is CSV or another text table, .mat, .npz, .h5 or .tdms, as other programs write them. Units
    are read from the headers. Options name the columns; --time and --unit describe them.
    """


for _method in (
    actuator,
    transfer,
    arx,
    subspace,
    frequency_response,
    free_response,
    hyperelastic,
    regions,
    voltage_map,
    capacitance_map,
    spline_map,
    hysteresis,
    creep,
    verdict,
    plan_experiment,
):
    command.add_command(_method)
