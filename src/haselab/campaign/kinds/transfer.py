"""Case kind `transfer`: identify a simulated linear device from a record with noise."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from haselab.base import InputError, ResultError
from haselab.campaign.kinds.case_kind import CaseKind, Inputs, Results
from haselab.store.toml import Section

__all__ = ["TRANSFER", "TransferSettings"]

_MOST_SAMPLES = 1_000_000


class TransferSettings(Section):
    """A linear device, and the record from which it is identified."""

    gain: float = Field(0.5, description="static gain of the resonance")
    natural_frequency_rad_s: float = Field(33.0, gt=0, le=1e4, description="of the resonance")
    damping_ratio: float = Field(0.11, gt=0, lt=1, description="of the resonance")
    delay_s: float = Field(0.012, ge=0, le=10, description="of the device, in s")
    slow_gain: float = Field(0.0, description="static gain of a slow mode; 0: none")
    slow_time_constant_s: float = Field(3.0, gt=0, le=1e3, description="of the slow mode, in s")
    amplitude: float = Field(1.0, gt=0, description="of the input, a random binary signal")
    hold_s: float = Field(
        0.05, gt=0, description="shortest time between two changes of the input, in s"
    )
    noise_std: float = Field(
        0.01, ge=0, description="standard deviation of the noise of each output sample"
    )
    rate_hz: float = Field(100.0, gt=0, le=1e5, description="sampling rate, in Hz")
    duration_s: float = Field(5.0, gt=0, le=1e4, description="of the record, in s")


class _Transfer(CaseKind):
    name = "transfer"
    settings = TransferSettings

    def check(self, inputs: Inputs) -> None:
        case = inputs.settings(TransferSettings)
        count = case.rate_hz * case.duration_s
        if not 50 <= count <= _MOST_SAMPLES:
            raise InputError(
                f"case.rate_hz times case.duration_s is {count:g} samples, but it must be 50 to "
                f"{_MOST_SAMPLES:,}. Change one of them."
            )

    def compute(self, inputs: Inputs, rng: np.random.Generator) -> Results:
        # slow to import, and not needed to check or to continue a campaign
        from haselab.identify.record import Record
        from haselab.identify.transfer.fit import TransferStructure, fit_transfer
        from haselab.models import Plant, SlowMode

        case = inputs.settings(TransferSettings)
        self.check(inputs)
        slow = (SlowMode(case.slow_gain, case.slow_time_constant_s),) if case.slow_gain else ()
        plant = Plant(
            case.gain, case.natural_frequency_rad_s, case.damping_ratio, case.delay_s, slow
        )
        count = round(case.rate_hz * case.duration_s)
        held = max(1, round(case.hold_s * case.rate_hz))
        u = case.amplitude * np.repeat(rng.choice([-1.0, 1.0], math.ceil(count / held)), held)
        u, time_s = u[:count], np.arange(count) / case.rate_hz
        clean = plant.simulate(u, case.rate_hz, time_s)
        y = clean + case.noise_std * rng.standard_normal(count)
        fit = fit_transfer(
            Record(u, case.rate_hz, y, time_s), TransferStructure(slow_modes=len(slow)),
            applied=True,
        )  # fmt: skip
        if not fit.succeeded:
            raise ResultError(f"The fit has no result: {fit.status}.")
        true = {
            "gain": case.gain,
            "natural_frequency_rad_s": case.natural_frequency_rad_s,
            "damping_ratio": case.damping_ratio,
            "delay_s": case.delay_s,
            "slow_gain": case.slow_gain,
            "slow_time_constant_s": case.slow_time_constant_s,
        }
        names = [name for name in true if name in fit.parameters]
        return {name: fit.parameters[name] for name in names} | {
            f"{name}.true": true[name] for name in names
        }


TRANSFER = _Transfer()
