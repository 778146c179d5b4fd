"""Free response, margins, steps once more from session.h5, without the product's fits and control.

What is used: h5py, numpy, scipy and python-control. The margins start from the identified plant and
the gains that were played, in model.json and controller.toml. See test_recomputed.py.
"""

from __future__ import annotations

import json
import math
import tomllib
from typing import Any

import control
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import curve_fit, least_squares
from scipy.signal import find_peaks

Floats = NDArray[np.float64]
ROUNDING = 1e-6


# ---- row S19 ----


def falls(recorded: Any) -> list[tuple[Floats, Floats]]:
    """Time and length of each trial from its drop on; time counts from the first frame."""
    dropped = {
        what.decode(): time for time, what in recorded.file["events"][()][["time_s", "what"]]
    }
    found = []
    for k, seen in enumerate(recorded.trials("free")):
        after = seen.time >= dropped[f"drop free-{k + 1}"]
        found.append((seen.time[after] - seen.time[after][0], seen.length[after]))
    return found


def through_peaks(t: Floats, swing: Floats, floor: float) -> float:
    """Decay of a straight line through the logarithms of the peaks; NaN through fewer than 2."""
    peaks = find_peaks(swing, height=floor)[0]
    if peaks.size < 2:
        return math.nan
    return -float(np.polyfit(t[peaks], np.log(swing[peaks]), 1)[0])


def through_rounded_peaks(t: Floats, swing: Floats, floor: float, apart_s: float) -> float:
    """The same through the tops of parabolas over a fifth of the period, the high ones first."""
    step = t[1] - t[0]
    half = max(1, round(0.1 * apart_s / step))
    tops = []
    for at in find_peaks(swing, height=floor, distance=round(0.7 * apart_s / step))[0]:
        if half <= at < t.size - half:
            near = slice(at - half, at + half + 1)
            bend, tilt, level = np.polyfit(t[near] - t[at], swing[near], 2)
            tops.append((t[at] - tilt / (2.0 * bend), level - tilt**2 / (4.0 * bend)))
    time, height = np.array(tops).T
    return -float(np.polyfit(time, np.log(height), 1, w=height)[0])


def test_eq_6_as_printed(recorded: Any) -> None:
    """Plain least squares of eq. 6 alone by scipy's curve_fit; raw peaks above 3 % of it,
    where there are two of a sign.

    The product's search ends when the sum changes by 1e-8 of itself: the numbers are then off by
    the root of that, 1e-4, at the most.
    """

    def eq_6(t: Floats, level: float, decay: float, omega: float, c: float, s: float) -> Floats:
        return level + np.exp(-decay * t) * (c * np.cos(omega * t) + s * np.sin(omega * t))

    rows = []
    for t, x in falls(recorded):
        start = (x[-1], 4.0, 33.0, x[0] - x[-1], 0.0)
        p = curve_fit(
            eq_6, t, x, p0=start, x_scale=np.abs(start) + 1e-3, method="trf", xtol=1e-12, ftol=1e-12
        )[0]
        size, last = math.hypot(p[3], p[4]), -math.log(0.03) / p[1]
        hulls = [
            through_peaks(t[t <= last], sign * (x - p[0])[t <= last], 0.03 * size)
            for sign in (1.0, -1.0)
        ]
        rms = np.sqrt(np.mean((x - eq_6(t, *p)) ** 2))
        rows.append([p[2], p[1], *hulls, math.hypot(p[2], p[1]), rms])
    names = ("omega_d", "decay", "decay_1", "decay_2", "omega_0", "rms")
    for name, own in zip(names, np.mean(rows, axis=0), strict=True):
        assert (f"S19.eq6_{name}" in recorded.rows) == math.isfinite(own), name
        if math.isfinite(own):
            recorded.agrees(f"S19.eq6_{name}", own, rel=1e-4)


def test_eq_6_beside_a_creep(recorded: Any) -> None:
    """One frequency, decay and creep time for all trials; the product weights as it does here.

    Hulls: which peaks count is a choice of the method; the stated deviation is the tolerance.
    """
    records = falls(recorded)

    def parts(search: Floats) -> list[tuple[Floats, Floats, Floats]]:
        found = []
        for t, x in records:
            hull = np.exp(-search[0] * t)
            basis = np.stack(
                [
                    hull * np.cos(search[1] * t),
                    hull * np.sin(search[1] * t),
                    np.ones_like(t),
                    np.exp(-t / search[2]),
                ],
                axis=1,
            )
            factors = np.linalg.lstsq(basis, x, rcond=None)[0]
            found.append((basis, factors, x - basis @ factors))
        return found

    search = least_squares(
        lambda p: np.concatenate([left for *_, left in parts(p)]),
        (4.0, 33.0, 4.0), x_scale=(1.0, 10.0, 1.0), xtol=1e-13, ftol=1e-13,
    ).x  # fmt: skip
    decay, omega, _ = search
    recorded.agrees("S19.omega_d", omega, rel=1e-5)
    recorded.agrees("S19.omega_0", math.hypot(omega, decay), rel=1e-5)
    recorded.agrees(
        "S19.chirp_difference",
        math.hypot(omega, decay) / recorded.value("S20.omega_n") - 1.0,
        within=2e-5,
    )
    swings = [
        (t, basis[:, :2] @ factors[:2] + left, math.hypot(*factors[:2]))
        for (t, _), (basis, factors, left) in zip(records, parts(search), strict=True)
    ]
    for sign, key in ((1.0, "S19.decay_1"), (-1.0, "S19.decay_2")):
        own = [
            through_rounded_peaks(t, sign * swing, 0.01 * size, 2.0 * math.pi / omega)
            for t, swing, size in swings
        ]
        recorded.agrees(key, float(np.mean(own)), within=recorded.rows[key]["std"])


# ---- rows S21 and S25 ----


def sampled_plant(plant: dict[str, Any], delay_s: float, period_s: float) -> Any:
    """Resonance and slow branch behind a hold, read late: exact, by matrix exponentials."""
    wn, zeta = plant["natural_frequency_rad_s"], plant["damping_ratio"]
    whole = control.tf([plant["gain"] * wn**2], [1.0, 2.0 * zeta * wn, wn**2])
    for slow in plant["slow_modes"]:
        whole = whole + control.tf([slow["gain"]], [slow["time_constant_s"], 1.0])
    ss = control.tf2ss(whole)
    late = math.ceil((delay_s + plant["delay_s"]) / period_s)
    lead = late * period_s - delay_s - plant["delay_s"]
    n = ss.nstates

    def held(time_s: float) -> tuple[Floats, Floats]:
        block = np.zeros((n + 1, n + 1))
        block[:n] = np.hstack([ss.A, ss.B])
        grown = expm(block * time_s)
        return grown[:n, :n], grown[:n, n:]

    (a, b), (to_sample, added) = held(period_s), held(lead)
    found = control.ss(a, b, ss.C @ to_sample, ss.C @ added, period_s)
    return found * control.ss(control.tf([1.0], [1.0] + [0.0] * late, period_s))


def controller(gains: dict[str, float], period_s: float) -> Any:
    """The integral takes the present error, the derivative a filtered difference."""
    found = control.tf([gains["kp"]], [1.0], period_s)
    found += control.tf([gains["ki"] * period_s, 0.0], [1.0, -1.0], period_s)
    if gains.get("kd"):
        tau = gains["derivative_filter_s"]
        found += control.tf([gains["kd"], -gains["kd"]], [tau + period_s, -tau], period_s)
    return control.ss(found)


def margins_of(loop: Any) -> dict[str, float]:
    """By python-control, from the loop's response on a dense grid.

    A stable loop has the smallest gain above 1, an unstable one the largest below.
    """
    top = math.pi / loop.dt
    omega = np.geomspace(1e-3, top, 4001)[:-1]
    response = control.frd(loop, omega)
    gain, phase, _, _, at, _ = control.stability_margins(response, returnall=True)
    stable = bool((np.abs(control.feedback(loop, 1).poles()) < 1.0).all())
    end = np.real(loop(-1.0))
    gain = np.append(gain, -1.0 / end) if end < 0.0 else gain
    factor = min(gain[gain > 1.0]) if stable else max(gain[gain < 1.0])
    return {
        "phase_margin": min(abs(phase)) * (1.0 if stable else -1.0),
        "gain_margin": 20.0 * math.log10(factor),
        "delay_margin": min(np.radians(phase % 360.0) / at) if stable else 0.0,
        "crossover": max(at),
    }


def test_margins_by_python_control(recorded: Any) -> None:
    """The sampled loop, exact; python-control interpolates on the grid: 1e-6."""
    model = json.loads((recorded.folder / "model.json").read_text())
    gains = tomllib.loads((recorded.folder / "controller.toml").read_text())
    plant, period, delay = model["plant"], 1.0 / model["rate_hz"], model["loop_delay_s"]
    printed = recorded.study["control"]
    factor = printed["plant_gain"] / plant["gain"]
    scaled = {key: factor * printed[key] for key in ("kp", "ki")}
    later = delay + recorded.study["steps"]["extra_delay_blocks"] * recorded.block_s
    every = ("phase_margin", "gain_margin", "delay_margin", "crossover")
    cases = [
        ("S21.", gains["pi"], delay, every),
        ("S21.plant_", {"kp": 1.0, "ki": 0.0}, 0.0, every[3:]),
        ("S21.printed_", printed, delay, every[1:2]),
        ("S21.delayed_", scaled, later, every[1:2]),
        ("S25.", gains["pid"], delay, every[:2]),
    ]
    for prefix, played, late, names in cases:
        found = margins_of(controller(played, period) * sampled_plant(plant, late, period))
        for name in names:
            recorded.agrees(f"{prefix}{name}", found[name], rel=1e-5)
    for key in ("kp", "ki"):
        recorded.agrees(f"S21.{key}", gains["pi"][key], rel=ROUNDING)
        assert gains["pi"][key] == pytest.approx(scaled[key], rel=ROUNDING)


# ---- rows S22 and S24 ----


def stepped(recorded: Any, group: str) -> list[tuple[Floats, Floats, float]]:
    """Time from the step, strain from its level in the second before, and error, of each trial."""
    steps, found = recorded.study["steps"], []
    # test_recomputed.py finds the same length of zero strain by itself.
    zero = json.loads((recorded.folder / "model.json").read_text())["zero_strain_length_m"]
    for seen in recorded.trials(group):
        time = seen.time - seen.start[0] - steps["zero_s"]
        strain = seen.length / zero - 1.0
        keep = time <= steps["step_s"] - 0.1
        level = strain[(time < 0.0) & (time > -1.0)].mean()
        t, moved = time[keep & (time >= 0.0)], strain[keep & (time >= 0.0)] - level
        final = moved[-round(0.1 * moved.size) :].mean()
        found.append((t, moved / final, (steps["step"] - level - final) / steps["step"]))
    return found


def rise(t: Floats, part: Floats) -> float:
    """From the first crossing of a tenth to that of nine tenths; a start beyond is a crossing."""
    crossings = []
    for level in (0.1, 0.9):
        k = int(np.argmax(part >= level))
        low = max(k - 1, 0)
        crossings.append(np.interp(level, part[low : k + 1], t[low : k + 1]) if k else t[0])
    return float(crossings[1] - crossings[0])


def without_ringing(t: Floats, part: Floats) -> Floats:
    """The response less a decaying oscillation, fitted beside a level and two exponentials."""

    def model(t: Floats, *p: float) -> Floats:
        slow = p[0] + p[1] * np.exp(-t / p[2]) + p[3] * np.exp(-t / p[4])
        return slow + swing(t, *p[5:])

    def swing(t: Floats, decay: float, omega: float, c: float, s: float) -> Floats:
        return np.exp(-decay * t) * (c * np.cos(omega * t) + s * np.sin(omega * t))

    start = (1.0, -0.5, 5.0, -0.2, 1.0, 4.0, 35.0, -0.1, 0.0)
    low = (0.0, -2.0, 1.0, -2.0, 0.2, 0.1, 25.0, -2.0, -2.0)
    high = (2.0, 2.0, 20.0, 2.0, 5.0, 15.0, 50.0, 2.0, 2.0)
    p = curve_fit(model, t, part, p0=start, bounds=(low, high))[0]
    return part - swing(t, *p[5:])


@pytest.mark.parametrize(("group", "loop"), [("open", "open"), ("pi", "closed")])
def test_rise_times_with_and_without_ringing(recorded: Any, group: str, loop: str) -> None:
    """Raw: the same crossings. Without ringing: fitted and taken off here, averaged there."""
    trials = stepped(recorded, group)
    raw = np.mean([rise(t, part) for t, part, _ in trials])
    clean = np.mean([rise(t, without_ringing(t, part)) for t, part, _ in trials])
    recorded.agrees(f"S24.rise_{loop}_raw", float(raw), rel=ROUNDING)
    recorded.agrees(
        f"S24.rise_{loop}",
        float(clean),
        within=1.0 / recorded.study["steps"]["frame_rate_hz"],
    )
    recorded.agrees(f"S24.error_{loop}", np.mean([error for *_, error in trials]), within=ROUNDING)


def test_saturation_and_recovery(recorded: Any) -> None:
    (trial,) = recorded.trials("saturating")
    m = json.loads((recorded.folder / "model.json").read_text())["voltage_map"]
    high = recorded.value("S22.saturation_high")
    limit = m["a1_v"] * math.exp(m["b1"] * high) + m["a2_v"] * math.exp(m["b2"] * high)
    assert trial.drive.max() == pytest.approx(limit, abs=1e-6)
    much = trial.reference == recorded.study["steps"]["saturating_step"]
    held = trial.drive > limit - 1e-3
    stood = np.flatnonzero(held[much])
    share = (stood[-1] - stood[0] + 1) / much.sum()
    recorded.agrees("S22.saturated_fraction", float(share), within=ROUNDING)
    after = int(np.argmin(held[np.flatnonzero(much)[-1] + 1 :]))
    middle = recorded.block_s * (after + 0.5)  # it leaves within a block
    recorded.agrees("S22.recovery_time", middle, within=ROUNDING)
