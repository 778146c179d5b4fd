"""What the pages and the recorder of the panel get from each block, armed or not."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from haselab.panel.columns import LiveWriter
from haselab.runtime.lockin import lockin_of
from haselab.runtime.loop import LoopSettings
from haselab.safety.guarded import GuardedRig

__all__ = ["IdleWatch", "LiveSignals"]

_IDLE_BLOCKS = 20  # this many blocks in a row with an unexpected voltage trip the bench


class LiveSignals:
    """Computes the live signals of each block and writes them.

    Args:
        rig: the bench.
        writer: of the live signals.
        carrier_hz: by which the capacitance is sensed.
    """

    def __init__(self, rig: GuardedRig, writer: LiveWriter, carrier_hz: float) -> None:
        self._rig, self._writer = rig, writer
        self.sense_at(carrier_hz)
        self.extrapolated = False  # the strain of the last block
        about = rig.description
        self._settled = about.switch_in_block + round(1e-3 * about.rate_hz)

    def sense_at(self, carrier_hz: float) -> None:
        """Sense the capacitance by another carrier.

        Args:
            carrier_hz: its frequency.
        """
        self._lockin = lockin_of(self._rig.description, carrier_hz)

    def append(
        self,
        codes: NDArray[np.int16],
        loop: LoopSettings | None,
        reference: float | None,
        *,
        armed: bool,
    ) -> None:
        """Write the signals of one block.

        Args:
            codes: of the block. Shape `(N, 2)`.
            loop: with the map from capacitance to strain; None: no strain is known.
            reference: desired strain; None: no closed loop.
            armed: whether a page has armed the bench; else nothing is sensed.
        """
        about, drive_v = self._rig.description, self._rig.present_drive_v
        capacitance_f, _, valid = self._lockin.step(codes)
        sensed_f = capacitance_f if valid and armed else math.nan
        strain = math.nan
        self.extrapolated = False
        if loop is not None:
            low_f, high_f = loop.strain_map.usable_f
            if low_f <= sensed_f <= high_f:  # as in the loop
                strain = float(loop.strain_map.strain(sensed_f))
                self.extrapolated = not bool(loop.strain_map.inside(sensed_f))
        seen_v = float(codes[self._settled :, 0].mean()) * about.volt_per_code
        residual_v = seen_v / about.monitor_v_per_drive_v - drive_v
        desired = math.nan if reference is None else reference
        values = (drive_v, desired, sensed_f, strain, residual_v)
        self._writer.append(codes, self._rig.bench.time_s, values)


class IdleWatch:
    """Looks at the voltage monitor while the bench is not armed.

    For example, an instrument may have switched itself on.

    Args:
        rig: the bench.
    """

    def __init__(self, rig: GuardedRig) -> None:
        self._rig = rig
        self._unexpected = 0  # blocks in a row with an unexpected voltage

    def fault(self, codes: NDArray[np.int16]) -> str:
        """Take one block, and trip the bench if too many in a row show a voltage.

        Args:
            codes: of the block. Shape `(N, 2)`.
        Returns:
            Why the bench was tripped; empty: it was not.
        """
        rig = self._rig
        limit_v, left_v = rig.safety.settings.residual_v, rig.bench.watch.residual_v(codes)
        watched = rig.safety.settings.read_back and left_v >= limit_v
        self._unexpected = self._unexpected + 1 if watched else 0
        if self._unexpected != _IDLE_BLOCKS:
            return ""
        reason = (
            f"The voltage monitor shows {left_v:.4g} V although the bench is not armed (limit "
            f"{limit_v:g} V). Switch the high voltage off by hand, then check the instruments "
            "and the monitor cables."
        )
        rig.safety.trip(reason)
        if rig.safety.guardians is not None:
            rig.safety.guardians.make_safe(reason)
        return reason
