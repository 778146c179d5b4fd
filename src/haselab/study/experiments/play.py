"""The experiments of a study, each played on a runner; names are those in the session."""

from __future__ import annotations

import numpy as np

from haselab.models.maps import VoltageMap
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import FIDUCIALS, PARTICLES
from haselab.runtime.runner import Runner
from haselab.signals import constant, linear_chirp, triangle
from haselab.store.session.writer import ExperimentPlan
from haselab.study.definition import Steps, StepStudy, StepTrials, Study
from haselab.study.own_controller import own_names

__all__ = [
    "FURTHER",
    "UPDATE_HZ",
    "chip_names",
    "closed_names",
    "free_names",
    "further_names",
    "hold_drives_v",
    "hold_names",
    "open_names",
    "plans",
    "play_chip_steps",
    "play_chirp",
    "play_closed_steps",
    "play_free_responses",
    "play_holds",
    "play_open_steps",
    "play_static_loads",
    "play_triangle",
    "rig_seconds",
    "saturating_reference",
]

UPDATE_HZ = 100.0  # one new output a block, row S5
_LEAD_S = 1.0  # recorded at rest before a signal begins
# Groups of closed-loop trials beside the paper's, and their kind in the session.
FURTHER = {
    "printed": "PI step by the paper's sensing chain",
    "late": "PI step with extra delay",
    "saturating": "PI step that saturates",
}
_HOLDS = 5  # voltages among which a baseline is found
_HOLD_S = 0.5  # recorded of each
_SATURATED_PART = 0.4  # of step_s, at the strain that saturates
_REST_S, _REST_FRAMES = 0.5, 15  # at rest before a controller is told anything


def open_names(study: Study) -> list[str]:
    """Open-loop step trials."""
    return [f"open-{k + 1}" for k in range(study.steps.open_trials)]


def closed_names(study: Study, group: str) -> list[str]:
    """Closed-loop step trials of a group, `pi` or `pid`."""
    trials = study.steps.pi_trials if group == "pi" else study.steps.pid_trials
    return [f"{group}-{k + 1}" for k in range(trials)]


def further_names(study: Study, group: str) -> list[str]:
    """Closed-loop trials beside the paper's: `printed`, `late` or `saturating`."""
    steps = study.steps
    trials = {
        "printed": steps.printed_chain_trials,
        "late": steps.extra_delay_trials,
        "saturating": steps.saturating_trials,
    }[group]
    return [f"{group}-{k + 1}" for k in range(trials)]


def hold_drives_v(study: Study) -> list[float]:
    """Voltages at which the strain is measured at rest: the baseline, or those it is found among.

    About each of them the chirp stays within the triangle.
    """
    given = study.operating_point.baseline_v
    if given is not None:
        return [given]
    low = study.triangle.low_v + study.chirp.amplitude_v
    high = study.triangle.high_v - study.chirp.amplitude_v
    return [float(level) for level in np.linspace(low, high, _HOLDS)]


def hold_names(study: Study) -> list[str]:
    """Of the voltages that are held."""
    return [f"hold-{k + 1}" for k in range(len(hold_drives_v(study)))]


def free_names(study: Study) -> list[str]:
    """Free-response trials."""
    return [f"free-{k + 1}" for k in range(study.free_response.trials)]


def plans(study: Study) -> list[ExperimentPlan]:
    """All experiments of a study, in the order of playing."""
    kinds = [("triangle", "triangle"), ("static", "static load")]
    kinds += [(name, "voltage held") for name in hold_names(study)]
    kinds += [(name, "free response") for name in free_names(study)]
    kinds += [("chirp", "chirp")]
    kinds += [(name, "open-loop step") for name in open_names(study)]
    kinds += [(name, "PI step") for name in closed_names(study, "pi")]
    kinds += [(name, "PID step") for name in closed_names(study, "pid")]
    for group, kind in FURTHER.items():
        kinds += [(name, kind) for name in further_names(study, group)]
    kinds += [(name, f"step by {study.control.kind}") for name in own_names(study)]
    planned = [ExperimentPlan(name, kind, FIDUCIALS, {}) for name, kind in kinds]
    return [*planned, ExperimentPlan("particles", "particles of the triangle", PARTICLES, {})]


def rig_seconds(study: Study) -> float:
    """How long the recorded part takes on the rig, in s: the progress bar's total."""
    steps, free = study.steps, study.free_response
    trials = (
        steps.open_trials + steps.pi_trials + steps.pid_trials
        + steps.printed_chain_trials + steps.extra_delay_trials + steps.saturating_trials
        + len(own_names(study))
    )  # fmt: skip
    return (
        study.triangle.cycles / study.triangle.frequency_hz
        + len(study.static_load.masses_kg) * study.static_load.settle_s
        + len(hold_names(study)) * _HOLD_S
        + free.trials * free.record_s
        + study.chirp.duration_s
        + trials * (steps.zero_s + steps.step_s)
    )


def play_triangle(runner: Runner, study: Study) -> None:
    """Row S13: the triangle, from rest at 0 V."""
    t = study.triangle
    lead = constant(t.low_v, 0.2, UPDATE_HZ)
    drive_v = triangle(t.low_v, t.high_v, t.frequency_hz, t.cycles, UPDATE_HZ)
    runner.play(
        "triangle",
        np.concatenate([lead, drive_v]),
        t.frame_rate_hz,
        runner.mass_kg,
        particles="particles",
    )


def play_static_loads(runner: Runner, study: Study) -> None:
    """Row S16: each mass in turn at 0 V, then the rig's own weight again."""
    s = study.static_load
    runner.hang("static", list(s.masses_kg), s.settle_s, s.frame_rate_hz)
    runner.load(runner.mass_kg)
    runner.settle(0.0, s.settle_s)


def play_holds(runner: Runner, study: Study) -> None:
    """Row S18: the rig's own weight at each of some voltages, at rest."""
    s = study.static_load
    for name, drive_v in zip(hold_names(study), hold_drives_v(study), strict=True):
        runner.settle(drive_v, s.settle_s)
        runner.play(name, constant(drive_v, _HOLD_S, UPDATE_HZ), s.frame_rate_hz, runner.mass_kg)
    runner.settle(0.0, s.settle_s)


def play_free_responses(runner: Runner, study: Study, baseline_v: float) -> None:
    """Row S19: lift, wait, let go, at the baseline voltage."""
    free = study.free_response
    for name in free_names(study):
        runner.release(
            name, baseline_v, free.settle_s, free.record_s, free.frame_rate_hz, runner.mass_kg
        )


def play_chirp(runner: Runner, study: Study, baseline_v: float) -> None:
    """Row S20: the chirp about the baseline voltage, after creep there has faded."""
    c = study.chirp
    runner.settle(baseline_v, c.hold_s)
    lead = constant(baseline_v, _LEAD_S, UPDATE_HZ)
    sweep = linear_chirp(c.start_hz, c.stop_hz, c.duration_s, UPDATE_HZ)
    drive_v = np.concatenate([lead, baseline_v + c.amplitude_v * sweep])
    runner.play("chirp", drive_v, c.frame_rate_hz, runner.mass_kg)


def _step(steps: Steps | StepTrials) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    zero = constant(0.0, steps.zero_s, UPDATE_HZ)
    return np.concatenate([zero, constant(steps.step, steps.step_s, UPDATE_HZ)])


def play_open_steps(runner: Runner, study: Study, to_volt: VoltageMap) -> None:
    """Row S24, open loop: to zero strain, then the step, by the voltage map alone."""
    drive_v = to_volt.voltage_v(_step(study.steps))
    for name in open_names(study):
        runner.settle(0.0, study.steps.rest_s)
        runner.play(name, drive_v, study.steps.frame_rate_hz, runner.mass_kg)


def saturating_reference(steps: Steps) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Desired strain of a trial that saturates: zero, too much, the step; one value a block."""
    much_s = _SATURATED_PART * steps.step_s
    return np.concatenate(
        [
            constant(0.0, steps.zero_s, UPDATE_HZ),
            constant(steps.saturating_step, much_s, UPDATE_HZ),
            constant(steps.step, steps.step_s - much_s, UPDATE_HZ),
        ]
    )


def play_closed_steps(runner: Runner, study: Study, names: list[str], loop: LoopSettings) -> None:
    """Rows S24 and S25, closed loop: the same by self-sensing."""
    for name in names:
        saturates = name.startswith("saturating")
        reference = saturating_reference(study.steps) if saturates else _step(study.steps)
        runner.settle(0.0, study.steps.rest_s)
        runner.close_loop(name, reference, loop, study.steps.frame_rate_hz, runner.mass_kg)


def chip_names(study: StepStudy) -> list[str]:
    """Step trials of a rig that closes its own loop."""
    return [f"chip-{k + 1}" for k in range(study.step_trials.trials)]


def play_chip_steps(runner: Runner, study: StepStudy) -> None:
    """Row S24 by the rig's own controller; at rest first, for the camera's reference."""
    trials = study.step_trials
    lead_s = max(_REST_S, _REST_FRAMES / trials.frame_rate_hz)
    reference = np.concatenate([constant(np.nan, lead_s, UPDATE_HZ), _step(trials)])
    for name in chip_names(study):
        runner.settle(0.0, trials.rest_s)
        runner.follow(name, reference, trials.frame_rate_hz, runner.mass_kg)
