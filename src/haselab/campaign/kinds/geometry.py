"""Case kind `geometry`: stroke, force, bandwidth and field of a design, without simulation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from haselab.actuators import GRAVITY_M_S2, OperatingPoint, equilibrium_m, linearise
from haselab.base import ResultError
from haselab.base.root import root
from haselab.campaign.kinds.base_files import LABELS, TWIN, twin_of
from haselab.campaign.kinds.case_kind import CaseKind, Inputs, Results
from haselab.store.toml import Section

__all__ = ["GEOMETRY", "GeometrySettings"]

Floats = NDArray[np.float64]
_DROP = math.sqrt(0.5)  # of the gain, at the bandwidth
_GRID = 400


class GeometrySettings(Section):
    """How a design is driven; mass and inertia are those of the twin."""

    voltage_v: float = Field(
        8000.0, gt=0, le=1e6, description="highest voltage at the actuator, in V"
    )
    bias_share: float = Field(
        0.7, gt=0, lt=1, description="share of that voltage at which the bandwidth is computed"
    )


class _Geometry(CaseKind):
    name = "geometry"
    files = (TWIN,)
    settings = GeometrySettings
    ignored = (
        *LABELS, "twin.amplifier", "twin.acquisition", "twin.camera", "twin.unmodelled",
        "twin.dielectric.series_ohm", "twin.dielectric.leakage_ohm",
        "twin.actuator.series_ohm", "twin.actuator.leakage_ohm",
    )  # fmt: skip

    def check(self, inputs: Inputs) -> None:
        inputs.settings(GeometrySettings)
        _ = twin_of(inputs).law

    def compute(self, inputs: Inputs, rng: np.random.Generator) -> Results:
        case, twin = inputs.settings(GeometrySettings), twin_of(inputs)
        law, load_n = twin.law, GRAVITY_M_S2 * twin.load.mass_kg
        low_m = equilibrium_m(law, 0.0, load_n)
        high_m = equilibrium_m(law, case.voltage_v, load_n)
        stroke_m = high_m - low_m
        # the electric force at the length where the stroke begins: nothing has moved yet
        force_n = float(law.electric_force_n(low_m, case.voltage_v))
        inertia_kg = twin.load.mass_kg + twin.load.added_inertia_kg
        point = linearise(law, case.bias_share * case.voltage_v, load_n, inertia_kg)
        fastest = point.poles[np.argmax(np.abs(point.poles.imag))]
        field = case.voltage_v / min(float(law.gap_m(low_m)), float(law.gap_m(high_m)))
        if field >= law.circuit.breakdown_v_per_m:
            raise ResultError(
                f"The field is {field:.4g} V/m, but the dielectric breaks down at "
                f"{law.circuit.breakdown_v_per_m:.4g} V/m. Lower the voltage."
            )
        return {
            "stroke_m": stroke_m,
            "relative_stroke": stroke_m / low_m,
            "blocked_force_n": force_n,
            "resonance_hz": float(abs(fastest)) / (2.0 * math.pi) if fastest.imag else math.nan,
            "bandwidth_hz": _bandwidth_hz(point),
            "peak_field_v_per_m": field,
            "relative_field": field / law.circuit.breakdown_v_per_m,
            "capacitance_f": float(law.capacitance_f(low_m)),
        }


def _bandwidth_hz(point: OperatingPoint) -> float:
    """Frequency above which the gain stays 3 dB below the static one."""
    fast_rad_s = float(np.abs(point.poles).max())
    grid = np.geomspace(1e-3 * fast_rad_s, 1e3 * fast_rad_s, _GRID)
    excess = np.array([_excess(point, omega_rad_s) for omega_rad_s in grid])
    above = np.flatnonzero(excess > 0.0)
    if above.size == 0 or above[-1] == _GRID - 1:
        raise ResultError(
            f"The gain does not cross -3 dB between {grid[0]:.3g} and {grid[-1]:.3g} rad/s, so "
            "there is no bandwidth. Change the bias or the losses."
        )
    at = int(above[-1])
    found = root(lambda omega: _excess(point, omega), float(grid[at]), float(grid[at + 1]))
    return found / (2.0 * math.pi)


def _excess(point: OperatingPoint, omega_rad_s: float) -> float:
    """Gain over the static one, less that at the bandwidth."""
    resolvent = np.linalg.solve(1j * omega_rad_s * np.eye(point.b.size) - point.a, point.b)
    gain = abs(complex(point.c @ resolvent)) / abs(point.gain_m_per_v)
    return gain - _DROP


GEOMETRY = _Geometry()
