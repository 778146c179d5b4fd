"""Models in files: the contract's model.json, the general rational form, MATLAB structs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from haselab.base import InputError
from haselab.models.plant import Plant, SlowMode
from haselab.models.rational import RationalModel
from haselab.store.mat_struct import read_mat_struct

__all__ = ["MAT_NAME", "file_text", "read_loop", "read_model", "read_plant"]

MAT_NAME = "model"


def read_model(path: Path) -> RationalModel:
    """Any model: of `identify transfer`, of a run, of `export`, or a MATLAB struct.

    Args:
        path: a .mat file with a struct of num, den and perhaps delay, or JSON.
    Raises:
        InputError: no model in the file.
    """
    if path.suffix.lower() == ".mat":
        return _from_struct(read_mat_struct(path, MAT_NAME), path)
    data = _document(path)
    if isinstance(data, dict) and "numerator" in data:
        return RationalModel.from_dict(data)
    plant = _plant_of(data, path)
    values = _values(plant)
    slow = values.get("slow_modes") or []
    poles, zeros = plant.get("poles") or [], plant.get("zeros") or []
    if not zeros and len(poles) in (0, 2 + len(slow)):
        return RationalModel.from_plant(Plant.from_dict(values))
    try:
        modes = [SlowMode(float(mode["gain"]), float(mode["time_constant_s"])) for mode in slow]
        fast = [complex(*pole) for pole in poles[: len(poles) - len(slow)]]
        gain, delay_s = float(values["gain"]), float(values["delay_s"])
        model = RationalModel.from_poles(fast, [complex(*z) for z in zeros], gain, delay_s)
    except (KeyError, TypeError) as error:
        raise InputError(
            f"the model lacks or misuses {error}; needed are numbers for gain, delay_s, poles, "
            f"zeros and slow_modes. Fit it again with what is not identifiable fixed: {path}"
        ) from error
    return model.beside(modes)


def _from_struct(fields: Mapping[str, Any], path: Path) -> RationalModel:
    if "num" not in fields or "den" not in fields:
        raise InputError(
            f"the struct holds {', '.join(fields) or 'nothing'}; needed are num and den. Save "
            f"num{{1}} and den{{1}} of the model as its fields: {path}"
        )
    if float(fields.get("Ts", 0.0)) != 0.0:
        raise InputError(
            f"the model is in discrete time (Ts = {float(fields['Ts']):g} s); allowed is 0. "
            f"Convert it with d2c: {path}"
        )
    top, bottom = (tuple(fields[name].astype(float).ravel().tolist()) for name in ("num", "den"))
    return RationalModel(
        top,
        bottom,
        float(fields.get("delay", 0.0)),
        str(fields.get("InputName", "u")),
        str(fields.get("OutputName", "y")),
    )


def read_plant(path: Path) -> Plant:
    """The plant of a model.json."""
    return Plant.from_dict(_values(_plant_of(_document(path), path)))


def read_loop(path: Path) -> dict[str, float]:
    """What a model.json tells of the loop that it was measured for: `rate_hz`, `loop_delay_s`.

    Raises:
        InputError: one of them is not a number above 0.
    """
    data = _document(path)
    told = {name: data[name] for name in ("rate_hz", "loop_delay_s") if name in data}
    for name, value in told.items():
        if not isinstance(value, (int, float)) or not 0.0 < value < math.inf:
            raise InputError(f"{name} = {value!r}, allowed: a number above 0. Correct it: {path}")
    return {name: float(value) for name, value in told.items()}


def _document(path: Path) -> Any:
    try:
        return json.loads(file_text(path))
    except json.JSONDecodeError as error:
        raise InputError(
            f"the model is not JSON (line {error.lineno}: {error.msg}); allowed: a file of "
            f"`haselab identify transfer` or `haselab reproduce`. Write it again: {path}"
        ) from error


def _plant_of(data: Any, path: Path) -> dict[str, Any]:
    plant = data.get("plant", data) if isinstance(data, dict) else None
    if not isinstance(plant, dict) or "natural_frequency_rad_s" not in plant:
        found = ", ".join(data) if isinstance(data, dict) else type(data).__name__
        raise InputError(
            f"the model holds {found or 'nothing'}; needed: an object `plant` with gain, "
            f"natural_frequency_rad_s, damping_ratio. Add it: {path}"
        )
    return plant


def _values(plant: dict[str, Any]) -> dict[str, Any]:
    """Numbers of a plant whose estimates come with intervals; an estimated delay is 0 or more."""
    plain = {
        name: item["value"] if isinstance(item, dict) and "value" in item else item
        for name, item in plant.items()
    }
    if isinstance(plain.get("slow_modes"), list):
        plain["slow_modes"] = [
            _values(mode) if isinstance(mode, dict) else mode for mode in plain["slow_modes"]
        ]
    estimated = isinstance(plant.get("delay_s"), dict) and isinstance(plain["delay_s"], float)
    return plain | ({"delay_s": max(0.0, plain["delay_s"])} if estimated else {})


def file_text(path: Path) -> str:
    """A text file, or an `InputError`."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise InputError(
            f"the file cannot be read ({reason}); allowed: a readable text file. Check the name: "
            f"{path}"
        ) from error
