"""Files that describe a twin: TWIN.toml, and an actuator file with an identified model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from haselab.actuators import (
    ACTUATORS,
    ADDED_INERTIA,
    DRIFTS,
    ActuatorLaw,
    Scales,
    draw_parameters,
    measured_parameters,
    with_parameters,
    with_stated,
)
from haselab.base import InputError, JsonObject, LimitError, table_at
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.sections import PhysicalTable
from haselab.rig.protocols import PLANAR_HASEL
from haselab.rig.twin.config import (
    HIGHEST_GAIN_ERROR,
    HIGHEST_LOAD_KG,
    READINGS,
    SETTLE_S,
    Origin,
    TwinConfig,
)
from haselab.store.actuator_file import read_actuator
from haselab.store.manifest import sha256_of
from haselab.store.toml import read_toml, validated

__all__ = ["identified_twin", "is_actuator_file", "load_twin"]

_SCALE = "sensing.scale"
# Tables of what the recording bench adds, and the instruments of a twin have of their own.
_OF_THE_BENCH = ("camera.", "sensing.")
_TRIES = 1000  # draws outside the limits of a law before they are given up
_SIGMAS = 3.0  # within which a negative inertia is an error of its estimate


def load_twin(path: Path) -> TwinConfig:
    """Read TWIN.toml; all faults are reported at once, with its path in the file.

    Args:
        path: of the TOML file; keys that it leaves out take their defaults. An actuator file with
            `[model.physical]` gives the twin of this actuator, with default instruments.
    Returns:
        The checked configuration.
    Raises:
        InputError: The file is missing or not TOML, or has an unknown key or a value out of range.
    """
    data = read_toml(path, "twin file")
    if _is_actuator(data):
        return identified_twin(path, TwinConfig())
    reading = data.get("reading")
    if isinstance(reading, str) and reading in READINGS:
        for section, values in READINGS[reading].items():
            given = data.setdefault(section, {})
            if isinstance(given, dict):
                data[section] = {**values, **given}
    return validated(TwinConfig, data, path)


def is_actuator_file(path: Path) -> bool:
    """Whether a file describes an actuator and not a whole twin.

    Args:
        path: of the TOML file.
    Returns:
        True for an actuator file, with or without a model.
    Raises:
        InputError: The file is missing or not TOML.
    """
    return _is_actuator(read_toml(path, "twin file"))


def _is_actuator(data: JsonObject) -> bool:
    own = {"sensing", "drive", "model", "controller", "provenance"} & set(data)
    return bool(own) or "kind" in table_at(data, "actuator")


def identified_twin(path: Path, bench: TwinConfig, draw: int | None = None) -> TwinConfig:
    """The twin of an identified actuator.

    Actuator, hung mass and inertia are those of the file, and so is the error of the capacitance;
    everything else of the instruments is that of the bench.

    Args:
        path: of an actuator file with `[model.physical]`.
        bench: whose instruments are used.
        draw: seed with which all parameters are drawn from their distributions: identified ones
            from their covariance, others from `[actuator.distribution]`. None: the estimates.
    Returns:
        The configuration; `origin` states the file.
    Raises:
        InputError: There is no model, its status is not ok, the kind is unknown, a value is outside
            its limits, or a distribution is missing.
    """
    sections = read_actuator(path)
    tables = validated(ActuatorTables, sections, path)
    about, model = tables.actuator, tables.model.physical if tables.model else None
    if model is None:
        raise InputError(
            "The actuator file has no [model.physical], so it has no twin. Add it with: haselab "
            f"identify actuator RUN --actuator {path}"
        )
    if model.status != "ok":
        raise InputError(
            f"[model.physical] has the status {model.status!r}, so a twin would not behave like "
            f"the actuator. Identify it again, from other records or starts. {path}"
        )
    if model.kind != about.kind:
        raise InputError(
            f"[model.physical] is of the kind {model.kind!r}, but [actuator] of {about.kind!r}. "
            f"Correct the kind, or identify the actuator again. {path}"
        )
    try:
        law = with_stated(ACTUATORS.find(model.kind)(), about.parameters)
        model.check_measured(measured_parameters(law))
        if draw is None:
            law, added_kg, scale, drift = _with(law, model, model.parameters)
        else:
            law, added_kg, scale, drift = _drawn(law, model, about.distribution, draw)
    except (InputError, LimitError) as error:
        raise InputError(f"{error} {path}") from error
    hashes = table_at(sections, "provenance", "model", "physical").get("sha256")
    name = about.name or path.stem
    origin = Origin(
        actuator=name,
        file=path.name,
        sha256=sha256_of(path),
        records_sha256=tuple(map(str, hashes)) if isinstance(hashes, list) else (),
        draw=draw,
        not_identifiable=model.not_identifiable,
    )
    data = _with_law(bench.model_dump(), law)
    mass_kg = about.mass_kg or model.mass_kg or bench.load.mass_kg
    monitor = (1.0 + bench.amplifier.i_monitor_gain_error) * scale - 1.0
    if not mass_kg < HIGHEST_LOAD_KG:
        raise InputError(
            f"mass_kg is {mass_kg:g} kg, but a twin carries less than {HIGHEST_LOAD_KG:g} kg. "
            f"Lower mass_kg. {path}"
        )
    if not abs(monitor) < HIGHEST_GAIN_ERROR:
        raise InputError(
            f"{_SCALE} is {scale:g}, but a twin's current monitor has a gain error of less than "
            f"{HIGHEST_GAIN_ERROR:g}. Identify the actuator again. {path}"
        )
    data |= {
        "name": f"twin of the identified actuator {name!r}",
        "load": {"mass_kg": mass_kg, "added_inertia_kg": added_kg},
        "amplifier": {**data["amplifier"], "i_monitor_gain_error": monitor},
        "unmodelled": {**data["unmodelled"], **drift},
        "origin": origin.model_dump(),
    }
    return validated(TwinConfig, data, path)


def _with_law(data: dict[str, Any], law: ActuatorLaw) -> dict[str, Any]:
    """A configuration with another actuator."""
    planar = {about.key.partition(".")[0] for about in ACTUATORS.find(PLANAR_HASEL).described()}
    data = {key: value for key, value in data.items() if key not in planar}
    data |= {"kind": law.kind, "actuator": {}}
    if law.kind != PLANAR_HASEL:
        data["actuator"] = {about.name: getattr(law, about.name) for about in law.described()}
        data["reading"] = "hz"  # the paper's actuator has readings
        return data
    for about in law.described():
        section, _, key = about.key.partition(".")
        data.setdefault(section, {})[key] = getattr(law, about.name)
    return data


def _with(
    law: ActuatorLaw, model: PhysicalTable, values: Mapping[str, float]
) -> tuple[ActuatorLaw, float, float, dict[str, float]]:
    """Law, added inertia, error of the capacitance and drift with the values of a model.

    Raises:
        InputError: A name is unknown, or a value cannot be.
        LimitError: A value is outside the limits of the law.
    """
    own = {key: value for key, value in values.items() if not key.startswith(_OF_THE_BENCH)}
    changed = with_parameters(law, own)
    _ = changed.length_limits_m  # which states what its values exclude together
    added_kg, scale = values.get(ADDED_INERTIA, 0.0), values.get(_SCALE, 1.0)
    if added_kg < -_SIGMAS * model.std.get(ADDED_INERTIA, 0.0):
        raise InputError(f"{ADDED_INERTIA} is {added_kg:g} kg, but it must not be below 0.")
    if not scale > 0.0:
        raise InputError(f"{_SCALE} is {scale:g}, but it must be above 0. Change it.")
    return changed, max(added_kg, 0.0), scale, _drift(values)


def _drift(values: Mapping[str, float]) -> dict[str, float]:
    """Slow changes as the twin has them, from the beginning of a study on."""
    found: dict[str, float] = {}
    for (rate, time), change, constant, sign in (
        (DRIFTS[:2], "stiffness_loss", "ageing_s", -1.0),
        (DRIFTS[2:], "capacitance_rise", "warming_s", 1.0),
    ):
        if rate in values:
            found |= {change: sign * values[rate] * values[time], constant: values[time]}
            found["begins_s"] = SETTLE_S
    return found


def _drawn(
    law: ActuatorLaw,
    model: PhysicalTable,
    distribution: Mapping[str, tuple[float, float]],
    seed: int,
) -> tuple[ActuatorLaw, float, float, dict[str, float]]:
    """The same with all parameters drawn.

    Raises:
        InputError: A distribution is missing, or no draw is within the limits.
        LimitError: A bound of a distribution is outside the limits of the law.
    """
    for name in model.not_identifiable:
        if name not in distribution and not name.startswith(_OF_THE_BENCH):
            raise InputError(
                f"{name} cannot be drawn: it is not identifiable from the records, and "
                f'[actuator.distribution] does not say where it lies. Add "{name}" = [low, high] '
                "there, or leave out --draw."
            )
    if model.covariance is None:
        raise InputError(
            "[model.physical] has no covariance to draw from. Identify the actuator again, or "
            "leave out --draw."
        )
    names = list(model.covariance.names)
    spread = np.array(model.covariance.matrix, dtype=np.float64).reshape(len(names), len(names))
    open_names = set(distribution) - (set(model.parameters) - set(model.not_identifiable))
    lacking = set(model.parameters) ^ {*names, *open_names.intersection(model.parameters)}
    lacking = {name for name in lacking if not name.startswith(_OF_THE_BENCH)}
    if lacking or not np.isfinite(spread).all():
        raise InputError(
            "The covariance of [model.physical] is not finite, or not that of its parameters "
            f"({', '.join(sorted(lacking)) or 'all of them'}). Identify the actuator again, or "
            "leave out --draw."
        )
    for name in sorted(open_names):
        for bound in distribution[name]:
            with_parameters(law, {name: bound})
    values = np.array([model.parameters[name] for name in names])
    scales, rng = Scales.of(law, names), np.random.default_rng(seed)
    reason = ""
    for _ in range(_TRIES):
        known = {name: float(rng.uniform(*distribution[name])) for name in sorted(open_names)}
        by_index = {names.index(name): value for name, value in known.items() if name in names}
        found = draw_parameters(scales, values, spread, by_index, rng)
        drawn = {**known, **dict(zip(names, found.tolist(), strict=True))}
        if not np.isfinite(found).all():
            reason = "An inverse is negative."
            continue
        if drawn.get(ADDED_INERTIA, 0.0) < 0.0:
            reason = f"{ADDED_INERTIA} is below 0."
            continue
        try:
            return _with(law, model, drawn)
        except LimitError as error:
            reason = str(error)
    raise InputError(
        f"None of {_TRIES} draws is within the limits of the law, so its estimates are too "
        f"uncertain to draw from. The last one: {reason}"
    )
