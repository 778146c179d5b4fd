"""Random plants: wrong fits with status "ok", coverage of the intervals, errors over the bound.

    python -m benchmarks.identification.random_plants [--plants 1000] [--first 0] [--list]

Plants have 1 to 6 poles and a delay of up to 3 periods of their slowest pole; five excitations; 10
to 40 dB. The data come from recursions of scipy, not from the code under test.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, max_len_seq

from benchmarks.rows import Row, goal_of
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferFit, TransferStructure, fit_transfer

Floats = NDArray[np.float64]
PLANTS = 200
EXCITATIONS = ("prbs", "chirp", "multisine", "steps", "noise")
WRONG = 5.0  # stated standard deviations
SAMPLES_A_PERIOD = 24  # of the fastest pole, or more


@dataclass(frozen=True)
class Case:
    """One random plant, its record without noise, and the noise."""

    number: int
    poles: NDArray[np.complex128]
    zeros: NDArray[np.complex128]
    gain: float
    delay_s: float
    rate_hz: float
    excitation: str
    snr_db: float
    u: Floats
    clean: Floats
    y: Floats
    std: float

    @property
    def structure(self) -> TransferStructure:
        return TransferStructure(poles=self.poles.size, zeros=self.zeros.size)

    def truth(self) -> dict[str, float]:
        """Numbers by name, pairs in order of frequency."""
        upper = sorted((p for p in self.poles if p.imag > 0.0), key=abs)
        numbers = {"gain": self.gain, "delay_s": self.delay_s}
        for i, p in enumerate(upper):
            mark = "" if i == 0 else f"_{i + 1}"
            numbers[f"natural_frequency{mark}_rad_s"] = float(abs(p))
            numbers[f"damping_ratio{mark}"] = float(-p.real / abs(p))
        if len(self.poles) % 2:
            real = next(p for p in self.poles if p.imag == 0.0)
            numbers["time_constant_s"] = float(-1.0 / real.real)
        return numbers


def excitation(
    kind: str, count: int, rate_hz: float, top_hz: float, rng: np.random.Generator
) -> Floats:
    """Unit amplitude or unit rms, without content far above `top_hz`."""
    every = max(1, int(rate_hz / (2.5 * top_hz)))
    if kind == "prbs":
        bits = max_len_seq(12, state=rng.integers(0, 2, 12) | np.eye(12, dtype=int)[0])[0]
        return np.repeat(2.0 * np.resize(bits, -(-count // every)) - 1.0, every)[:count]
    if kind == "noise":
        return np.repeat(rng.normal(size=-(-count // every)), every)[:count]
    if kind == "steps":
        held = rng.integers(2 * every, 30 * every, size=count)
        return np.repeat(rng.uniform(-1.0, 1.0, size=count), held)[:count]
    t = np.arange(count) / rate_hz
    if kind == "chirp":
        low = 2.0 / t[-1]
        return np.sin(2 * np.pi * (low * t + 0.5 * (top_hz - low) * t * t / t[-1]))
    lines = np.unique(np.rint(np.geomspace(2, top_hz * t[-1], 30)))
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    wave = np.sin(2 * np.pi * lines[:, None] * t / t[-1] + phases[:, None]).sum(axis=0)
    return np.asarray(wave / np.sqrt(np.mean(wave**2)))


def response(
    poles: NDArray[np.complex128],
    zeros: NDArray[np.complex128],
    gain: float,
    delay_s: float,
    u: Floats,
    rate_hz: float,
) -> Floats:
    """Output of the held input from rest: each pole's recursion is exact for a held input."""
    scale = gain * np.prod(-poles) / np.prod(-zeros)
    period_s = 1.0 / rate_hz
    whole = int(np.floor(delay_s * rate_hz))
    late_s = delay_s - whole * period_s
    total = np.zeros(u.size + whole + 1, complex)
    now = np.concatenate([np.zeros(whole), u, [0.0]])
    before = np.concatenate([[0.0], now[:-1]])
    for i, p in enumerate(poles):
        others = np.delete(poles, i)
        residue = scale * np.prod(p - zeros) / np.prod(p - others)
        early = np.expm1(p * (period_s - late_s)) / p
        old = np.exp(p * period_s) * -np.expm1(-p * late_s) / p
        driven = early * now + old * before
        total += residue * lfilter([0.0, 1.0], [1.0, -np.exp(p * period_s)], driven)
    return np.asarray(total[: u.size].real)


def case(number: int, orders: tuple[int, ...] = (1, 2, 3, 4, 5, 6), zeros: int = 0) -> Case:
    rng = np.random.default_rng([13, number])
    order = orders[number % len(orders)]
    kind = EXCITATIONS[(number // len(orders)) % len(EXCITATIONS)]
    size = np.exp(rng.uniform(np.log(0.5), np.log(30.0)))
    poles: list[complex] = []
    omega = size
    for _ in range(order // 2):
        zeta = np.exp(rng.uniform(np.log(0.03), np.log(0.8)))
        root = omega * complex(-zeta, np.sqrt(1.0 - zeta * zeta))
        poles += [root, root.conjugate()]
        omega *= rng.uniform(1.4, 2.5)
    if order % 2:
        poles.append(complex(-size * np.exp(rng.uniform(-0.7, 0.7))))
    p = np.array(poles)
    slowest_s = 2 * np.pi / np.abs(p).min()
    rate_hz = np.abs(p).max() / (2 * np.pi) * rng.uniform(SAMPLES_A_PERIOD, 2 * SAMPLES_A_PERIOD)
    count = int(min(max(2000, 30 * slowest_s * rate_hz), 8000))
    delay_s = rng.uniform(0.0, 3.0) * slowest_s
    gain = float(rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(-3.0, 3.0)))
    top_hz = 2.0 * float(np.abs(p).max()) / (2 * np.pi)
    u = excitation(kind, count, rate_hz, top_hz, rng)
    z = np.zeros(0, complex)
    clean = response(p, z, gain, delay_s, u, rate_hz)
    snr_db = rng.uniform(10.0, 40.0)
    std = float(np.sqrt(np.mean((clean - clean.mean()) ** 2))) * 10 ** (-snr_db / 20)
    y = clean + std * rng.normal(size=count)
    return Case(number, p, z, gain, delay_s, rate_hz, kind, snr_db, u, clean, y, std)


@dataclass
class Tally:
    statuses: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)
    over_bound: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    not_identifiable: int = 0

    def add(self, one: Case, fit: TransferFit, spent: float) -> None:
        self.statuses[fit.status.split(":")[0]] += 1
        self.seconds.append(spent)
        if not fit.succeeded:
            return
        bounds = bound(one)
        truth = one.truth()
        for name, value in truth.items():
            estimate = fit.parameters[name]
            if not np.isfinite(estimate.std):
                self.not_identifiable += 1
                continue
            scale = estimate.std / max(abs(estimate.value), 1e-300)
            logarithmic = name not in ("gain", "delay_s") and estimate.value > 0
            off = (
                np.log(value / estimate.value) / scale
                if logarithmic
                else ((value - estimate.value) / estimate.std)
            )
            if abs(off) > WRONG:
                self.wrong.append(
                    f"{one.number} {len(one.poles)} poles {one.excitation} {one.snr_db:.0f} dB "
                    f"delay {one.delay_s:.3g}: {name} "
                    f"{estimate.value:.5g} +- {estimate.std:.2g}, true {value:.5g}"
                )
            self.inside.append(bool(estimate.ci95[0] <= value <= estimate.ci95[1]))
            if bounds[name] < 0.3 * (abs(value) if name != "delay_s" else np.inf):
                self.over_bound.append((estimate.value - value) / bounds[name])


def bound(one: Case) -> dict[str, float]:
    """Cramer-Rao bounds by differences, offset and initial state unknown."""
    truth = one.truth()
    names = list(truth)
    base = np.array([truth[name] for name in names])

    def output(x: Floats) -> Floats:
        numbers = dict(zip(names, x, strict=True))
        poles: list[complex] = []
        for i in range(len(one.poles) // 2):
            mark = "" if i == 0 else f"_{i + 1}"
            omega, zeta = numbers[f"natural_frequency{mark}_rad_s"], numbers[f"damping_ratio{mark}"]
            root = omega * complex(-zeta, np.sqrt(1.0 - zeta * zeta))
            poles += [root, root.conjugate()]
        if len(one.poles) % 2:
            poles.append(complex(-1.0 / numbers["time_constant_s"]))
        return response(
            np.array(poles), one.zeros, numbers["gain"], numbers["delay_s"], one.u, one.rate_hz
        )

    columns = []
    for i in range(base.size):
        step = 1e-5 * (abs(base[i]) if names[i] != "delay_s" else 1.0 / np.abs(one.poles).max())
        up, down = base.copy(), base.copy()
        up[i], down[i] = up[i] + step, down[i] - step
        columns.append((output(up) - output(down)) / (2 * step))
    t = np.arange(one.u.size) / one.rate_hz
    own = [np.ones(t.size)]
    for p in one.poles:
        if p.imag >= 0.0:
            own.append(np.exp(p.real * t) * np.cos(p.imag * t))
        if p.imag > 0.0:
            own.append(np.exp(p.real * t) * np.sin(p.imag * t))
    basis = np.linalg.qr(np.array(own).T)[0]
    z = np.array(columns).T
    z -= basis @ (basis.T @ z)
    scale = np.linalg.norm(z, axis=0)
    inverse = np.linalg.pinv((z / scale).T @ (z / scale), rcond=1e-14)
    return dict(zip(names, (one.std * np.sqrt(np.diag(inverse)) / scale).tolist(), strict=True))


def board(first: int, plants: int) -> Tally:
    tally = Tally()
    for number in range(first, first + plants):
        one = case(number)
        start = time.perf_counter()
        fit = fit_transfer([Record.sampled(one.u, one.y, one.rate_hz)], one.structure)
        tally.add(one, fit, time.perf_counter() - start)
    return tally


def rows(plants: int = PLANTS, first: int = 0, listed: bool = False) -> Iterator[Row]:
    tally = board(first, plants)
    if listed:
        print("\n".join(tally.wrong))
    errors = np.array(tally.over_bound)
    statuses = ", ".join(f"{n} {status}" for status, n in tally.statuses.most_common())
    count = len({line.split()[0] for line in tally.wrong})
    yield Row("random plants: wrong with ok", count, f"of {plants}", 0.0, False, statuses)
    cover = 100.0 * float(np.mean(tally.inside))
    yield Row(
        "random plants: least coverage",
        cover,
        "%",
        goal_of(93.0, 95.0, plants),
        True,
        f"{tally.not_identifiable} not identifiable",
    )
    yield Row("random plants: largest coverage", cover, "%", goal_of(97.0, 95.0, plants), False)
    rms = float(np.sqrt(np.mean(errors**2)))
    yield Row("random plants: rms error / bound", rms, "", goal_of(1.05, 1.0, plants), False)
    each = np.array(tally.seconds)
    note = f"slowest {each.max():.2g}"
    yield Row("random plants: median time of a fit", 1e3 * float(np.median(each)), "ms", note=note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=PLANTS)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="list what is wrong")
    options = parser.parse_args()
    for row in rows(options.plants, options.first, options.list):
        print(row, flush=True)


if __name__ == "__main__":
    main()
