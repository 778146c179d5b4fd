"""Designs on the posterior: shares against python-control, and coverage of the true plant.

    python -m benchmarks.control.plausible_design [--records 100] [--draws 200] [--probability 0.9]

Shares: margins of drawn plants by python-control (sampled by its own `c2d`, whole samples of
delay), against the margins that the share counts. Coverage: a chirp of 10 s with noise is
simulated, fitted, and a PI designed on the fit; the true plant then keeps the margins or does not.
"""

import argparse
import math
from collections.abc import Iterator

import control
import numpy as np

from benchmarks.rows import Row
from haselab.control import (
    DesignSpec,
    LoopSetting,
    PidGains,
    design_controller,
    design_pi,
    margins,
    plausible_margins,
)
from haselab.identify import Record, fit_transfer
from haselab.models import Plant, PlantPosterior

RATE_HZ = 100.0
SETTING = LoopSetting(RATE_HZ, 0.01)
SPEC = DesignSpec(frequency_spread=0.0)
TRUTH = Plant(1.0, 32.1, 0.12, 0.012)
NOISE = 0.03  # strain rms, against a chirp of 0.02
NAMES = (
    "gain", "natural_frequency_rad_s", "damping_ratio", "delay_s", "slow_gain",
    "slow_time_constant_s",
)  # fmt: skip


def loops(damping: float) -> dict[str, PidGains]:
    """A PI and a PID that keep their margins with some, not all, of the drawn plants."""
    if damping < 0.1:
        return {"PI": PidGains(0.0, 0.2), "PID": PidGains(0.0, 0.3, 0.002, 0.006)}
    if damping < 1.0:
        return {"PI": PidGains(0.0, 3.0), "PID": PidGains(0.0, 6.0, 0.01, 0.006)}
    return {"PI": PidGains(0.0, 10.0), "PID": PidGains(1.5, 12.0, 0.03, 0.006)}


def posterior(damping: float, delay_s: float, gain: float = 1.0) -> PlantPosterior:
    """A wide one, its numbers correlated by 0.5; the delay is a known whole number of samples."""
    std = np.array([0.15, 0.15, 0.5, 0.0, 0.1, 0.3])
    correlation = 0.5 + 0.5 * np.eye(std.size)
    values = np.array([gain, 32.1, damping, delay_s, 0.5, 6.0])
    flags = (False, True, True, False, False, True)
    return PlantPosterior(NAMES, flags, values, correlation * np.outer(std, std))


def theirs(plant: Plant, gains: PidGains) -> tuple[bool, float, float]:
    """Stable, phase margin in degrees, gain margin in dB, all by python-control."""
    period_s = 1.0 / RATE_HZ
    s, z = control.tf("s"), control.tf([1, 0], [1], period_s)
    wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
    total = plant.gain * wn**2 / (s**2 + 2 * zeta * wn * s + wn**2)
    for mode in plant.slow_modes:
        total = total + mode.gain / (mode.time_constant_s * s + 1)
    late = round((plant.delay_s + SETTING.measurement_delay_s) * RATE_HZ)
    sampled = control.c2d(control.ss(total), period_s, "zoh")
    tau = gains.derivative_filter_s
    law = gains.kp + gains.ki * period_s * z / (z - 1)
    law = law + gains.kd * (z - 1) / ((tau + period_s) * z - tau)
    line = control.tf([1], [1] + [0] * late, period_s)
    loop = control.ss(law) * control.ss(line) * sampled
    closed = control.feedback(loop, 1)
    stable = bool(np.abs(closed.poles()).max() < 1.0)
    omega = np.unique(np.r_[np.geomspace(1e-4, 0.99999 * math.pi * RATE_HZ, 600),
                            wn * (1.0 + zeta * np.tan(np.linspace(-1.5, 1.5, 300)))])  # fmt: skip
    omega = omega[(omega > 0.0) & (omega < math.pi * RATE_HZ)]
    found = control.stability_margins(control.frd(loop(np.exp(1j * omega * period_s)), omega),
                                      returnall=True)  # fmt: skip
    factors, phases = np.asarray(found[0]), np.abs((np.asarray(found[1]) + 180) % 360 - 180)
    upward = factors[factors > 1.0]
    gain_db = 20.0 * math.log10(upward.min()) if upward.size else math.inf
    return stable, float(phases.min(initial=math.inf)), gain_db


def disagreements(
    plants: tuple[Plant, ...], gains: PidGains, spec: DesignSpec = SPEC
) -> tuple[int, float, float]:
    """Plants that are classified differently, and both shares."""
    ours = plausible_margins(plants, gains, SETTING, spec)
    mine = ours.keeps_phase & ours.keeps_gain
    other = []
    for plant in plants:
        stable, phase_deg, gain_db = theirs(plant, gains)
        other.append(
            stable and phase_deg >= spec.phase_margin_deg and gain_db >= spec.gain_margin_db
        )
    return int((mine != np.array(other)).sum()), float(mine.mean()), float(np.mean(other))


def simulated(rng: np.random.Generator, noise: float = NOISE) -> Record:
    """A chirp from 0.5 to 8 Hz in 10 s, the output at 400 Hz with white noise."""
    frequency = np.linspace(0.5, 8.0, 1000)
    u = 0.02 * np.sin(2.0 * math.pi * np.cumsum(frequency) / RATE_HZ)
    time_s = np.arange(4000) / 400.0
    y = TRUTH.simulate(u, RATE_HZ, time_s) + noise * rng.normal(size=time_s.size)
    return Record(u, RATE_HZ, y, time_s)


def keeps(gains: PidGains, spec: DesignSpec = SPEC) -> bool:
    """Whether the true plant keeps the demanded margins, by the exact ones."""
    found = margins(TRUTH, gains, loop_delay_s=SETTING.measurement_delay_s, rate_hz=RATE_HZ)
    return (
        found.stable
        and found.phase_margin_deg >= spec.phase_margin_deg
        and found.gain_margin_db >= spec.gain_margin_db
    )


def covered(seed: int, probability: float, noise: float = NOISE) -> tuple[bool, bool, float]:
    """Whether the true plant keeps its margins: best plant alone, on the posterior; its share."""
    rng = np.random.default_rng(seed)
    fit = fit_transfer([simulated(rng, noise)])
    assert fit.succeeded, fit.status
    alone = design_pi(fit.plant, SPEC, SETTING, rng=np.random.default_rng(seed))
    careful = design_controller(
        fit.posterior, SPEC, SETTING, structure="pi", probability=probability, rng=rng
    )
    assert careful.plausible is not None
    return keeps(alone.gains), keeps(careful.gains), careful.plausible.share.value


def agreement(draws: int) -> Iterator[Row]:
    for damping in (0.01, 0.12, 1.2):
        for late in (0, 1, 3):
            for name, gains in loops(damping).items():
                drawn = posterior(damping, late / RATE_HZ).draw(draws, np.random.default_rng(1))
                wrong, mine, theirs = disagreements(drawn, gains)  # type: ignore[arg-type]
                what = f"{name}, damping {damping:g}, {late} samples: otherwise"
                note = f"share {mine:g}, theirs {theirs:g}"
                yield Row(what, wrong, f"of {draws}", 0.0, False, note)


def coverage(records: int, probability: float) -> Iterator[Row]:
    found = np.array([covered(seed, probability) for seed in range(records)])
    alone, careful, stated = found.mean(axis=0)
    least = probability - 2.0 * math.sqrt(probability * (1.0 - probability) / records)
    yield Row("true plant keeps its margins, best plant alone", alone, f"of {records}")
    note = f"requested {probability:g}, share stated {stated:.3f}"
    yield Row("the same, designed on the posterior", careful, f"of {records}", least, True, note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--probability", type=float, default=0.9)
    options = parser.parse_args()
    for row in coverage(options.records, options.probability) if options.records else ():
        print(row, flush=True)
    for row in agreement(options.draws) if options.draws else ():
        print(row, flush=True)


if __name__ == "__main__":
    main()
