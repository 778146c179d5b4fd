"""Transfer function from chirp and steps: row S20."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, JsonObject, ResultError
from haselab.identify.frequency.response import estimate_frequency_response
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferFit, TransferStructure, fit_transfer
from haselab.models.actuator.strain_map import LARGEST_FEEDTHROUGH
from haselab.models.plant import Plant, SlowMode
from haselab.models.posterior import PlantPosterior
from haselab.rig import RigDescription
from haselab.sensing.feedthrough import fit_feedthrough
from haselab.study.definition import Study
from haselab.study.fits.maps import Maps
from haselab.study.fits.observe import Observation

__all__ = ["Dynamics", "fit_chirp", "fit_chirp_and_steps", "fit_chirp_of_voltage"]

Floats = NDArray[np.float64]
_UPDATE_HZ = 100.0  # one new output per block, row S5
_LEAST_FEEDTHROUGH = 0.05
_BEFORE_STEP_S = 4.0  # of a step trial, to estimate its initial state


@dataclass(frozen=True)
class Dynamics:
    """Results of the chirp and the open-loop steps.

    Args:
        plant: fast mode from the chirp, slow branch from the steps; used by `design`.
        second_order: the paper's structure, fitted to the chirp only.
        quantities: results by id.
        figures: section of analysis.json.
        posterior: the plant's parameters with the covariance of both fits.
        residual_std: rms residual of the plant in the chirp, in strain.
        slow: fit of the slow branch to the steps.
        joined: fit of the fast mode to the chirp, with that branch.
        feedthrough: of the sensed strain in the chirp, see `fit_feedthrough`; None: sensing
            failed in it.
    """

    plant: Plant
    second_order: TransferFit
    quantities: dict[str, Estimate]
    figures: JsonObject
    posterior: PlantPosterior
    residual_std: float
    slow: TransferFit | None = None
    joined: TransferFit | None = None
    feedthrough: Estimate | None = None

    @property
    def significant_feedthrough(self) -> Estimate | None:
        """The feedthrough if it is clearly more than errors of the maps could cause."""
        found = self.feedthrough
        if found is None or not abs(found.value) - 2.0 * found.std > _LEAST_FEEDTHROUGH:
            return None
        limited = min(max(found.value, -LARGEST_FEEDTHROUGH), LARGEST_FEEDTHROUGH)
        return Estimate.normal(limited, found.std, "")


def _record(seen: Observation, maps: Maps, rig: RigDescription, from_s: float) -> Record:
    """Record of corrected strain (input) and strain (output), from a time on."""
    first = round(from_s / rig.block_s)
    return _held(seen, maps.voltage_map.strain(seen.drive_v), maps.length_m, rig, first)


def _held(seen: Observation, u: Floats, length_m: float, rig: RigDescription, first: int) -> Record:
    """An input that each block holds, and the strain from its first update on."""
    zero_s, after = _begin(seen, rig, first)
    strain = seen.length_m[after] / length_m - 1.0
    return Record(u[first:], _UPDATE_HZ, strain, seen.frame_time_s[after] - zero_s, None)


def _begin(seen: Observation, rig: RigDescription, first: int) -> tuple[float, NDArray[np.bool_]]:
    """Time of the first update from a block on, in s, and which frames are not before it."""
    zero_s = float(seen.block_start_s[first]) + rig.switch_sample / rig.rate_hz
    return zero_s, seen.frame_time_s >= zero_s


def fit_chirp_and_steps(
    chirp: Observation,
    steps: Sequence[Observation],
    maps: Maps,
    study: Study,
    rig: RigDescription,
    near: Dynamics | None = None,
) -> Dynamics:
    """Fit the second order to the chirp and the slow branch to the steps; join them to one plant.

    If the steps do not determine the slow branch, the plant is the second order alone.

    Args:
        chirp: the chirp.
        steps: the open-loop trials.
        maps: zero strain and the voltage map.
        study: time of the step.
        rig: for the output's delay.
        near: results of almost the same observations, at which the searches start. The new ones
            then have neither figures nor a covariance.
    Returns:
        Results S20, the plant, data for the Bode plots.
    Raises:
        ResultError: a fit has no result.
    Source: reference study, row S20, eqs. 8 to 10.
    """
    sweep = _record(chirp, maps, rig, 0.0)
    printed = _second_order(sweep, None if near is None else near.second_order)
    fast = printed.parameters
    for name in ("natural_frequency_rad_s", "damping_ratio"):
        if not np.isfinite(fast[name].value):
            raise ResultError(
                f"The chirp up to {study.chirp.stop_hz:g} Hz does not determine {name}. Use a "
                "higher stop_hz or a larger amplitude_v in [chirp]."
            )
    trials = [_record(s, maps, rig, study.steps.zero_s - _BEFORE_STEP_S) for s in steps]
    slow = _checked(
        fit_transfer(
            trials,
            TransferStructure(
                slow_modes=1,
                delay=0.0,
                fixed={
                    "natural_frequency_rad_s": fast["natural_frequency_rad_s"].value,
                    "damping_ratio": fast["damping_ratio"].value,
                },
            ),
            applied=True,
            near=None if near is None else near.slow,
        ),
        "steps, slow branch",
    )
    (slow_gain, slow_tau) = slow.slow_modes[0]
    if not (np.isfinite(slow_gain.value) and np.isfinite(slow_tau.value)):
        return _fast_alone(printed, sweep, study, _feedthrough(chirp, maps, rig, printed))
    both = _checked(
        fit_transfer(
            [sweep],
            TransferStructure(
                slow_modes=1,
                fixed={"slow_gain": slow_gain.value, "slow_time_constant_s": slow_tau.value},
            ),
            applied=True,
            near=None if near is None else near.joined,
        ),
        "chirp, second order plus slow branch",
    )
    e = both.parameters
    gain, wn, zeta = e["gain"], e["natural_frequency_rad_s"], e["damping_ratio"]
    plant = Plant(
        gain.value, wn.value, zeta.value, max(e["delay_s"].value, 0.0),
        (SlowMode(slow_gain.value, slow_tau.value),),
    )  # fmt: skip
    posterior = _posterior(both, slow)
    figures: JsonObject = {}
    feedthrough = _feedthrough(chirp, maps, rig, both)
    if near is None:
        figures = {"chirp": _chirp_figure(sweep, printed, both, study.chirp.stop_hz)}
    else:
        posterior = replace(posterior, covariance=np.zeros_like(posterior.covariance))
    return Dynamics(
        plant=plant,
        second_order=printed,
        quantities={
            "S20.gain": gain,
            "S20.omega_n": wn,
            "S20.zeta": zeta,
            "S20.delay": e["delay_s"],
            "S20.slow_gain": slow_gain,
            "S20.slow_tau": slow_tau,
            **_second_order_results(printed),
            **_feedthrough_result(feedthrough),
        },
        figures=figures,
        posterior=posterior,
        residual_std=float(np.sqrt(np.mean(both.residuals[0] ** 2))),
        slow=slow,
        joined=both,
        feedthrough=feedthrough,
    )


def fit_chirp(
    chirp: Observation, maps: Maps, rig: RigDescription, stop_hz: float
) -> tuple[dict[str, Estimate], JsonObject]:
    """Fit the paper's second-order model to the chirp.

    Args:
        chirp: the chirp.
        maps: zero strain and the voltage map.
        rig: for the output's delay.
        stop_hz: highest frequency of the chirp.
    Returns:
        Results S20 of eq. 8 without a slow branch, and the section of analysis.json.
    Raises:
        ResultError: the fit has no result.
    """
    sweep = _record(chirp, maps, rig, 0.0)
    printed = _second_order(sweep)
    return _second_order_results(printed), {"chirp": _chirp_figure(sweep, printed, None, stop_hz)}


def fit_chirp_of_voltage(
    chirp: Observation, rig: RigDescription, lead_s: float, stop_hz: float
) -> tuple[dict[str, Estimate], JsonObject]:
    """The second order from the drive voltage itself, where no voltage map is known.

    Args:
        chirp: the chirp; its strain counts from the length before it.
        rig: for the output's delay.
        lead_s: recorded before the chirp begins, in s.
        stop_hz: highest frequency of the chirp.
    Returns:
        Gain in 1/V, natural frequency, damping ratio; and the section of analysis.json.
    Raises:
        ResultError: the fit has no result, or there is no frame before the chirp.
    """
    before = chirp.frame_time_s < chirp.frame_time_s[0] + lead_s
    length_m = float(np.mean(chirp.length_m[before]))
    sweep = _held(chirp, chirp.drive_v - chirp.drive_v[0], length_m, rig, 0)
    found = _second_order(sweep)
    gain, omega, zeta = _second_order_results(found).values()
    figure = _chirp_figure(sweep, found, None, stop_hz)
    del figure["u"]  # in V: the figure's axis is strain
    gain_per_v = Estimate(gain.value, gain.std, gain.ci95, "1/V")
    results = {
        "S20.gain_per_volt": gain_per_v, "S20.eq8_omega_n": omega, "S20.eq8_zeta": zeta
    }  # fmt: skip
    return results, {"chirp": figure}


def _fast_alone(
    printed: TransferFit, sweep: Record, study: Study, feedthrough: Estimate | None
) -> Dynamics:
    """The plant of a slow branch that the steps do not determine: without it."""
    e = printed.parameters
    gain, wn, zeta, delay = (
        e[name] for name in ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
    )
    return Dynamics(
        plant=Plant(gain.value, wn.value, zeta.value, max(delay.value, 0.0)),
        second_order=printed,
        quantities={
            "S20.gain": gain, "S20.omega_n": wn, "S20.zeta": zeta, "S20.delay": delay,
            **_second_order_results(printed), **_feedthrough_result(feedthrough),
        },
        figures={"chirp": _chirp_figure(sweep, printed, None, study.chirp.stop_hz)},
        posterior=printed.posterior,
        residual_std=float(np.sqrt(np.mean(printed.residuals[0] ** 2))),
        feedthrough=feedthrough,
    )  # fmt: skip


def _feedthrough(
    chirp: Observation, maps: Maps, rig: RigDescription, fit: TransferFit
) -> Estimate | None:
    """Feedthrough of the sensed strain in the chirp; None if sensing failed in it.

    Args:
        chirp: the chirp.
        maps: zero strain and both maps.
        rig: for the output's delay.
        fit: of a transfer function to the chirp.
    """
    sensed = maps.strain_map.strain(chirp.capacitance_f)
    sensed[~maps.strain_map.inside(chirp.capacitance_f)] = np.nan
    block = np.searchsorted(chirp.block_start_s, chirp.sensed_s, side="right") - 1
    u = maps.voltage_map.strain(chirp.drive_v[np.maximum(block, 0)])
    _, after = _begin(chirp, rig, 0)
    strain = chirp.length_m[after] / maps.length_m - 1.0
    try:
        return fit_feedthrough(
            chirp.sensed_s, sensed, fit.plant.static_gain * u, chirp.frame_time_s[after], strain,
            fit.modelled[0],
        )  # fmt: skip
    except InputError:
        return None


def _feedthrough_result(found: Estimate | None) -> dict[str, Estimate]:
    return {} if found is None else {"S20.feedthrough": found}


def _second_order(sweep: Record, near: TransferFit | None = None) -> TransferFit:
    found = fit_transfer([sweep], TransferStructure(), applied=True, near=near)
    return _checked(found, "chirp, second order")


def _second_order_results(printed: TransferFit) -> dict[str, Estimate]:
    fast = printed.parameters
    return {
        "S20.eq8_gain": fast["gain"],
        "S20.eq8_omega_n": fast["natural_frequency_rad_s"],
        "S20.eq8_zeta": fast["damping_ratio"],
    }


def _posterior(both: TransferFit, slow: TransferFit) -> PlantPosterior:
    """Covariance of the plant: slow branch from the steps, the rest from the chirp.

    The two experiments are independent. The chirp was fitted with the slow branch held fixed; the
    dependence of its parameters on the slow branch is neglected.
    """
    fast, steps = both.posterior, slow.posterior
    names = ("slow_time_constant_s", "slow_gain")
    into = [fast.names.index(name) for name in names]
    out_of = [steps.names.index(name) for name in names]
    covariance = fast.covariance.copy()
    covariance[np.ix_(into, into)] = steps.covariance[np.ix_(out_of, out_of)]
    return replace(fast, covariance=covariance)


def _checked(fit: TransferFit, what: str) -> TransferFit:
    if not fit.succeeded:
        raise ResultError(f"Transfer function ({what}): {fit.status}")
    return fit


def _chirp_figure(
    sweep: Record, printed: TransferFit, both: TransferFit | None, stop_hz: float
) -> dict[str, Any]:
    index = (sweep.output_time_s * _UPDATE_HZ).astype(int)
    u = sweep.u[np.minimum(index, sweep.u.size - 1)]
    frame_rate_hz = 1.0 / float(np.median(np.diff(sweep.output_time_s)))
    measured = estimate_frequency_response(Record.sampled(u, sweep.y, frame_rate_hz)).answer()
    swept = np.asarray(measured["frequency_hz"]) <= stop_hz
    words = ("status", "notes")
    lines = {key: np.asarray(values)[swept] for key, values in measured.items() if key not in words}
    omega_rad_s = 2.0 * np.pi * lines["frequency_hz"]
    thin = slice(None, None, max(1, sweep.y.size // 2000))
    models = {"second order": printed}
    if both is not None:
        models["second order plus slow branch"] = both
    curves = {name: fit.plant.frequency_response(omega_rad_s) for name, fit in models.items()}
    return {
        "time_s": sweep.output_time_s[thin],
        "u": u[thin],
        "strain": sweep.y[thin],
        "fits": {name: {"strain": fit.modelled[0][thin]} for name, fit in models.items()},
        "frequency_response": lines,
        "models": {
            name: {"magnitude": np.abs(curve), "phase_rad": np.unwrap(np.angle(curve))}
            for name, curve in curves.items()
        },
    }
