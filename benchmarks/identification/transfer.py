"""Transfer functions on the reference study's own problem: bound, coverage, time, structure.

    python -m benchmarks.identification.transfer [--runs 1000] [--structures 100]

The problem: chirp of 0.1 to 10 Hz in 10 s, 400 Hz, second order, damping ratio 0.09, white noise.
"""

import argparse
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.rows import CHECKOUT, Row, goal_of, medians
from haselab.identify.record import Record
from haselab.identify.transfer.choice import choose_transfer
from haselab.identify.transfer.fit import TransferFit, TransferStructure, fit_transfer
from haselab.models import Plant, SlowMode

Floats = NDArray[np.float64]
RUNS, STRUCTURES = 1000, 100
RATE_HZ = 400.0
TIME_S = np.arange(4000) / RATE_HZ
CHIRP = np.sin(2 * np.pi * (0.1 * TIME_S + 0.495 * TIME_S**2))
STEP_S = np.arange(12000) / RATE_HZ
STEP = np.where(STEP_S < 2.0, 0.0, 1.0)
GAIN, OMEGA, ZETA = 0.5, float(np.sqrt(26.14)), 0.93 / (2 * float(np.sqrt(26.14)))
READINGS = {"rad": OMEGA, "hz": 2 * np.pi * 5.11}
NAMES = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
AT_REST = TransferStructure(delay=0.0, offset=False, initial_state=False)
START = np.array([0.4, 4.6, 0.12])
LIBRARIES = CHECKOUT / ".venv" / "libraries" / "bin" / "python"


def output(x: Sequence[float]) -> Floats:
    """Of gain, frequency, damping, and if given delay, two states and offset."""
    late = max(x[3], 0.0) if len(x) > 3 else 0.0
    moved = Plant(x[0], x[1], x[2], late)
    if len(x) == 3:
        return moved.simulate(CHIRP, RATE_HZ, TIME_S)
    return moved.simulate(CHIRP, RATE_HZ, TIME_S, [x[4], x[5]]) + x[6]


def bound(x: Floats, std: float) -> Floats:
    """Cramer-Rao bound of the standard deviations, by central differences."""
    steps = 1e-5 * np.maximum(np.abs(x), 0.1)
    columns = np.array([(output(x + h) - output(x - h)) / (2 * h.max()) for h in np.diag(steps)])
    return np.sqrt(np.diag(np.linalg.inv(columns @ columns.T))) * std


@dataclass
class Tally:
    """Errors over their bound, and intervals that contain the truth. Shape `(R, P)` each."""

    errors: list[Floats]
    inside: list[list[bool]]
    failures: int = 0

    def add(self, fit: TransferFit, truth: Floats, bounds: Floats) -> None:
        if not fit.succeeded:
            self.failures += 1
            return
        found = [fit.parameters[name] for name, _ in zip(NAMES, bounds, strict=False)]
        self.errors.append(np.array([e.value for e in found] - truth[: len(found)]) / bounds)
        self.inside.append(
            [bool(e.ci95[0] <= t <= e.ci95[1]) for e, t in zip(found, truth, strict=False)]
        )

    def rows(
        self, what: str, most: float, band: tuple[float, float], bias: float | None
    ) -> list[Row]:
        z = np.array(self.errors)
        cover = 100.0 * np.mean(self.inside, axis=0)
        each = " / ".join(f"{value:.3f}" for value in np.sqrt((z**2).mean(axis=0)))
        covered = " / ".join(f"{value:.1f}" for value in cover)
        rows = [
            Row(f"{what}: failures", self.failures, f"of {len(z) + self.failures}", 0.0, False),
            Row(f"{what}: rms error / bound", float(np.sqrt((z**2).mean(axis=0)).max()), "",
                goal_of(most, 1.0, len(z)), False, each),
            Row(f"{what}: least coverage", float(cover.min()), "%",
                goal_of(band[0], 95.0, len(z)), True, covered),
            Row(f"{what}: largest coverage", float(cover.max()), "%",
                goal_of(band[1], 95.0, len(z)), False),
        ]  # fmt: skip
        if bias is not None:
            worst = float(np.abs(z.mean(axis=0)).max())
            rows.append(Row(f"{what}: bias / standard deviation", worst, "",
                            goal_of(bias, 0.0, len(z)), False))  # fmt: skip
        return rows


def at_rest_rows(runs: int) -> Iterator[Row]:
    truth = np.array([GAIN, OMEGA, ZETA])
    clean = output(truth)
    for snr_db in (20, 30, 40):
        std = float(np.sqrt(np.mean(clean**2))) * 10 ** (-snr_db / 20)
        bounds, tally = bound(truth, std), Tally([], [])
        for run in range(runs):
            rng = np.random.default_rng([20181001, snr_db, run])
            y = clean + std * rng.normal(size=clean.size)
            tally.add(
                fit_transfer([Record.sampled(CHIRP, y, RATE_HZ, 0.0)], AT_REST), truth, bounds
            )
        yield from tally.rows(f"at rest, {snr_db} dB", 1.05, (93.0, 97.0), None)


def nuisance_rows(runs: int) -> Iterator[Row]:
    for reading, omega in READINGS.items():
        for snr_db in (20, 30, 40) if reading == "rad" else (30,):
            tally = Tally([], [])
            for run in range(runs):
                rng = np.random.default_rng([7, snr_db, run])
                truth = np.array([GAIN, omega, ZETA, rng.uniform(0, 0.03), rng.uniform(-0.1, 0.1),
                                  rng.uniform(-0.3, 0.3), rng.uniform(-0.05, 0.05)])  # fmt: skip
                clean = output(truth)
                std = float(np.sqrt(np.mean((clean - truth[6]) ** 2))) * 10 ** (-snr_db / 20)
                y = clean + std * rng.normal(size=clean.size)
                fit = fit_transfer([Record.sampled(CHIRP, y, RATE_HZ)])
                tally.add(fit, truth, bound(truth, std)[:4])
            what = f"delay, state, offset; {reading}, {snr_db} dB"
            yield from tally.rows(what, 1.10, (92.0, 97.0), 0.15)


def colour_rows(runs: int) -> Iterator[Row]:
    fired = quiet = 0
    for reading, omega in READINGS.items():
        truth = np.array([GAIN, omega, ZETA])
        clean = output(truth)
        std = float(np.sqrt(np.mean(clean**2) / 1e3))
        inside = []
        for run in range(runs):
            white = np.random.default_rng([5, run]).normal(size=8000)
            noise = std * lfilter([np.sqrt(1 - 0.99**2)], [1, -0.99], white)[4000:]
            fit = fit_transfer([Record.sampled(CHIRP, clean + noise, RATE_HZ)])
            found = [fit.parameters[name].ci95 for name in NAMES[:3]]
            inside.append([low <= t <= high for (low, high), t in zip(found, truth, strict=True)])
        cover = 100.0 * np.mean(inside, axis=0)
        each = " / ".join(f"{value:.1f}" for value in cover)
        yield Row(f"AR(1) noise, pole 0.99; {reading}: least coverage", cover.min(), "%",
                  goal_of(90.0, 95.0, runs), True, each)  # fmt: skip
        yield Row(f"AR(1) noise, pole 0.99; {reading}: largest", cover.max(), "%",
                  goal_of(98.0, 95.0, runs), False)  # fmt: skip
        linear = clean / np.abs(clean).max()
        for softening in (0.05, 0.0):
            y = linear - softening * linear**3
            std = float(np.sqrt(np.mean(y**2) / 1e3))
            count = 0
            for run in range(runs):
                noise = std * np.random.default_rng([6, run]).normal(size=y.size)
                fit = fit_transfer([Record.sampled(CHIRP, y + noise, RATE_HZ)])
                count += fit.residual_whiteness_p < 0.05
            fired, quiet = (count, quiet) if softening else (fired, count)
        yield Row(f"cubic softening of 5 %; {reading}: test fires", 100.0 * fired / runs, "%", 95.0,
                  True, f"where there is none: {100.0 * quiet / runs:.1f} %")  # fmt: skip


def creeping(seed: int, omega: float) -> list[Record]:
    """A chirp and a step of a plant with 10 % creep, each from its own state and offset."""
    rng = np.random.default_rng([11, seed])
    plant = Plant(GAIN, omega, ZETA, rng.uniform(0, 0.03), (SlowMode(0.1 * GAIN, 5.0),))
    sweep = plant.simulate(CHIRP, RATE_HZ, TIME_S, [*rng.uniform(-0.05, 0.05, 2), 0.0])
    rise = plant.simulate(STEP, RATE_HZ, STEP_S, [*rng.uniform(-0.05, 0.05, 2), 0.0])
    std = float(np.sqrt(np.mean(sweep**2) / 1e3))
    return [
        Record.sampled(CHIRP, sweep + 0.02 + std * rng.normal(size=sweep.size), RATE_HZ),
        Record.sampled(STEP, rise - 0.03 + std * rng.normal(size=rise.size), RATE_HZ),
    ]


def structure_rows(runs: int) -> Iterator[Row]:
    for reading, omega in READINGS.items():
        right = silent = 0
        for seed in range(runs):
            records = creeping(seed, omega)
            chosen = choose_transfer(records).fit.structure
            right += (chosen.poles, chosen.zeros, chosen.slow_modes) == (2, 0, 1)
            choice = choose_transfer(records[:1], varied=["slow_modes"])
            notes = (*choice.notes, *choice.fit.notes)
            silent += not any("not identifiable" in note for note in notes)
        yield Row(f"chirp and step; {reading}: right structure", 100.0 * right / runs, "%", 95.0)
        named = 100.0 * (1 - silent / runs)
        yield Row(f"chirp alone; {reading}: creep not identifiable", named, "%", 95.0)


def time_rows() -> Iterator[Row]:
    from benchmarks.identification.transfer_libraries import by_hand

    clean = output([GAIN, OMEGA, ZETA])
    std = float(np.sqrt(np.mean(clean**2) / 1e3))
    noisy = [clean + std * np.random.default_rng([3, k]).normal(size=4000) for k in range(20)]

    def hand() -> None:
        for y in noisy:
            by_hand(CHIRP, y, RATE_HZ, START)

    def rest() -> None:
        for y in noisy:
            fit_transfer([Record.sampled(CHIRP, y, RATE_HZ, 0.0)], AT_REST)

    def seven() -> None:
        for y in noisy:
            fit_transfer([Record.sampled(CHIRP, y, RATE_HZ)])

    hand_s, rest_s, seven_s = medians(hand, rest, seven)
    note = f"{rest_s / 20e-3:.2f} ms against {hand_s / 20e-3:.2f} ms by hand"
    yield Row("fit of 3 numbers at rest / scipy by hand", rest_s / hand_s, "", 0.5, False, note)
    note = f"{seven_s / 20e-3:.2f} ms"
    yield Row("fit of 7 numbers / scipy by hand of 3", seven_s / hand_s, "", 2.0, False, note)


def library_table() -> Iterator[str]:
    """Failures, errors over the bound and time of each library on the problem at rest, 30 dB."""
    if not LIBRARIES.exists():
        yield "other libraries: `make bench` installs them in .venv/libraries"
        return
    truth = np.array([GAIN, OMEGA, ZETA])
    clean = output(truth)
    std = float(np.sqrt(np.mean(clean**2) / 1e3))
    noise = [np.random.default_rng([20181001, 30, k]).normal(size=4000) for k in range(100)]
    records: dict[str, Any] = {"u": CHIRP, "y": clean + std * np.array(noise), "rate_hz": RATE_HZ,
                               "start": START}  # fmt: skip
    heads = f"{'n':>4s} {'fail %':>7s} {'rms / bound':>24s} {'time':>8s}"
    yield f"{'library, at rest, 30 dB':52s} {heads}"
    ours = np.array([
        [fit_transfer([Record.sampled(CHIRP, y, RATE_HZ, 0.0)], AT_REST).parameters[n].value
         for n in NAMES[:3]] for y in records["y"]
    ])  # fmt: skip
    yield line("haselab", ours, truth, bound(truth, std), None, "see above")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "records.npz"
        np.savez(file, **records)
        script = Path(__file__).parent / "transfer_libraries.py"
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        command = [str(LIBRARIES), str(script), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
    for text in done.stdout.splitlines():
        if text.startswith("{"):
            fitted = json.loads(text)
            found = np.array(fitted["found"], dtype=float).reshape(-1, 3)
            yield line(
                fitted["library"],
                found,
                truth,
                bound(truth, std),
                fitted["ratio"],
                fitted["message"],
            )


def line(
    name: str, found: Floats, truth: Floats, bounds: Floats, ratio: float | None, message: str
) -> str:
    off = np.abs(found / truth - 1.0)
    good = np.isfinite(found).all(axis=1) & (off[:, 1] < 0.1) & (off[:, 2] < 0.5)
    failed = 100.0 * (1.0 - good.mean()) if len(found) else float("nan")
    rms = np.sqrt((((found[good] - truth) / bounds) ** 2).mean(axis=0)) if good.any() else []
    shown = " / ".join(f"{value:.3g}" for value in rms) or "-"
    spent = "" if ratio is None else f"{ratio:.2f}"
    return f"{name:52s} {len(found):4d} {failed:7.0f} {shown:>24s} {spent:>8s}  {message}".rstrip()


def rows(runs: int = RUNS, structures: int = STRUCTURES, libraries: bool = True) -> list[Row]:
    """Return the goals; print the table of the other libraries."""
    found = [*time_rows(), *at_rest_rows(runs), *nuisance_rows(runs), *colour_rows(runs)]
    if structures:  # each takes more than a minute
        found += structure_rows(structures)
    for text in library_table() if libraries else ():
        print(text, flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--structures", type=int, default=STRUCTURES)
    given = parser.parse_args()
    for row in rows(given.runs, given.structures):
        print(row, flush=True)


if __name__ == "__main__":
    main()
