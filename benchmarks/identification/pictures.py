"""Draws the pictures of docs/identify and prints the figures of identification.md.

    python -m benchmarks.identification.pictures docs/pictures/identify [DATA]

DATA is a folder with identification/ecoflex-00-30-tensile.csv (LucMarechal/Soft-Robotics-
Materials-Database, ODbL 1.0); without it the picture of the laws is left out.
"""

import csv
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from haselab.actuators import GRAVITY_M_S2, PlanarHasel, linearise
from haselab.identify import (
    FreeTrial,
    Record,
    TransferStructure,
    estimate_frequency_response,
    fit_free_response,
    fit_hyperelastic,
    fit_transfer,
)
from haselab.models import Plant, SlowMode
from haselab.report.style import BLUE, GREEN, GREY, PURPLE, RED, figure_style, to_svg

OMEGA = float(np.sqrt(26.14))
ZETA = 0.93 / (2.0 * OMEGA)
TIME_S = np.arange(4000) / 400.0
SWEEP = np.sin(2 * np.pi * (0.1 * TIME_S + 0.5 * 0.99 * TIME_S**2))


def draw_transfer():
    """Chirp and step with the joint fit, and the fit of the chirp alone."""
    rng = np.random.default_rng(3)
    plant = Plant(0.5, OMEGA, ZETA, 0.012, (SlowMode(0.4, 4.7),))
    update_s = np.arange(1000) / 100.0
    u = np.sin(2 * np.pi * (0.1 * update_s + 0.5 * 0.99 * update_s**2))
    long_s, step = np.arange(8000) / 400.0, np.repeat([0.0, 1.0], [200, 1])
    sweep = plant.simulate(u, 100.0, TIME_S) + 0.01 * rng.normal(size=4000)
    rise = plant.simulate(step, 100.0, long_s) + 0.01 * rng.normal(size=8000)
    records = [Record(u, 100.0, sweep, TIME_S), Record(step, 100.0, rise, long_s)]
    both = fit_transfer(records, TransferStructure(slow_modes=1))
    alone = fit_transfer(records[:1])
    figure = Figure(figsize=(8.0, 5.2), layout="constrained")
    left, right, low, bode = figure.subplots(2, 2).flat
    for axes, record, k in ((left, records[0], 0), (right, records[1], 1)):
        axes.plot(record.output_time_s[::4], record.y[::4], color=GREY, lw=0.8, label="measured")
        axes.plot(record.output_time_s[::4], both.modelled[k][::4], color=RED, label="fit of both")
        axes.set(xlabel="time / s", ylabel="strain")
    right.plot(long_s[::4], alone.plant.simulate(step, 100.0, long_s[::4]), color=BLUE, ls="--",
               label="second order, chirp alone")  # fmt: skip
    left.set_title("A  chirp", loc="left")
    right.set_title("B  step at 2 s", loc="left")
    right.legend(loc="lower right")
    low.plot(TIME_S[::4], both.residuals[0][::4], color=GREY, lw=0.5)
    low.set_title(f"C  residual of the chirp, whiteness p = {both.residual_whiteness_p:.2f}",
                  loc="left")  # fmt: skip
    low.set(xlabel="time / s", ylabel="strain")
    omega = np.geomspace(0.05, 60.0, 400)
    for fit, colour, label in ((both, RED, "fit of both"), (alone, BLUE, "chirp alone")):
        bode.loglog(omega, np.abs(fit.plant.frequency_response(omega)), color=colour, label=label,
                    ls="-" if fit is both else "--")  # fmt: skip
    bode.loglog(omega, np.abs(plant.frequency_response(omega)), color="black", lw=0.7, ls=":",
                label="truth")  # fmt: skip
    bode.set_title("D  magnitude", loc="left")
    bode.set(xlabel="angular frequency / (rad/s)", ylabel="gain")
    bode.legend(loc="lower left")
    return figure


def draw_frequency_response():
    """One sweep at 30 dB by three methods."""
    plant = Plant(0.5, OMEGA, ZETA)
    clean = plant.simulate(SWEEP, 400.0, TIME_S)
    noise = np.random.default_rng(1).normal(size=4000)
    y = clean + clean.std() / np.sqrt(1e3) * noise
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    whole, close = figure.subplots(1, 2)
    styles = {"h1": (BLUE, "v"), "polynomial": (PURPLE, "x"), "rational": (RED, "o")}
    for method, (colour, marker) in styles.items():
        response = estimate_frequency_response(Record.sampled(SWEEP, y, 400.0), method=method)
        for axes in (whole, close):
            axes.errorbar(
                response.frequency_hz, np.abs(response.response), 1.96 * response.magnitude_std,
                color=colour, marker=marker, ms=3, lw=0, elinewidth=0.8, label=method,
            )  # fmt: skip
    frequency_hz = np.geomspace(0.05, 10.0, 500)
    truth = np.abs(plant.frequency_response(2 * np.pi * frequency_hz))
    for axes in (whole, close):
        axes.plot(frequency_hz, truth, color="black", lw=0.8, label="truth")
        axes.set(xlabel="frequency / Hz", ylabel="gain")
    whole.set(xscale="log", yscale="log", xlim=(0.09, 10.5), ylim=(2e-3, 2e2))
    close.set(xlim=(0.25, 1.55), ylim=(0.0, 3.6))
    whole.set_title("A  one chirp, 30 dB", loc="left")
    close.set_title("B  the resonance", loc="left")
    whole.legend(loc="upper right")
    return figure


def draw_free_response():
    """The same decay under both interpretations of the frequency axis."""
    time_s = np.arange(480) / 400.0
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    for axes, omega, name in zip(
        figure.subplots(1, 2), (5.1, 2 * np.pi * 5.1), ("A  5.1 rad/s", "B  5.1 Hz"), strict=True
    ):
        x_mm = 10.0 * np.exp(-4.2 * time_s) * np.cos(omega * time_s - 0.3)
        x_mm = x_mm + 0.1 * np.random.default_rng(2).normal(size=time_s.size)
        fit = fit_free_response([FreeTrial(x_mm, time_s)])
        axes.plot(time_s, x_mm, ".", color=GREY, ms=2, label="record")
        axes.plot(fit.time_s[0], fit.modelled[0], color=RED, label="fit of eq. 6")
        envelopes = (fit.envelope_positive_decay_per_s, fit.envelope_negative_decay_per_s)
        height = fit.parameters["amplitude"].value
        for hull, sign, colour in zip(envelopes, (1.0, -1.0), (BLUE, GREEN), strict=True):
            if hull is not None:
                side = "positive" if sign > 0 else "negative"
                axes.plot(time_s, sign * height * np.exp(-hull.value * time_s), color=colour,
                          ls="--", label=f"hull of {side} peaks: {hull.value:.2f} 1/s")  # fmt: skip
        natural = fit.parameters["natural_frequency_rad_s"].value
        zeta = fit.parameters["damping_ratio"].value
        axes.set_title(f"{name}: natural {natural:.2f} rad/s, damping {zeta:.2f}", loc="left")
        axes.set(xlabel="time / s", ylabel="displacement / mm")
        axes.legend(loc="upper right")
    return figure


def draw_hyperelastic(data):
    """Laws on the measured shell material."""
    path = data / "identification/ecoflex-00-30-tensile.csv"
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(stream, delimiter=";"))
    start = next(i for i, row in enumerate(rows) if row[0] == "Time (s)") + 1
    table = np.array([[float(cell) for cell in row[3:5]] for row in rows[start:] if row[0]])
    stretch, stress_pa = 1.0 + table[:, 0], 1e6 * table[:, 1]
    low = stretch <= 4.0
    fit = fit_hyperelastic(stretch[low], stress_pa[low])
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    curve, error = figure.subplots(1, 2)
    curve.plot(stretch[low], stress_pa[low] / 1e3, ".", color=GREY, ms=4, label="measured")
    colours = iter((RED, BLUE, GREEN, PURPLE))
    shown = ("yeoh", "ogden", "arruda-boyce", "neo-hooke")
    for candidate in (c for c in fit.candidates if c.model in shown):
        colour = next(colours)
        modelled_pa = candidate.modelled_pa[0]
        curve.plot(stretch[low], modelled_pa / 1e3, color=colour, label=candidate.model)
        error.plot(stretch[low], (stress_pa[low] - modelled_pa) / 1e3, color=colour)
    curve.set(xlabel="stretch", ylabel="nominal stress / kPa")
    error.set(xlabel="stretch", ylabel="measured minus law / kPa", ylim=(-3.0, 3.0))
    curve.set_title("A  Ecoflex 00-30, best first", loc="left")
    error.set_title("B  what the laws leave", loc="left")
    curve.legend(loc="upper left")
    for candidate in fit.candidates:
        numbers = {n: f"{e.value:.5g} +- {e.std:.2g}" for n, e in candidate.parameters.items()}
        print(f"{candidate.model:20s} AIC {candidate.aic:8.0f} {numbers}")
    return figure


def draw_operating_points():
    """Gain, natural frequency and slowest pole of the reference actuator over voltage and mass."""
    law, voltages, masses = PlanarHasel(), np.linspace(250.0, 10.8e3, 18), np.linspace(0.1, 0.4, 10)
    longest_m = 0.1  # beyond all of them, so that the actuator is softened everywhere
    found = np.empty((3, masses.size, voltages.size))
    for row, mass_kg in enumerate(masses):
        for column, volt in enumerate(voltages):
            point = linearise(law, volt, mass_kg * GRAVITY_M_S2, mass_kg, longest_m=longest_m)
            found[:, row, column] = (
                np.log10(1e6 * point.gain_m_per_v),
                np.abs(point.poles).max(),
                np.abs(point.poles).min(),
            )
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    labels = ("log10 of the gain / (µm/V)", "natural frequency / (rad/s)", "slowest pole / (rad/s)")
    grid = np.meshgrid(1e-3 * voltages, masses)
    for k, (values, label) in enumerate(zip(found, labels, strict=True)):
        axes = figure.add_subplot(1, 3, k + 1, projection="3d")
        axes.plot_surface(*grid, values, cmap="viridis", rstride=1, cstride=1, lw=0.2, ec="white")
        axes.set(xlabel="voltage / kV", ylabel="hung mass / kg", xticks=[0, 5, 10],
                 yticks=[0.1, 0.2, 0.3, 0.4])  # fmt: skip
        axes.set_title(f"{'ABC'[k]}  {label}", loc="left")
        axes.view_init(25.0, -125.0 if k == 0 else -40.0)
        axes.set_box_aspect(None, zoom=0.9)
    return figure


def _bound(std):
    """Cramer-Rao bound of gain, frequency, damping, delay; state and offset unknown."""

    def output(x):
        plant = Plant(x[0], x[1], x[2], 0.01 + x[3])
        late_s = TIME_S + 0.01
        return (
            plant.simulate(SWEEP, 400.0, late_s)
            + x[6]
            + Plant(1.0, x[1], x[2]).simulate([0.0], 1.0, TIME_S, [x[4], x[5]])
        )

    at = np.array([0.5, OMEGA, ZETA, 0.0, 0.0, 0.0, 0.0])
    step = 1e-5
    columns = [(output(at + h) - output(at - h)) / (2 * step) for h in step * np.eye(7)]
    information = np.array(columns) @ np.array(columns).T / std**2
    return np.sqrt(np.diag(np.linalg.inv(information)))[:4]


def count_transfer(runs):
    """Bias, spread and coverage of the chirp problem at three noise levels."""
    plant = Plant(0.5, OMEGA, ZETA)
    clean = plant.simulate(SWEEP, 400.0, TIME_S)
    truth = {"gain": 0.5, "natural_frequency_rad_s": OMEGA, "damping_ratio": ZETA, "delay_s": 0.0}
    for level_db in (20, 30, 40):
        std = np.sqrt(np.mean(clean**2) / 10 ** (level_db / 10))
        errors, inside, spent_s = [], np.zeros(4), []
        for run in range(runs):
            noise = std * np.random.default_rng([20181001, level_db, run]).normal(size=4000)
            start_s = time.perf_counter()
            fit = fit_transfer([Record(SWEEP, 400.0, clean + noise, TIME_S)])
            spent_s.append(time.perf_counter() - start_s)
            got = [fit.parameters[name] for name in truth]
            errors.append([e.value - t for e, t in zip(got, truth.values(), strict=True)])
            inside += [
                e.ci95[0] <= t <= e.ci95[1] for e, t in zip(got, truth.values(), strict=True)
            ]
        rmse = np.sqrt(np.mean(np.square(errors), axis=0)) / _bound(std)
        print(f"{level_db} dB, {runs} runs: RMSE over bound {np.round(rmse, 3)}, "
              f"inside {inside / runs}, median {1e3 * np.median(spent_s):.0f} ms")  # fmt: skip


def count_random_plants(runs):
    """Failures and coverage on plants drawn at random, output read at random times."""
    rng = np.random.default_rng(0)
    failed, inside = 0, []
    for run in range(runs):
        slow = (SlowMode(rng.uniform(0.1, 0.5), rng.uniform(2.0, 8.0)),) if run % 3 == 2 else ()
        omega, zeta = np.exp(rng.uniform(0, np.log(60))), np.exp(rng.uniform(np.log(0.02), 0.4))
        plant = Plant(rng.uniform(0.1, 2.0), omega, zeta, rng.uniform(0.0, 0.05), slow)
        time_s = np.unique(rng.uniform(0.0, 20.0, 3000))
        u = _drive(rng, run % 4)
        y = 0.3 + plant.simulate(u, 100.0, time_s, [0.1, 0.0, *(0.02 for _ in slow)])
        y = y + y.std() * 10**-1.5 * rng.normal(size=time_s.size)
        fit = fit_transfer([Record(u, 100.0, y, time_s, None)],
                           TransferStructure(slow_modes=len(slow)))  # fmt: skip
        # At 30 dB the truth explains 96.8 %; 1.5 % below it is another optimum.
        if not fit.succeeded or fit.fit_percent < 95.3:
            failed += 1
            continue
        truth = {"natural_frequency_rad_s": omega, "damping_ratio": zeta, "delay_s": plant.delay_s}
        ranges = [(fit.parameters[name].ci95, value) for name, value in truth.items()]
        inside.append([low <= value <= high for (low, high), value in ranges])
    print(f"{runs} random plants: {failed} failed, inside {np.mean(inside, axis=0)}")


def _drive(rng, kind):
    """Chirp, noise, random steps of 1 s, or random steps of 0.1 s about 3; 2,000 values."""
    at_s = np.arange(2000) / 100.0
    return (
        lambda: np.sin(2 * np.pi * (0.1 * at_s + 0.25 * at_s**2)),
        lambda: rng.normal(size=2000),
        lambda: np.repeat(rng.choice([0.0, 1.0], size=20), 100),
        lambda: 3.0 + np.repeat(rng.choice([-1.0, 1.0], size=200), 10),
    )[kind]()


def main(folder, data):
    folder.mkdir(parents=True, exist_ok=True)
    with figure_style():
        figures = {
            "transfer": draw_transfer(),
            "frequency-response": draw_frequency_response(),
            "free-response": draw_free_response(),
            "operating-points": draw_operating_points(),
        }
        if data is not None:
            figures["hyperelastic"] = draw_hyperelastic(data)
        for name, figure in figures.items():
            svg = to_svg(figure, name, name.replace("-", " "))
            (folder / f"{name}.svg").write_text(svg, encoding="utf-8")
    count_transfer(200)
    count_random_plants(150)


if __name__ == "__main__":
    paths = [Path(argument) for argument in sys.argv[1:]]
    main(paths[0], paths[1] if len(paths) > 1 else None)
