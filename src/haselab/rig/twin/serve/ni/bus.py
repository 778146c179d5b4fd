"""The bus between an emulated NI device and its driver, with faults.

On a plug-in board a sample is in the computer's memory when it has been taken, and a value in the
device when it has been written. Over USB both travel in packets (USB-621x User Manual p. 5-3: in
large blocks). How large they are and how long they take is inferred: a high-speed bulk packet has
512 bytes, and a millisecond is eight of USB's microframes.
"""

from __future__ import annotations

from dataclasses import dataclass

from haselab.base import LimitError
from haselab.rig.twin.serve.ni.devices import NiDevice

__all__ = ["BoardFaults", "Bus"]

_PACKET_SAMPLES = 128  # of two channels, 512 bytes
_WRITE_S = 1e-3


@dataclass(frozen=True)
class BoardFaults:
    """Faults of a served board; none by default.

    Args:
        usb_lag_samples: by which counts and samples, and values to put out, come later still.
        stall_s: a USB device that is not queried for this long sends nothing until its task is
            started again (nidaqmx-python issue 931); 0: it goes on.
        refuse_routes: terminals, or `source>destination` as `ai/StartTrigger>Ctr1ArmStartTrigger`.
        orphaned_tasks: a crashed program still holds inputs, output and counters.
        slow_transfer: samples that travel in one packet, in place of the usual number; 0: usual.
    Raises:
        LimitError: a number below zero.
    """

    usb_lag_samples: int = 0
    stall_s: float = 0.0
    refuse_routes: tuple[str, ...] = ()
    orphaned_tasks: bool = False
    slow_transfer: int = 0

    def __post_init__(self) -> None:
        for name in ("usb_lag_samples", "stall_s", "slow_transfer"):
            if not getattr(self, name) >= 0:
                raise LimitError(f"{name} is {getattr(self, name)}, but must be 0 or more.")


class Bus:
    """How far the computer's view of a device is behind it, in samples.

    Args:
        device: the product.
        rate_hz: of the inputs.
        faults: planted.
    """

    def __init__(self, device: NiDevice, rate_hz: float, faults: BoardFaults) -> None:
        self._packet = (faults.slow_transfer or _PACKET_SAMPLES) if device.usb else 1
        self._lag = faults.usb_lag_samples if device.usb else 0
        self.write_samples = round(_WRITE_S * rate_hz) + self._lag if device.usb else 0
        self._stall = round(faults.stall_s * rate_hz) if device.usb else 0
        self._asked = 0  # samples there were at the last question
        self._stuck: int | None = None

    def restart(self) -> None:
        """The inputs start: nothing waits."""
        self._asked, self._stuck = 0, None

    def visible(self, acquired: int) -> int:
        """Samples that have come to the computer, at a question about them.

        Args:
            acquired: samples that the device has taken.
        """
        if self._stuck is None and self._stall and acquired - self._asked > self._stall:
            self._stuck = self._seen(self._asked + self._stall)
        self._asked = max(self._asked, acquired)
        return self._seen(acquired) if self._stuck is None else self._stuck

    def _seen(self, acquired: int) -> int:
        return max(acquired - self._lag, 0) // self._packet * self._packet

    def needed(self, samples: int) -> int | None:
        """Samples that the device must have taken before so many have come; None: never."""
        if self._stuck is not None and samples > self._stuck:
            return None
        return -(-samples // self._packet) * self._packet + self._lag
