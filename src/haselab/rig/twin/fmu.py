"""The twin as a functional mock-up unit (FMU) for simulators that know the FMI standard."""

from __future__ import annotations

import ctypes
import dataclasses
import hashlib
import importlib.metadata
import math
import platform
import struct
import sys
import zipfile
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from haselab import _motion, _twin
from haselab.actuators import (
    GRAVITY_M_S2,
    ActuatorLaw,
    motion_parameters,
    with_parameters,
)
from haselab.base import InputError
from haselab.rig.twin.config import SETTLE_S, TwinConfig
from haselab.rig.twin.twin_bench import CARRIER_HIGH_V, CLAMP_KG, instrument_values, native_bench

__all__ = ["FMI_VERSIONS", "Fmu", "twin_fmu"]

FMI_VERSIONS = ("3", "2")
_SUFFIX = ".dll" if sys.platform == "win32" else ".so"  # CMake modules end with .so on macOS too
_LIBRARY = Path(_twin.__file__).parent / "libraries" / f"haselab_twin{_SUFFIX}"
_MODEL = "haselab_twin"
_STEP_SAMPLES = 20  # TWIN_SUB
_DATE = (1980, 1, 1, 0, 0, 0)  # of the files in the archive: the same twin gives the same bytes

_NAME = 56  # bytes of a name in the resources, as FMU_NAME in native/fmu/instance.h
# Value references and places of native/fmu/bench.h.
_INPUTS = (
    ("drive_v", "V", 0.0, "voltage at the amplifier's input"),
    ("force_n", "N", 0.0, "force at the moving end in addition to the weight, positive: lengthens"),
    ("carrier_v", "V", 0.0, "amplitude of the carrier at the amplifier's input; 0: off"),
    ("carrier_hz", "Hz", 2000.0, "frequency of the carrier"),
)
_OUTPUTS = (
    ("length_m", "m", "length of the actuator"),
    ("speed_m_per_s", "m/s", "rate of the length"),
    ("strain", "", "length over free length, minus 1"),
    ("output_v", "V", "output of the amplifier"),
    ("actuator_v", "V", "voltage over the capacitor, without its series resistance"),
    ("field_v_per_m", "V/m", "largest field during the last step"),
    ("capacitance_f", "F", "true differential capacitance"),
    ("v_reading_v", "V", "last reading of the voltage monitor"),
    ("i_reading_v", "V", "last reading of the current monitor"),
    ("sensed_capacitance_f", "F", "sensed by the lock-in, with stray capacitance"),
    ("sensed_resistance_ohm", "ohm", "series resistance, sensed by the lock-in"),
)
_FIRST_OUTPUT, _BREAKDOWN, _SENSED_VALID, _SEED, _TIME = 100, 200, 201, 300, 400
_FIRST_PARAMETER, _FIRST_CONSTANT = 1000, 3000
_PLACES = {
    "amplifier.gain": -1,
    "amplifier.gain_error": -2,
    "amplifier.bandwidth_hz": -3,
    "amplifier.volt_per_monitor_volt": -4,
    "amplifier.ampere_per_monitor_volt": -5,
    "amplifier.v_monitor_gain_error": -6,
    "amplifier.i_monitor_gain_error": -7,
    "unmodelled.resonance_hz": -8,
    "load.mass_kg": -9,
    "load.added_inertia_kg": -10,
    "acquisition.output_delay_s": -11,
}
_FIXED = ("rate_hz", "block_samples", "bits", "range_v", "drive_low_v", "drive_high_v")
_LARGEST_SEED = 2**31 - 1
# Exponents of kg, m, s, A.
_UNITS = {
    "V": (1, 2, -3, -1),
    "V/m": (1, 1, -3, -1),
    "V/s": (1, 2, -4, -1),
    "N": (1, 1, -2, 0),
    "N/m": (1, 0, -2, 0),
    "N s/m": (1, 0, -1, 0),
    "J": (1, 2, -2, 0),
    "Pa": (1, -1, -2, 0),
    "Hz": (0, 0, -1, 0),
    "m": (0, 1, 0, 0),
    "m/s": (0, 1, -1, 0),
    "m2": (0, 2, 0, 0),
    "m3": (0, 3, 0, 0),
    "F": (-1, -2, 4, 2),
    "ohm": (1, 2, -3, -2),
    "A": (0, 0, 0, 1),
    "s": (0, 0, 1, 0),
    "kg": (1, 0, 0, 0),
}
_SUFFIXES = {
    "_v_per_m": "V/m",
    "_v_per_s": "V/s",
    "_n_s_per_m": "N s/m",
    "_n_per_m": "N/m",
    "_hz": "Hz",
    "_ohm": "ohm",
    "_kg": "kg",
    "_pa": "Pa",
    "_m3": "m3",
    "_m": "m",
    "_v": "V",
    "_a": "A",
    "_f": "F",
    "_n": "N",
    "_s": "s",
}


@dataclasses.dataclass(frozen=True)
class _Setting:
    """A number of TWIN.toml that the FMU states, and can change if it has a place."""

    key: str
    value: float
    unit: str
    description: str
    place: int | None = None
    low: float = -math.inf
    high: float = math.inf


@dataclasses.dataclass(frozen=True)
class Fmu:
    """A packed functional mock-up unit.

    Args:
        content: of the .fmu file.
        inputs: names of the input variables.
        outputs: names of the output variables.
        parameters: values by their keys in TWIN.toml; the FMU can change them.
        constants: values by their keys in TWIN.toml; only another export can change them.
    """

    content: bytes
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: Mapping[str, float]
    constants: Mapping[str, float]


def twin_fmu(config: TwinConfig, *, version: Literal["2", "3"] = "3", seed: int = 1) -> Fmu:
    """Pack a twin as an FMU for co-simulation.

    Args:
        config: of the bench.
        version: of the FMI standard: 3 (3.0.2) or 2 (2.0.4).
        seed: of the monitors' noise, which the FMU has as a parameter.
    Returns:
        The FMU; the same twin gives the same bytes.
    Raises:
        InputError: The library of the FMU was not built, the seed is too large, or the twin cannot
            integrate the law.
    Source:
        fmi-standard.org, Functional Mock-up Interface 3.0.2 and 2.0.4.
    Example:
        >>> import io, zipfile
        >>> from haselab.rig.twin.config import TwinConfig
        >>> fmu = twin_fmu(TwinConfig())
        >>> "modelDescription.xml" in zipfile.ZipFile(io.BytesIO(fmu.content)).namelist()
        True
    """
    if not 0 <= seed <= _LARGEST_SEED:
        raise InputError(f"The seed is {seed}, but an FMU takes 0 to {_LARGEST_SEED}. Use another.")
    if not _LIBRARY.is_file():
        raise InputError(
            f"The library of the FMU is missing ({_LIBRARY.name}). Install haselab again, from a "
            "package for this platform."
        )
    library = _LIBRARY.read_bytes()
    settings = [*_settings(config), *_law_settings(config.law)]
    free = [setting for setting in settings if setting.place is not None]
    fixed = [setting for setting in settings if setting.place is None]
    resource = _resource(config, free, fixed, seed)
    token = hashlib.sha256(resource + library + version.encode()).hexdigest()
    describe = _description3 if version == "3" else _description2
    tree = describe(config, free, fixed, seed, token)
    ElementTree.indent(tree)
    xml = ElementTree.tostring(tree, encoding="UTF-8", xml_declaration=True)
    files = {
        "modelDescription.xml": xml,
        f"binaries/{_platform_folder(version)}/{_MODEL}{_LIBRARY.suffix}": library,
        "resources/twin.bin": resource,
        "resources/twin.json": config.model_dump_json(indent=2).encode(),
    }
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
    return Fmu(
        packed.getvalue(),
        tuple(name for name, *_ in _INPUTS),
        (*(name for name, *_ in _OUTPUTS), "breakdown", "sensed_valid"),
        {each.key: each.value for each in free},
        {each.key: each.value for each in fixed},
    )


def _platform_folder(version: str) -> str:
    machine = platform.machine().lower()
    system = {"linux": "linux", "darwin": "darwin", "win32": "windows"}.get(sys.platform)
    intel = machine in ("x86_64", "amd64")
    if system is None or not (intel or machine in ("aarch64", "arm64")):
        raise InputError(
            f"The FMI standard names no platform for {sys.platform} on {machine}. Export the FMU "
            "on Linux, macOS or Windows."
        )
    if version == "3":
        return f"{'x86_64' if intel else 'aarch64'}-{system}"
    if not intel:
        raise InputError(
            f"FMI 2.0 names no platform for {machine}. Export for FMI 3.0, with --fmi 3."
        )
    return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}[system]


# ---- numbers ----


def _bounds(metadata: list[object]) -> tuple[float, float]:
    low, high = -math.inf, math.inf
    for rule in metadata:
        low = max(low, getattr(rule, "ge", low))
        high = min(high, getattr(rule, "le", high))
        if hasattr(rule, "gt"):
            low = max(low, math.nextafter(rule.gt, math.inf))
        if hasattr(rule, "lt"):
            high = min(high, math.nextafter(rule.lt, -math.inf))
    return low, high


def _unit(key: str) -> str:
    return next((unit for end, unit in _SUFFIXES.items() if key.endswith(end)), "")


def _settings(config: TwinConfig) -> Iterator[_Setting]:
    """Numbers of the instruments, of the load and of what no law has."""
    before = instrument_values(config, noise=True)
    for name in ("load", "amplifier", "acquisition", "unmodelled"):
        section = getattr(config, name)
        for field, about in type(section).model_fields.items():
            value = getattr(section, field)
            if isinstance(value, bool | str):
                continue
            key = f"{name}.{field}"
            place = _PLACES.get(key)
            if place is None and field not in _FIXED:
                other = value * 1.0009765625 + (0.0009765625 if value == 0.0 else 0.0)
                moved = section.model_copy(update={field: other})
                after = instrument_values(config.model_copy(update={name: moved}), noise=True)
                place = _offset(before, after, other)
            low, high = _bounds(about.metadata)
            if field == "output_delay_s":
                daq = config.acquisition
                high = 0.5 * daq.block_samples / daq.rate_hz
            elif field == "skew_s":
                high = 0.5 / config.acquisition.rate_hz
            yield _Setting(
                key, float(value), _unit(field), about.description or "", place, low, high
            )


def _offset(before: Mapping[str, float], after: Mapping[str, float], value: float) -> int | None:
    """Where the only number that has changed to a value lies."""
    changed = [name for name in before if before[name] != after[name]]
    if len(changed) != 1 or after[changed[0]] != value:
        return None
    return _twin.OFFSETS[changed[0]]


def _law_settings(law: ActuatorLaw) -> Iterator[_Setting]:
    """Parameters of a law: those that change neither force nor capacitance can be set."""
    before = _numbers_of(law)
    for about in law.described():
        value = getattr(law, about.name)
        values = value if isinstance(value, tuple) else (value,)
        for k, part in enumerate(values):
            key = f"{about.key}[{k}]" if isinstance(value, tuple) else about.key
            inside = [x for x in (1.0009765625 * part, 0.9990234375 * part, 0.5 * about.high)
                      if about.low <= x <= about.high and x != part]  # fmt: skip
            place = None
            if inside:
                after = _numbers_of(with_parameters(law, {key: inside[0]}))
                changed = [name for name, number in before.items() if after[name] != number]
                if len(changed) == 1 and after[changed[0]] == inside[0]:
                    place = _place_of(changed[0])
            yield _Setting(
                key, float(part), about.unit, about.description, place, about.low, about.high
            )


def _numbers_of(law: ActuatorLaw) -> dict[str | tuple[str, int], float]:
    """What a law gives to the twin: losses and circuit, and a sample of its statics."""
    limits, circuit = law.length_limits_m, law.circuit
    lengths = np.linspace(limits.low, limits.high, 9)[1:-1]
    statics = law.on_grid(lengths, np.array([0.0, 2500.0, 5000.0]))
    tables = (statics.elastic_n, statics.capacitance_f, statics.pull_n_v2, law.gap_m(lengths))
    found: dict[str | tuple[str, int], float] = {
        ("statics", k): float(number)
        for k, number in enumerate(np.concatenate([np.ravel(table) for table in tables]))
    }
    found |= {
        "series_ohm": circuit.series_ohm,
        "leakage_ohm": circuit.leakage_ohm,
        "breakdown_v_m": circuit.breakdown_v_per_m,
    }
    record = motion_parameters(law)
    for name in record.dtype.names or ():
        for k, number in enumerate(np.ravel(record[name])):
            found[(name, k)] = float(number)
    return found


def _place_of(number: str | tuple[str, int]) -> int | None:
    """Offset in twin_parameters of a number of `_numbers_of`."""
    if isinstance(number, str):
        return _twin.OFFSETS[number]
    name, index = number
    if name in ("statics", "free_length_m", "inertia_kg"):
        return None
    fields = _motion.PARAMETERS.fields
    assert fields is not None
    offset = fields[name][1]
    return _twin.OFFSETS["motion"] + int(offset) + 8 * index


def _resource(config: TwinConfig, free: list[_Setting], fixed: list[_Setting], seed: int) -> bytes:
    """resources/twin.bin, as native/fmu/bench.c reads it."""
    bench = native_bench(config, seed)
    daq, amplifier = config.acquisition, config.amplifier
    highest_v = max(daq.drive_high_v, -daq.drive_low_v) + CARRIER_HIGH_V
    parameters, state = _twin.SIZES
    parts = [
        struct.pack(
            "<8s5I3i7d",
            b"HASELFMU", 2, parameters, state, len(free), len(fixed),
            daq.block_samples, seed, 0,
            daq.drive_low_v, daq.drive_high_v,
            amplifier.gain * (1.0 + amplifier.gain_error) * highest_v,
            CLAMP_KG, config.law.moving_mass_kg, SETTLE_S, GRAVITY_M_S2,
        )
    ]  # fmt: skip
    parts += [
        struct.pack(
            f"<q3d{_NAME}s", each.place, each.value, each.low, each.high,
            each.key.encode()[: _NAME - 1],
        )
        for each in free
    ]  # fmt: skip
    parts += [struct.pack("<d", each.value) for each in fixed]
    parts.append(ctypes.string_at(bench.addresses[0], parameters))
    return b"".join(parts)


# ---- modelDescription.xml ----


def _about(config: TwinConfig, token: str) -> dict[str, str]:
    return {
        "modelName": config.name,
        "description": f"Simulated bench with a {config.kind} actuator: amplifier, actuator, "
        "monitors and lock-in",
        "version": importlib.metadata.version("haselab"),
        "generationTool": "haselab",
        "variableNamingConvention": "structured",
    } | {"token": token}


def _units(parent: ElementTree.Element, settings: list[_Setting]) -> None:
    used = {each.unit for each in settings} | {unit for _, unit, *_ in (*_INPUTS, *_OUTPUTS)}
    definitions = ElementTree.SubElement(parent, "UnitDefinitions")
    for name in sorted(used - {""}):
        unit = ElementTree.SubElement(definitions, "Unit", name=name)
        exponents = zip(("kg", "m", "s", "A"), _UNITS.get(name, ()), strict=False)
        stated = {base: str(exponent) for base, exponent in exponents if exponent}
        if stated:
            ElementTree.SubElement(unit, "BaseUnit", stated)


def _number(value: float) -> str:
    return repr(float(value))


def _limits(setting: _Setting) -> dict[str, str]:
    return {
        name: _number(bound)
        for name, bound in (("min", setting.low), ("max", setting.high))
        if math.isfinite(bound)
    }


def _variables(
    free: list[_Setting], fixed: list[_Setting], seed: int
) -> Iterator[tuple[str, dict[str, str], dict[str, str]]]:
    """Type, attributes of the variable and attributes of its type."""
    for k, (name, unit, start, text) in enumerate(_INPUTS):
        yield "Float64", _variable(name, k, text, "input", "continuous"), {
            "unit": unit, "start": _number(start)}  # fmt: skip
    for k, (name, unit, text) in enumerate(_OUTPUTS):
        about = _variable(name, _FIRST_OUTPUT + k, text, "output", "continuous")
        yield "Float64", about, _in(unit)
    text = "the dielectric broke down: the output stays at 0 V"
    yield "Boolean", _variable("breakdown", _BREAKDOWN, text, "output", "discrete"), {}
    text = "false: the sensed values are not of this step, do not use them"
    yield "Boolean", _variable("sensed_valid", _SENSED_VALID, text, "output", "discrete"), {}
    text = "seed of the noise of the monitors"
    yield "Int32", _variable("seed", _SEED, text, "parameter", "fixed"), {
        "min": "0", "start": str(seed)}  # fmt: skip
    for k, each in enumerate(free):
        about = _variable(each.key, _FIRST_PARAMETER + k, each.description, "parameter", "fixed")
        yield "Float64", about, _in(each.unit) | _limits(each) | {"start": _number(each.value)}
    for k, each in enumerate(fixed):
        about = _variable(each.key, _FIRST_CONSTANT + k, each.description, "local", "constant")
        yield "Float64", about, _in(each.unit) | {"start": _number(each.value)}


def _in(unit: str) -> dict[str, str]:
    return {"unit": unit} if unit else {}


def _variable(
    name: str, reference: int, description: str, causality: str, variability: str
) -> dict[str, str]:
    text = {"description": description} if description else {}
    return {
        "name": name, "valueReference": str(reference), "causality": causality,
        "variability": variability,
    } | text  # fmt: skip


def _experiment(parent: ElementTree.Element, config: TwinConfig) -> None:
    daq = config.acquisition
    ElementTree.SubElement(
        parent, "DefaultExperiment", startTime="0", stopTime="1",
        stepSize=_number(daq.block_samples / daq.rate_hz),
    )  # fmt: skip


def _description3(
    config: TwinConfig, free: list[_Setting], fixed: list[_Setting], seed: int, token: str
) -> ElementTree.Element:
    about = _about(config, token)
    about["instantiationToken"] = about.pop("token")
    root = ElementTree.Element("fmiModelDescription", {"fmiVersion": "3.0"} | about)
    ElementTree.SubElement(
        root, "CoSimulation", modelIdentifier=_MODEL, canGetAndSetFMUState="true",
        canSerializeFMUState="true", canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=_number(_STEP_SAMPLES / config.acquisition.rate_hz),
    )  # fmt: skip
    _units(root, [*free, *fixed])
    _experiment(root, config)
    variables = ElementTree.SubElement(root, "ModelVariables")
    ElementTree.SubElement(
        variables, "Float64", name="time", valueReference=str(_TIME), causality="independent",
        variability="continuous", description="end of the last step, in steps of the twin",
    )  # fmt: skip
    outputs = []
    for kind, variable, typed in _variables(free, fixed, seed):
        ElementTree.SubElement(variables, kind, variable | typed)
        if variable["causality"] == "output":
            outputs.append(variable["valueReference"])
    structure = ElementTree.SubElement(root, "ModelStructure")
    for reference in outputs:
        ElementTree.SubElement(structure, "Output", valueReference=reference)
    for reference in outputs:
        ElementTree.SubElement(structure, "InitialUnknown", valueReference=reference)
    return root


def _description2(
    config: TwinConfig, free: list[_Setting], fixed: list[_Setting], seed: int, token: str
) -> ElementTree.Element:
    about = _about(config, token)
    about["guid"] = about.pop("token")
    root = ElementTree.Element("fmiModelDescription", {"fmiVersion": "2.0"} | about)
    ElementTree.SubElement(
        root, "CoSimulation", modelIdentifier=_MODEL, canGetAndSetFMUstate="true",
        canSerializeFMUstate="true", canHandleVariableCommunicationStepSize="true",
    )  # fmt: skip
    _units(root, [*free, *fixed])
    _experiment(root, config)
    variables = ElementTree.SubElement(root, "ModelVariables")
    names = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}
    outputs = []
    for index, (kind, variable, typed) in enumerate(_variables(free, fixed, seed), start=1):
        parent = ElementTree.SubElement(variables, "ScalarVariable", variable)
        ElementTree.SubElement(parent, names[kind], typed)
        if variable["causality"] == "output":
            outputs.append(str(index))
    structure = ElementTree.SubElement(root, "ModelStructure")
    for element in ("Outputs", "InitialUnknowns"):
        listed = ElementTree.SubElement(structure, element)
        for index_text in outputs:
            ElementTree.SubElement(listed, "Unknown", index=index_text)
    return root
