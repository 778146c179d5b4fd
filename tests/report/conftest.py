"""The folder of a run, synthetic: numbers of a plausible actuator, each from a formula."""

import json
import math
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

GAIN, OMEGA_RAD_S, ZETA, SLOW_GAIN, SLOW_TAU_S = 0.5, 5.11, 0.09, 0.4, 4.7


def estimate(value, relative_std, unit):
    std = abs(value) * relative_std
    return {
        "value": value,
        "std": std,
        "ci95": [value - 1.96 * std, value + 1.96 * std],
        "unit": unit,
    }


# id, name, unit, paper, recomputed, truth
QUANTITIES = (
    ("S14.a1", "Voltage map, first amplitude", "V", 1.324, None, 1.324),
    ("S14.b2", "Voltage map, second rate", "", -26.92, None, -26.92),
    ("S15.slope", "Capacitance map, slope", "", 4.923e6, None, 4.93e6),
    ("S16.mu", "Arruda-Boyce shear modulus", "Pa", None, None, 15600.0),
    ("S19.omega_0", "Free response, natural frequency", "rad/s", 5.1, [6.24, 6.61], 5.11),
    ("S20.omega_n", "Natural frequency of the fast mode", "rad/s", 5.11, 5.1127, 5.11),
    ("S20.zeta", "Damping ratio of the fast mode", "", 0.09, 0.0909, 0.09),
    ("S24.rise_open", "Rise time, open loop", "s", [6, 8], 0.21, 7.0),
    ("S24.rise_closed", "Rise time, closed loop", "s", [2.5, 3], 1.4, 2.7),
    ("S24.error_open", "Steady-state error, open loop", "", None, None, 0.1),
    ("S24.error_closed", "Steady-state error, closed loop", "", 0, 0, None),
)
DISAGREE = {"S19.omega_0"}


def results_document():
    rows = []
    for at, (identifier, name, unit, paper, recomputed, truth) in enumerate(QUANTITIES):
        centre = truth if truth is not None else 0.002
        verdict = "not in paper" if paper is None else "agrees"
        rows.append(
            {
                "id": identifier,
                "name": name,
                "unit": unit,
                "paper": paper,
                "recomputed": recomputed,
                "measured": estimate(centre * (1.0 + 0.002 * (at % 3)), 0.004, unit),
                "noise_free": truth,
                "verdict": "disagrees" if identifier in DISAGREE else verdict,
                "note": "Read as Hz it gives 5.13." if identifier in DISAGREE else "",
            }
        )
    provenance = {
        "haselab": "0.1.0",
        "seed": 20181004,
        "reading": "rad",
        "versions": {"python": "3.11.2", "numpy": "2.4.6"},
        "configuration": {"loop_rate_hz": 100.0, "carrier_hz": 2000.0, "trials": [6, 4]},
    }
    return {"quantities": rows, "provenance": provenance}


def plant(omega):
    s = 1j * omega
    fast = GAIN * OMEGA_RAD_S**2 / (s**2 + 2 * ZETA * OMEGA_RAD_S * s + OMEGA_RAD_S**2)
    return fast + SLOW_GAIN / (SLOW_TAU_S * s + 1)


def step_response(time_s):
    decay, wd = ZETA * OMEGA_RAD_S, OMEGA_RAD_S * math.sqrt(1 - ZETA**2)
    t = np.maximum(time_s, 0.0)
    fast = 1 - np.exp(-decay * t) * (np.cos(wd * t) + decay / wd * np.sin(wd * t))
    return GAIN * fast + SLOW_GAIN * (1 - np.exp(-t / SLOW_TAU_S))


def tracks(rng):
    particles, frames = 120, 60
    length = np.linspace(0.0, 1.0, frames)[:, None]
    x0, y0 = rng.uniform(80, 430, particles), rng.uniform(80, 400, particles)
    position = np.linspace(0.05, 0.95, 10)
    pull = -4.0 * ((x0 - 256) / 176) ** 3
    return {
        "frame_png": "video/first.png",
        "scale_mm_per_px": 0.35,
        "x_px": (x0 + length * pull).tolist(),
        "y_px": (y0 + length * 0.1 * (y0 - 60)).tolist(),
        "picked_x_px": [220.0, 256.0, 292.0],
        "picked_y_px": [405.0, 404.0, 405.5],
        "midline_px": 256.0,
        "lateral": {
            "distance_mm": (0.35 * (x0 - 256)).tolist(),
            "motion_mm": (0.35 * pull).tolist(),
        },
        "along": {
            "position": position.tolist(),
            "strain": (0.1 + 0.002 * np.sin(9 * position)).tolist(),
            "strain_std": [0.002] * 10,
        },
    }


def triangle(rng):
    time_s = np.arange(0.0, 20.0, 0.0125)
    drive_v = 2.0 * (1 - np.abs(2 * (time_s * 0.25 % 1.0) - 1))
    lag = np.sqrt(np.interp(time_s - 0.12, time_s, drive_v) ** 2 + 1e-9)
    strain = -0.0479 + 0.0454 * lag**2 + 0.0005 * rng.standard_normal(time_s.size)
    relative = (strain + 0.276) / 4.923e6
    return {
        "time_s": time_s.tolist(),
        "drive_v": drive_v.tolist(),
        "strain": strain.tolist(),
        "strain_std": [0.0008] * time_s.size,
        "relative_capacitance": relative.tolist(),
        "capacitance_f": (relative * 0.02).tolist(),
    }


def maps(test):
    strain, grid = np.array(test["strain"]), np.linspace(-0.045, 0.133, 120)
    eq4 = 1.324 * np.exp(3.124 * grid) - 0.2805 * np.exp(-26.92 * grid)
    relative = np.linspace(4.7e-8, 8.2e-8, 200)
    time_s = np.array(test["time_s"])
    wobble = 0.003 * np.sin(np.linspace(0, 12, 200))
    voltage_map = {
        "strain": strain[320:].tolist(),
        "voltage_v": test["drive_v"][320:],
        "fit_strain": grid.tolist(),
        "fit_voltage_v": (eq4 + 0.01).tolist(),
        "paper_voltage_v": eq4.tolist(),
    }
    capacitance_map = {
        "relative_capacitance": relative.tolist(),
        "strain": (4.923e6 * relative - 0.276 + wobble).tolist(),
        "fit_relative_capacitance": relative.tolist(),
        "fit_strain": (4.923e6 * relative - 0.276).tolist(),
        "time_s": time_s.tolist(),
        "strain_time": strain.tolist(),
        "reconstructed_strain": (strain + 0.002 * np.sin(3 * time_s)).tolist(),
    }
    return voltage_map, capacitance_map


def static():
    stretch = np.linspace(1.0, 3.2, 23)
    load_n = 1.6 * (stretch - stretch**-2) + 0.02 * (stretch - 1) ** 5
    noise = 0.03 * np.cos(7 * stretch)
    return {
        "stretch": stretch.tolist(),
        "load_n": (load_n + noise).tolist(),
        "stretch_std": [0.03] * 23,
        "fit_stretch": stretch.tolist(),
        "fit_load_n": load_n.tolist(),
        "regions": [
            {"stretch": [1.6, 2.5], "load_n": [1.95, 3.9]},
            {"stretch": [1.0, 1.4], "load_n": [0.0, 1.45]},
            {"stretch": [2.6, 3.2], "load_n": [4.1, 6.0]},
        ],
        "chosen": 0,
        "operating_point": {"stretch": 1.9, "load_n": 2.45},
    }


def chain():
    time_s = np.arange(0.0, 16.0, 0.01)
    lockin_f = 5.5e-10 + 1e-10 * np.sin(2 * math.pi * 0.25 * time_s)
    printed_f = lockin_f * (1.0 + 0.01 * np.cos(2 * math.pi * 0.25 * time_s))
    return {
        "time_s": time_s.tolist(),
        "lockin_f": lockin_f.tolist(),
        "printed_f": printed_f.tolist(),
    }


def further():
    time_s = np.arange(-5.0, 20.0, 0.05)
    desired = np.where(time_s < 0.0, 0.0, np.where(time_s < 8.0, 0.15, 0.04))
    trial = {
        "time_s": time_s.tolist(),
        "desired": desired.tolist(),
        "strain": step_response(time_s).tolist(),
    }
    drive_v = np.where(desired > 0.1, 1.7, 1.2)
    return {
        "printed": trial,
        "late": trial,
        "saturating": {**trial, "drive_v": drive_v.tolist(), "limit_v": 1.7},
    }


def free_response(rng):
    time_s = np.arange(0.0, 4.0, 0.0025)
    trials = []
    for amplitude_m in (0.020, 0.022):
        decay, wd = 1.1, 9.4
        envelope = amplitude_m * np.exp(-decay * time_s)
        fit = envelope * np.cos(wd * time_s)
        peaks = np.arange(5) * 2 * math.pi / wd
        troughs = peaks + math.pi / wd
        trials.append(
            {
                "time_s": time_s.tolist(),
                "displacement_m": (fit + 2e-4 * rng.standard_normal(time_s.size)).tolist(),
                "displacement_std_m": [3e-4] * time_s.size,
                "creeping_m": fit.tolist(),
                "envelope_positive_m": envelope.tolist(),
                "envelope_negative_m": (-envelope).tolist(),
                "peaks_positive": {
                    "time_s": peaks.tolist(),
                    "m": (amplitude_m * np.exp(-decay * peaks)).tolist(),
                },
                "peaks_negative": {
                    "time_s": troughs.tolist(),
                    "m": (-amplitude_m * np.exp(-decay * troughs)).tolist(),
                },
            }
        )
    mean = np.mean([trial["displacement_m"] for trial in trials], axis=0)
    return {"trials": trials, "mean_m": mean.tolist(), "time_s": time_s.tolist()}


def chirp(rng):
    time_s = np.arange(0.0, 10.0, 0.0025)
    u = 0.015 + 0.05 * np.cos(2 * math.pi * (0.1 * time_s + 0.495 * time_s**2))
    kernel = np.diff(step_response(np.arange(0.0, 10.0, 0.0025)))
    strain = np.convolve(u, kernel)[: time_s.size]
    frequency_hz = np.geomspace(0.1, 10.0, 80)
    response = plant(2 * math.pi * frequency_hz)
    rough = response * (1 + 0.03 * rng.standard_normal(80))
    model = {"magnitude": np.abs(response).tolist(), "phase_rad": np.angle(response).tolist()}
    return {
        "time_s": time_s.tolist(),
        "u": u.tolist(),
        "strain": (strain + 4e-4 * rng.standard_normal(time_s.size)).tolist(),
        "fits": {
            "second order": {"strain": (0.95 * strain).tolist()},
            "second order plus slow branch": {"strain": strain.tolist()},
        },
        "frequency_response": {
            "frequency_hz": frequency_hz.tolist(),
            "magnitude": np.abs(rough).tolist(),
            "magnitude_std": (0.03 * np.abs(rough)).tolist(),
            "phase_rad": np.angle(rough).tolist(),
            "phase_std_rad": [0.04] * 80,
            "coherence": (1 - 0.1 * np.linspace(0, 1, 80) ** 2).tolist(),
        },
        "models": {"second order plus slow branch": model},
    }


def loop():
    omega = np.geomspace(0.2, 60.0, 200)
    s = 1j * omega
    delayed = plant(omega) * np.exp(-0.01 * s)

    def controller(kp, ki, margin_deg, margin_db):
        response = (kp + ki / s) * delayed
        level_db = 20 * np.log10(np.abs(response))
        last = np.flatnonzero(level_db >= 0.0)[-1]
        share = level_db[last] / (level_db[last] - level_db[last + 1])
        crossover = omega[last] + share * (omega[last + 1] - omega[last])
        return {
            "magnitude": np.abs(response).tolist(),
            "phase_rad": np.angle(response).tolist(),
            "phase_margin_deg": margin_deg,
            "gain_margin_db": margin_db,
            "crossover_rad_s": float(crossover),
            "kp": kp,
            "ki": ki,
            "kd": 0.0,
            "derivative_filter_s": 0.0,
        }

    return {
        "omega_rad_s": omega.tolist(),
        "plant": {"magnitude": np.abs(delayed).tolist(), "phase_rad": np.angle(delayed).tolist()},
        "controllers": {
            "PI": controller(0.85, 1.5, 12.6, 8.4),
            "I-dominant": controller(0.1, 0.8, 52.1, 11.8),
        },
    }


def steps(rng):
    time_s = np.arange(0.0, 30.0, 0.02)
    desired = np.where(time_s < 12.0, 0.0, 0.05)
    shapes = {
        "open loop": (6, 0.05 / 0.9 * 0.9 * step_response(time_s - 12.0) / 0.9),
        "PI": (4, 0.05 * (1 - np.exp(-np.maximum(time_s - 12.0, 0) / 1.2))),
        "PID": (4, 0.05 * (1 - np.exp(-np.maximum(time_s - 12.0, 0) / 0.3))),
    }
    groups, metrics = {}, {}
    for name, (count, mean) in shapes.items():
        trials = mean * (1 + 0.05 * rng.standard_normal((count, 1)))
        trials = trials + 3e-4 * rng.standard_normal((count, time_s.size))
        groups[name] = {
            "mean": trials.mean(axis=0).tolist(),
            "std": trials.std(axis=0).tolist(),
            "trials": trials.tolist(),
            "sensed_mean": (trials.mean(axis=0) + 1e-3).tolist(),
        }
        metrics[name] = {
            "rise_time_s": estimate({"open loop": 7.0, "PI": 2.7, "PID": 0.66}[name], 0.03, "s"),
            "overshoot": estimate(0.04, 0.2, ""),
            "error": estimate(0.01, 0.5, ""),
        }
    return {
        "time_s": time_s.tolist(),
        "desired": desired.tolist(),
        "groups": groups,
        "metrics": metrics,
    }


def on_the_chip():
    time_s = np.arange(-1.0, 5.0, 0.005)
    wanted = {"time_s": time_s.tolist(), "strain": np.where(time_s < 0, 0.0, 0.04).tolist()}
    loops, metrics = {}, {}
    for name, tau_s in {"desktop, 100 Hz": 0.09, "desktop, 1000 Hz": 0.08, "chip": 0.08}.items():
        strain = 0.04 * (1 - np.exp(-np.maximum(time_s, 0) / tau_s))
        loops[name] = {"time_s": time_s.tolist(), "strain": strain.tolist()}
        metrics[name] = {"rise_time_s": 2.2 * tau_s, "phase_margin_deg": 60.0}
    return {"desired": wanted, "loops": loops, "metrics": metrics}


def analysis_document():
    rng = np.random.default_rng(2018)
    test = triangle(rng)
    voltage_map, capacitance_map = maps(test)
    camera = np.array(test["strain"])
    return {
        "tracks": tracks(rng),
        "triangle": test,
        "voltage_map": voltage_map,
        "capacitance_map": capacitance_map,
        "static": static(),
        "free_response": free_response(rng),
        "chirp": chirp(rng),
        "loop": loop(),
        "steps": steps(rng),
        "sensing": {
            "time_s": test["time_s"],
            "camera_strain": test["strain"],
            "sensed_strain": (camera + 0.001 * rng.standard_normal(camera.size)).tolist(),
        },
        "chip": on_the_chip(),
        "chain": chain(),
        "further": further(),
        "miniature": on_the_chip(),
        "reading": {
            "verdict": "The data support the reading in rad/s.",
            "evidence": [
                {"what": "ω0 of the free response, in rad/s", "rad": 5.1, "hz": 32.0, "data": 5.12}
            ],
        },
        "d_rows": [
            {
                "id": "D1",
                "claim": "eq. 7 gives ω0 = 5.1 rad/s for δ = 3.6 and 4.2",
                "paper": 5.1,
                "recomputed": "6.24 and 6.61 rad/s",
                "verdict": "disagrees",
            },
            {
                "id": "eq. 9",
                "claim": "natural frequency & damping < 1",
                "paper": "5.11 rad/s",
                "recomputed": 5.1127,
                "verdict": "agrees",
            },
        ],
    }


def write_run(folder: Path, results, analysis):
    (folder / "video").mkdir(parents=True)
    rows, columns = np.mgrid[0:96, 0:96]
    grey = (120 + 60 * np.sin(rows / 3) * np.sin(columns / 3)).astype(np.uint8)
    frame = np.kron(grey, np.ones((5, 5), np.uint8))
    matplotlib.image.imsave(folder / "video" / "first.png", frame, cmap="gray", vmin=0, vmax=255)
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    (folder / "analysis.json").write_text(json.dumps(analysis), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def documents():
    """results.json and analysis.json as parsed; copy before a change."""
    return results_document(), analysis_document()


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory, documents):
    """A complete folder, not yet reported on."""
    return write_run(tmp_path_factory.mktemp("run") / "study", *documents)


@pytest.fixture
def make_run(tmp_path):
    """Write a folder of one's own: `make_run(results, analysis) -> Path`."""
    return lambda results, analysis: write_run(tmp_path / "study", results, analysis)
