"""`haselab identify frequency-response` and `free-response`."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from haselab.app.common import answer_options, emit
from haselab.app.identify_common import FILE, FILES, INPUT, OUTPUT, RATE, give, rate_hz_of
from haselab.identify.free_response import FreeTrial, fit_free_response
from haselab.identify.frequency_response import RESPONSE_METHODS, estimate_frequency_response
from haselab.store.tables import read_table

__all__ = ["free_response", "frequency_response"]


@click.command("frequency-response")
@FILE
@INPUT
@OUTPUT
@RATE
@click.option(
    "--method", type=click.Choice(RESPONSE_METHODS), default="rational",
    show_default=True, help="How leakage is treated.",
)  # fmt: skip
@click.option("--measured-input", is_flag=True, help="The input was measured, not held.")
@answer_options
def frequency_response(
    file: Path,
    source: str,
    output: str,
    rate_hz: float | None,
    method: str,
    measured_input: bool,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Bode estimate with coherence and standard deviations."""
    table = read_table(file, [source, output])
    rate = rate_hz_of(table, rate_hz, file)
    response = estimate_frequency_response(
        table[source], table[output], rate, method=method, held=not measured_input
    )
    emit(response.answer(), as_json=as_json, out=out)


@click.command("free-response")
@FILES
@click.option("--output", default="x", show_default=True, help="Column of the motion.")
@RATE
@click.option(
    "--creep/--no-creep", default=None, help="Fit an exponential beside the oscillation, or not; "
    "the data decide when not given.",
)  # fmt: skip
@answer_options
def free_response(
    files: tuple[Path, ...],
    output: str,
    rate_hz: float | None,
    creep: bool | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Decay, damped and natural frequency (eqs. 6 and 7), hull curves; several FILES are trials."""
    trials = []
    for file in files:
        table = read_table(file, [output])
        rate = rate_hz_of(table, rate_hz, file)
        trials.append(FreeTrial(table[output], np.arange(table[output].size) / rate))
    give(fit_free_response(trials, creep=creep), files, as_json, out)
