"""Draws the pictures of docs/concepts, from the twin.

    python -m benchmarks.concepts.pictures [docs/pictures/concepts]

A minute on one core. Prints the figures that the pages state.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import haselab as hl
from haselab.report.style import BLUE, GREY, RED, figure_style, to_svg
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of

LINEAR_SEEDS, TWIN_SEEDS = range(100), range(1, 31)
LINEAR = hl.Plant(0.5, 33.0, 0.11, 0.012)
NOISE = 3e-3  # standard deviation of its output
STEP, ZERO_S, STEP_S = 0.03, 4.0, 40.0


def draw_creep() -> Figure:
    """One step of strain at a constant voltage, and one in closed loop."""
    with hl.Runner(hl.twin(seed=1), baseline_v=1.0) as runner:
        slow = runner.play(hl.signals.triangle(0.0, 2.0, 0.25, 2, runner.update_hz))
        to_volt = hl.fit_voltage_map(slow["strain"], slow["drive_v"]).map
        to_strain = hl.fit_strain_map(slow["capacitance_f"], slow["strain"])
        chirp = 0.02 * hl.signals.linear_chirp(0.1, 10.0, 10.0, runner.update_hz)
        fit = hl.fit_transfer(runner.play(to_volt.voltage_v(chirp)).records(through=to_volt))
        print(f"gain of the chirp {fit.parameters['gain'].value:.3f}")
        design = hl.design(fit, limits=(-0.03, 0.1))
        before, after = (round(time_s * runner.update_hz) for time_s in (ZERO_S, STEP_S))
        reference = np.r_[np.zeros(before), np.full(after, STEP)]
        actuator = hl.Actuator(to_volt, to_strain, design)
        recorded = {
            "constant voltage": runner.play(to_volt.voltage_v(reference)),
            "closed loop": runner.close_loop(reference, actuator),
        }
    figure = Figure(figsize=(6.8, 4.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for (name, each), colour in zip(recorded.items(), (RED, BLUE), strict=True):
        time_s = each["time_s"] - ZERO_S
        strain = each["strain"] - each["strain"][time_s < 0].mean()
        above.plot(time_s, 100 * strain, color=colour, label=name)
        below.plot(time_s, each["drive_v"], color=colour, label=name)
        at = [float(np.mean(strain[np.abs(time_s - one) < 0.5])) for one in (1.5, 10.0, 39.0)]
        drive_v = np.interp([1.5, 39.0], time_s, each["drive_v"]).round(3)
        print(f"{name}: strain after 1.5, 10 and 39 s {np.round(at, 4)}; drive then {drive_v} V")
    above.set_ylabel("strain since the step / %")
    below.set(xlabel="time after the step / s", ylabel="drive / V", xlim=(-2.0, STEP_S))
    above.legend(loc="lower right")
    return figure


def _fit(bench: hl.Rig) -> hl.Fit:
    with hl.Runner(bench, baseline_v=1.0) as runner:
        chirp = 1.0 + 0.1 * hl.signals.linear_chirp(0.5, 10.0, 10.0, runner.update_hz)
        return hl.fit_transfer(runner.play(chirp).records())


def _linear_fits() -> list[hl.Fit]:
    """Fits of records of a linear device, which the model of the fit can describe exactly."""
    rate_hz = 100.0
    u = 0.1 * hl.signals.linear_chirp(0.5, 10.0, 10.0, rate_hz)
    time_s = np.arange(u.size) / rate_hz
    clean = LINEAR.simulate(u, rate_hz, time_s)
    noise = (np.random.default_rng(seed).normal(0.0, NOISE, u.size) for seed in LINEAR_SEEDS)
    return [hl.fit_transfer(hl.Record(u, rate_hz, clean + each, time_s)) for each in noise]


def _draw_intervals(axes: Axes, fits: list[hl.Fit], truth: float) -> None:
    """Deviation of each natural frequency from the truth, with its interval."""
    found = [fit.parameters["natural_frequency_rad_s"] for fit in fits]
    low, high = 100 * (np.array([each.ci95 for each in found]).T / truth - 1)
    value = 100 * (np.array([each.value for each in found]) / truth - 1)
    missed = (low > 0) | (high < 0)
    print(f"{missed.sum()} of {missed.size} intervals miss the truth of {truth:.4f} rad/s; mean "
          f"half width {np.mean(high - low) / 2:.3f} %; scatter of the estimates "
          f"{np.std(value, ddof=1):.4f} %")  # fmt: skip
    for which, colour, name in (
        (~missed, BLUE, "contains the truth"), (missed, RED, "misses it")
    ):  # fmt: skip
        runs = np.flatnonzero(which) + 1
        axes.vlines(runs, low[which], high[which], colors=colour, lw=1.8, label=name)
        axes.plot(runs, value[which], "o", color=colour, ms=3)
    axes.axhline(0.0, color=GREY, lw=1.0)
    axes.set(xlabel="repetition")


def draw_coverage() -> Figure:
    """Natural frequency and interval from the same chirp with other noise: model right, and not."""
    config = twin_of_reading("hz")
    quiet = _fit(rig_of(TwinBench(config, 1, noise=False), config))
    truth = quiet.parameters["natural_frequency_rad_s"].value
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    _draw_intervals(left, _linear_fits(), LINEAR.natural_frequency_rad_s)
    left.set_title("A  linear device: noise is the only error", loc="left")
    left.set_ylabel("natural frequency: deviation / %")
    left.legend(loc="upper right", ncols=2)
    _draw_intervals(right, [_fit(hl.twin(seed=seed)) for seed in TWIN_SEEDS], truth)
    right.set_title("B  twin: it also creeps", loc="left")
    return figure


TITLES = {
    "creep": "Strain and drive after a step, at a constant voltage and in closed loop",
    "coverage": "Natural frequency with its 95 % interval in repetitions of one experiment",
}


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with figure_style():
        for name, draw in {"creep": draw_creep, "coverage": draw_coverage}.items():
            svg = to_svg(draw(), name, TITLES[name])
            (folder / f"{name}.svg").write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "concepts"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
