r"""Slow changes of an actuator in a record: of stiffness, such as by ageing, and permittivity.

All elastic forces, or the permittivity, have the factor

$1 + r\,\tau\,(1 - e^{-t/\tau})$

a time $t$ after the record's first edge, with the rate $r$ there and the time constant $\tau$. The
family does not depend on when the change began: later, it has another rate and the same $\tau$.
"""

from __future__ import annotations

from collections.abc import Mapping

from haselab.base import LimitError

__all__ = ["DRIFTS", "DRIFT_LIMITS", "DRIFT_TIMES", "DRIFT_UNITS", "drift_pairs"]

STIFFNESS = ("drift.stiffness_per_s", "drift.stiffness_s")
PERMITTIVITY = ("drift.permittivity_per_s", "drift.permittivity_s")
DRIFTS = (*STIFFNESS, *PERMITTIVITY)
DRIFT_TIMES = (STIFFNESS[1], PERMITTIVITY[1])
DRIFT_UNITS = {name: "s" if name in DRIFT_TIMES else "1/s" for name in DRIFTS}
DRIFT_LIMITS = {name: (10.0, 1e6) if name in DRIFT_TIMES else (-0.01, 0.01) for name in DRIFTS}
_LEAST = 0.1  # of stiffness or permittivity that is left


def drift_pairs(values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Rates and time constants as the compiled motion takes them.

    Args:
        values: by the names of `DRIFTS`; those that are missing are 0.
    Returns:
        Pairs by the fields of the compiled motion; a time constant of 0 switches a drift off.
    Raises:
        LimitError: Hardly anything would be left of the stiffness or of the permittivity.
    Example:
        >>> drift_pairs({"drift.stiffness_per_s": -1e-5, "drift.stiffness_s": 600.0})
        {'elastic_drift': (-1e-05, 600.0), 'electric_drift': (0.0, 0.0)}
    """
    found = {}
    for field, (rate, time) in (("elastic_drift", STIFFNESS), ("electric_drift", PERMITTIVITY)):
        pair = values.get(rate, 0.0), values.get(time, 0.0)
        if not 1.0 + pair[0] * pair[1] > _LEAST:
            raise LimitError(
                f"{rate} = {pair[0]:g} and {time} = {pair[1]:g} leave less than {_LEAST:g} of it. "
                "Change them."
            )
        found[field] = pair
    return found
