"""An own bench from the first permission to 0 V, read back: one `with` block."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from haselab.base import SafetyError
from haselab.rig import Rig
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.signals import OrderlyEnd
from haselab.safety.state_machine import Safety, SafetySettings, Stage

__all__ = ["arm_simulated", "armed", "ends_at_zero"]


@contextlib.contextmanager
def armed(
    rig: Rig, settings: SafetySettings | None = None, *, acknowledged: str = ""
) -> Iterator[GuardedRig]:
    """Guard and arm a bench; every way out of the `with` block is 0 V, read back.

    HIGH VOLTAGE MAY BE APPLIED inside the block. Entering it is both steps of arming: whoever
    writes it has read the limits of the bench.

    Args:
        rig: the bench, of drivers shipped with haselab or written by you.
        settings: limits of the safety chain; None: the default ones.
        acknowledged: the reason of the last trip, word for word, once its cause is removed.
    Returns:
        A context with the bench behind its safety chain.
    Raises:
        InputError: a driver without the methods that take it to 0 V.
        SafetyError: the reason of the last trip was not acknowledged; or at the end, the output is
            not at 0 V or not known to be. Then the bench is tripped: switch the high voltage off by
            hand.
    Example:
        >>> from haselab.rig.twin.bench import make_twin
        >>> from haselab.rig.twin.config import twin_of_reading
        >>> with armed(make_twin(twin_of_reading("hz"), 1)) as guarded:
        ...     guarded.source.write(0.5)
    """
    guarded = guard(rig, Safety(settings or SafetySettings()))
    with ends_at_zero(guarded):
        guarded.safety.arm(guarded.safety.request(), acknowledged)
        yield guarded


@contextlib.contextmanager
def ends_at_zero(guarded: GuardedRig) -> Iterator[None]:
    """Every way out of the `with` block is 0 V, read back; the arming happens inside it.

    Args:
        guarded: the bench behind its safety chain.
    Raises:
        SafetyError: the output is not at 0 V at the end, or not known to be.
    """
    with OrderlyEnd() as signals:
        try:
            yield
        finally:
            with signals.finishing():
                try:
                    if guarded.safety.stage not in (Stage.OFF, Stage.REQUESTED):  # it was armed
                        guarded.safe()
                finally:
                    guarded.safety.end_run()


def arm_simulated(guarded: GuardedRig) -> None:
    """Arm a bench that can put out no voltage, without anybody's word.

    Raises:
        SafetyError: it is not simulated in this process, or has a reason to be acknowledged.
    """
    if not guarded.simulated:
        raise SafetyError(
            f"The bench {guarded.description.name!r} is not armed. Arm it before you run something "
            "on it: 'with armed(rig) as guarded:' (haselab.safety.armed), then use guarded."
        )
    guarded.safety.arm(guarded.safety.request())
