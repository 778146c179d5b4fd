"""results.json: paper, recomputed, measured here; and which reading the data support."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from haselab.base import Estimate
from haselab.control import LoopSetting, PidGains, margins, predict
from haselab.models.plant import Plant

__all__ = ["Quantity", "quantities", "quantity_rows", "reading_verdict"]

_TOLERANCE = 0.10  # a printed number of two digits is met within this part of it
_PAPER_WN_RAD_S = math.sqrt(26.14)
_PAPER = Plant(0.5, _PAPER_WN_RAD_S, 0.93 / (2.0 * _PAPER_WN_RAD_S))
_PAPER_PI = PidGains(0.85, 1.5)
_IN_HZ = "printed in rad/s; the same number read in Hz is {:.1f} rad/s"


@dataclass(frozen=True)
class Quantity:
    """One row of the table.

    Args:
        name: for people.
        unit: SI.
        paper: printed value, or range; None where the paper gives none.
        recomputed: what the paper's own numbers give; None where that is the printed value.
        note: what the reader should know.
    """

    name: str
    unit: str
    paper: float | tuple[float, float] | None
    recomputed: float | tuple[float, float] | None = None
    note: str = ""


def _paper_loop() -> dict[str, float]:
    """Margins and rise times of the printed plant and controller."""
    loop = margins(_PAPER, _PAPER_PI, loop_delay_s=0.0, rate_hz=None)
    closed = predict(_PAPER, _PAPER_PI, LoopSetting(measurement_delay_s=0.0), step=0.04)
    return {
        "phase": loop.phase_margin_deg,
        "gain": loop.gain_margin_db,
        "rise": closed.step.rise_time_s,
    }


@functools.cache
def quantities() -> dict[str, Quantity]:
    """The table of all results, by id."""
    loop = _paper_loop()
    hz = 2.0 * math.pi
    omega_0 = tuple(math.hypot(5.1, decay) for decay in (3.6, 4.2))
    return {
        "S14.a1": Quantity("voltage map, a1", "V", 1.324),
        "S14.b1": Quantity("voltage map, b1", "", 3.124),
        "S14.a2": Quantity("voltage map, a2", "V", -0.2805),
        "S14.b2": Quantity("voltage map, b2", "", -26.92),
        "S15.slope": Quantity("strain over relative capacitance", "", 4.923e6,
                              note="with the scale 2.5e3 in eq. 2 (D11b)"),
        "S15.offset": Quantity("strain at no capacitance", "", -0.276),
        "S16.mu": Quantity("Arruda-Boyce shear modulus", "Pa", None),
        "S16.lambda_m": Quantity("Arruda-Boyce locking stretch", "", None),
        "S17.region_low": Quantity("longest linear region, from", "", None),
        "S17.region_high": Quantity("longest linear region, to", "", None),
        "S19.omega_d": Quantity("free response, damped frequency", "rad/s", 5.1,
                                note=_IN_HZ.format(5.1 * hz)),
        "S19.decay_1": Quantity("free response, decay of positive hull", "1/s", 3.6),
        "S19.decay_2": Quantity("free response, decay of negative hull", "1/s", 4.2),
        "S19.omega_0": Quantity("natural frequency by eq. 7", "rad/s", 5.1,
                                (omega_0[0], omega_0[1]), _IN_HZ.format(5.1 * hz)),
        "S20.gain": Quantity("plant, gain of the fast mode", "", 0.5,
                             note="eq. 4 makes it 1 (D8)"),
        "S20.omega_n": Quantity("plant, natural frequency", "rad/s", 5.11, _PAPER_WN_RAD_S,
                                _IN_HZ.format(5.11 * hz)),
        "S20.zeta": Quantity("plant, damping ratio", "", 0.09, _PAPER.damping_ratio),
        "S20.slow_gain": Quantity("plant, gain of the slow branch", "", None),
        "S20.slow_tau": Quantity("plant, time constant of the slow branch", "s", None),
        "S21.phase_margin": Quantity("PI, phase margin", "deg", None, loop["phase"],
                                     "here with the true delay of the loop"),
        "S21.gain_margin": Quantity("PI, gain margin", "dB", None, loop["gain"],
                                    "here with the true delay of the loop"),
        "S24.rise_open": Quantity("rise time, open loop", "s", (6.0, 8.0), 0.21,
                                  "recomputed: eq. 8 alone (D4)"),
        "S24.rise_closed": Quantity("rise time, PI", "s", (2.5, 3.0), loop["rise"],
                                    "recomputed: eq. 8 alone, ringing averaged out (D5)"),
        "S24.error_open": Quantity("steady-state error, open loop", "", None,
                                   note="part of the step; negative: beyond it"),
        "S24.error_closed": Quantity("steady-state error, PI", "", None),
        "S24.overshoot_closed": Quantity("overshoot, PI, ringing averaged out", "", None),
        "S25.phase_margin": Quantity("PID, phase margin", "deg", None),
        "S25.gain_margin": Quantity("PID, gain margin", "dB", None),
        "S25.rise_pid": Quantity("rise time, PID", "s", None),
        "S25.overshoot_pid": Quantity("overshoot, PID, ringing included", "", None),
        "S25.error_pid": Quantity("steady-state error, PID", "", None),
        "S26.rise": Quantity("rise time, loop on the chip", "s", None),
        "S26.settling": Quantity("settling time, loop on the chip", "s", None),
        "S26.overshoot": Quantity("overshoot, loop on the chip, ringing included", "", None),
        "S26.error": Quantity("steady-state error, loop on the chip", "", None,
                              note="part of the step; negative: beyond it"),
        "S26.phase_margin": Quantity("loop on the chip, phase margin", "deg", None),
        "S28.rise": Quantity("rise time, miniature bench", "s", None),
        "S28.settling": Quantity("settling time, miniature bench", "s", None),
        "S28.overshoot": Quantity("overshoot, miniature bench, noise included", "", None),
        "S28.error": Quantity("steady-state error, miniature bench", "", None,
                              note="part of the step; negative: beyond it"),
        "S28.phase_margin": Quantity("miniature bench, phase margin", "deg", None,
                                     note="of the plant at the study's operating point"),
    }  # fmt: skip


def _verdict(quantity: Quantity, measured: Estimate) -> str:
    if quantity.paper is None:
        return "not in paper"
    ends = quantity.paper if isinstance(quantity.paper, tuple) else (quantity.paper,) * 2
    margin = 0.0 if isinstance(quantity.paper, tuple) else _TOLERANCE * abs(quantity.paper)
    low, high = min(ends) - margin, max(ends) + margin
    inside = low <= measured.value <= high
    compatible = measured.ci95[0] <= max(ends) and measured.ci95[1] >= min(ends)
    return "agrees" if inside or compatible else "disagrees"


def quantity_rows(
    measured: Mapping[str, Estimate],
    truth: Mapping[str, float] | None,
    notes: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Rows of results.json.

    Args:
        measured: estimates by id.
        truth: of the same experiment without noise, by id; None off the twin.
        notes: by id, in front of the table's own.
    Returns:
        One row an id, in the table's order.
    """
    rows = []
    for key, quantity in quantities().items():
        if key not in measured:
            continue
        estimate = measured[key]
        parts = [notes[key]] if key in notes else []
        parts += [quantity.note] if quantity.note else []
        row: dict[str, Any] = {
            "id": key,
            "name": quantity.name,
            "unit": quantity.unit,
            "paper": quantity.paper,
            "recomputed": quantity.paper if quantity.recomputed is None else quantity.recomputed,
            "measured": Estimate(estimate.value, estimate.std, estimate.ci95, quantity.unit),
            "verdict": _verdict(quantity, estimate),
            "note": "; ".join(parts),
        }
        if truth is not None and key in truth:
            row["truth"] = truth[key]
        rows.append(row)
    return rows


def reading_verdict(measured: Mapping[str, Estimate]) -> dict[str, Any]:
    """Which reading of the paper's frequency axis the data support.

    Both readings put the same printed number on the axis. The relative distance of a measured
    frequency from each, with the interval of the printed digits, decides; a frequency that is
    near neither supports neither.

    Args:
        measured: estimates by id.
    Returns:
        Section `reading` of analysis.json.
    """
    evidence, votes = [], []
    for key, what, printed in (
        ("S20.omega_n", "natural frequency, chirp", 5.11),
        ("S19.omega_0", "natural frequency, free response", 5.1),
    ):
        value = measured[key].value
        evidence.append(
            {
                "what": f"{what} (rad/s)",
                "rad": printed,
                "hz": 2.0 * math.pi * printed,
                "data": measured[key],
            }
        )
        off = {
            "rad": abs(math.log(value / printed)),
            "hz": abs(math.log(value / (2.0 * math.pi * printed))),
        }
        best = min(off, key=lambda name: off[name])
        votes.append(best if off[best] < 0.2 else "neither")
    decays = (measured["S19.decay_1"].value, measured["S19.decay_2"].value)
    evidence.append(
        {
            "what": "hull decays (1/s); printed 3.6 and 4.2",
            "rad": 0.09 * 5.11,
            "hz": 0.12 * 2.0 * math.pi * 5.11,
            "data": f"{decays[0]:.2f} and {decays[1]:.2f}",
        }
    )
    agreed = votes[0] if len(set(votes)) == 1 else "cannot tell"
    words = {
        "rad": "The data support the reading rad/s, as printed.",
        "hz": "The data support the reading Hz: the printed number times 2 pi.",
        "neither": "The data support neither reading: the frequency is near neither number.",
        "cannot tell": "Chirp and free response point to different readings: cannot tell.",
    }
    return {"verdict": words[agreed], "evidence": evidence}
