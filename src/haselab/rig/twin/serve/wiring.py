"""The wiring between the instruments of a served bench, and its faults."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Wiring"]

_NOISE = 0.7  # standard deviation of the converter, in codes


@dataclass(frozen=True)
class Wiring:
    """Wires between board, generator and amplifier; the default is the bench of the rig file.

    A gain of 0 is a wire that is off, of -1 one whose poles are swapped.

    Args:
        output_gain: of the board's output at the amplifier's input.
        carrier_gain: of the generator's signal there.
        v_monitor_gain: of the voltage monitor at its input.
        i_monitor_gain: of the current monitor at its input.
        swapped_monitors: each monitor is at the other one's input.
        loop_back: the board's output is at the input of the voltage monitor, not at the amplifier.
        offset_v: at both inputs, as without a path for their bias currents, in V.
        hum_v: amplitude of the mains at both inputs, in V.
        hum_hz: frequency of the mains.
    """

    output_gain: float = 1.0
    carrier_gain: float = 1.0
    v_monitor_gain: float = 1.0
    i_monitor_gain: float = 1.0
    swapped_monitors: bool = False
    loop_back: bool = False
    offset_v: float = 0.0
    hum_v: float = 0.0
    hum_hz: float = 50.0

    def amplifier_input(self, output_v: float) -> float:
        """Voltage at the amplifier's input due to the board's output, in V."""
        return 0.0 if self.loop_back else output_v * self.output_gain

    def read(
        self, codes: NDArray[np.int16], output_v: float, volt_per_code: float, top_code: int,
        time_s: float,
        sample_s: float,
    ) -> NDArray[np.int16]:  # fmt: skip
        """Compute the codes that the board reads.

        Args:
            codes: of both monitors, `(n, 2)`, wired as the rig file says.
            output_v: of the board, in V.
            volt_per_code: of the converter.
            top_code: the largest code of the converter.
            time_s: of the first sample, for the mains.
            sample_s: from sample to sample.
        Returns:
            Shape `(n, 2)`, clipped at the ends of the range as a converter does.
        """
        if self == _RIGHT:
            return codes
        read = codes * np.array([self.v_monitor_gain, self.i_monitor_gain])
        if self.swapped_monitors:
            read = read[:, ::-1]
        if self.loop_back:
            read[:, 0] = output_v / volt_per_code
        at_s = time_s + sample_s * np.arange(len(codes))
        hum_v = self.hum_v * np.sin(2.0 * np.pi * self.hum_hz * at_s)
        # An input without a signal still shows the converter's noise.
        noise = np.random.default_rng(round(time_s / sample_s)).normal(0.0, _NOISE, codes.shape)
        read = np.rint(read + noise + ((self.offset_v + hum_v) / volt_per_code)[:, None])
        clipped: NDArray[np.int16] = np.clip(read, -top_code - 1, top_code).astype(np.int16)
        return clipped


_RIGHT = Wiring()
