"""Arm a bench in a `with` block that always ends at 0 V, read back."""

from __future__ import annotations

import atexit
import contextlib
import os
from collections.abc import Callable

from haselab.base import SafetyError, checked
from haselab.rig import Rig
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.signals import OrderlyEnd
from haselab.safety.state_machine import Safety, SafetySettings, Stage

__all__ = ["arm_simulated", "armed", "zero_at_end"]


@checked
def armed(
    rig: Rig, settings: SafetySettings | None = None, *, acknowledged: str = ""
) -> contextlib.AbstractContextManager[GuardedRig]:
    """Guard and arm a bench; the `with` block always ends at 0 V, read back.

    HIGH VOLTAGE MAY BE APPLIED inside the block. Keep clear. Entering the block takes both steps of
    arming, so read the limits of the bench before you write it.

    Args:
        rig: the bench, of drivers shipped with haselab or written by you.
        settings: limits of the safety chain; None: the defaults.
        acknowledged: the reason for the last trip, word for word, once its cause is removed.
    Returns:
        A context with the bench behind its safety chain.
    Raises:
        InputError: A driver lacks the methods that take it to 0 V.
        SafetyError: The reason for the last trip was not acknowledged; or at the end, the output is
            not confirmed at 0 V. Then the bench is tripped: switch the high voltage off by hand.
    Example:
        >>> from haselab.rig.twin.twin_bench import make_twin
        >>> from haselab.rig.twin.config import twin_of_reading
        >>> with armed(make_twin(twin_of_reading("hz"), 1)) as guarded:
        ...     guarded.source.write(0.5)
    """
    return _Armed(rig, settings, acknowledged)


def zero_at_end(guarded: GuardedRig) -> contextlib.AbstractContextManager[object]:
    """Return a context that always ends at 0 V, read back; arm the bench inside it.

    The end of the program ends it too, also for a block in a thread that is still running.

    Args:
        guarded: the bench behind its safety chain.
    Returns:
        A context.
    Raises:
        SafetyError: The output is not confirmed at 0 V at the end.
    """

    return OrderlyEnd(_way_to_zero(guarded))


def _way_to_zero(guarded: GuardedRig) -> Callable[[BaseException | None], None]:
    _live[id(guarded)] = (guarded, os.getpid())

    def to_zero(_: BaseException | None) -> None:
        _live.pop(id(guarded), None)
        try:
            if _was_armed(guarded):
                guarded.safe()
        finally:
            guarded.safety.end_run()

    return to_zero


def _was_armed(guarded: GuardedRig) -> bool:
    return guarded.safety.stage not in (Stage.OFF, Stage.REQUESTED)


# benches in a block that ends at 0 V, with their process
_live: dict[int, tuple[GuardedRig, int]] = {}


@atexit.register
def _at_exit() -> None:
    for guarded, process in list(_live.values()):
        if process == os.getpid() and _was_armed(guarded):
            with contextlib.suppress(Exception):
                guarded.safety.trip("The program ended while the bench was armed.")


class _Armed(OrderlyEnd):
    """What `armed` returns. Not a generator: a signal could end one before its cleanup runs."""

    def __init__(self, rig: Rig, settings: SafetySettings | None, acknowledged: str) -> None:
        super().__init__(lambda error: self._to_zero(error))
        self._rig, self._settings, self._acknowledged = rig, settings, acknowledged

    def __enter__(self) -> GuardedRig:
        guarded = guard(self._rig, Safety(self._settings or SafetySettings()))
        self._to_zero = _way_to_zero(guarded)
        try:
            super().__enter__()
            guarded.safety.arm(guarded.safety.request(), self._acknowledged)
            return guarded
        except BaseException as error:
            self.__exit__(None, error, None)
            raise


def arm_simulated(guarded: GuardedRig) -> None:
    """Arm a simulated bench, which cannot put out a voltage, without confirmation.

    Raises:
        SafetyError: The bench is not simulated in this process, or a trip is not acknowledged.
    """
    if not guarded.simulated:
        raise SafetyError(
            f"The bench {guarded.description.name!r} is not armed. Arm it before you run something "
            "on it: 'with armed(rig) as guarded:' (haselab.safety.armed), then use guarded."
        )
    guarded.safety.arm(guarded.safety.request())
