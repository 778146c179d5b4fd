"""`haselab identify`: identify models, with uncertainty, from recorded files."""

from __future__ import annotations

import click

from haselab.cli.lazy_group import LazyGroup

__all__ = ["command"]

_PLACES = {
    "actuator": "haselab.cli.identify.actuator:actuator",
    "arx": "haselab.cli.identify.arx:arx",
    "capacitance-map": "haselab.cli.identify.statics:capacitance_map",
    "creep": "haselab.cli.identify.hysteresis:creep",
    "free-response": "haselab.cli.identify.response:free_response",
    "frequency-response": "haselab.cli.identify.response:frequency_response",
    "hyperelastic": "haselab.cli.identify.statics:hyperelastic",
    "hysteresis": "haselab.cli.identify.hysteresis:hysteresis",
    "map": "haselab.cli.identify.static_map:spline_map",
    "model-comparison": "haselab.cli.identify.model_comparison:model_comparison",
    "plan-experiment": "haselab.cli.identify.plan_experiment:command",
    "regions": "haselab.cli.identify.statics:regions",
    "subspace": "haselab.cli.identify.arx:subspace",
    "transfer": "haselab.cli.identify.transfer:transfer",
    "voltage-map": "haselab.cli.identify.statics:voltage_map",
}


@click.group("identify", cls=LazyGroup, places=_PLACES)
def command() -> None:
    """Identify models, with confidence intervals, from records.

    FILE is CSV or another text table, .mat, .npz, .h5 or .tdms, as other programs write them. Units
    are read from the headers. Options name the columns; --time and --unit describe them.
    """
