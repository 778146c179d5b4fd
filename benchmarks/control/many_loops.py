"""A thousand randomised closed loops of 20 s at 1 kHz, compared with other ways to run them.

The common problem: a resonance with one slow branch, no delay; PID with its filter, saturation
and conditional anti-windup; each loop is summarised in a few numbers. haselab has the controller in
the core's single precision, any delay, and starts from the models; the others start from
coefficients.

Seconds are the processor's, of one thread: other programs are not counted.
"""

import importlib.util
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from benchmarks.rows import CHECKOUT, Row, medians
from haselab import _loops
from haselab.control import LoopSetting, PidGains, WhiteNoise, simulate_ensemble, trace_ensemble
from haselab.control.plants.loop_table import LoopTable
from haselab.models.plant import Plant, SlowMode

__all__ = [
    "HIGH",
    "LEVEL",
    "LOW",
    "PERIOD_S",
    "SAMPLES",
    "coefficients",
    "ours",
    "processor_s",
    "rows",
]

LOOPS, SAMPLES, PERIOD_S = 1000, 20_000, 0.001
SIMULATED_S = LOOPS * SAMPLES * PERIOD_S
LOW, HIGH, LEVEL = -0.05, 0.1, 0.04
UNIT = "sim s / cpu s"
REFERENCE = np.full(SAMPLES, LEVEL)
SETTING = LoopSetting(1.0 / PERIOD_S, 0.0)

Numbers = NDArray[np.float64]


def problem(longest_delay_s: float = 0.0) -> tuple[list[Plant], list[PidGains]]:
    """Plants of a bootstrap or a robust design: every parameter off by up to 30 %."""
    rng = np.random.default_rng(5)
    off = rng.uniform(0.7, 1.3, (LOOPS, 5)).tolist()
    delays_s = rng.uniform(0.0, longest_delay_s, LOOPS).tolist()
    plants = [
        Plant(0.5 * a, 5.11 * b, 0.09 * c, delay_s, (SlowMode(0.4 * d, 4.7 * e),))
        for (a, b, c, d, e), delay_s in zip(off, delays_s, strict=True)
    ]
    laws = rng.uniform((0.1, 0.5, 0.01, 0.02), (0.8, 1.5, 0.1, 0.04), (LOOPS, 4)).tolist()
    return plants, [PidGains(*law) for law in laws]


def coefficients() -> Numbers:
    """The common problem as the other libraries step it. Shape `(12, LOOPS)`."""
    columns = []
    for plant, law in zip(*problem(), strict=True):
        wn, (slow,) = plant.natural_frequency_rad_s, plant.slow_modes
        free = expm(PERIOD_S * wn * np.array([[0.0, 1.0], [-1.0, -2.0 * plant.damping_ratio]]))
        decay = np.exp(-PERIOD_S / slow.time_constant_s)
        push = plant.gain * (1.0 - free[0, 0]), -plant.gain * free[1, 0]
        weight = PERIOD_S / (PERIOD_S + law.derivative_filter_s)
        columns.append(
            [*free.ravel(), *push, decay, slow.gain * (1.0 - decay),
             law.kp, law.ki * PERIOD_S, law.kd / PERIOD_S, weight]
        )  # fmt: skip
    return np.array(columns).T


def ours(
    longest_delay_s: float = 0.0, threads: int = 1, noise: WhiteNoise | None = None
) -> Callable[[], Numbers]:
    plants, gains = problem(longest_delay_s)

    def run() -> Numbers:
        found = simulate_ensemble(
            plants, gains, REFERENCE, SETTING, measurement_noise=noise, threads=threads
        )
        return np.array([found.absolute_error_s, found.highest, found.lowest, found.limited_time_s])

    return run


def traces() -> Callable[[], object]:
    plants, gains = problem()
    return lambda: trace_ensemble(plants, gains, REFERENCE, SETTING, threads=1)


def one_by_one(bits: int = 0) -> Callable[[], NDArray[np.void]]:
    loops = LoopTable.of(*problem(), SETTING).loops()
    ends = np.arange(1, 21, dtype=np.uint64) * (SAMPLES // 20)
    kept = np.empty((LOOPS, ends.size), _loops.SUMMARY)
    silent = np.zeros((0, 0), np.float32), np.zeros(0, np.uint32)
    reference = REFERENCE.astype(np.float32)

    def run() -> NDArray[np.void]:
        loops.summaries(reference, *silent, 0.02 * LEVEL, ends, kept, bits, 1)
        return kept.copy()

    return run


def numba_scalar(c: Numbers) -> Callable[[], Numbers]:
    import numba

    @numba.njit(cache=False)
    def run(c, samples, summary):  # type: ignore[no-untyped-def]
        for loop in range(c.shape[1]):
            a11, a12, a21, a22, b1, b2, decay, push, kp, ki, kd, weight = c[:, loop]
            x1 = x2 = s = integral = filtered = error_sum = limited = 0.0
            top, bottom = -np.inf, np.inf
            for _ in range(samples):
                y = x1 + s
                error = LEVEL - y
                change = weight * (y - filtered)
                filtered += change
                direct = kp * error - kd * change
                free = direct + integral
                if not ((free > HIGH and error > 0.0) or (free < LOW and error < 0.0)):
                    integral += ki * error
                u = min(max(direct + integral, LOW), HIGH)
                error_sum += abs(error)
                top, bottom = max(top, y), min(bottom, y)
                if u >= HIGH or u <= LOW:
                    limited += 1.0
                x1, x2 = a11 * x1 + a12 * x2 + b1 * u, a21 * x1 + a22 * x2 + b2 * u
                s = decay * s + push * u
            summary[:, loop] = error_sum * PERIOD_S, top, bottom, limited * PERIOD_S

    def job() -> Numbers:
        summary = np.empty((4, LOOPS))
        run(c, SAMPLES, summary)
        return summary

    return job


def numpy_vectorised(c: Numbers, samples: int) -> Callable[[], Numbers]:
    a11, a12, a21, a22, b1, b2, decay, push, kp, ki, kd, weight = c

    def run() -> Numbers:
        x1, x2, s, integral, filtered, error_sum, limited = np.zeros((7, LOOPS))
        top, bottom = np.full(LOOPS, -np.inf), np.full(LOOPS, np.inf)
        for _ in range(samples):
            y = x1 + s
            error = LEVEL - y
            change = weight * (y - filtered)
            filtered = filtered + change
            direct = kp * error - kd * change
            free = direct + integral
            outward = ((free > HIGH) & (error > 0.0)) | ((free < LOW) & (error < 0.0))
            integral = np.where(outward, integral, integral + ki * error)
            u = np.minimum(np.maximum(direct + integral, LOW), HIGH)
            error_sum += np.abs(error)
            top, bottom = np.maximum(top, y), np.minimum(bottom, y)
            limited += (u >= HIGH) | (u <= LOW)
            x1, x2 = a11 * x1 + a12 * x2 + b1 * u, a21 * x1 + a22 * x2 + b2 * u
            s = decay * s + push * u
        return np.array([error_sum * PERIOD_S, top, bottom, limited * PERIOD_S])

    return run


def python_control(c: Numbers, samples: int) -> Callable[[], Numbers]:
    """One loop, as a discrete interconnection; its outputs alone."""
    import control

    a11, a12, a21, a22, b1, b2, decay, push, kp, ki, kd, weight = c[:, 0].tolist()
    plant = control.ss(
        [[a11, a12, 0.0], [a21, a22, 0.0], [0.0, 0.0, decay]], [[b1], [b2], [push]],
        [[1.0, 0.0, 1.0]], [[0.0]], PERIOD_S, inputs="u", outputs="y", name="plant",
    )  # fmt: skip

    def step(x, reads):  # type: ignore[no-untyped-def]
        integral, filtered = x
        error, change = reads[0] - reads[1], weight * (reads[1] - filtered)
        direct = kp * error - kd * change
        free = direct + integral
        if not ((free > HIGH and error > 0.0) or (free < LOW and error < 0.0)):
            integral = integral + ki * error
        return integral, filtered + change, min(max(direct + integral, LOW), HIGH)

    law = control.nlsys(
        lambda t, x, reads, p: step(x, reads)[:2], lambda t, x, reads, p: step(x, reads)[2:],
        inputs=["r", "y"], outputs="u", states=2, dt=PERIOD_S, name="law",
    )  # fmt: skip
    loop = control.interconnect([plant, law], inputs="r", outputs="y")
    time_s = np.arange(samples) * PERIOD_S

    def run() -> Numbers:
        found = control.input_output_response(loop, time_s, np.full(samples, LEVEL))
        return np.asarray(found.outputs)

    return run


def processor_s(*jobs: Callable[[], object], rounds: int) -> list[float]:
    """Median processor seconds of each job; the jobs take turns."""

    def spent(job: Callable[[], object]) -> float:
        start = time.process_time()
        job()
        return time.process_time() - start

    for job in jobs:
        job()
    times = [[spent(job) for job in jobs] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]


def jax_row() -> Row:
    """In its own process, bound to one core, where haselab is timed again."""
    what = "  jax, scan x vmap, one core"
    if importlib.util.find_spec("jax") is None:
        return Row(f"{what}: not installed", float("nan"), UNIT)
    command = [sys.executable, "-m", "benchmarks.control.many_loops_jax"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=CHECKOUT)
    result = json.loads(done.stdout)
    note = (
        f"ours / this {result['jax_s'] / result['ours_s']:.1f}, compiled before; single precision"
    )
    return Row(what, SIMULATED_S / result["jax_s"], UNIT, note=note)


def rows() -> list[Row]:
    c = coefficients()
    runs: list[Callable[[], object]] = [ours(), ours(0.012), one_by_one()]
    runs += [ours(noise=WhiteNoise(1e-4)), traces()]
    slower = [numpy_vectorised(c, SAMPLES // 10), python_control(c, 500)]
    has_numba = importlib.util.find_spec("numba") is not None
    if has_numba:
        runs.append(numba_scalar(c))
    ours_s, late_s, single_s, noisy_s, traced_s, *numba_s = processor_s(*runs, rounds=5)
    numpy_s, control_s = processor_s(*slower, rounds=3)
    one_thread_s, two_threads_s = medians(ours(), ours(threads=2))
    differing = int((one_by_one(0)() != one_by_one(512)()).sum())

    def compared(what: str, simulated_s: float, took_s: float, note: str = "") -> Row:
        ratio = f"ours / this {took_s / simulated_s * SIMULATED_S / ours_s:.3g}"
        return Row(what, simulated_s / took_s, UNIT, note=f"{ratio}{note}")

    two_note = f"1 thread {SIMULATED_S / one_thread_s:.3g}"
    table = [
        Row("1,000 saturated loops of 20 s at 1 kHz", SIMULATED_S / ours_s, UNIT, 6e5),
        Row("  each with 0 to 12 ms of delay", SIMULATED_S / late_s, UNIT, 6e5),
        Row("  with noise made for each measurement", SIMULATED_S / noisy_s, UNIT),
        Row("  every sample kept, 80 MB each of u and y", SIMULATED_S / traced_s, UNIT),
        Row("  2 threads, wall time", SIMULATED_S / two_threads_s, "sim s / s", note=two_note),
        Row("  numbers that differ from the loop in plain C", differing, "of 100000", 0.0, False),
        compared("  the loop in plain C, one by one", SIMULATED_S, single_s),
    ]
    if has_numba:
        off = np.abs(numba_scalar(c)() - ours()())[1:3].max() / LEVEL
        note = f", its extremes within {off:.1e} of the step"
        table.append(compared("  numba, one by one", SIMULATED_S, *numba_s, note))
    else:
        table.append(Row("  numba: not installed", float("nan"), UNIT))
    table.append(jax_row())
    table.append(compared("  numpy, all loops a step", SIMULATED_S / 10, numpy_s, ", from 2 s"))
    table.append(compared("  python-control, interconnect", 0.5, control_s, ", from 0.5 s of one"))
    return table
