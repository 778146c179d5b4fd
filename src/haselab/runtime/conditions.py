"""Record what acts on the actuator while no blocks are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from haselab.actuators import GRAVITY_M_S2
from haselab.rig import Rig

__all__ = ["Conditions"]


class _Recorder(Protocol):
    def condition(
        self, time_s: float, drive_v: float, carrier_v: float, pull_n: float, mass_kg: float
    ) -> None:
        """Record what acts from a time on."""


class Conditions:
    """Keeps drive, carrier and load, and records each change with its time.

    Blocks have their own drive. Between two rows the pull changes in a straight line, all others
    stay; a pull that jumps has two rows at one time.

    Args:
        recorder: of the session.
        rig: the bench, whose own mass has hung for long.
    """

    def __init__(self, recorder: _Recorder, rig: Rig) -> None:
        self._recorder, self._rig = recorder, rig
        self._mass_kg = rig.description.mass_kg
        self._drive_v = self._carrier_v = 0.0
        self._pull_n = self._mass_kg * GRAVITY_M_S2

    def drive(self, drive_v: float) -> None:
        """The drive is another one from now on."""
        self._drive_v = drive_v
        self._record()

    def carrier(self, carrier_v: float) -> None:
        """The carrier has another amplitude from now on, in V before the amplifier."""
        self._carrier_v = carrier_v
        self._record()

    @contextmanager
    def hanging(self, mass_kg: float) -> Iterator[None]:
        """A mass is hung, at 0 V and without carrier, while the block runs."""
        self._drive_v = self._carrier_v = 0.0
        self._mass_kg = mass_kg
        with self._pulling(mass_kg * GRAVITY_M_S2):
            yield

    @contextmanager
    def lifting(self) -> Iterator[None]:
        """The mass is lifted while the block runs; it keeps its inertia."""
        with self._pulling(0.0):
            yield

    def dropped(self) -> None:
        """The lifted mass hangs freely from now on."""
        self._record()
        self._pull_n = self._mass_kg * GRAVITY_M_S2
        self._record()

    @contextmanager
    def _pulling(self, pull_n: float) -> Iterator[None]:
        self._record()
        yield
        self._pull_n = pull_n
        self._record()

    def _record(self) -> None:
        self._recorder.condition(
            self._rig.acquisition.time_s,
            self._drive_v,
            self._carrier_v,
            self._pull_n,
            self._mass_kg,
        )
