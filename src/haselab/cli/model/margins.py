"""`haselab margins`: compute the stability margins of given gains."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.cli.common import REAL, answer_options, emit
from haselab.cli.model.charts import loop_chart
from haselab.cli.model.model_file import loop_of, loop_options, read_any_plant
from haselab.cli.plot import save_plot
from haselab.control import LoopSetting, PidGains, margins

__all__ = ["command"]


@click.command("margins")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--kp", type=REAL, required=True, help="Set the proportional gain.")
@click.option("--ki", type=REAL, required=True, help="Set the integral gain in 1/s.")
@click.option(
    "--kd", type=REAL, default=0.0, show_default=True, help="Set the derivative gain in s."
)
@click.option(
    "--derivative-filter-s", type=REAL, default=0.0, show_default=True,
    help="Set the time constant of the measurement's filter in s.",
)  # fmt: skip
@loop_options
@answer_options(plot=True)
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
    plot: Path | None,
) -> None:
    """Compute the stability margins of PID gains.

    MODEL is a model.json or an actuator file. The margins include the delay of the loop.
    """
    setting = LoopSetting(*loop_of(model, rate_hz, delay_s))
    gains = PidGains(kp, ki, kd, derivative_filter_s)
    plant = read_any_plant(model)
    found = margins(
        plant,
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
    save_plot(plot, lambda: loop_chart(plant, gains, setting, found.crossover_rad_s))
