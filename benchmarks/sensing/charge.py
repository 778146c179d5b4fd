"""Records without a carrier: is each capacitance right within its deviation, or refused?

    python -m benchmarks.sensing.charge [--seeds 10] [--only TEXT]

Simulated records of both monitors, by a fine integration of `i = d(C v)/dt + G v + i0` that does
not share a line with `haselab.sensing.charge.estimate`. The truth of a block is the mean of C
with the weight v^2, which is what the method states.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from haselab.sensing import Charge, ChargeConfig

FAR = 5.0  # stated deviations
MOST_FAR = 1e-3  # share of the valid blocks
STATED = (0.8, 1.25)
REFUSED = 0.5  # share of valid blocks below which a case counts as refused
OHM = 2.5e6
CAPACITANCE_F = 1e-9
FINE_HZ = 16000.0  # steps of the simulation, at least 8 per sample

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """One kind of record; voltages and currents as readings, in V.

    `must` is "valid", "refused" or "" where both are accepted; `words` name a refusal.
    """

    name: str
    drive: Callable[[Floats, np.random.Generator], Floats]
    must: str = "valid"
    words: tuple[str, ...] = ()
    check_std: bool = True  # stated over true deviation must lie in STATED
    rate_hz: float = 1000.0
    duration_s: float = 40.0
    block_s: float = 0.5
    nonlinear: float = 0.0  # C grows by this share at 2 V
    hysteresis: float = 0.0
    leakage: float = 0.0  # current over voltage, both as readings
    offset: float = 3e-3
    drift: float = 0.0  # of the offset over the record
    wander: float = 0.0  # of the offset: random walk, at the record's end
    hum: float = 0.0
    v_noise: float = 1e-3
    i_noise: float = 1e-3
    lsb: float = 0.0
    clip: float = float("inf")
    skew_s: float = 0.0
    stated_skew_s: float | None = None
    burst: float = 0.0
    pointwise: bool = False  # samples are no means over their own duration
    series_s: float = 0.0  # R C of a resistance in series
    sign: float = 1.0

    def record(self, seed: int) -> tuple[Floats, Floats, Floats]:
        """Both monitors and the truth in F a block."""
        rng = np.random.default_rng(seed)
        count = round(self.duration_s * self.rate_hz)
        fine = max(8, round(FINE_HZ / self.rate_hz))
        fine_s = (np.arange(-fine, (count + 1) * fine) + 0.5) / (fine * self.rate_hz)
        v = self.drive(fine_s, rng)
        share = 1.0 + self.nonlinear * (v / 2.0) ** 2
        if self.hysteresis:
            share *= 1.0 + self.hysteresis * np.tanh(_lagged(v, fine_s))
        time_s = np.arange(count) / self.rate_hz + 0.5 / self.rate_hz
        late_s = time_s + self.skew_s
        # Both monitors are limited in band: each sample is the mean over its own duration.
        charge = OHM * CAPACITANCE_F * share * _behind(v, self.series_s, fine_s)
        half = (0.5 / fine if self.pointwise else 0.5) / self.rate_hz
        i = np.interp(late_s + half, fine_s, charge) - np.interp(late_s - half, fine_s, charge)
        i = i / (2.0 * half) + self.leakage * np.interp(late_s, fine_s, v)
        area = (np.cumsum(v) - 0.5 * v) / (fine * self.rate_hz)
        vv = np.interp(time_s + half, fine_s, area) - np.interp(time_s - half, fine_s, area)
        vv /= 2.0 * half
        i = self.sign * i + self.offset + self.drift * time_s / self.duration_s
        i += self.wander * np.cumsum(rng.standard_normal(count)) / count**0.5
        i += self.hum * np.sin(2 * np.pi * 50 * time_s + rng.uniform(0, 6))
        vv = vv + self.v_noise * rng.standard_normal(count)
        i = i + self.i_noise * rng.standard_normal(count)
        if self.burst:
            at = rng.integers(count // 4, count // 2)
            i[at : at + round(0.05 * self.rate_hz)] += self.burst
        if self.lsb:
            vv, i = (self.lsb * np.round(x / self.lsb) for x in (vv, i))
        vv, i = (np.clip(x, -self.clip, self.clip) for x in (vv, i))
        return vv, i, self._truth(time_s, fine_s, v, share)

    def _truth(self, time_s: Floats, fine_s: Floats, v: Floats, share: Floats) -> Floats:
        length = round(self.block_s * self.rate_hz)
        blocks = time_s.size // length
        at = time_s[: blocks * length].reshape(blocks, length)
        square = np.interp(at, fine_s, v) ** 2
        c = np.interp(at, fine_s, share)
        with np.errstate(invalid="ignore", divide="ignore"):
            return CAPACITANCE_F * (square * c).sum(axis=1) / square.sum(axis=1)

    def config(self) -> ChargeConfig:
        skew_s = self.skew_s if self.stated_skew_s is None else self.stated_skew_s
        return ChargeConfig(
            self.rate_hz, round(self.block_s * self.rate_hz), OHM, skew_s, full_scale=self.clip
        )


def _behind(v: Floats, series_s: float, time_s: Floats) -> Floats:
    """Voltage of a capacitor behind a resistance: an exponential lag."""
    if not series_s:
        return v
    share = 1.0 - np.exp(-(time_s[1] - time_s[0]) / series_s)
    return signal.lfilter([share], [1.0, share - 1.0], v, zi=[(1.0 - share) * v[0]])[0]


def _lagged(v: Floats, time_s: Floats) -> Floats:
    """A direction that follows the drive's slope: up 1, down -1, with a lag."""
    slope = np.gradient(v, time_s)
    kernel = np.ones(max(1, round(0.02 / (time_s[1] - time_s[0]))))
    smooth = np.convolve(slope, kernel / kernel.size, "same")
    return 3.0 * smooth / (np.abs(smooth).max() + 1e-300)


def triangle(hz: float, low: float = 0.0, high: float = 2.0) -> Callable[..., Floats]:
    def drive(time_s: Floats, rng: np.random.Generator) -> Floats:
        turn = (time_s * hz * (1.0 + 0.01 * rng.random()) + rng.random()) % 1.0
        return low + (high - low) * (1.0 - np.abs(2.0 * turn - 1.0))

    return drive


def sine(hz: float, peak: float = 2.0, bias: float = 0.0) -> Callable[..., Floats]:
    def drive(time_s: Floats, rng: np.random.Generator) -> Floats:
        return bias + peak * np.sin(2 * np.pi * hz * time_s + rng.uniform(0, 6.28))

    return drive


def holds(rise_s: float, hold_s: float, peak: float = 2.0) -> Callable[..., Floats]:
    """0 V, ramp up, hold, ramp down, again and again."""

    def drive(time_s: Floats, rng: np.random.Generator) -> Floats:
        knots = np.cumsum([0.0, hold_s, rise_s, hold_s, rise_s])
        at = (time_s + rng.uniform(0, knots[-1])) % knots[-1]
        return np.interp(at, knots, [0.0, 0.0, peak, peak, 0.0])

    return drive


def steps(tau_s: float, hold_s: float, peak: float = 2.0) -> Callable[..., Floats]:
    """Between 0 V and the peak, each time as an exponential."""

    def drive(time_s: Floats, rng: np.random.Generator) -> Floats:
        phase = time_s + rng.uniform(0, 2 * hold_s)
        at, up = phase % hold_s, (phase // hold_s) % 2 == 0
        tail = np.exp(-at / tau_s) if tau_s else np.zeros(at.size)
        return peak * np.where(up, 1.0 - tail, tail)

    return drive


def ramp(time_s: Floats, rng: np.random.Generator) -> Floats:
    return 0.05 * time_s + 0.05 * rng.random()


def still(time_s: Floats, rng: np.random.Generator) -> Floats:
    return 0.0 * time_s


T1 = triangle(0.5)
CASES = [
    Case("triangle 0.5 Hz", T1),
    Case("triangle 0.1 Hz", triangle(0.1)),
    Case("triangle 2 Hz", triangle(2.0)),
    Case("triangle bipolar 0.5 Hz", triangle(0.5, -2.0, 2.0)),
    Case("triangle, C +30 % with v^2", T1, nonlinear=0.3),
    Case("bipolar, C +30 % with v^2", triangle(0.5, -2.0, 2.0), nonlinear=0.3),
    Case("triangle, hysteresis of 3 %", T1, nonlinear=0.3, hysteresis=0.03, check_std=False),
    Case("triangle, leakage", T1, leakage=2e-4, check_std=False),
    Case("bipolar, leakage", triangle(0.5, -2.0, 2.0), leakage=2e-4),
    Case("ramps with holds", holds(1.0, 1.0)),
    Case("ramps with holds, leakage", holds(1.0, 1.0), leakage=2e-4),
    Case("ramps with holds, C(v^2), leakage", holds(1.0, 1.0), leakage=2e-4, nonlinear=0.3),
    Case("ramps with holds, hysteresis", holds(1.0, 1.0), hysteresis=0.03, nonlinear=0.3),
    *(Case(f"sine {hz:g} Hz", sine(hz), duration_s=max(40.0, 3 / hz)) for hz in (0.05, 0.3, 1, 5)),
    Case("sine 20 Hz", sine(20.0)),
    Case("sine 20 Hz at 200 Hz", sine(20.0), rate_hz=200.0),
    Case("sine 5 Hz, C +30 % with v^2", sine(5.0), nonlinear=0.3),
    Case("sine 1 Hz biased to 0", sine(1.0, 1.0, 1.0), nonlinear=0.3),
    Case("steps of 50 ms", steps(0.05, 1.0), nonlinear=0.3),
    Case("steps of 10 ms", steps(0.01, 1.0), nonlinear=0.3),
    Case("steps of 3 ms", steps(0.003, 1.0), "", ("steps",), check_std=False),
    Case("steps between two samples", steps(0.0, 1.0), "", ("steps",), check_std=False),
    Case("rate 200 Hz", T1, rate_hz=200.0),
    Case("rate 10 kHz", T1, rate_hz=1e4),
    Case("rate 200 kHz", T1, rate_hz=2e5, duration_s=6.0),
    Case("blocks of 50 ms", T1, block_s=0.05),
    Case("blocks of 5 s", T1, block_s=5.0),
    Case("noise of current 10 mV", T1, i_noise=1e-2),
    Case("noise of current 100 mV", T1, "", ("hardly",), i_noise=1e-1),
    Case("noise of voltage 10 mV", T1, v_noise=1e-2),
    Case("noise of voltage 50 mV", T1, v_noise=5e-2),
    Case("noise of both 0.1 mV", T1, v_noise=1e-4, i_noise=1e-4),
    Case("noise of both 10 uV, C(v^2)", T1, v_noise=1e-5, i_noise=1e-5, nonlinear=0.3),
    Case("12 bit of 10 V", T1, "", ("coarse",), lsb=20 / 4096, v_noise=1e-4, i_noise=1e-4),
    Case("12 bit, C(v^2)", T1, "", ("coarse",), lsb=20 / 4096, nonlinear=0.3, check_std=False),
    Case("12 bit, noise of 3 mV", T1, lsb=20 / 4096, v_noise=3e-3, i_noise=3e-3),
    Case("16 bit", T1, lsb=20 / 65536, v_noise=1e-4, i_noise=1e-4),
    Case("hum of 2 mV", T1, hum=2e-3),
    Case("hum of 50 mV", T1, hum=5e-2),
    Case("hum of 5 mV, sine 1 Hz", sine(1.0), hum=5e-3, nonlinear=0.3),
    Case("hum of 5 mV, holds", holds(1.0, 1.0), hum=5e-3),
    Case("offset of 50 mV", T1, offset=5e-2),
    Case("offset drifts by 10 mV", T1, drift=1e-2),
    Case("offset drifts by 10 mV, sine", sine(0.3), drift=1e-2),
    Case("offset wanders by 5 mV", T1, "", ("wanders", "offset"), wander=5e-3, check_std=False),
    Case("skew of 0.4 ms, stated", sine(5.0), skew_s=4e-4),
    Case("skew of -3.3 ms, stated", sine(5.0), skew_s=-3.3e-3),
    Case("skew of 0.4 ms, triangle", T1, skew_s=4e-4),
    Case("clipped", triangle(0.5, 0.0, 4.0), "", ("clipped", "separable"), clip=3.9,
         check_std=False),
    Case("burst on the current", T1, "", ("close",), burst=0.3, check_std=False),
    Case("samples without a band", T1, pointwise=True),
    Case("the same, little noise", T1, pointwise=True, v_noise=1e-5, i_noise=1e-5, check_std=False),
    Case("the same, 2 Hz at 200 Hz", triangle(2.0), pointwise=True, rate_hz=200.0, check_std=False),
    Case("RC of 0.1 ms", T1, series_s=1e-4),
    Case("RC of 3 ms", T1, series_s=3e-3, check_std=False),
    Case("never at 0 V", triangle(0.5, 1.0, 2.0), "refused", ("pass 0 V",)),
    Case("biased sine, never at 0 V", sine(1.0, 0.5, 1.0), "refused", ("pass 0 V",), nonlinear=0.3),
    Case("one slope throughout", ramp, "refused", ("not separable", "pass 0 V")),
    Case("no drive", still, "refused", ("hardly",)),
    Case("current not connected", T1, "refused", ("hardly",), sign=0.0),
    Case("current inverted", T1, "refused", ("inverted",), sign=-1.0),
]  # fmt: skip


@dataclass(frozen=True)
class Line:
    """One case, over all its seeds."""

    case: Case
    std: float
    error: float
    valid: float
    far: float
    message: str
    named: bool

    @property
    def stated(self) -> float:
        return self.std / self.error if self.error else float("nan")

    @property
    def marks(self) -> str:
        case = self.case
        refused = self.valid < REFUSED
        wrong = (case.must == "valid" and refused) or (case.must == "refused" and self.valid > 0.0)
        miscalibrated = case.check_std and not refused and not STATED[0] <= self.stated <= STATED[1]
        marks = (
            ("F", self.far > MOST_FAR),
            ("S", miscalibrated),
            ("V", wrong),
            ("N", not self.named),
        )
        return "".join(mark for mark, bad in marks if bad)

    def __str__(self) -> str:
        return (
            f"{self.case.name:36s}{100 * self.error:8.3f}{100 * self.std:8.3f}{self.stated:8.2f}"
            f"{100 * self.valid:7.1f}{100 * self.far:7.2f}  {self.marks:4s} {self.message}"
        )


HEAD = (
    f"{'case':36s}{'rms %':>8s}{'std %':>8s}{'stated':>8s}{'valid%':>7s}{'>5s %':>7s}  "
    "F far off, S stated, V valid or not, N cause not named"
)


def evaluate(case: Case, seeds: int) -> Line:
    """Sense a case with each seed and compare with the truth."""
    errors, stds, valid = [], [], []
    messages: Counter[str] = Counter()
    for seed in range(seeds):
        v, i, truth_f = case.record(seed)
        used = truth_f.size * case.config().block_samples
        sensed = Charge(case.config()).sense_channels(v[:used], i[:used])
        errors.append(sensed.capacitance_f / truth_f - 1.0)
        stds.append(sensed.capacitance_std_f / truth_f)
        valid.append(sensed.valid)
        messages.update(text_of(sensed, k) for k in range(truth_f.size))
    error, std, ok = np.concatenate(errors), np.concatenate(stds), np.concatenate(valid)
    messages.pop("", None)
    refused = {text: n for text, n in messages.items() if text.startswith("not valid")}
    named = all(
        any(word in text for word in ("hardly", *case.words))
        for text, n in refused.items()
        if n > 0.01 * ok.size
    )
    if not ok.any():
        return Line(case, np.nan, np.nan, 0.0, 0.0, _most(messages), named)
    return Line(
        case,
        float(np.sqrt(np.mean(std[ok] ** 2))),
        float(np.sqrt(np.mean(error[ok] ** 2))),
        float(ok.mean()),
        float(np.mean(np.abs(error[ok]) > FAR * std[ok])),
        _most(messages),
        named,
    )


def text_of(sensed, block: int) -> str:  # type: ignore[no-untyped-def]
    if sensed.valid[block]:
        return sensed.seen.get(block, "")
    return f"not valid: {sensed.reason_of(block)}"


def _most(messages: Counter[str]) -> str:
    return "; ".join(f"{n} {text}" for text, n in messages.most_common(2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", default="", help="part of the cases' names")
    options = parser.parse_args()
    print(HEAD)
    lines = []
    for case in CASES:
        if options.only in case.name:
            fewer = max(2, options.seeds // 5) if case.rate_hz > 5e3 else options.seeds
            lines.append(evaluate(case, fewer))
            print(lines[-1], flush=True)
    far = max(line.far for line in lines)
    clean = sum(not line.marks for line in lines)
    print(f"{clean} of {len(lines)} cases without a mark; worst share beyond 5 stated: {far:.2%}")


if __name__ == "__main__":
    main()
