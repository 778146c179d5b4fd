"""The study's results once more from session.h5, without the product's fits and sensing.

What is used: h5py, numpy, scipy. Rows S6 to S18; test_recomputed_loops.py has S19 to S25. A
tolerance is either rounding (the same definition, other arithmetic) or stated beside the test.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import brentq
from scipy.signal import butter, sosfilt

Floats = NDArray[np.float64]
ROUNDING = 1e-6
GRAVITY = 9.81
ZOOMS = 30


class Triangle:
    """The triangle test: cycles, length at a voltage, both sensing methods."""

    def __init__(self, session: Any) -> None:
        seen, t = session.experiment("triangle"), session.study["triangle"]
        self.rig, self.codes, self.start, self.drive = seen.rig, seen.codes, seen.start, seen.drive
        self.time, self.length = seen.time, seen.length
        self.session, self.left_out = session, t["skipped_cycles"]
        period = 1.0 / t["frequency_hz"]
        self.half = 0.5 * period
        self.bounds = self.start[-1] + session.block_s - period * np.arange(t["cycles"], -1, -1)
        self.first = self.bounds[self.left_out]
        self.zero = self.length_at(session.value("S18.baseline"))
        self.strain = self.length / self.zero - 1.0

    def length_at(self, volt: float) -> float:
        """Straight lines through both edges within 60 mV of a voltage, their mean there."""
        s = self.session
        middle = self.start + s.late_s + 0.5 * s.block_s
        ramp = np.interp(self.time, middle, self.drive)
        phase = np.mod(self.time - s.late_s - self.bounds[0], 2.0 * self.half)
        counted = (self.time >= self.first) & (self.time <= self.bounds[-1])
        near = counted & (np.abs(ramp - volt) < 0.06)
        edges = (near & (phase < self.half), near & (phase >= self.half))
        return float(np.mean([np.polyfit(ramp[e] - volt, self.length[e], 1)[1] for e in edges]))

    @cached_property
    def lockin(self) -> dict[str, Floats]:
        """Least squares of cosine, sine, level and slope over a block's settled samples.

        The output has settled 2.5 ms after a block's start. The product counts whole segments of
        112 samples from there (ADR 7), the first of them at 2.8 ms.
        """
        rate, carrier = self.rig["rate_hz"], self.session.study["sensing"]["carrier_hz"]
        begin = 112 * math.ceil((self.session.late_s + 0.5e-3) * rate / 112)
        n = np.arange(begin, self.rig["block_samples"])
        turn = 2.0 * np.pi * carrier * n / rate
        basis = np.column_stack([np.cos(turn), np.sin(turn), np.ones(n.size), n - n.mean()])
        fit = np.linalg.pinv(basis)[:2]
        real, imag = np.einsum("kn,bnc->kbc", fit, self.codes[:, begin:, :].astype(float))
        phasors = real - 1j * imag
        found = self._numbers(phasors[:, 0], phasors[:, 1], 2.0 * np.abs(phasors))
        return found | {"time": self.start + n.mean() / rate}

    @cached_property
    def printed(self) -> dict[str, Floats]:
        """Low-pass, mean of the periods, peak to peak, angle between the fundamentals."""
        rate, carrier = self.rig["rate_hz"], self.session.study["sensing"]["carrier_hz"]
        sections = butter(4, 2001.0, fs=rate, output="sos")
        samples = round(rate / carrier)
        wave = np.exp(-2j * np.pi * np.arange(samples) / samples)
        passed = sosfilt(sections, self.codes[()].reshape(-1, 2).astype(float), axis=0)
        mean = passed.reshape(len(self.start), -1, samples, 2).mean(axis=1)
        v, i = (mean @ np.eye(2)[k] @ wave for k in range(2))
        return self._numbers(v, i, np.ptp(mean, axis=1))

    def _numbers(self, v: Any, i: Any, pp: Floats) -> dict[str, Floats]:
        """Phase at one instant, capacitance, and eqs. 2 and 3."""
        rig, sensing = self.rig, self.session.study["sensing"]
        omega = 2.0 * np.pi * sensing["carrier_hz"]
        phase = np.angle(i / v * np.exp(-1j * omega * rig["skew_s"]))
        ratio = pp[:, 0] / pp[:, 1]
        ohm = rig["i_monitor_v_per_a"] / rig["v_monitor_v_per_v"] * ratio * np.sin(phase)
        reactance = sensing["reactance_scale"] * np.abs(ratio * np.sin(np.abs(phase)))
        relative = 1.0 / (omega * sensing["capacitance_scale"] * reactance)
        return {"c": 1.0 / (omega * ohm), "phase": phase, "relative": relative, "v_pp": pp[:, 0]}

    @cached_property
    def counted(self) -> NDArray[np.bool_]:
        """Blocks of the cycles that count."""
        return np.asarray(self.lockin["time"] >= self.first)

    @cached_property
    def sensed_strain(self) -> Floats:
        """Of the camera, at the lock-in's times."""
        return np.interp(self.lockin["time"], self.time, self.strain)


@pytest.fixture(scope="module")
def triangle(recorded: Any) -> Triangle:
    return Triangle(recorded)


def test_printed_chain_and_lockin(recorded: Any, triangle: Triangle) -> None:
    """Up to a twentieth of the blocks have a model of their own in the product: see eq. 5 below.

    A mean over N blocks that scatter by s has the error s / sqrt(N). Two means that differ in a
    twentieth of the blocks differ by sqrt(1/20) of that.
    """
    seen = triangle
    keep, p, k = seen.counted, seen.printed, seen.lockin
    passed = p["v_pp"][keep] / k["v_pp"][keep]
    turned = np.abs(p["phase"][keep]) - np.abs(k["phase"][keep])
    ratio = p["c"][keep] / k["c"][keep] - 1.0
    rises = np.gradient(seen.drive[keep]) > 0.0
    for key, blocks in (
        ("S6.carrier_gain", passed),
        ("S8.phase", turned),
        ("S8.difference_rising", ratio[rises]),
        ("S8.difference_falling", ratio[~rises]),
    ):
        error = blocks.std(ddof=1) / math.sqrt(blocks.size)
        recorded.agrees(key, blocks.mean(), within=math.sqrt(1 / 20) * error)
    assert (
        recorded.value("S7.periods") == recorded.study["sensing"]["carrier_hz"] * recorded.block_s
    )


def test_cycles_repeat_and_drift(recorded: Any, triangle: Triangle) -> None:
    seen = triangle
    ends = np.interp(seen.bounds, seen.time, seen.strain)
    cycle = np.searchsorted(seen.bounds, seen.time, side="right")
    peaks = [seen.strain[cycle == k].max() for k in range(1, seen.bounds.size)]
    recorded.agrees("S13.residual_first", ends[1] - ends[0], within=ROUNDING)
    recorded.agrees("S13.peak_drift", peaks[-1] - peaks[seen.left_out], within=ROUNDING)
    recorded.agrees("S13.residual_drift", ends[-1] - ends[seen.left_out + 1], within=ROUNDING)


def test_eq_5_at_equal_times_from_the_turn(recorded: Any, triangle: Triangle) -> None:
    """Each cycle folded at its turn, the output's delay included, in steps of a block.

    The sheet swings after a turn, and the carrier's size changes within a block: such blocks have
    models of their own in the product, or are refused, and with one the averages on both sides of
    it. What any two neighbouring averages do to the line is the tolerance.
    """
    seen = triangle
    after = (np.arange(round(seen.half / recorded.block_s)) + 0.5) * recorded.block_s
    folded = []
    for begin in seen.bounds[seen.left_out : -1] + recorded.late_s:
        times = (begin + after, begin + 2.0 * seen.half - after)
        folded.append(
            [
                np.mean([np.interp(at, seen.lockin["time"], values) for at in times], axis=0)
                for values in (seen.lockin["relative"], seen.sensed_strain)
            ]
        )
    c, e = np.concatenate(folded, axis=1)
    slope, offset = np.polyfit(c, e, 1)
    without = [
        np.polyfit(np.delete(c, slice(k, k + 2)), np.delete(e, slice(k, k + 2)), 1)
        for k in range(c.size - 1)
    ]
    moved = np.abs(np.array(without) - (slope, offset)).max(axis=0)
    recorded.agrees("S15.slope", slope, within=moved[0])
    recorded.agrees("S15.offset", offset, within=moved[1])


def test_eq_5_at_equal_strain(recorded: Any, triangle: Triangle) -> None:
    """Means of both edges over cells of equal strain; an edge ends where the strain turns.

    The product makes 40 cells. What 38 to 42 of them differ by is the tolerance.
    """
    seen = triangle
    c, e = seen.lockin["relative"][seen.counted], seen.sensed_strain[seen.counted]
    cycles = len(seen.bounds) - 1 - seen.left_out
    tops = [part[e[part].argmax()] for part in np.array_split(np.arange(e.size), cycles)]
    bounds = itertools.pairwise([0, *tops, e.size])
    turns = np.sort([*tops, *(low + e[low:high].argmin() for low, high in bounds)])
    rising = np.searchsorted(turns, np.arange(e.size)) % 2 == 1
    lines = {}
    for count in range(38, 43):
        cell = np.digitize(e, np.linspace(e.min(), e.max(), count + 1)[1:-1])
        edges = [[(cell == k) & way for way in (rising, ~rising)] for k in range(count)]
        rows = [
            np.mean([(c[part].mean(), e[part].mean()) for part in pair], axis=0)
            for pair in edges
            if all(part.any() for part in pair)
        ]
        lines[count] = np.polyfit(*np.transpose(rows), 1)
    slope, offset = lines[40]
    spread = np.ptp(list(lines.values()), axis=0)
    recorded.agrees("S15.slope_at_strain", slope, within=spread[0])
    recorded.agrees("S15.offset_at_strain", offset, within=spread[1])


def sums_left(x: Floats, y: Floats, breaks: Floats) -> Floats:
    """Sums of squares that continuous broken lines leave, for each row of break points."""
    kinks = np.maximum(x[None, :, None] - breaks[:, None, :], 0.0)
    line = np.stack([np.ones_like(x), x - x.mean()], axis=1)
    basis = np.concatenate([np.broadcast_to(line, (len(breaks), *line.shape)), kinks], axis=2)
    q = np.linalg.qr(basis)[0]
    return np.asarray(y @ y - (np.einsum("bnk,n->bk", q, y) ** 2).sum(axis=1))


def grid_of(gaps: list[Floats]) -> Floats:
    """All combinations of places, one row each."""
    return np.array(list(itertools.product(*gaps))).reshape(-1, len(gaps))


def best_line(x: Floats, y: Floats, pieces: int) -> tuple[float, Floats]:
    """Break points by brute force: every split into three samples or more, places on a grid.

    Between two samples each break point takes each of five places; the best five are zoomed in on.
    """
    if pieces == 1:
        return float(sums_left(x, y, np.empty((1, 0)))[0]), np.empty(0)
    found = []
    for split in itertools.combinations(range(3, x.size - 2), pieces - 1):
        if (np.diff([0, *split, x.size]) >= 3).all():
            breaks = grid_of([np.linspace(x[k - 1], x[k], 5) for k in split])
            left = sums_left(x, y, breaks)
            found.append((float(left.min()), split, breaks[left.argmin()]))
    refined = []
    for _, split, at in sorted(found, key=lambda item: item[0])[:5]:
        low, high = x[np.array(split) - 1], x[np.array(split)]
        width = (high - low) / 4.0
        for _ in range(ZOOMS):
            steps = np.linspace(-width, width, 5)
            breaks = grid_of(list(np.clip(at + steps, low, high).T))
            left = sums_left(x, y, breaks)
            at, width = breaks[left.argmin()], 0.7 * width
        refined.append((float(left.min()), at))
    return min(refined, key=lambda item: item[0])


def test_longest_linear_region_and_operating_point(recorded: Any, triangle: Triangle) -> None:
    """The same least squares, found by brute force: break points agree to the search's end.

    The product's search ends at a millionth of the range of stretch, the grid at 0.7**30 of a gap:
    together less than 1e-5. Half the region is a quarter: 1e-4 of it.
    """
    static = recorded.experiment("static")
    masses = np.unique(static.mass)
    lengths = np.array([static.length[static.mass == m].mean() for m in masses])
    x, y = lengths / lengths[0], GRAVITY * masses
    tried = {pieces: best_line(x, y, pieces) for pieces in range(1, 7)}
    bic = {
        p: x.size * math.log(cost / x.size) + 2 * p * math.log(x.size)
        for p, (cost, _) in tried.items()
    }
    chosen = min(bic, key=lambda p: bic[p])
    ends = np.concatenate([[x[0]], tried[chosen][1], [x[-1]]])
    k = int(np.argmax(np.diff(ends)))
    low, high = ends[k], ends[k + 1]
    recorded.agrees("S17.region_low", low, within=1e-5)
    recorded.agrees("S17.region_high", high, within=1e-5)
    # The stretch at rest rises with the voltage by a smooth curve: a cubic spline here, one of
    # monotone pieces there. A baseline is set to 10 mV.
    holds = recorded.trials("hold")
    volt = np.array([held.drive[-1] for held in holds])
    stretch = np.array([held.length.mean() for held in holds]) / lengths[0]
    curve, centre, half = CubicSpline(volt, stretch), 0.5 * (low + high), 0.5 * (high - low)
    exact = brentq(lambda v: float(curve(v)) - centre, volt[0], volt[-1])
    between = np.linspace(volt[0], volt[-1], 401)
    apart = np.abs(curve(between) - PchipInterpolator(volt, stretch)(between)).max()
    recorded.agrees("S18.baseline", exact, within=0.5e-2 + apart / float(curve(exact, 1)))
    off = (float(curve(recorded.value("S18.baseline"))) - centre) / half
    recorded.agrees("S18.centre_offset", off, within=apart / half + 1e-4)
    seen = triangle
    known = tomllib.loads((recorded.folder / "actuator.toml").read_text())
    zero_m = known["actuator"]["geometry"]["zero_length_m"]
    assert seen.zero == pytest.approx(zero_m, rel=ROUNDING)
    recorded.agrees("S18.strain_min", seen.strain[seen.time >= seen.first].min(), within=ROUNDING)
    recorded.agrees("S18.strain_max", seen.strain[seen.time >= seen.first].max(), within=ROUNDING)
