"""Frequency responses on the reference study's own chirp: error, intervals, weighted fit, time.

    python -m benchmarks.identification.frequency_response [--runs 40]

The problem: chirp of 0.1 to 10 Hz in 10 s, 400 Hz, second order, damping ratio 0.09, white noise.
"""

import argparse
import importlib.util
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import csd, welch

from benchmarks.identification.transfer import CHIRP, GAIN, OMEGA, RATE_HZ, TIME_S, ZETA, bound
from benchmarks.rows import Row, medians
from haselab.identify import Record, estimate_frequency_response, fit_response
from haselab.models import Plant, RationalModel, SlowMode, from_scipy, to_scipy

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
RUNS = 40
PLANT = Plant(GAIN, OMEGA, ZETA)
CLEAN = PLANT.simulate(CHIRP, RATE_HZ, TIME_S)
NAMES = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
NEAR_HZ = (0.5, 1.2)
INSIDE = float(np.sqrt(-np.log(0.05)))  # |error|^2/std^2 of a complex normal is exponential


def truth(frequency_hz: Floats) -> Complexes:
    return PLANT.frequency_response(2.0 * np.pi * frequency_hz)


def drawn(level_db: int, run: int) -> tuple[Floats, float]:
    """Output with noise, and its standard deviation."""
    std = float(CLEAN.std()) / 10 ** (level_db / 20)
    return CLEAN + std * np.random.default_rng([20181001, level_db, run]).normal(size=4000), std


def scipy_h1(y: Floats, segment: int) -> tuple[Floats, Complexes]:
    """H1 as in the documentation of scipy, with the hold, up to 10 Hz."""
    at_hz, cross = csd(CHIRP, y, RATE_HZ, nperseg=segment)
    power = welch(CHIRP, RATE_HZ, nperseg=segment)[1]
    kept = (at_hz > 0.0) & (at_hz <= 10.0)
    turn = 2j * np.pi * at_hz[kept] / RATE_HZ
    return at_hz[kept], (cross / power)[kept] * turn / -np.expm1(-turn)


def plain_ratio(y: Floats) -> tuple[Floats, Complexes]:
    """Ratio of the whole spectra (ETFE)."""
    at_hz = np.fft.rfftfreq(4000, 1.0 / RATE_HZ)[1:101]
    turn = 2j * np.pi * at_hz / RATE_HZ
    ratio = np.fft.rfft(y - y.mean())[1:101] / np.fft.rfft(CHIRP - CHIRP.mean())[1:101]
    return at_hz, ratio * turn / -np.expm1(-turn)


def error(at_hz: Floats, response: Complexes) -> float:
    """Root mean square relative error about the resonance, in %."""
    near = (at_hz >= NEAR_HZ[0]) & (at_hz <= NEAR_HZ[1])
    return 100.0 * float(np.sqrt(np.mean(np.abs(response / truth(at_hz) - 1.0)[near] ** 2)))


def resonance_rows(runs: int) -> list[Row]:
    """Each estimator about the resonance at 30 dB."""
    errors: dict[str, list[float]] = {}
    for run in range(runs):
        y, _ = drawn(30, run)
        for method in ("rational", "polynomial", "h1"):
            found = estimate_frequency_response(Record.sampled(CHIRP, y, RATE_HZ), method=method)
            errors.setdefault(f"ours, {method}", []).append(
                error(found.frequency_hz, found.response)
            )
        errors.setdefault("scipy csd/welch, 5 s Hann", []).append(error(*scipy_h1(y, 2000)))
        errors.setdefault("numpy, ratio of spectra", []).append(error(*plain_ratio(y)))
    clean = estimate_frequency_response(Record.sampled(CHIRP, CLEAN, RATE_HZ))
    rows = [
        Row("  noise-free, ours, rational", error(clean.frequency_hz, clean.response), "%", 1e-3,
            False, "numpy, ratio of spectra "
            f"{error(*plain_ratio(CLEAN)):.2g}, scipy H1 {error(*scipy_h1(CLEAN, 2000)):.3g}"),
    ]  # fmt: skip
    for name, values in errors.items():
        goal = 0.5 if name == "ours, rational" else None
        rows.append(Row(f"  30 dB, {name}", float(np.median(values)), "%", goal, False))
    return [Row("one chirp, error at 0.5 to 1.2 Hz", float(runs), "runs"), *rows]


def interval_rows(runs: int) -> list[Row]:
    """95 % circles that contain the truth, all lines; the largest bias at resonance."""
    rows = []
    for level_db in (20, 30, 40):
        scaled: dict[float, list[complex]] = {}
        for run in range(runs):
            found = estimate_frequency_response(
                Record.sampled(CHIRP, drawn(level_db, run)[0], RATE_HZ)
            )
            ratio = (found.response - truth(found.frequency_hz)) / found.std
            for at_hz, value in zip(found.frequency_hz.round(4), ratio, strict=True):
                scaled.setdefault(float(at_hz), []).append(complex(value))
        swept = [np.abs(v) <= INSIDE for f, v in scaled.items() if f <= 10.0]
        near = [abs(np.mean(v)) for f, v in scaled.items() if NEAR_HZ[0] <= f <= NEAR_HZ[1]]
        held = 100.0 * float(np.mean(np.concatenate(swept)))
        note = f"mean error at resonance at most {max(near):.2f} std ({runs**-0.5:.2f} is chance)"
        rows.append(
            Row(f"rational, {level_db} dB, 95 % circles contain", held, "%", 92.0, True, note)
        )
    return rows


def by_hand(at_hz: Floats, response: Complexes) -> Floats:
    """Unweighted complex least squares of gain, frequency and damping, started at the truth."""

    def misfit(x: Floats) -> Floats:
        s = 2j * np.pi * at_hz
        gap = x[0] * x[1] ** 2 / (s * s + 2 * x[2] * x[1] * s + x[1] ** 2) - response
        return np.concatenate([gap.real, gap.imag])

    return np.asarray(least_squares(misfit, [GAIN, OMEGA, ZETA]).x)


def vector_fitted(at_hz: Floats, response: Complexes) -> Floats:
    """The same numbers from one complex pair of scikit-rf's vector fitting."""
    import skrf
    from skrf.vectorFitting import VectorFitting

    network = skrf.Network(f=at_hz, s=response[:, None, None], f_unit="hz")
    fitting = VectorFitting(network)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitting.vector_fit(n_poles_real=0, n_poles_cmplx=1, fit_constant=False,
                           fit_proportional=False)  # fmt: skip
    pole, residue = complex(fitting.poles[0]), complex(fitting.residues[0, 0])
    omega = abs(pole)
    return np.array([-2.0 * (residue / pole).real, omega, -pole.real / omega])


def fit_rows(runs: int) -> list[Row]:
    """Gain, frequency, damping from the response of one chirp at 30 dB."""
    x = np.array([GAIN, OMEGA, ZETA, 0.0, 0.0, 0.0, 0.0])
    # A delay of 10 ms has the same bound, and differences to both sides of it.
    best = bound(x + 0.01 * (np.arange(7) == 3), 1.0)[:4]
    ours, held, others = [], [], {"complex least squares on scipy's H1": [],
                                 "complex least squares on the ratio": []}  # fmt: skip
    skrf = importlib.util.find_spec("skrf") is not None
    if skrf:
        others["scikit-rf vector fitting on our lines"] = []
    for run in range(runs):
        y, std = drawn(30, run)
        found = estimate_frequency_response(Record.sampled(CHIRP, y, RATE_HZ))
        estimates = [found.fit().parameters[name] for name in NAMES]
        ours.append(([e.value for e in estimates] - x[:4]) / best / std)
        held.append([e.ci95[0] <= t <= e.ci95[1] for e, t in zip(estimates, x, strict=False)])
        h1, ratio = scipy_h1(y, 2000), plain_ratio(y)
        others["complex least squares on scipy's H1"].append(by_hand(*h1))
        others["complex least squares on the ratio"].append(by_hand(*ratio))
        if skrf:
            swept = found.frequency_hz <= 10.0
            others["scikit-rf vector fitting on our lines"].append(
                vector_fitted(found.frequency_hz[swept], found.response[swept])
            )
    rms = np.sqrt(np.mean(np.square(ours), axis=0))
    spread = " ".join(f"{value:.2f}" for value in rms)
    note = f"gain, omega_n, zeta, delay: {spread}; hold {np.round(np.mean(held, axis=0), 2)}"
    rows = [Row("weighted fit of rational lines, 30 dB, rms / bound", float(rms.max()), "", 1.3,
                False, note)]  # fmt: skip
    for name, values in others.items():
        away = np.sqrt(np.mean((np.array(values) - x[:3]) ** 2, axis=0)) / best[:3] / std
        mean = 100.0 * (np.mean(values, axis=0) / x[:3] - 1.0)
        note = "mean error in % of gain, omega_n, zeta: " + " ".join(f"{v:.2g}" for v in mean)
        rows.append(Row(f"  {name}, rms / bound", float(away.max()), "", note=note))
    if not skrf:
        rows.append(Row("  scikit-rf vector fitting: not installed", float("nan"), ""))
    return rows


def time_rows() -> list[Row]:
    """Segments compared with scipy on noise; the local models and the fit in ms."""
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=4000), rng.normal(size=4000)

    def ours() -> object:
        return estimate_frequency_response(
            Record.sampled(u, y, RATE_HZ), method="h1", segment_s=1.25
        )

    def theirs() -> object:
        return (csd(u, y, RATE_HZ, nperseg=500), welch(u, RATE_HZ, nperseg=500),
                welch(y, RATE_HZ, nperseg=500))  # fmt: skip

    noisy, _ = drawn(30, 0)
    record = Record.sampled(CHIRP, noisy, RATE_HZ)
    lines = estimate_frequency_response(record)
    ours_s, theirs_s, local_s, together_s, apart_s = medians(
        ours, theirs, lambda: estimate_frequency_response(record), lines.fit,
        lambda: fit_response(lines.frequency_hz, lines.response, lines.std), rounds=15,
    )  # fmt: skip
    return [
        Row("H1 of 4,000 samples, time beside csd + 2 welch", ours_s / theirs_s, "", 1.0, False,
            f"{1e3 * ours_s:.2f} ms, coherence and intervals included"),
        Row("local rational models of a chirp, 4,000 samples", 1e3 * local_s, "ms"),
        Row("weighted fit of its lines, with covariance", 1e3 * together_s, "ms",
            note=f"lines taken as independent {1e3 * apart_s:.0f} ms"),
    ]  # fmt: skip


def exchange_rows() -> list[Row]:
    """Largest relative difference of 50 gains through another tool and back."""
    plant = Plant(0.5, 5.11, 0.09, 0.012, (SlowMode(0.4, 4.7),))
    model = RationalModel.from_plant(plant).without_delay(3)
    omega_rad_s = np.geomspace(0.01, 100.0, 50)
    again = from_scipy(to_scipy(model, "ss"))
    gap = again.frequency_response(omega_rad_s) / model.frequency_response(omega_rad_s) - 1.0
    return [Row("model to a state space of scipy and back", float(np.abs(gap).max()), "", 1e-10,
                False, "slow branch, delay as an all-pass of order 3")]  # fmt: skip


def rows(runs: int = RUNS) -> list[Row]:
    return [
        *resonance_rows(runs), *interval_rows(5 * runs // 2), *fit_rows(runs), *time_rows(),
        *exchange_rows(),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    for row in rows(parser.parse_args().runs):
        print(row, flush=True)


if __name__ == "__main__":
    main()
