"""`haselab margins`: stability margins of given gains on a model."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.app.common import REAL, answer_options, emit
from haselab.app.model_file import read_any_plant, read_loop
from haselab.control import LoopSetting, PidGains, margins

__all__ = ["command"]

_RATE_HZ, _DELAY_S = 100.0, 0.01


@click.command("margins")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--kp", type=REAL, required=True, help="Proportional gain.")
@click.option("--ki", type=REAL, required=True, help="Integral gain, in 1/s.")
@click.option("--kd", type=REAL, default=0.0, show_default=True, help="Derivative gain, in s.")
@click.option(
    "--derivative-filter-s", type=REAL, default=0.0, show_default=True,
    help="Time constant of the measurement's filter, in s.",
)  # fmt: skip
@click.option(
    "--rate-hz", type=REAL, show_default="MODEL.json's, else 100", help="Sampling rate, in Hz."
)
@click.option(
    "--delay-s", type=REAL, show_default="measured one of MODEL.json, else 0.01",
    help="Age of a measurement at its use, in s; half the hold comes on top.",
)  # fmt: skip
@answer_options()
def command(
    model: Path,
    kp: float,
    ki: float,
    kd: float,
    derivative_filter_s: float,
    rate_hz: float | None,
    delay_s: float | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Margins of given PID gains on the plant of MODEL.json, the loop's delay included."""
    told = {} if model.suffix.lower() == ".mat" else read_loop(model)
    setting = LoopSetting(
        told.get("rate_hz", _RATE_HZ) if rate_hz is None else rate_hz,
        told.get("loop_delay_s", _DELAY_S) if delay_s is None else delay_s,
    )
    gains = PidGains(kp, ki, kd, derivative_filter_s)
    found = margins(
        read_any_plant(model),
        gains,
        loop_delay_s=setting.measurement_delay_s,
        rate_hz=setting.rate_hz,
    )
    answer = {
        "stable": found.stable,
        "phase_margin_deg": found.phase_margin_deg,
        "gain_margin_db": found.gain_margin_db,
        "delay_margin_s": found.delay_margin_s,
        "peak_sensitivity": found.peak_sensitivity,
        "crossover_rad_s": found.crossover_rad_s,
        "rate_hz": setting.rate_hz,
        "delay_s": setting.measurement_delay_s,
    }
    emit(answer, as_json=as_json, out=out)
