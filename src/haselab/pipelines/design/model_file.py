"""Models in files: actuator.toml, model.json, the general rational form, MATLAB structs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from haselab.base import InputError
from haselab.control import LoopSetting
from haselab.identify.nonlinear.input_curve import InputCurve
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.model_tables import (
    CovarianceTable,
    LoopTable,
    NonlinearTable,
    OriginTable,
    PlantTable,
    PolesTable,
    RationalTable,
)
from haselab.models.actuator.sections import missing
from haselab.models.plant import Plant, SlowMode
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel
from haselab.pipelines.design.model_keys import refuse_unknown_keys
from haselab.rig.twin.twin_file import is_actuator_file, load_twin
from haselab.store.actuator_file import read_actuator, read_run
from haselab.store.columns.mat_struct import read_mat_struct
from haselab.store.folder import read_json
from haselab.store.toml import validated

__all__ = [
    "MAT_NAME",
    "loop_of",
    "read_any_plant",
    "read_input_curve",
    "read_loop",
    "read_model",
    "read_origin",
    "read_plant",
    "read_posterior",
    "read_tables",
]

MAT_NAME = "model"

_Checked = TypeVar("_Checked", bound=PolesTable)
_USUAL = LoopSetting()
_LEAST_GAIN = 1e-6  # of the largest one
_SAME = 1e-3  # relative difference of responses: a file rounded by hand has fewer digits


def read_tables(path: Path) -> ActuatorTables:
    """Read the sections of an actuator file, or of the folder of a run.

    Args:
        path: of the file or the folder.
    Returns:
        The checked sections.
    Raises:
        InputError: no such file, or an impossible value.
    """
    return validated(ActuatorTables, read_run(path), path)


def read_model(path: Path) -> RationalModel:
    """Read any model: an actuator file, `identify transfer`, `export`, or a MATLAB struct.

    Args:
        path: an actuator file, JSON, or a .mat file with a struct of num, den and perhaps delay.
    Raises:
        InputError: no model in the file.
    """
    if path.suffix.lower() == ".mat":
        return _from_struct(read_mat_struct(path, MAT_NAME), path)
    data = _data(path)
    if isinstance(data, dict) and "numerator" in data:
        return RationalModel.from_dict(validated(RationalTable, data, path).model_dump())
    plant = _plant_of(data, path)
    table = _checked(PolesTable, plant, path)
    poles, zeros, slow = table.poles or [], table.zeros or [], table.slow_modes
    if not zeros and len(poles) in (0, 2 + len(slow)):
        return RationalModel.from_plant(_plant(_checked(PlantTable, plant, path)))
    fast = [complex(*pole) for pole in poles[: len(poles) - len(slow)]]
    model = RationalModel.from_poles(
        fast, [complex(*zero) for zero in zeros], table.gain, table.delay_s
    )
    return model.beside([SlowMode(mode.gain, mode.time_constant_s) for mode in slow])


def _data(path: Path) -> Any:
    """The content of a model.json, or `[model]` of an actuator file in the same form."""
    if path.suffix.lower() != ".toml":
        data = read_json(path)
        refuse_unknown_keys(data, path)
        return data
    sections = read_actuator(path)
    model = sections.get("model")
    table = model if isinstance(model, dict) else {}
    if not table.keys() & {"gain", "numerator"}:
        held = [key for key in table if key not in ("physical", "provenance")]
        if held:
            raise InputError(
                f"[model] has {', '.join(held)}, but neither gain nor numerator. Add gain, or "
                f"check its spelling: {path}"
            )
        if _is_twin(path):
            raise InputError(
                f"{path} is a twin file, which has no [model]. Name an actuator file, or export "
                f"the twin with: haselab export {path} --to fmu --out TWIN.fmu"
            )
        raise InputError(f"{missing('model', 'haselab identify transfer FILE')} {path}")
    if "numerator" in table:
        return table
    loop = {name: table[name] for name in ("rate_hz", "loop_delay_s") if name in table}
    return {"plant": table, **loop}


def _from_struct(fields: Mapping[str, Any], path: Path) -> RationalModel:
    if "num" not in fields or "den" not in fields:
        raise InputError(
            f"The struct has the fields {', '.join(fields) or 'none'}, but must have num and den. "
            f"Save num{{1}} and den{{1}} of the model as its fields: {path}"
        )
    scalars = {"Ts": 0.0, "delay": 0.0} | {
        name: _scalar(fields[name], path) for name in ("Ts", "delay") if name in fields
    }
    if scalars["Ts"] != 0.0:
        raise InputError(
            f"The model is in discrete time (Ts = {scalars['Ts']:g} s). Convert it to continuous "
            f"time with d2c: {path}"
        )
    table = {
        "numerator": _vector(fields["num"], path),
        "denominator": _vector(fields["den"], path),
        "delay_s": scalars["delay"],
        "input": str(fields.get("InputName", "u")),
        "output": str(fields.get("OutputName", "y")),
    }
    return RationalModel.from_dict(validated(RationalTable, table, path).model_dump())


def _vector(field: Any, path: Path) -> list[float]:
    """Numbers of a field of a struct."""
    try:
        return [float(value) for value in np.asarray(field, dtype=np.float64).ravel()]
    except (TypeError, ValueError):
        raise InputError(f"num and den of the struct must be real numbers: {path}") from None


def _scalar(field: Any, path: Path) -> float:
    """The one number of a field of a struct."""
    values = _vector(field, path)
    if len(values) != 1:
        raise InputError(f"Ts and delay of the struct must be one number each: {path}")
    return values[0]


def read_plant(path: Path) -> Plant:
    """Read the plant of a model.json."""
    return _plant(_checked(PlantTable, _plant_of(_data(path), path), path))


def read_any_plant(path: Path) -> Plant | RationalModel:
    """Read the plant of a model file: one resonance if it has that form, else the rational one."""
    if path.suffix.lower() != ".mat":
        data = _data(path)
        if not (isinstance(data, dict) and "numerator" in data):
            plant = _plant_of(data, path)
            table = _checked(PolesTable, plant, path)
            if not table.zeros and len(table.poles or []) in (0, 2, 2 + len(table.slow_modes)):
                return _plant(_checked(PlantTable, plant, path))
    model = read_model(path)
    try:
        return model.to_plant()
    except InputError:
        return model


def read_posterior(path: Path) -> PlantPosterior | None:
    """Read the parameters of a model with their covariance; None if the file has none.

    Raises:
        InputError: a parameter is not identifiable, the covariance is invalid, or it belongs to
            other parameters than those of the model in the file.
    """
    if path.suffix.lower() == ".mat":
        return None
    data = _data(path)
    general = isinstance(data, dict) and "numerator" in data
    table = data if general else _plant_of(data, path)
    if table.get("covariance") is None:
        return None
    found = validated(CovarianceTable, table["covariance"], path).model_dump()
    try:
        posterior = PlantPosterior.from_dict(found)
    except InputError as error:
        raise InputError(f"{str(error).rstrip('.')}: {path}") from None
    plant, nominal = read_any_plant(path), posterior.nominal
    sizes = np.abs(np.asarray(plant.poles, dtype=complex))
    scale = np.median(sizes[sizes > 0.0]) if (sizes > 0.0).any() else 1.0
    omega = scale * np.geomspace(0.011, 97.0, 12)  # does not hit a pole on the axis
    ours, theirs = plant.frequency_response(omega), nominal.frequency_response(omega)
    if not (np.abs(ours - theirs) <= _SAME * np.abs(ours)).all():
        raise InputError(
            "The covariance belongs to other parameters than those of the model in the file. "
            f"Identify the model again, or remove the key covariance: {path}"
        )
    return posterior


def read_origin(path: Path) -> OriginTable:
    """Read what signals and records a model was fitted to, as far as its file states them.

    Raises:
        InputError: an impossible value.
    """
    if path.suffix.lower() == ".mat":
        return OriginTable()
    data = _data(path)
    return validated(OriginTable, {**data, **data.get("plant", {})}, path)


def read_input_curve(path: Path) -> InputCurve | None:
    """Read the curve ahead of a Hammerstein model; None for a linear model.

    Raises:
        InputError: the model is nonlinear in another way, or an impossible value.
    """
    data = {} if path.suffix.lower() == ".mat" else _data(path)
    stated = data.get("nonlinear") if isinstance(data, dict) else None
    if stated is None:
        return None
    if not isinstance(stated, dict):
        raise InputError(
            f"nonlinear is {stated!r}, but must be an object with kind and operating_input. "
            f"Identify the model again. {path}"
        )
    gain = _plant_of(data, path).get("gain")
    table = validated(NonlinearTable, {**stated, "gain": gain}, path)
    if table.kind.startswith(("duffing", "wiener")):
        raise InputError(
            f"The model is nonlinear ({table.kind}), but of the nonlinear models in files only "
            "Hammerstein models can be compared. In Python, use the method compare of the result "
            f"of fit_nonlinear, or fit a linear model. {path}"
        )
    degree = {"hammerstein-2": 2, "hammerstein-3": 3}.get(table.kind)
    gains = (table.gain, table.gain_2, table.gain_3)[:degree]
    if degree is None or None in gains:
        raise InputError(
            f"The nonlinear part has kind {table.kind!r}. hammerstein-2 needs gain_2, and "
            f"hammerstein-3 also gain_3. Identify the model again. {path}"
        )
    if abs(table.gain) < _LEAST_GAIN * max(abs(gain or 0.0) for gain in gains):
        raise InputError(
            f"gain is {table.gain:g}, too small for a Hammerstein model in a file. Identify the "
            f"model about another mean input. {path}"
        )
    return InputCurve(table.operating_input, tuple((gain or 0.0) / table.gain for gain in gains))


def loop_of(
    path: Path,
    rate_hz: float | None,
    delay_s: float | None,
    usual: tuple[float | None, float | None] = (None, None),
) -> tuple[float, float]:
    """Rate and delay of a loop: as given, else from the model file, else the usual ones.

    Args:
        path: of the model.
        rate_hz: as given; None: not given.
        delay_s: likewise.
        usual: rate and delay where the model file states none; None: the defaults.
    Returns:
        Rate, in Hz, and delay, in s.
    Raises:
        InputError: a value in the file is not a number above 0.
    """
    stated = {
        "rate_hz": _USUAL.rate_hz if usual[0] is None else usual[0],
        "loop_delay_s": _USUAL.measurement_delay_s if usual[1] is None else usual[1],
    }
    if path.suffix.lower() != ".mat":
        stated |= read_loop(path)
    return (
        stated["rate_hz"] if rate_hz is None else rate_hz,
        stated["loop_delay_s"] if delay_s is None else delay_s,
    )


def read_loop(path: Path) -> dict[str, float]:
    """Read the loop that a model.json was measured for: `rate_hz`, `loop_delay_s`.

    Raises:
        InputError: one of them is not a number above 0.
    """
    return validated(LoopTable, _data(path), path).model_dump(exclude_none=True)


def _checked(model: type[_Checked], plant: Any, path: Path) -> _Checked:
    """Check a plant, whose table in an actuator file is [model]."""
    return validated(model, plant, path, "model" if path.suffix.lower() == ".toml" else "")


def _plant(table: PlantTable) -> Plant:
    return Plant.from_dict(table.model_dump())


def _is_twin(path: Path) -> bool:
    """Whether a TOML file describes a twin and not an actuator."""
    try:
        return not is_actuator_file(path) and bool(load_twin(path).model_fields_set)
    except InputError:
        return False


def _plant_of(data: Any, path: Path) -> dict[str, Any]:
    plant = data.get("plant", data) if isinstance(data, dict) else None
    if not isinstance(plant, dict) or "gain" not in plant:
        found = ", ".join(list(data)[:8]) if isinstance(data, dict) else type(data).__name__
        raise InputError(
            f"The model has the keys {found[:200] or 'none'}, but must have an object `plant` with "
            f"gain, natural_frequency_rad_s and damping_ratio. Add it: {path}"
        )
    return plant
