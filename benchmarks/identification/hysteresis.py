"""Hysteresis and creep: errors over the Cramer-Rao bound, coverage, speed.

Compared with loops that a user would write, in numpy and in numba, and with scipy's curve_fit,
which is given the model and a good start; haselab is given neither. The loop of the twin is
played, not predicted.
"""

import importlib.util
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from benchmarks.rows import Row, medians
from haselab.base import Estimate
from haselab.identify import LoopRecord, Record, fit_creep, fit_hysteresis
from haselab.identify.hysteresis.loops import band_widths
from haselab.models import BoucWen, PrandtlIshlinskii, PronyCreep
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, native_bench
from haselab.signals import triangle

__all__ = ["rows"]

Floats = NDArray[np.float64]
RUNS = 40
STEPS = 1000
LOOP_NOISE, CREEP_NOISE = 0.005, 0.003
PLAYS = {"gain": 1.0, "offset": 0.2, "threshold_1": 0.15, "threshold_2": 0.5,
         "weight_1": 0.4, "weight_2": 0.3}  # fmt: skip
MEMORY = {"gain": 1.0, "offset": 0.2, "weight": -0.1, "sharpness": 3.0, "sigma": 0.8}
CREEP = {"instant": 1.0, "gain_1": 0.2, "gain_2": 0.15,
         "time_constant_1_s": 0.8, "time_constant_2_s": 9.0}  # fmt: skip
CYCLE = triangle(0.0, 2.0, 0.25, 1, 100.0)
DRIVE = np.concatenate([CYCLE, 0.6 * CYCLE, 0.8 * CYCLE])
HELD = np.r_[np.zeros(100), np.ones(1500), np.zeros(1400)]


def _plays(v: Sequence[float]) -> PrandtlIshlinskii:
    return PrandtlIshlinskii(v[0], (v[2], v[3]), (v[4], v[5]), v[1])


def _memory(v: Sequence[float]) -> BoucWen:
    return BoucWen(v[0], v[2], v[3], v[4], 1.0, v[1])


def _creep(v: Sequence[float]) -> Floats:
    return PronyCreep(v[0], (v[1], v[2]), (v[3], v[4])).simulate(HELD, 50.0)


def _bound(output: Callable[[Sequence[float]], Floats], truth: Floats, noise: float) -> Floats:
    """Cramer-Rao bound of each number, by differences of the exact output."""
    steps = 1e-6 * np.eye(truth.size)
    slopes = [(output(truth + step) - output(truth - step)) / 2e-6 for step in steps]
    gram = np.array(slopes) @ np.array(slopes).T
    return noise * np.sqrt(np.diag(np.linalg.inv(gram)))


def _judge(
    what: str, fits: Sequence[dict[str, Estimate]], truth: dict[str, float], bound: Floats
) -> list[Row]:
    values = np.array(list(truth.values()))
    # Another structure has another bound; what is not fitted there is recognised by its name.
    usable = [[fit[name] for name in truth] for fit in fits
              if set(fit) - {"rate_dependence_s", "offset"} == set(truth) - {"offset"}]  # fmt: skip
    found = np.array([[entry.value for entry in fit] for fit in usable])
    inside = np.array([[e.ci95[0] <= v <= e.ci95[1] for e, v in zip(fit, values, strict=True)]
                       for fit in usable])  # fmt: skip
    ratio = np.sqrt(((found - values) ** 2).mean(axis=0)) / bound
    note = f"of {values.size} numbers, {len(usable)} of {len(fits)} runs of that structure"
    return [
        Row(f"{what}: rms error / Cramer-Rao bound, worst", float(ratio.max()), "", note=note),
        Row(f"{what}: 95 % intervals contain the truth", 100.0 * float(inside.mean()), "%"),
    ]


def loop_rows(runs: int) -> list[Row]:
    rows = []
    settled = LoopRecord(DRIVE, DRIVE, 100.0).settled()
    kinds = (("play operators", _plays, PLAYS, "prandtl-ishlinskii"),
             ("Bouc-Wen", _memory, MEMORY, "bouc-wen"))  # fmt: skip
    for what, make, truth, kind in kinds:
        values = np.array(list(truth.values()))
        clean = make(values).simulate(DRIVE)
        fits = [
            fit_hysteresis([LoopRecord(DRIVE, clean + _noise(k, LOOP_NOISE), 100.0)])
            for k in range(runs)
        ]
        right = [fit for fit in fits if fit.verdict == kind]
        estimates = [f.parameters for f in right]

        def seen(v: Sequence[float], make: Callable[..., object] = make) -> Floats:
            return make(v).simulate(DRIVE)[settled]  # type: ignore[attr-defined]

        bound = _bound(seen, values, LOOP_NOISE)
        wrong = sum(fit.verdict not in (kind, "cannot tell") for fit in fits)
        note = f"{wrong} of {runs} name another"
        rows.append(Row(f"{what}: model named right", 100.0 * len(right) / runs, "%", note=note))
        rows += _judge(what, estimates, truth, bound)
    record = LoopRecord(DRIVE, clean + _noise(0, LOOP_NOISE), 100.0)
    (fit_s,) = medians(lambda: fit_hysteresis([record]), rounds=3)
    return [*rows, Row("hysteresis fit, all models, 1,200 samples", 1e3 * fit_s, "ms")]


def _noise(seed: int, std: float, size: int = DRIVE.size) -> Floats:
    return std * np.random.default_rng([7, seed]).normal(size=size)


def creep_rows(runs: int) -> list[Row]:
    values = np.array(list(CREEP.values()))
    clean = _creep(values)
    records = [clean + _noise(k, CREEP_NOISE, HELD.size) for k in range(runs)]
    fits = [fit_creep(Record.sampled(HELD, y, 50.0)) for y in records]
    estimates = [fit.parameters for fit in fits if fit.verdict == "prony"]
    wrong = sum(fit.verdict not in ("prony", "cannot tell") for fit in fits)
    bound = _bound(_with_offset, np.append(values, 0.0), CREEP_NOISE)[:-1]

    def theirs() -> object:
        return curve_fit(
            lambda _, *v: _with_offset(v), HELD, records[0], p0=[*(1.1 * values), 0.01]
        )

    our_s, one_s, their_s = medians(
        lambda: fit_creep(Record.sampled(HELD, records[0], 50.0)),
        lambda: fit_creep(Record.sampled(HELD, records[0], 50.0), "prony"),
        theirs,
        rounds=3,
    )
    note = f"{wrong} of {runs} name another"
    right = 100.0 * len(estimates) / runs
    return [
        Row("creep: model named right, two branches", right, "%", note=note),
        *_judge("creep", estimates, CREEP, bound),
        Row("creep fit, all laws, 3,000 samples", 1e3 * our_s, "ms",
            note=f"branches alone {1e3 * one_s:.0f}, curve_fit with model and start "
            f"{1e3 * their_s:.0f}"),
    ]  # fmt: skip


def _with_offset(v: Sequence[float]) -> Floats:
    return _creep(v) + v[5]


def _numpy_plays(u: Floats, thresholds: Floats, weights: Floats) -> Floats:
    state, out = np.zeros(thresholds.size), np.empty(u.size)
    for k, value in enumerate(u):
        state = np.minimum(value + thresholds, np.maximum(value - thresholds, state))
        out[k] = value + weights @ state
    return out


def _scalar_plays(u: Floats, thresholds: Floats, weights: Floats) -> Floats:
    state, out = np.zeros(thresholds.size), np.empty(u.size)
    for k in range(u.size):
        total = u[k]
        for i in range(thresholds.size):
            x = min(u[k] + thresholds[i], max(u[k] - thresholds[i], state[i]))
            state[i] = x
            total += weights[i] * x
        out[k] = total
    return out


def speed_rows() -> list[Row]:
    thresholds, weights = np.linspace(0.05, 0.9, 10), np.full(10, 0.1)
    model = PrandtlIshlinskii(1.0, tuple(thresholds.tolist()), tuple(weights.tolist()))
    memory = BoucWen(1.0, -0.1, 2.0, 1.5)
    u = np.sin(np.linspace(0.0, 300.0, 1_000_000))
    few = np.ascontiguousarray(u[:20_000])

    def step() -> None:
        state, one = model.init(), np.array([0.3])
        for _ in range(STEPS):
            state = model.step(state, one)[0]

    jobs: list[Callable[[], object]] = [
        lambda: model.simulate(u),
        lambda: model.invert(u),
        lambda: memory.simulate(u),
        lambda: memory.invert(u),
        lambda: _numpy_plays(few, thresholds, weights),
        step,
    ]
    has_numba = importlib.util.find_spec("numba") is not None
    if has_numba:
        import numba

        compiled = numba.njit(_scalar_plays)
        jobs.append(lambda: compiled(u, thresholds, weights))
    times = medians(*jobs, rounds=5)
    runs, inverts, bends, unbends, plain, step_s = times[:6]
    note = f"{runs / u.size / (plain / few.size):.2g} of numpy's time"
    note += f", {runs / times[6]:.2f} of numba's" if has_numba else ", numba not installed"
    return [
        Row("10 play operators", 1e-6 * u.size / runs, "Msample / s", 10.0, note=note),
        Row("10 play operators, inverse", 1e-6 * u.size / inverts, "Msample / s", 10.0),
        Row("Bouc-Wen, exponent 1", 1e-6 * u.size / bends, "Msample / s"),
        Row("Bouc-Wen, inverse", 1e-6 * u.size / unbends, "Msample / s"),
        Row("play operators, one sample from Python", 1e6 * step_s / STEPS, "us"),
    ]


def twin_rows() -> list[Row]:
    config = twin_of_reading("hz")
    load_n = config.load.mass_kg * GRAVITY_M_S2

    def play(drive_v: Floats) -> Floats:
        bench = native_bench(config, 1, noise=False)
        bench.move(np.zeros(1), 600_000, load_n, np.empty(600_000))
        lengths_m = np.empty(drive_v.size * 100)
        bench.move(np.ascontiguousarray(drive_v), 100, load_n, lengths_m)
        return lengths_m[99::100]

    rows = []
    for frequency_hz in (0.05, 0.1, 0.25):
        drive_v = triangle(0.0, 2.0, frequency_hz, 5, 100.0)
        length_m = play(drive_v)
        strain = length_m / length_m[0] - 1.0
        strain = strain + _noise(9, 2e-5, strain.size)
        record = LoopRecord(drive_v, strain, 100.0, 1.0 / frequency_hz)
        for kind in ("prandtl-ishlinskii", "bouc-wen"):
            fit = fit_hysteresis([record], kind)
            what = f"twin's loop at {frequency_hz:g} Hz, inverse of {kind}"
            if not fit.succeeded or fit.model.obstacle(100.0):
                rows.append(Row(what, float("nan"), "x", note="no inverse"))
                continue
            low, high = np.quantile(strain[strain.size // 2 :], [0.05, 0.95])
            wanted = triangle(low, high, frequency_hz, 5, 100.0)
            command_v = fit.model.invert(wanted, 100.0)
            if not 0.0 <= command_v.min() <= command_v.max() <= 2.2:
                rows.append(Row(what, float("nan"), "x", note="command outside 0 to 2.2 V"))
                continue
            made = play(command_v) / length_m[0] - 1.0
            cycles = band_widths([LoopRecord(wanted, made, 100.0, 1.0 / frequency_hz)])
            after = float(np.mean([cycle.relative_width.value for cycle in cycles]))
            before = fit.relative_width.value
            note = f"width {100 * before:.1f} -> {100 * after:+.2f} % of the span, played"
            rows.append(Row(what, abs(before / after), "x narrower", note=note))
    return rows


def rows(runs: int = RUNS) -> list[Row]:
    return [*loop_rows(runs), *creep_rows(runs), *speed_rows(), *twin_rows()]


if __name__ == "__main__":
    for row in rows():
        print(row, flush=True)
