"""Error of the sensed capacitance over its bound: the sweeps that `pictures.py` draws.

    python -m benchmarks.sensing.pictures_error

prints the figures of ADR 8 and docs/measure/how-self-sensing-works.md for a step at an unknown
time. The records are those of `accuracy.py`; the first block of each is left out, in which the
paper's filter still settles.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from benchmarks.sensing.accuracy import (
    AMPLITUDES,
    BLOCK,
    CARRIER_HZ,
    OHM_PER_RATIO,
    RATE_HZ,
    SETTLED,
    STEP_V,
    Case,
    cases,
    config_of,
)
from haselab.report.style import BLUE, GREEN, GREY, PURPLE, RED
from haselab.sensing import Lockin, LockinConfig, PaperChain, SineFit

RECORDS = 20  # a random phase of the carrier and 59 blocks each
LOOKS = {
    "lockin": (BLUE, "o", "-"),
    "sinefit": (GREEN, "s", "--"),
    "paper": (RED, "^", "-."),
    "Hann": (PURPLE, "D", ":"),
    "lockin, time stated": (GREY, "v", "--"),
}


@dataclass(frozen=True)
class Stairs(Case):
    """A drive that climbs by `height_v` a block."""

    height_v: float = STEP_V

    def _drive(self, rng: np.random.Generator, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        drive_v, per_s = super()._drive(rng, time_s)
        return drive_v * self.height_v / STEP_V, per_s * self.height_v / STEP_V


class HannFit:
    """Least squares on sine, cosine, level and slope, weighted by Hann, for comparison."""

    def __init__(self, config: LockinConfig) -> None:
        index = np.arange(BLOCK)
        angle = 2 * np.pi * config.carrier_hz / RATE_HZ * index
        basis = np.stack([np.cos(angle), np.sin(angle), np.ones(BLOCK), index / BLOCK - 0.5])
        weighted = basis * np.hanning(BLOCK + 1)[:-1]
        rows = np.linalg.solve(weighted @ basis.T, weighted)
        self._row = rows[0] - 1j * rows[1]
        self._omega_rad_s = config.omega_rad_s

    def capacitance_f(self, record: np.ndarray) -> np.ndarray:
        phasors = np.einsum("n,bnc->bc", self._row, record)
        impedance = OHM_PER_RATIO * phasors[:, 0] / phasors[:, 1]
        return -1 / (self._omega_rad_s * impedance.imag)


def capacitances(name: str, case: Case, record: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Capacitance of each block but the first, and its reported standard deviation."""
    config = config_of(case)
    if name == "Hann":
        found = HannFit(config).capacitance_f(record)[1:]
        return found, np.full_like(found, np.nan)
    plain = replace(config, blank=(0, 0), search_updates=False)
    if name == "lockin, time stated":
        sensed = Lockin(config).sense(record)
    elif name == "lockin":
        sought = replace(plain, search_updates=case.step_at is not None)
        sensed = Lockin(sought).sense(record)
    elif name == "sinefit":
        sensed = SineFit(plain).sense(record)
    else:
        sensed = PaperChain(plain).sense(record)
    held = sensed.valid.copy()
    held[0] = False
    return sensed.capacitance_f[held], sensed.capacitance_std_f[held]


def errors(case: Case, names: tuple[str, ...], seed: int) -> dict[str, tuple[float, float]]:
    """By method: rms error of C over the bound, claimed over true standard deviation."""
    rng = np.random.default_rng(seed)
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for _ in range(RECORDS):
        record = case.record(rng)
        for name in names:
            found[name].append(np.stack(capacitances(name, case, record)))
    result = {}
    for name, parts in found.items():
        value, claimed = np.concatenate(parts, axis=1) / case.capacitance_f
        rms = np.sqrt(np.mean((value - 1) ** 2)) if value.size else np.nan
        claim = np.sqrt(np.mean(claimed**2)) if value.size else np.nan
        result[name] = (float(rms / case.bound), float(claim / rms))
    return result


def sweep(
    axes, x: np.ndarray, make: Callable[[float], Case], names: tuple[str, ...], *, first: int = 100
) -> None:
    """Error over bound of each method along one axis."""
    rows = [errors(make(float(value)), names, first + k) for k, value in enumerate(x)]
    for name in names:
        colour, marker, line = LOOKS[name]
        axes.plot(x, [row[name][0] for row in rows], color=colour, marker=marker, ls=line,
                  ms=3.5, label=name)  # fmt: skip
    axes.axhline(1.0, color="black", lw=0.7)
    axes.set_yscale("log")
    axes.set_yticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
    axes.set_ylabel("rms error of C / bound")


def draw_error() -> Figure:
    """Amplitude, ramp and frequency of the carrier: three methods."""
    names = ("lockin", "sinefit", "paper")
    figure = Figure(figsize=(6.8, 5.4), layout="constrained")
    amplitude, ramp, offset, dots = figure.subplots(2, 2).flat
    sweep(
        amplitude,
        np.geomspace(5.0, 1000.0, 8),
        lambda x: Case("", 1e-3 * x, 2.5e-3 * x),
        names,
    )
    amplitude.set(xscale="log", xlabel="carrier on the voltage monitor / mV p-p", ylim=(0.7, 60.0))
    amplitude.set_xticks([10, 100, 1000], ["10", "100", "1000"])
    amplitude.set_title("A  still", loc="left")
    sweep(
        ramp,
        np.array([0.03, 0.1, 0.3, 1.0, 3.0, 10.0]),
        lambda x: Case("", 0.05, 0.2, ramp_v_s=x),
        names,
    )
    ramp.set(xscale="log", xlabel="ramp of the voltage monitor / (V/s)", ylim=(0.7, 60.0))
    ramp.set_xticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
    ramp.set_title("B  ramp", loc="left")
    sweep(
        offset,
        np.array([0.1, 0.3, 1.0, 2.0, 4.0, 8.0]),
        lambda x: Case("", 0.05, 0.2, carrier_hz=CARRIER_HZ + x),
        names,
    )
    offset.set(xscale="log", xlabel="carrier beside 2000 Hz / Hz", ylim=(0.7, 60.0))
    offset.set_xticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
    offset.set_title("C  frequency", loc="left")
    _draw_claims(dots)
    amplitude.legend(loc="upper right")
    return figure


def _draw_claims(axes) -> None:
    """Claimed over true standard deviation in the conditions of `accuracy.py`."""
    kinds = list(dict.fromkeys(case.name for case, _ in cases()))
    words = ("still", "1 V/s", "5 V/s", "step,\nedge", "step,\n3 ms", "step,\nany", "0.1 %\noff")
    for k, (case, _) in enumerate(cases()):
        names = (
            ("lockin, time stated", "paper") if case.step_at is not None else ("lockin", "paper")
        )
        if case.step_at == -1:
            names = ("lockin", "paper")
        if case.carrier_hz != CARRIER_HZ:
            names = ("sinefit", "paper")
        for name, (_, claim) in errors(case, names, 500 + k).items():
            shown = "lockin" if name == "lockin, time stated" else name
            colour, marker, _ = LOOKS[shown]
            spread = 0.22 * (AMPLITUDES.index((case.v_pp, case.i_pp)) - 1)
            axes.plot(kinds.index(case.name) + spread, claim, marker, color=colour, ms=3.5)
    axes.axhspan(0.9, 1.1, color=GREY, alpha=0.2, lw=0)
    axes.set_yscale("log")
    axes.set_yticks([0.1, 0.3, 1.0], ["0.1", "0.3", "1"])
    axes.set_xticks(range(len(words)), words, fontsize=7)
    axes.set_ylabel("claimed / true std of C")
    axes.set_title("D  its own standard deviation", loc="left")


def draw_steps() -> Figure:
    """One step in each block: where it comes, and how high it is."""
    figure = Figure(figsize=(6.8, 3.8), layout="constrained")
    place, height = figure.subplots(1, 2, sharey=True)
    at_ms = np.linspace(0.0, 9.5, 20)
    names = ("lockin", "Hann", "paper", "lockin, time stated")
    sweep(
        place,
        at_ms,
        lambda x: Stairs("", 0.05, 0.2, step_at=round(200 * x), height_v=0.2),
        names,
    )
    place.set(xlabel="time of a step of 200 mV in its block / ms")
    place.set_title("A  when it comes", loc="left")
    heights_mv = np.geomspace(0.5, 1000.0, 9)
    sweep(
        height,
        heights_mv,
        lambda x: Stairs("", 0.05, 0.2, step_at=-1, height_v=1e-3 * x),
        ("lockin", "Hann", "paper"),
    )
    height.set(xscale="log", xlabel="step at a random time / mV", ylabel="")
    height.set_xticks([1, 10, 100, 1000], ["1", "10", "100", "1000"])
    height.set_title("B  how high it is", loc="left")
    figure.legend(*place.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def phase_scatter(v_pp: float, i_pp: float) -> tuple[float, float, float]:
    """Hann's rms error over the bound in a block hit in its middle: least, rms and most of what
    40 phases of the carrier give."""
    rng = np.random.default_rng(3)
    case = Stairs("", v_pp, i_pp, step_at=BLOCK // 2)
    method = HannFit(config_of(case))
    found = []
    for _ in range(40):
        error = method.capacitance_f(case.record(rng))[1:] / case.capacitance_f - 1
        found.append(np.sqrt(np.mean(error**2)) / case.bound)
    return min(found), float(np.sqrt(np.mean(np.square(found)))), max(found)


def main() -> None:
    print("rms error over bound, a step of 20 mV at a random time and phase in each block")
    for k, (v_pp, i_pp) in enumerate(AMPLITUDES):
        case = Stairs("", v_pp, i_pp, step_at=-1)
        row = errors(case, ("lockin", "Hann", "paper"), 900 + k)
        parts = "  ".join(f"{name} {error:6.2f}" for name, (error, _) in row.items())
        low, rms, high = phase_scatter(v_pp, i_pp)
        print(f"{1e3 * v_pp:4.0f},{1e3 * i_pp:4.0f} mV pp  {parts}   "
              f"Hann, step at 5 ms, over 40 phases: {low:.2f} {rms:.2f} {high:.2f}")  # fmt: skip
    for k, at in enumerate((0, SETTLED, 600)):
        row = errors(Stairs("", 0.05, 0.2, step_at=at), ("Hann",), 950 + k)
        print(f"Hann, step {at / 200:.1f} ms into each block at 50,200 mV pp: {row['Hann'][0]:.2f}")


if __name__ == "__main__":
    main()
