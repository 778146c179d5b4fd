"""Monitor records of a series R-C with known truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from haselab.sensing import LockinConfig

LSB_V = 20.0 / 2**16


@dataclass(frozen=True)
class Scene:
    """A series R-C under a carrier, seen by two monitors; the defaults are the study's bench."""

    capacitance_f: float = 1.5e-9
    resistance_ohm: float = 5e3
    v_peak_v: float = 0.025
    carrier_hz: float = 2000.0
    rate_hz: float = 200e3
    block_samples: int = 2000
    skew_s: float = 0.0
    ramp_v_s: float = 0.0
    noise_v: float = 1e-3
    phase_rad: float = 0.4
    ohm_per_ratio: float = 2.5e6

    def but(self, **changes: float) -> "Scene":
        return replace(self, **changes)

    @property
    def impedance_ohm(self) -> complex:
        omega = 2 * np.pi * self.carrier_hz
        return self.resistance_ohm + 1 / (1j * omega * self.capacitance_f)

    @property
    def i_peak_v(self) -> float:
        return self.v_peak_v * self.ohm_per_ratio / abs(self.impedance_ohm)

    @property
    def sigma_v(self) -> float:
        """Noise of one reading: of the channel, and of rounding to a code."""
        return float(np.hypot(self.noise_v, LSB_V / np.sqrt(12)))

    @property
    def capacitance_bound_f(self) -> float:
        r"""Cramer-Rao bound of the standard deviation of C from one block.

        A quadrature of a phasor from N readings of white noise has variance 2 sigma^2 / N at the
        least (the Fisher information of a cosine's amplitude is N / 2 sigma^2, and over whole
        periods level, slope and the other quadrature cost next to nothing). C follows Im Z = Im
        (k V / I) alone: dC / C = -dIm Z / Im Z, and a circular relative error e of V / I moves
        Im Z by |Z| times one quadrature of e.
        """
        per_quadrature = 2 * self.sigma_v**2 / self.block_samples
        relative = np.sqrt(per_quadrature * (self.v_peak_v**-2 + self.i_peak_v**-2))
        z = self.impedance_ohm
        return float(self.capacitance_f * relative * abs(z) / abs(z.imag))

    def config(self, **changes: float) -> LockinConfig:
        config = LockinConfig(
            rate_hz=self.rate_hz,
            block_samples=self.block_samples,
            carrier_hz=self.carrier_hz,
            skew_s=self.skew_s,
            ohm_per_ratio=self.ohm_per_ratio,
            min_amplitude_codes=0.0,
        )
        return replace(config, **changes)

    def readings(self, blocks: int, rng: np.random.Generator | None) -> NDArray[np.float64]:
        """Volts, shape `(blocks, block_samples, 2)`; without a generator no noise at all."""
        time_s = np.arange(blocks * self.block_samples) / self.rate_hz
        omega = 2 * np.pi * self.carrier_hz
        voltage = self.v_peak_v * np.exp(1j * self.phase_rad)
        current = voltage * self.ohm_per_ratio / self.impedance_ohm
        ramp = self.ramp_v_s * time_s
        charging = self.ohm_per_ratio * self.capacitance_f * self.ramp_v_s
        record = np.stack(
            [
                (voltage * np.exp(1j * omega * time_s)).real + ramp,
                (current * np.exp(1j * omega * (time_s + self.skew_s))).real + charging,
            ],
            axis=1,
        )
        if rng is not None:
            record += self.noise_v * rng.standard_normal(record.shape)
        return record.reshape(blocks, self.block_samples, 2)

    def codes(self, blocks: int, rng: np.random.Generator) -> NDArray[np.int16]:
        return np.round(self.readings(blocks, rng) / LSB_V).astype(np.int16)


@pytest.fixture(scope="session")
def scene() -> Scene:
    return Scene()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20181001)


@pytest.fixture(scope="session")
def rms() -> Callable[[NDArray[np.float64]], float]:
    return lambda values: float(np.sqrt(np.mean(np.square(values))))
