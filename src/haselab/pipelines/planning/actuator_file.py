"""Plan experiments for the physical model that an actuator file holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from haselab.actuators import (
    ACTUATORS,
    ADDED_INERTIA,
    DRIFTS,
    measured_parameters,
    with_parameters,
    with_stated,
)
from haselab.base import InputError, LimitError
from haselab.identify.physical.outlook import Outlook
from haselab.identify.physical.unknowns import Unknowns
from haselab.models.actuator.sections import ActuatorSection, PhysicalTable
from haselab.pipelines.planning.catalogue import Range
from haselab.pipelines.planning.proposal import Planner

__all__ = ["planner_of"]

Ends = Callable[[float], tuple[float | None, float | None]]
_AGAIN = "Identify the actuator again: haselab identify actuator RUN --actuator"


def planner_of(about: ActuatorSection, model: PhysicalTable, ends_v: Ends, path: Path) -> Planner:
    """Prepare to plan experiments for a physical model.

    Args:
        about: `[actuator]`.
        model: `[model.physical]`.
        ends_v: lowest and highest drive for a gain, see `ActuatorTables.drive_ends_v`; without a
            highest drive, that of the records counts.
        path: of the actuator file, for messages.
    Raises:
        InputError: The model has no records or no covariance, or they do not fit together.
    """
    records, covariance, mass_kg = model.records, model.covariance, model.mass_kg
    if records is None or covariance is None or mass_kg is None:
        raise InputError(
            "[model.physical] does not say what it was identified from: [model.physical.records] "
            f"or its covariance is missing, or mass_kg. {_AGAIN} {path}"
        )
    try:
        law = with_stated(ACTUATORS.find(model.kind)(), about.parameters)
        model.check_measured(measured_parameters(law))
        values = dict(model.parameters)
        own = {about.key for about in law.described()}
        law = with_parameters(law, {k: v for k, v in values.items() if k.partition("[")[0] in own})
    except (InputError, LimitError) as error:
        raise InputError(f"[model.physical]: {error} {path}") from error
    unknowns = Unknowns.of(
        law, added_inertia_kg=values.get(ADDED_INERTIA, 0.0), mass_kg=mass_kg,
        drifts={name: value for name, value in values.items() if name in DRIFTS},
    )  # fmt: skip
    if set(unknowns.names) != set(covariance.names) or set(unknowns.names) - set(values):
        odd = sorted(set(unknowns.names) ^ set(covariance.names)) or sorted(unknowns.names)
        raise InputError(
            "The parameters and the covariance of [model.physical] are not those of the law "
            f"({', '.join(odd)}). {_AGAIN} {path}"
        )
    unknowns = replace(unknowns, values=np.array([values[name] for name in unknowns.names]))
    order = [covariance.names.index(name) for name in unknowns.names]
    matrix = np.array(covariance.matrix, dtype=np.float64)[np.ix_(order, order)]
    highest_v = ends_v(records.gain_v_per_v)[1]
    within = Range(
        records.highest_drive_v if highest_v is None else highest_v,
        max(records.heaviest_kg, mass_kg),
        mass_kg,
    )
    return Planner(Outlook.of(unknowns, matrix, records.excess_variance), records, within)
