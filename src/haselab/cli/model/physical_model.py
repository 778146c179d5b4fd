"""The physical model of an actuator file, with the uncertainty of its parameters."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from haselab.actuators import ACTUATORS, measured_parameters, with_stated
from haselab.base import InputError, LimitError, table_at
from haselab.cli.actuator_file import load_actuator
from haselab.identify.physical import ChannelNoise, IdentifiedModel
from haselab.models.actuator import ActuatorTables
from haselab.store.actuator_file import read_actuator

__all__ = ["has_physical_model", "read_physical_model", "sources_of_physical_model"]


def has_physical_model(path: Path) -> bool:
    """Whether a file is an actuator file with `[model.physical]`.

    Args:
        path: of any model file.
    """
    return path.suffix.lower() == ".toml" and bool(
        table_at(read_actuator(path), "model", "physical")
    )


def sources_of_physical_model(path: Path) -> frozenset[str]:
    """SHA-256 of the recordings that `[model.physical]` was identified from.

    Args:
        path: of the actuator file.
    """
    found = table_at(read_actuator(path), "provenance", "model", "physical").get("sha256")
    return frozenset(map(str, found)) if isinstance(found, list) else frozenset()


def read_physical_model(path: Path) -> tuple[IdentifiedModel, ActuatorTables]:
    """Read the physical model of an actuator file.

    Args:
        path: of the file.
    Returns:
        The model, and all sections of the file.
    Raises:
        InputError: There is no model, it has no covariance, its kind is unknown or not that of
            `[actuator]`, or a value is outside its limits.
    """
    if path.suffix.lower() != ".toml":
        raise InputError(
            f"A physical model is in an actuator file, such as A.toml. Leave out --model. {path}"
        )
    tables = load_actuator(path)
    about, model = tables.actuator, tables.model.physical if tables.model else None
    again = f"haselab identify actuator RUN --actuator {path}"
    if model is None:
        raise InputError(f"The actuator file has no [model.physical]. Add it with: {again}")
    if model.kind != about.kind:
        raise InputError(
            f"[model.physical] is of the kind {model.kind!r}, but [actuator] of {about.kind!r}. "
            f"Correct the kind, or identify the actuator again. {path}"
        )
    if model.covariance is None:
        raise InputError(
            "[model.physical] has no covariance, so the prediction would have no band. Identify "
            f"the actuator with: {again}"
        )
    mass_kg = model.mass_kg or about.mass_kg
    if mass_kg is None:
        raise InputError(f"[model.physical] has no mass_kg, the hung mass of its records. {path}")
    names, left = model.covariance.names, model.residuals
    if model.status != "ok":
        worst = (left.length_worst_m, left.capacitance_worst_f)
        if left.hidden_variance is None or worst == (None, None):
            raise InputError(
                f"[model.physical] has the status {model.status!r}, but no residuals that say how "
                f"large its error is. Identify the actuator again with: {again}"
            )
        click.echo(
            f"haselab: warning: [model.physical] has the status {model.status!r}. The band allows "
            f"for an error like those in the records of the fit. File: {path}",
            err=True,
        )
    matrix = np.array(model.covariance.matrix, dtype=np.float64).reshape(len(names), len(names))
    widening = np.array(model.covariance.widening or [1.0] * len(names))
    explained = model.status == "ok"
    try:
        law = with_stated(ACTUATORS.find(model.kind)(), about.parameters)
        model.check_measured(measured_parameters(law))
        found = IdentifiedModel.of(
            law,
            model.parameters,
            names,
            matrix / np.outer(widening, widening) * (1.0 + (left.hidden_variance or 0.0)),
            mass_kg=mass_kg,
            length=_noise(left.length_factor, left.length_noise_m, left.length_worst_m, explained),
            capacitance=_noise(
                left.capacitance_factor,
                left.capacitance_noise_f,
                left.capacitance_worst_f,
                explained,
            ),
        )
    except (InputError, LimitError) as error:
        raise InputError(f"[model.physical]: {error} {path}") from error
    return found, tables


def _noise(
    factor: float | None, noise: float | None, worst: float | None, explained: bool
) -> ChannelNoise:
    nan = float("nan")
    return ChannelNoise(
        1.0 if factor is None else factor,
        nan if noise is None else noise,
        nan if worst is None else worst,
        explained,
    )
