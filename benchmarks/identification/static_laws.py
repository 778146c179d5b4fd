"""Static fits compared with scipy's curve_fit and smoothing spline, numpy's lstsq and pwlf.

The other libraries are given the model and, where stated, a good start; haselab is given neither.
"""

import importlib.util
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import OptimizeWarning, curve_fit

from benchmarks.rows import Row, medians
from haselab.identify import (
    ArxOrders,
    Record,
    find_regions,
    fit_arx,
    fit_hyperelastic,
    fit_map,
    fit_voltage_map,
)
from haselab.models import ArrudaBoyce, ArxModel, VoltageMap

__all__ = ["rows"]

Floats = NDArray[np.float64]
RUNS = 200
STRETCH = np.linspace(1.0, 3.5, 60)
CHAINS = ArrudaBoyce(15.6e3, 3.95)
EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
STRAIN = 0.051 - 0.096 * np.cos(2.0 * np.pi * np.arange(400) / 200.0)
KNOTS, LOADS = [1.0, 1.3, 2.1, 2.6, 3.0], [0.0, 2.0, 3.0, 5.0, 5.5]


def _least(runs: int) -> float:
    """Coverage of 95 % less three spreads of a binomial, in per cent, rounded down."""
    return float(np.floor(100.0 * (0.95 - 3.0 * np.sqrt(0.95 * 0.05 / runs))))


def _covered(inside: list[list[bool]]) -> float:
    """Smallest share of the intervals that contain the truth, over the numbers, in per cent."""
    return 100.0 * float(np.mean(inside, axis=0).min())


def _inside(estimates: list[tuple[float, float]], truth: list[float]) -> list[bool]:
    return [low <= t <= high for (low, high), t in zip(estimates, truth, strict=True)]


def hyperelastic_rows(runs: int) -> list[Row]:
    clean = CHAINS.nominal_stress_pa(STRETCH)
    noise = [300.0 * np.random.default_rng([1, k]).normal(size=60) for k in range(runs)]

    def stress(x: Floats, mu: float, limit: float) -> Floats:
        return ArrudaBoyce(mu, limit).nominal_stress_pa(x)

    def ours() -> object:
        return fit_hyperelastic(STRETCH, clean + noise[0], "arruda-boyce")

    def theirs() -> object:
        return curve_fit(stress, STRETCH, clean + noise[0], p0=(15e3, 4.0))

    our_s, their_s = medians(ours, theirs)
    inside = []
    for e in noise:
        found = fit_hyperelastic(STRETCH, clean + e, "arruda-boyce").best.parameters
        inside.append(_inside([found["mu_pa"].ci95, found["lambda_m"].ci95], [15.6e3, 3.95]))
    failed = 0
    for k in range(runs):
        start = np.exp(np.random.default_rng([2, k]).uniform(np.log([1e2, 1.5]), np.log([1e6, 50])))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", OptimizeWarning)
                got = curve_fit(stress, STRETCH, clean + noise[0], p0=start)[0]
            failed += not np.allclose(got, [15.6e3, 3.95], rtol=0.1)
        except (ValueError, RuntimeError, OptimizeWarning):
            failed += 1
    return [
        Row("Arruda-Boyce, least coverage of 2 intervals", _covered(inside), "%", _least(runs)),
        Row("  time, no start, with checks of its range", 1e3 * our_s, "ms",
            note=f"curve_fit from a good start {1e3 * their_s:.2g}"),
        Row("  curve_fit from starts over 4 decades, failed", 100.0 * failed / runs, "%",
            note="ours takes no start"),
    ]  # fmt: skip


def region_rows(runs: int) -> list[Row]:
    x = np.linspace(1.0, 3.0, 150)
    clean = np.interp(x, KNOTS, LOADS)
    inside, right = [], 0
    for k in range(runs):
        y = clean + 0.03 * np.random.default_rng([3, k]).normal(size=x.size)
        found = find_regions(x, y)
        right += len(found.regions) == 4
        if len(found.regions) == 4:
            ends = sorted((r.low for r in found.regions), key=lambda low: low.value)[1:]
            inside.append(_inside([end.ci95 for end in ends], KNOTS[1:-1]))
    y = clean + 0.03 * np.random.default_rng(4).normal(size=x.size)
    jobs: list[Callable[[], object]] = [lambda: find_regions(x, y, 4)]
    note, ratio = "pwlf is not installed", float("nan")
    if importlib.util.find_spec("pwlf") is not None:
        from pwlf import PiecewiseLinFit

        other = PiecewiseLinFit(x, y, seed=1)
        jobs.append(lambda: other.fit(4))
    times = medians(*jobs, rounds=3)
    if len(times) > 1:
        (left,) = find_regions(x, y, 4).residuals
        cost = float(left @ left)
        ratio = cost / other.ssr
        note = f"pwlf {1e3 * times[1]:.3g}; cost ours / pwlf {ratio:.6f}"
    return [
        Row("linear regions, 4 segments chosen by BIC", 100.0 * right / runs, "%", 90.0),
        Row("  least coverage of 3 break points", _covered(inside), "%", _least(runs),
            note=f"of {len(inside)} runs"),
        Row("  time, 4 segments of 150 samples", 1e3 * times[0], "ms", note=note),
    ]  # fmt: skip


def voltage_rows(runs: int) -> list[Row]:
    clean = EQ4.voltage_v(STRAIN)
    truth = [EQ4.a1_v, EQ4.b1, EQ4.a2_v, EQ4.b2]
    inside = []
    for k in range(runs):
        e = 0.01 * np.random.default_rng([5, k]).normal(size=STRAIN.size)
        found = fit_voltage_map(STRAIN, clean + e).parameters
        inside.append(_inside([found[name].ci95 for name in ("a1_v", "b1", "a2_v", "b2")], truth))
    y = clean + 0.01 * np.random.default_rng(6).normal(size=STRAIN.size)

    def curve(x: Floats, a1: float, b1: float, a2: float, b2: float) -> Floats:
        return a1 * np.exp(b1 * x) + a2 * np.exp(b2 * x)

    def theirs() -> object:
        return curve_fit(curve, STRAIN, y, p0=truth)

    our_s, their_s = medians(lambda: fit_voltage_map(STRAIN, y), theirs)
    least = float(((y - fit_voltage_map(STRAIN, y).map.voltage_v(STRAIN)) ** 2).sum())
    lost = 0
    for k in range(runs):
        start = np.random.default_rng([7, k]).uniform([-2, -30, -2, -30], [2, 30, 2, 30])
        try:
            with np.errstate(over="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore", OptimizeWarning)
                got = curve_fit(curve, STRAIN, y, p0=start)[0]
            lost += float(((y - curve(STRAIN, *got)) ** 2).sum()) > 1.01 * least
        except RuntimeError:
            lost += 1
    return [
        Row("eq. 4, least coverage of 4 intervals", _covered(inside), "%", _least(runs)),
        Row("  time, global search", 1e3 * our_s, "ms",
            note=f"curve_fit from the truth {1e3 * their_s:.2g}"),
        Row("  curve_fit from random starts, not the minimum", 100.0 * lost / runs, "%",
            note="ours takes no start"),
    ]  # fmt: skip


def map_rows(runs: int) -> list[Row]:
    x = np.linspace(-0.045, 0.147, 400)
    at = np.linspace(-0.04, 0.14, 50)
    truth, inside, ours, theirs = EQ4.voltage_v(at), [], [], []
    for k in range(runs // 3):
        y = EQ4.voltage_v(x) + 0.02 * np.random.default_rng([8, k]).normal(size=x.size)
        fit = fit_map(x, y, monotone=True)
        off = fit.map.value(at) - truth
        inside.append(list(np.abs(off) <= 1.96 * fit.value_std(at)))
        ours.append(np.mean(off**2))
        # GCV of the natural spline; hundredths keep its matrices well conditioned.
        other = make_smoothing_spline(100.0 * x, y)
        theirs.append(np.mean((other(100.0 * at) - truth) ** 2))
    ratio = float(np.sqrt(np.mean(ours) / np.mean(theirs)))
    our_s, their_s = medians(
        lambda: fit_map(x, y, monotone=True),
        lambda: make_smoothing_spline(100.0 * x, y),
    )
    return [
        Row("monotone map, mean coverage over its curve", 100.0 * np.mean(inside), "%", 93.0),
        Row("  rms error against scipy's smoothing spline", ratio, "ratio", 1.1, False,
            "which is not monotone, has no interval"),
        Row("  time, 400 samples", 1e3 * our_s, "ms", note=f"scipy {1e3 * their_s:.2g}"),
    ]  # fmt: skip


def arx_rows(runs: int) -> list[Row]:
    model = ArxModel([-1.27374, 0.39355], [0.066618, 0.044482], 3, 12.5)
    truth = [*model.a, *model.b]
    inside = []
    for k in range(runs):
        u, e = np.random.default_rng([9, k]).normal(size=(2, 1000))
        noise = ArxModel(model.a, [0.03], 0, 12.5).simulate(e)
        fit = fit_arx(Record.sampled(u, model.simulate(u) + noise, 12.5), ArxOrders(2, 2, 3))
        inside.append(_inside([n.ci95 for n in (*fit.a, *fit.b)], truth))
    y = model.simulate(u) + noise

    def theirs() -> object:
        k = np.arange(4, y.size)
        return np.linalg.lstsq(
            np.column_stack([-y[k - 1], -y[k - 2], u[k - 3], u[k - 4]]), y[k], rcond=None
        )

    our_s, their_s = medians(
        lambda: fit_arx(Record.sampled(u, y, 12.5), ArxOrders(2, 2, 3)), theirs
    )
    return [
        Row("ARX, least coverage of 4 intervals", _covered(inside), "%", _least(runs)),
        Row("  time, with validation and whiteness", 1e3 * our_s, "ms",
            note=f"lstsq by hand, numbers alone {1e3 * their_s:.2g}"),
    ]  # fmt: skip


def rows(runs: int = RUNS) -> list[Row]:
    return [
        *hyperelastic_rows(runs),
        *region_rows(runs // 6),
        *voltage_rows(runs),
        *map_rows(runs),
        *arx_rows(runs),
    ]


if __name__ == "__main__":
    for row in rows():
        print(row)
