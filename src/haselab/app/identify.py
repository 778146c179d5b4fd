"""`haselab identify`: models with uncertainty from recorded files."""

from __future__ import annotations

import click

from haselab.app.identify_arx import arx, subspace
from haselab.app.identify_hysteresis import creep, hysteresis
from haselab.app.identify_map import spline_map
from haselab.app.identify_response import free_response, frequency_response
from haselab.app.identify_static import capacitance_map, hyperelastic, regions, voltage_map
from haselab.app.identify_transfer import transfer
from haselab.app.identify_verdict import verdict

__all__ = ["command"]


@click.group("identify")
def command() -> None:
    """Models with uncertainty from records.

    FILE is CSV (a header row, SI units), .mat, .npz, .h5 or .tdms.
    """


for _method in (
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
):
    command.add_command(_method)
