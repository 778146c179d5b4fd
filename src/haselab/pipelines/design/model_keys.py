"""Keys of a model.json: an unknown one is refused, because it would have no effect on the loop."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from haselab.base import InputError
from haselab.models.actuator.model_tables import (
    LoopTable,
    OriginTable,
    PlantTable,
    RationalTable,
)

__all__ = ["refuse_unknown_keys"]

_FITTED = "covariance"
_BESIDE = {*LoopTable.model_fields, *OriginTable.model_fields}
# Keys that haselab writes beside a model, and that no command reads from it again.
_WRITTEN = {
    # identify transfer
    "fit_percent", "validation_fit_percent", "residual_whiteness_p", "input_correlation_p",
    "status", "notes", "other_minima", "structure", "candidates", "nonlinear", "bootstrap",
    "gain_unit",
    # identify frequency-response --fit
    "method", "frequency_hz", "magnitude", "phase_rad", "coherence", "std", "magnitude_std",
    "phase_std_rad", "distortion_std", "fit",
    # runs of older versions
    "zero_strain_length_m", "strain_map", "voltage_map",
}  # fmt: skip
_PLANT = {*PlantTable.model_fields, _FITTED}
_RATIONAL = {*RationalTable.model_fields, _FITTED}
_MODE = {"gain", "time_constant_s"}
_DISCRETE = ({"a", "b", "orders"}, {"a", "b", "c", "d", "singular_values"})  # arx, subspace
_LONGEST = 60  # characters of a key that are shown


def refuse_unknown_keys(data: Any, path: Path) -> None:
    """Refuse a model.json with a key that no command knows.

    Args:
        data: content of the file, unchecked. One without a model is left to its reader.
        path: of the file, for the message.
    Raises:
        InputError: an unknown key, numerator and denominator inside `plant`, or a model in discrete
            time.
    """
    if not isinstance(data, dict):
        return
    if any(keys <= data.keys() for keys in _DISCRETE):
        raise InputError(
            "The file has a model in discrete time, of 'identify arx' or 'identify subspace'. "
            f"Identify one in continuous time with: haselab identify transfer FILE --out {path}"
        )
    plant = data.get("plant")
    if isinstance(plant, dict) and "numerator" in plant:
        raise InputError(
            "numerator and denominator are inside `plant`. Put them at the top of the file, "
            f"without `plant`: {path}"
        )
    for place, key, known in _unknown(data):
        name = f"{place}{key if key.isidentifier() else repr(key)}"[:_LONGEST]
        if not place and isinstance(plant, dict) and key in _PLANT:
            raise InputError(f"{key} is beside `plant`. Move it into `plant`: {path}")
        close = next(iter(difflib.get_close_matches(key.lower(), sorted(known), 1)), None)
        meant = f"Did you mean {close}?" if close else f"The keys are {', '.join(sorted(known))}."
        raise InputError(f"A model has no key {name}. {meant} Correct or remove it: {path}")


def _unknown(data: dict[str, Any]) -> Iterator[tuple[str, str, Collection[str]]]:
    """Place, name and known neighbours of each unknown key; nothing for a file without model."""
    plant = data.get("plant")
    if "numerator" in data:
        yield from _beyond("", data, _RATIONAL, _BESIDE | _WRITTEN)
    elif isinstance(plant, dict) and "gain" in plant:
        yield from _beyond("", data, {"plant"} | _BESIDE, _WRITTEN)
        yield from _beyond("plant.", plant, _PLANT, set())
        yield from _in_modes("plant.", plant)
    elif "plant" not in data and "gain" in data:
        yield from _beyond("", data, _PLANT, _BESIDE | _WRITTEN)
        yield from _in_modes("", data)


def _in_modes(place: str, plant: dict[str, Any]) -> Iterator[tuple[str, str, Collection[str]]]:
    modes = plant.get("slow_modes")
    for number, mode in enumerate(modes if isinstance(modes, list) else []):
        if isinstance(mode, dict):
            yield from _beyond(f"{place}slow_modes.{number}.", mode, _MODE, set())


def _beyond(
    place: str, table: dict[str, Any], known: set[str], written: set[str]
) -> Iterator[tuple[str, str, Collection[str]]]:
    for key in table:
        if key not in known and key not in written:
            yield place, key, known
