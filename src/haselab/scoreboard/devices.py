"""The devices of the scoreboard: public twins, and devices drawn about them from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from haselab.actuators import ActuatorLaw
from haselab.base import InputError
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.store.toml import validated

__all__ = ["DEVICES", "ZERO_LENGTH_M", "Device", "drawn", "find_device"]

_FIELD_SHARE = 0.85  # of the breakdown field that a controller may use
_LATE_S = 0.005  # added at most to the delay of a drawn device


@dataclass(frozen=True)
class Device:
    """A public device: the twin that controllers are tuned on, and how it is used.

    Args:
        name: in the results.
        title: what it is.
        config: of the twin.
        high_v: highest drive.
        zero_v: drive whose static strain is 0.
        late_s: added to the delay of the output, unknown to the controller.
        low_v: lowest drive, 0 if it has one sign.
        stated_inertia_kg: inertia without weight that a person states who hangs the device, from
            which its identification starts; None: nobody has hung any.
    """

    name: str
    title: str
    config: TwinConfig
    high_v: float
    zero_v: float
    late_s: float = 0.0
    low_v: float = 0.0
    stated_inertia_kg: float | None = None

    @property
    def law(self) -> ActuatorLaw:
        """The true law."""
        return self.config.law

    @property
    def mass_kg(self) -> float:
        """Hung mass."""
        return self.config.load.mass_kg

    @property
    def field_v_per_m(self) -> float:
        """Highest field that a controller may use: 34 kV/mm of the public twin's 40."""
        return _FIELD_SHARE * self.law.circuit.breakdown_v_per_m


def _kind(name: str, mass_kg: float, **actuator: float) -> TwinConfig:
    table: dict[str, Any] = {"name": name, "kind": name, "load": {"mass_kg": mass_kg}}
    if actuator:
        table["actuator"] = actuator
    if name == "dea-stack":
        table["amplifier"] = {"current_limit_a": 0.04}
    return validated(TwinConfig, table, name)


def _changed(**tables: dict[str, float]) -> TwinConfig:
    return validated(TwinConfig, {"reading": "hz", **tables}, "scoreboard")


ZERO_LENGTH_M = 0.051  # length of the public twin at strain 0
_HZ = twin_of_reading("hz")
DEVICES = {
    one.name: one
    for one in (
        Device("hz", "planar HASEL, 0.25 kg, 5 Hz", _HZ, 2.0, 1.04),
        Device("rad", "planar HASEL with 9.3 kg of inertia, 0.8 Hz", twin_of_reading("rad"),
               2.0, 1.04, stated_inertia_kg=8.0),
        Device("retention", "planar HASEL, a fifth of the voltage acts with a delay of 5.7 s",
               _changed(dielectric={"relaxation_share": 0.2}), 2.0, 1.04),
        Device("bipolar", "planar HASEL on a drive of both signs",
               _changed(acquisition={"drive_low_v": -2.0}), 2.0, 1.04, low_v=-2.0),
        Device("bipolar-retention", "the same, a fifth of the voltage acts late",
               _changed(acquisition={"drive_low_v": -2.0}, dielectric={"relaxation_share": 0.2}),
               2.0, 1.04, low_v=-2.0),
        Device("hysteresis", "planar HASEL with rate-independent hysteresis of 0.06 N",
               _changed(hysteresis={"force_n": 0.06, "width": 0.02}), 2.0, 1.04),
        Device("warming", "planar HASEL whose permittivity rises by 0.5 %",
               _changed(unmodelled={"capacitance_rise": 0.005, "warming_s": 300.0}), 2.0, 1.04),
        Device("second-resonance", "planar HASEL with a second mass at 12 Hz",
               _changed(unmodelled={"resonance_mass_kg": 0.0125, "resonance_hz": 12.0}),
               2.0, 1.04),
        Device("peano-hasel", "Peano-HASEL of five pouches, 0.1 kg",
               _kind("peano-hasel", 0.1, damping_n_s_per_m=3.0), 1.4, 0.8),
        Device("dea-stack", "stack of 50 layers, 0.2 kg", _kind("dea-stack", 0.2), 1.8, 1.2),
    )
}  # fmt: skip


def find_device(name: str) -> Device:
    """A public device by its name.

    Raises:
        InputError: There is none of this name.
    """
    if name not in DEVICES:
        raise InputError(f"No device {name!r}. The devices are {', '.join(DEVICES)}.")
    return DEVICES[name]


def drawn(rng: np.random.Generator, *, senses_alike: bool = False) -> Device:
    """Draw a planar HASEL that differs from `hz` in all that a controller does not know.

    The ranges: stiffness 10 %, relaxing shares 20 %, exponent of the capacitance 2 to 4, delay
    up to 5 ms later, hysteresis up to 0.06 N, capacitance up to 0.5 % and retention up to 0.1.
    The permittivity follows the exponent so that the capacitance at strain 0 stays the same: it is
    what a calibration of the sensor at the bench would give.

    Args:
        rng: random generator.
        senses_alike: keep what is not mechanical, so that the sensed length is the true one.
    Returns:
        The device.
    """
    stiffer, creepier = rng.uniform(0.9, 1.1), rng.uniform(0.8, 1.2)
    exponent = float(rng.uniform(2.0, 4.0))
    config = _HZ.model_dump()
    for section, key in (("shell", "shear_modulus_pa"), ("electrodes", "stiffness_n_per_m")):
        config[section][key] *= stiffer
    config["viscosity"]["share"] = [creepier * g for g in config["viscosity"]["share"]]
    share, hysteresis_n, rise, late_s = rng.uniform(
        [0.0, 0.0, -0.005, 0.0], [0.1, 0.06, 0.005, _LATE_S]
    ).tolist()
    config["hysteresis"]["force_n"] = hysteresis_n
    if not senses_alike:
        dielectric, zero = config["dielectric"], ZERO_LENGTH_M / _HZ.free_length_m
        dielectric["permittivity"] *= zero ** (dielectric["capacitance_exponent"] - exponent)
        dielectric["capacitance_exponent"] = exponent
        dielectric["relaxation_share"] = share
        config["unmodelled"]["capacitance_rise"] = rise
    config.pop("origin")
    return Device("drawn", "drawn about hz", validated(TwinConfig, config, "drawn"), 2.0, 1.04,
                  late_s)  # fmt: skip
