"""Keys of an actuator file that look like misspelled ones: nothing would read them."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from haselab.models.actuator.model_tables import PlantTable, RationalTable
from haselab.models.actuator.sections import ActuatorTables

__all__ = ["Misspelled", "close_key", "misspelled_keys"]

_CLOSE = 0.8  # ratio of difflib: one letter off in a word of four, two in one of ten
# Keys that commands write and that no field of ActuatorTables holds.
_WRITTEN = {
    "": ("provenance",),
    "sensing": ("date", "amplifier", "rate_hz", "scale_std_s", "stray_s", "offsets_v", "residual",
                "reference"),
    "model": (*PlantTable.model_fields, *RationalTable.model_fields, "fit_percent", "input_unit",
              "output_unit", "training_output", "through_voltage_map", "linear_models",
              "input_range"),
    "controller": ("predicted", "plausible", "uncertainty"),
}  # fmt: skip
_GAINS = ("kp", "ki", "kd", "derivative_filter_s")
_MARGINS = ("phase_margin_deg", "phase_margin_deg_std", "gain_margin_db", "gain_margin_db_std",
            "delay_margin_s", "peak_sensitivity", "crossover_rad_s", "worst_phase_margin_deg",
            "worst_gain_margin_db", "stable", "stability_margin", "guaranteed_gain_margin_db",
            "guaranteed_phase_margin_deg")  # fmt: skip
# Their content is checked by whoever reads it, or is written only.
_NOT_LOOKED_INTO = {
    "provenance",
    "model.covariance",
    "model.training_output",
    "model.linear_models",
    "controller.demands",
}


@dataclass(frozen=True)
class Misspelled:
    """A key that nothing reads.

    Args:
        section: that it is in; empty: it is a section itself.
        key: as it was typed.
        meant: the known key that is close to it.
    """

    section: str
    key: str
    meant: str

    def __str__(self) -> str:
        if not self.section:
            return f"[{self.key}] has no effect; did you mean [{self.meant}]?"
        return f"[{self.section}] {self.key} has no effect; did you mean {self.meant}?"


def close_key(key: str, known: Collection[str]) -> str:
    """The known key that is close to another one.

    Args:
        key: as it was typed.
        known: the keys that there are.
    Returns:
        The closest one; empty where none is close.
    Example:
        >>> close_key("hihg_v", ["low_v", "high_v"]), close_key("colour", ["low_v", "high_v"])
        ('high_v', '')
    """
    return next(iter(difflib.get_close_matches(key.lower(), known, 1, _CLOSE)), "")


def misspelled_keys(sections: Mapping[str, Any]) -> list[Misspelled]:
    """Unknown keys that are close to a known one of the same section.

    Other unknown keys are the user's own and are left alone.

    Args:
        sections: of an actuator file, unchecked.
    Returns:
        One entry a key, in the order of the file.
    """
    return list(_looked_into(sections, ActuatorTables, ""))


def _looked_into(
    table: Mapping[str, Any], kind: type[BaseModel] | None, place: str
) -> Iterator[Misspelled]:
    fields = {} if kind is None else kind.model_fields
    known = [*fields, *_WRITTEN.get(place, ())]
    if place.endswith("parameters"):
        known += _GAINS
    if place == "controller.margins":
        known += _MARGINS
    for key, item in table.items():
        inner = f"{place}.{key}" if place else key
        if key not in known:
            # `haselab init` writes every section, so a misspelled one stands beside the right one.
            if meant := close_key(key, [name for name in known if not place or name not in table]):
                yield Misspelled(place, key, meant)
            continue
        if inner in _NOT_LOOKED_INTO or key not in fields:
            continue
        if key == "parameters":
            if table.get("kind", "pid") in ("pi", "pid") and isinstance(item, Mapping):
                yield from _looked_into(item, None, inner)
            continue
        if inner == "controller.margins" and isinstance(item, Mapping):
            yield from _looked_into(item, None, inner)
        model = _model_in(fields[key].annotation)
        for part in item if isinstance(item, list) else [item]:
            if model is not None and isinstance(part, Mapping):
                yield from _looked_into(part, model, _place_of(inner))


def _place_of(inner: str) -> str:
    """Alternatives are controllers, with the keys of one."""
    return "controller" if inner.endswith(".alternatives") else inner


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model of a field: `X`, `X | None` or `tuple[X, ...]`."""
    for kind in (annotation, *typing.get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None
