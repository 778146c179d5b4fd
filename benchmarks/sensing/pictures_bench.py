"""Calibration, strain and carrier plan on the twin, for `pictures.py`."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks.sensing.calibration import (
    LOADS,
    REFERENCES_F,
    SWING_V,
    TOP_HZ,
    Watch,
    calibrate,
    calibrated,
    load_errors,
    make,
    nominal,
    sweep,
)
from haselab.report.style import BLUE, GREEN, GREY, PURPLE, RED, SKY
from haselab.rig import Rig
from haselab.sensing import LockinConfig
from haselab.sensing.carrier_plan import CarrierRequest, evaluate_carrier, plan_carrier
from haselab.sensing.strain import fit_strain_map

SWEEP_S = 10.0
PAPER_HZ = 2000.0


def draw_calibration(rig: Rig, raw: LockinConfig, config: LockinConfig) -> Figure:
    """Errors of C and R over known loads, before and after two references."""
    figure = Figure(figsize=(6.8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    capacitance_nf = 1e9 * np.array([c for c, _ in LOADS])
    series_ohm = np.array([r for _, r in LOADS])
    for label, colour, used in (("before", RED, raw), ("after", BLUE, config)):
        errors = load_errors(rig, used)
        for axes, error in zip((left, right), errors, strict=True):
            for ohm, marker, line in ((5e3, "o", "-"), (20e3, "s", "--")):
                here = series_ohm == ohm
                axes.plot(
                    capacitance_nf[here],
                    100 * np.abs(error[here]),
                    color=colour,
                    marker=marker,
                    ls=line,
                    ms=4,
                    label=f"{label}, {1e-3 * ohm:g} kΩ",
                )
    for axes, goal, name in ((left, 0.5, "A  series capacitance"), (right, 5.0, "B  resistance")):
        axes.axhline(goal, color="black", lw=0.8, ls=":")
        axes.set(xscale="log", yscale="log", xlabel="true capacitance / nF")
        axes.set_xticks([0.3, 0.5, 1, 2, 5], ["0.3", "0.5", "1", "2", "5"])
        axes.minorticks_off()
        axes.set_title(name, loc="left")
        for reference_f in REFERENCES_F:
            axes.axvline(1e9 * reference_f, color=GREY, lw=0.8, alpha=0.6)
    left.set_ylabel("error, without sign / %")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def draw_strain(rig: Rig, config: LockinConfig) -> Figure:
    """Strain from the monitors and the camera: fitted on a sweep up, shown on one down."""
    watch = Watch(rig)
    first = sweep(watch, config, SWEEP_S, SWING_V, down=False)
    validation = sweep(watch, config, SWEEP_S, 0.9 * SWING_V, down=True)
    fitted = fit_strain_map(first.capacitance_f, first.strain, "cubic")
    inside = fitted.inside(validation.capacitance_f)
    time_s = validation.time_s[inside] - validation.time_s[0]
    sensed = fitted.strain(validation.capacitance_f[inside])
    low, high = fitted.interval(validation.capacitance_f[inside])
    camera = validation.strain[inside]
    figure = Figure(figsize=(6.8, 4.8), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 2))
    parts = ((0, 1.0, 1.5), (1, 6.0, 9.0))
    for column, start_s, stop_s in parts:
        axes = figure.add_subplot(grid[0, column])
        here = (time_s >= start_s) & (time_s < stop_s)
        axes.fill_between(time_s[here], low[here], high[here], color=SKY, alpha=0.35, lw=0,
                          label="band of 95 %")  # fmt: skip
        axes.plot(time_s[here], camera[here], color=GREY, lw=2.6, alpha=0.6, label="camera")
        axes.plot(time_s[here], sensed[here], color=BLUE, lw=1.0, label="monitors")
        hz = [TOP_HZ * (1 - at / SWEEP_S) for at in (start_s, stop_s)]
        letter = "AB"[column]
        axes.set_title(f"{letter}  {hz[0]:.0f} to {hz[1]:.0f} Hz", loc="left")
        axes.set(xlabel="time / s", ylabel="strain" if column == 0 else "")
    below = figure.add_subplot(grid[1, :])
    span = float(np.ptp(validation.strain))
    below.plot(time_s, 100 * (sensed - camera) / span, color=BLUE, lw=0.5)
    rms = 100 * float(np.sqrt(np.mean((sensed - camera) ** 2))) / span
    below.set_title(f"C  monitors less camera, {rms:.2f} % of the span rms", loc="left")
    below.set(xlabel="time / s (20 Hz at 0 s, 0 Hz at 10 s)", ylabel="% of span")
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3)
    held = np.mean((camera >= low) & (camera <= high))
    print(f"strain: rms {rms:.3f} % of a span of {span:.4f}; band held {100 * held:.1f} %")
    return figure


def draw_plan() -> Figure:
    """Cost of each carrier on the study's bench, and the place of the study's own."""
    request = CarrierRequest()
    plan, paper = plan_carrier(request), evaluate_carrier(request, PAPER_HZ)
    carriers_hz = np.array([c.carrier_hz for c in plan.candidates])
    figure = Figure(figsize=(6.8, 3.8), layout="constrained")
    block, second = figure.subplots(1, 2, width_ratios=(3, 2))
    for name, label, colour, line in (
        ("noise", "noise", BLUE, "--"),
        ("step", "steps of the output", RED, "-."),
        ("mains", "mains", GREEN, ":"),
        ("total", "all together", "black", "-"),
    ):
        values = 100 * np.array([getattr(c, name) for c in plan.candidates])
        block.plot(carriers_hz, values, color=colour, ls=line, label=label)
    for choice, text, marker in ((paper, "study", "^"), (plan.chosen, "chosen", "o")):
        at = (choice.carrier_hz, 100 * choice.total)
        block.plot(*at, marker, color="black", ms=7, zorder=5)
        block.annotate(f"{text}, {choice.carrier_hz:g} Hz", at, xytext=(-14, 30),
                       textcoords="offset points",
                       arrowprops={"arrowstyle": "-", "lw": 0.6, "shrinkB": 5})  # fmt: skip
    block.set(xscale="log", yscale="log", xlabel="carrier / Hz", ylabel="error of C / %, rms")
    block.set_xticks([500, 1000, 2000, 5000, 10000], ["500", "1000", "2000", "5000", "10000"])
    block.set_yticks([0.1, 1.0], ["0.1", "1"])
    block.minorticks_off()
    block.set_title("A  one block", loc="left")
    near = [c for c in plan.candidates if abs(c.carrier_hz - PAPER_HZ) <= 260]
    for c in near:
        is_paper = c.carrier_hz == PAPER_HZ
        second.plot(c.carrier_hz, 100 * c.step_average, "^" if is_paper else "o",
                    color="black" if is_paper else PURPLE, ms=7 if is_paper else 4)  # fmt: skip
        second.vlines(c.carrier_hz, 0, 100 * c.step_average, color=PURPLE, lw=1)
    second.annotate("2000 Hz", (PAPER_HZ, 100 * paper.step_average), xytext=(8, 0),
                    textcoords="offset points")  # fmt: skip
    second.set(xlabel="carrier / Hz", ylabel="left of the steps / %", ylim=(-0.05, 1.4))
    second.set_title("B  mean of 1 s", loc="left")
    figure.legend(*block.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    for choice in (paper, plan.chosen):
        parts = (choice.noise, choice.step, choice.step_average, choice.mains, choice.total)
        print(f"{choice.carrier_hz:g} Hz: noise, steps, over 1 s, mains, total in % of C:",
              " ".join(f"{100 * part:.3g}" for part in parts))  # fmt: skip
    return figure


def bench_figures() -> dict[str, Figure]:
    """The three pictures by name."""
    _, rig = make()
    raw, config = nominal(rig), calibrated(rig, calibrate(rig))
    return {
        "sensing-calibration": draw_calibration(rig, raw, config),
        "sensing-strain": draw_strain(rig, config),
        "sensing-carrier": draw_plan(),
    }
