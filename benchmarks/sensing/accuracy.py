"""Error of the sensed capacitance over its Cramer-Rao bound, condition by condition.

    python -m benchmarks.sensing.accuracy [--blocks 1200]

Both monitors are made here, not by the twin: a pure capacitor under a carrier of known amplitude
and random phase, a drive that rests, ramps or climbs in steps of 20 mV through a second-order
amplifier of 6 kHz, the current that charges the capacitor, white noise of 1 mV rms, and a 16-bit
converter of +-10 V. The bound is that of one whole block at the known noise.
"""

import argparse
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from benchmarks.rows import Row
from haselab.sensing import Lockin, LockinConfig, PaperChain, Sensed, SineFit

RATE_HZ, BLOCK, CARRIER_HZ = 200e3, 2000, 2000.0
LSB_V, NOISE_V = 20.0 / 2**16, 1e-3
AMPLIFIER_HZ, DAMPING = 6000.0, 0.6
STEP_V = 0.02
OHM_PER_RATIO = 2.5e6
SETTLED = 60  # samples, 0.3 ms: exp(-0.6 2 pi 6 kHz 0.3 ms) of a step is left
GROUP = 60  # blocks of one record: one phase of the carrier
AMPLITUDES = ((0.02, 0.02), (0.05, 0.2), (0.2, 0.5))


@dataclass(frozen=True)
class Case:
    """One condition.

    Args:
        name: of the condition.
        v_pp: carrier on the voltage monitor, in V.
        i_pp: carrier on the current monitor, in V.
        ramp_v_s: slope of the voltage monitor.
        step_at: sample of each block at which the drive climbs; None: never; -1: anywhere.
        carrier_hz: as generated.
    """

    name: str
    v_pp: float
    i_pp: float
    ramp_v_s: float = 0.0
    step_at: int | None = None
    carrier_hz: float = CARRIER_HZ

    @property
    def capacitance_f(self) -> float:
        return self.i_pp / self.v_pp / OHM_PER_RATIO / (2 * np.pi * self.carrier_hz)

    @property
    def bound(self) -> float:
        """Relative standard deviation of C that no unbiased estimate of one block can beat.

        A quadrature of a sine's amplitude in N readings of variance s^2 has Fisher information
        N / 2 s^2; a circular relative error of V and I moves C by one quadrature of each.
        """
        variance = NOISE_V**2 + LSB_V**2 / 12.0
        peaks = (0.5 * self.v_pp) ** -2 + (0.5 * self.i_pp) ** -2
        return float(np.sqrt(2.0 * variance / BLOCK * peaks))

    def record(self, rng: np.random.Generator) -> np.ndarray:
        """`GROUP` blocks in a row, volts as the converter gives them, `(GROUP, BLOCK, 2)`."""
        time_s = np.arange(GROUP * BLOCK) / RATE_HZ
        drive_v, per_s = self._drive(rng, time_s)
        omega = 2 * np.pi * self.carrier_hz
        turn = omega * time_s + rng.uniform(0, 2 * np.pi)
        voltage = 0.5 * self.v_pp * np.cos(turn) + drive_v
        current = -0.5 * self.i_pp * np.sin(turn) + per_s * OHM_PER_RATIO * self.capacitance_f
        clean = np.stack([voltage, current], axis=1)
        noisy = clean + NOISE_V * rng.standard_normal(clean.shape)
        return (np.round(noisy / LSB_V) * LSB_V).reshape(GROUP, BLOCK, 2)

    def _drive(self, rng: np.random.Generator, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The drive behind the amplifier, and its slope."""
        drive_v, per_s = self.ramp_v_s * time_s, np.full(time_s.size, self.ramp_v_s)
        if self.step_at is None:
            return drive_v, per_s
        omega = 2 * np.pi * AMPLIFIER_HZ
        amplifier = signal.TransferFunction([omega**2], [1, 2 * DAMPING * omega, omega**2])
        fine = 8  # the step falls between samples: the response is made eight times finer
        grid_s = np.arange(401 * fine) / RATE_HZ / fine
        _, level = signal.step(amplifier, T=grid_s)
        _, slope = signal.impulse(amplifier, T=grid_s)
        for block in range(GROUP):
            inside = rng.uniform(0, BLOCK) if self.step_at < 0 else float(self.step_at)
            start = int(np.ceil(block * BLOCK + inside))
            late = round((start - block * BLOCK - inside) * fine)
            stop = min(start + 400, time_s.size)
            drive_v[start:stop] += STEP_V * level[late::fine][: stop - start]
            drive_v[stop:] += STEP_V
            per_s[start:stop] += STEP_V * slope[late::fine][: stop - start]
        return drive_v, per_s


def config_of(case: Case) -> LockinConfig:
    """What a user would state of the case: the time of the update where it is known."""
    config = LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, OHM_PER_RATIO, min_amplitude_codes=1e-6)
    if case.step_at is None:
        return config
    if case.step_at < 0:
        return replace(config, search_updates=True)
    return replace(config, blank=(case.step_at, case.step_at + SETTLED))


def cases() -> list[tuple[Case, float]]:
    """Each condition and its goal."""
    found: list[tuple[Case, float]] = []
    for v_pp, i_pp in AMPLITUDES:
        found += [
            (Case("still", v_pp, i_pp), 1.1),
            (Case("ramp 1 V/s", v_pp, i_pp, ramp_v_s=1.0), 1.1),
            (Case("ramp 5 V/s", v_pp, i_pp, ramp_v_s=5.0), 1.1),
            (Case("steps at the block's edge", v_pp, i_pp, step_at=0), 1.25),
            (Case("steps 3 ms into the block", v_pp, i_pp, step_at=600), 1.25),
            (Case("steps at an unknown time", v_pp, i_pp, step_at=-1), 1.4),
            (Case("carrier off by 0.1 %", v_pp, i_pp, carrier_hz=1.001 * CARRIER_HZ), 1.2),
        ]
    return found


@dataclass(frozen=True)
class Result:
    """Of one method in one case: rms error over the bound, reported over true standard deviation,
    share of the blocks that are valid."""

    error: float
    reported: float
    valid: float


def evaluate(case: Case, sensed: list[Sensed]) -> Result:
    """Of all blocks but the first of each record, in which the paper's low-pass still settles."""
    capacitance_f = np.concatenate([s.capacitance_f[1:] for s in sensed])
    reported = np.concatenate([s.capacitance_std_f[1:] for s in sensed])
    valid = np.concatenate([s.valid[1:] for s in sensed])
    if not valid.any():
        return Result(float("nan"), float("nan"), 0.0)
    error = capacitance_f[valid] / case.capacitance_f - 1.0
    rms = np.sqrt(np.mean(error**2))
    spread = np.sqrt(np.mean((reported[valid] / case.capacitance_f) ** 2))
    return Result(float(rms / case.bound), float(spread / rms), float(valid.mean()))


def scipy_chain(record: np.ndarray, sections: np.ndarray) -> np.ndarray:
    """The paper's chain as a script has it: filter, fold, peak to peak, FFT; C of each block."""
    flat = record.reshape(-1, 2)
    rest = signal.sosfilt_zi(sections)[:, :, np.newaxis] * flat[0]
    filtered, _ = signal.sosfilt(sections, flat, axis=0, zi=rest)
    folded = filtered.reshape(len(record), -1, round(RATE_HZ / CARRIER_HZ), 2).mean(axis=1)
    peak = np.ptp(folded, axis=1)
    angle = np.angle(np.fft.rfft(folded, axis=1)[:, 1, :])
    quadrature = np.sin(np.abs(angle[:, 0] - angle[:, 1]))
    return peak[:, 1] / (peak[:, 0] * quadrature)


def run(case: Case, blocks: int, seed: int) -> tuple[Result, Result, Result | None]:
    """Ours, the lock-in without help, and the paper's chain (None where it cannot be set up)."""
    rng = np.random.default_rng(seed)
    records = [case.record(rng) for _ in range(-(-blocks // (GROUP - 1)))]
    off = case.carrier_hz != CARRIER_HZ
    ours = SineFit(config_of(case)) if off else Lockin(config_of(case))
    plain = Lockin(replace(config_of(case), blank=(0, 0), search_updates=False))
    paper = [PaperChain(plain.config).sense(record) for record in records]
    return (
        evaluate(case, [ours.sense(record) for record in records]),
        evaluate(case, [plain.sense(record) for record in records]),
        evaluate(case, paper),
    )


def table(blocks: int) -> list[tuple[Case, float, Result, Result, Result | None]]:
    return [(case, goal, *run(case, blocks, 7 + k)) for k, (case, goal) in enumerate(cases())]


def rows(blocks: int = 1200) -> list[Row]:
    """Error over the bound and the the stated over the true deviation, worst of each condition."""
    found = table(blocks)
    lines = []
    for name in dict.fromkeys(case.name for case, *_ in found):
        of_name = [line for line in found if line[0].name == name]
        worst = max(of_name, key=lambda line: line[2].error)
        stated = max((line[2].reported for line in of_name), key=lambda x: abs(x - 1.0))
        note = f"paper {worst[4].error:.1f}" if worst[4] else ""
        lines += [
            Row(f"rms error of C over bound, {name}", worst[2].error, "", worst[1], False, note),
            Row("   stated std over true, off by", abs(stated - 1.0), "", 0.1, False),
        ]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blocks", type=int, default=1200)
    blocks = parser.parse_args().blocks
    print("rms error of C over the bound; reported over true standard deviation; valid blocks")
    print(f"{'mV pp':10s}{'condition':28s}{'ours':>7s}{'goal':>6s}{'std':>7s}{'valid':>7s}"
          f"{'plain':>9s}{'paper':>9s}")  # fmt: skip
    for case, goal, ours, plain, paper in table(blocks):
        outcome = "" if ours.error <= goal and abs(ours.reported - 1) <= 0.1 else "  MISSED"
        other = f"{paper.error:9.2f}" if paper else f"{'-':>9s}"
        print(
            f"{1e3 * case.v_pp:3.0f},{1e3 * case.i_pp:3.0f}   {case.name:28s}{ours.error:7.3f}"
            f"{goal:6.2f}{ours.reported:7.3f}{ours.valid:7.3f}{plain.error:9.2f}{other}{outcome}"
        )


if __name__ == "__main__":
    main()
