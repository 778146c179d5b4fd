"""The classes of the scoreboard: how fast a loop runs, how late it is, and what it may know."""

from __future__ import annotations

import math
from dataclasses import dataclass

from haselab.controllers import ControllerKind
from haselab.firmware import CAPACITANCE_NOISE, MOTION_RISE_V_PER_S
from haselab.rig.twin.config import TwinConfig

__all__ = ["CLASSES", "LoopClass", "noise_of"]

STEP_S = 1e-4  # one mechanical step of the twin: TWIN_SUB samples at 200 kHz
CARRIER_HZ, CARRIER_V = 2000.0, 0.02  # of the reference study, before the amplifier


@dataclass(frozen=True)
class LoopClass:
    """Timing, noise and drive of one kind of loop.

    All times are whole mechanical steps of 0.1 ms. The capacitance is the mean from step `first` to
    step `last` of an update, where 0 is its beginning; a negative `first` is in the update before.

    Args:
        name: in the results.
        steps: of an update.
        switch_at: step at which the output computed from the update before takes effect.
        first: beginning of the samples that count.
        last: end of them.
        relative_noise: standard deviation of one capacitance over its value; None: computed from
            the monitors of the bench.
        drive_step_v: resolution of the output, before the amplifier; 0: none.
        slew_v_per_s: fastest change of the output; infinite: any.
        volt_slew_v_per_s: the same for controllers whose output is the voltage.
        on_chip: whether it is the loop of the microcontroller, the only one of kinds with a `loop`.
        true_states: whether the controller gets the true law, and capacitances without noise.
    """

    name: str
    steps: int
    switch_at: int
    first: int
    last: int
    relative_noise: float | None = None
    drive_step_v: float = 0.0
    slew_v_per_s: float = math.inf
    volt_slew_v_per_s: float = math.inf
    on_chip: bool = False
    true_states: bool = False

    @property
    def period_s(self) -> float:
        """Time from one update to the next."""
        return self.steps * STEP_S

    @property
    def window_s(self) -> float:
        """Time over which the capacitance is a mean."""
        return (self.last - self.first) * STEP_S

    @property
    def delay_s(self) -> float:
        """Age of a measurement when the output computed from it takes effect, without the hold."""
        return (self.steps - 0.5 * (self.first + self.last) + self.switch_at) * STEP_S

    @property
    def sensed_before_s(self) -> float:
        """Age of a measurement at the end of its update."""
        return (self.steps - 0.5 * (self.first + self.last)) * STEP_S

    @property
    def dead_s(self) -> float:
        """Time from an event at the beginning of an update to the first output that knows of it."""
        return (self.steps + self.switch_at) * STEP_S

    def suits(self, kind: ControllerKind) -> bool:
        """Whether a kind of controller is made for this loop."""
        return kind.loop is None or self.on_chip

    def slew_of(self, kind: ControllerKind) -> float:
        """Fastest change of the output of a kind of controller, in V/s."""
        return self.volt_slew_v_per_s if kind.output == "voltage" else self.slew_v_per_s

    @property
    def timing(self) -> tuple[int, int, int, int]:
        """As the compiled twin takes it."""
        return self.steps, self.switch_at, self.first, self.last


CLASSES = {
    one.name: one
    for one in (
        # the bench of the study: blocks of 10 ms, output 2 ms into the next, 0.5 ms blanked; the
        # lock-in counts whole periods of the carrier. The output of a 16-bit converter of 10 V.
        LoopClass("host-100hz", 100, 20, 28, 100, drive_step_v=20.0 / 2**16),
        # the microcontroller: see docs/control/firmware.md for noise, delay and rate limit
        LoopClass(
            "chip-1khz",
            10,
            9,
            -4,
            6,
            CAPACITANCE_NOISE,
            slew_v_per_s=20.0,
            volt_slew_v_per_s=MOTION_RISE_V_PER_S,
            on_chip=True,
        ),
        LoopClass("oracle", 10, 0, 9, 10, 0.0, true_states=True),
    )
}


def noise_of(loop: LoopClass, config: TwinConfig, capacitance_f: float) -> float:
    r"""Standard deviation of the capacitance of one update, by the noise of both monitors.

    A sine of amplitude $A$ in noise of $\sigma$ is known from $N$ samples to $\sigma\sqrt{2/N}$.

    Args:
        loop: class, whose window counts.
        config: of the bench.
        capacitance_f: at which the current of the carrier is computed.
    Returns:
        Standard deviation, in F.
    """
    if loop.relative_noise is not None:
        return loop.relative_noise * capacitance_f
    daq, amplifier = config.acquisition, config.amplifier
    count = loop.window_s * daq.rate_hz
    rounding_v = 2.0 * daq.range_v / 2**daq.bits / math.sqrt(12.0)
    volt_v = amplifier.gain * CARRIER_V
    current_v = 2.0 * math.pi * CARRIER_HZ * capacitance_f * volt_v
    seen = volt_v / amplifier.volt_per_monitor_volt, current_v / amplifier.ampere_per_monitor_volt
    parts = [
        math.hypot(noise_v, rounding_v) / value
        for noise_v, value in zip((daq.v_noise_v, daq.i_noise_v), seen, strict=True)
    ]
    return math.sqrt(2.0 / count) * math.hypot(*parts) * capacitance_f
