"""What every controller knows of a device: the physical model identified from one record.

The record is that of a short study: triangle, free response, chirp, steps and three masses. The
camera sees the lengths with 3 um of noise, the lock-in the capacitances with that of the monitors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import (
    ACTUATORS,
    GRAVITY_M_S2,
    ActuatorLaw,
    Drive,
    SampledLaw,
    equilibrium_m,
)
from haselab.base import ResultError
from haselab.controllers import KnownActuator
from haselab.identify.physical import ActuatorFit, MotionRecord, fit_actuator
from haselab.scoreboard.devices import Device
from haselab.scoreboard.loop_class import CARRIER_V, CLASSES, noise_of

__all__ = ["TRAINED", "identified", "known_by", "simulated_record", "true_actuator"]

Floats = NDArray[np.float64]
TRAINED = 2.4  # times the hung mass: before a task, the actuator was stretched by that weight
_BLOCK_S = 0.02
_FRAME_S = 0.04
_LENGTH_STD_M = 3e-6
_CLAMP_KG = 0.02  # what stays when the mass is lifted
_SEED = 2018  # of the record's noise, the same for all devices


def _carrier_v2(device: Device) -> float:
    return 0.5 * (device.config.amplifier.gain * CARRIER_V) ** 2


def _plan(device: Device) -> list[tuple[str, Floats, float]]:
    """Experiments: name, drive of each block, hung mass."""

    def held(seconds: float, volt: float = 0.0) -> Floats:
        return np.full(round(seconds / _BLOCK_S), volt)

    time_s = np.arange(0.0, 5.0, _BLOCK_S)
    high_v, zero_v, mass = device.high_v, device.zero_v, device.mass_kg
    rise = np.linspace(0.0, high_v, round(2.0 / _BLOCK_S))
    swing_v = 0.5 * min(zero_v, high_v - zero_v)
    chirp = zero_v + swing_v * np.sin(2.0 * np.pi * time_s * (0.1 + time_s))  # 0.1 to 10 Hz
    return [
        ("triangle", np.concatenate([held(1.0), rise, rise[::-1]]), mass),
        ("free-response", held(2.0), mass),
        ("free-response", held(0.2), _CLAMP_KG),
        ("free-response", held(3.0), mass),
        ("chirp", chirp, mass),
        ("steps", np.concatenate([held(4.0, share * zero_v) for share in (1.0, 1.4, 0.6)]), mass),
        ("masses", held(3.0), TRAINED * mass),
        ("masses", held(3.0), 0.6 * mass),
        ("masses", held(3.0), mass),
    ]


def simulated_record(device: Device, rng: np.random.Generator) -> MotionRecord:
    """Record a device as its bench would show it.

    Args:
        device: with its true law.
        rng: of the noise.
    Returns:
        The record.
    """
    parts = _plan(device)
    volt = device.config.amplifier.gain * np.concatenate([drive for _, drive, _ in parts])
    mass_kg = np.concatenate([np.full(drive.size, mass) for _, drive, mass in parts])
    names = tuple(dict.fromkeys(name for name, _, _ in parts))
    member = np.concatenate([np.full(drive.size, names.index(name)) for name, drive, _ in parts])
    edge_s = np.asarray(_BLOCK_S * np.arange(volt.size + 1.0))
    added_kg, ripple = device.config.load.added_inertia_kg, _carrier_v2(device)
    sampled = SampledLaw(
        device.law, float(volt.max()) + 2.0 * np.sqrt(ripple), added_inertia_kg=added_kg
    )
    drive = Drive(edge_s, volt, GRAVITY_M_S2 * mass_kg, mass_kg, np.full(volt.size, ripple))
    start, _ = sampled.at_rest(float(volt[0]), ripple, float(drive.load_n[0]))
    time_s = np.arange(0.5 * _FRAME_S, edge_s[-1], _FRAME_S)
    found = sampled.respond(drive, time_s, start)
    host = CLASSES["host-100hz"]
    noise = noise_of(host, device.config, float(np.median(found.capacitance_f)))
    std_f = noise * found.capacitance_f / np.median(found.capacitance_f)
    blocks = np.arange(volt.size)
    frames = np.minimum((time_s / _BLOCK_S).astype(np.int64), volt.size - 1)
    return MotionRecord(
        device.name, drive,
        time_s, found.length_m + rng.normal(0.0, _LENGTH_STD_M, time_s.size),
        np.full(time_s.size, _LENGTH_STD_M),
        blocks, blocks, found.capacitance_f + std_f * rng.standard_normal(volt.size), std_f,
        names, member[frames], member,
    )  # fmt: skip


def identified(device: Device) -> ActuatorFit:
    """Identify a device from its record.

    Args:
        device: nominal.
    Returns:
        The fit.
    Raises:
        ResultError: The fit has no result.
    """
    record = simulated_record(device, np.random.default_rng(_SEED))
    law = ACTUATORS.find(device.config.kind)()
    stated_kg = device.stated_inertia_kg
    fit = fit_actuator(law, [record], mass_kg=device.mass_kg, added_inertia_kg=stated_kg)
    if not fit.succeeded:
        raise ResultError(
            f"The model of the device {device.name!r} is not identified: {fit.status}"
        )
    return fit


def known_by(device: Device, fit: ActuatorFit) -> KnownActuator:
    """What controllers know: the fit, and the zero that the camera showed.

    Args:
        device: that was identified.
        fit: of its record.
    """
    assert fit.law is not None
    host, values = CLASSES["host-100hz"], {n: e.value for n, e in fit.parameters.items()}
    zero_m = (_zero_m(device) - values["camera.offset_m"]) / values["camera.scale"]
    farad = float(fit.law.capacitance_f(zero_m))
    noise_f = noise_of(host, device.config, farad)
    return _actuator(
        device, fit.law, zero_m, fit.added_inertia_kg, values["sensing.scale"], noise_f
    )


def true_actuator(device: Device) -> KnownActuator:
    """The device as it is, for the class oracle and for the bounds."""
    added_kg = device.config.load.added_inertia_kg
    return _actuator(device, device.law, _zero_m(device), added_kg, 1.0, 0.0)


def _actuator(
    device: Device, law: ActuatorLaw, zero_m: float, added_kg: float, scale: float, noise_f: float
) -> KnownActuator:
    return KnownActuator(
        law=law,
        mass_kg=device.mass_kg,
        zero_length_m=zero_m,
        low_v=device.low_v,
        high_v=device.high_v,
        gain_v_per_v=device.config.amplifier.gain,
        added_inertia_kg=added_kg,
        carrier_v2=_carrier_v2(device),
        sensing_scale=scale,
        capacitance_noise_f=noise_f,
        highest_field_v_per_m=device.field_v_per_m,
        longest_m=_longest_m(device),
    )


def _longest_m(device: Device) -> float:
    """Length under the weight of the training, which the camera shows: see `FastPlant.train`."""
    return equilibrium_m(device.law, 0.0, GRAVITY_M_S2 * TRAINED * device.mass_kg)


def _zero_m(device: Device) -> float:
    acting_v = np.hypot(device.config.amplifier.gain * device.zero_v, np.sqrt(_carrier_v2(device)))
    load_n = GRAVITY_M_S2 * device.mass_kg
    return equilibrium_m(device.law, float(acting_v), load_n,
                         longest_m=_longest_m(device))  # fmt: skip
