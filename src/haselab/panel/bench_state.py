"""The state of the bench, which the bench process sends 20 times a second."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BenchState"]


@dataclass(frozen=True)
class BenchState:
    """State of the bench that the pages show.

    Args:
        stage: of the safety chain: off, requested, armed, running or tripped. It is tripped until
            somebody arms the bench and acknowledges the reason.
        mode: `idle`, `drive` (manual), `loop` or `study`.
        drive_v: drive of the last block, in V.
        target_v: drive to which the ramp leads, in V.
        reference: desired strain; None: the loop is open.
        limit_v: highest drive that was typed when the bench was armed, in V.
        holder: page that armed the bench; empty: none.
        reason: of the last trip, or why the last run ended.
        low_v: lowest drive of the rig, in V.
        high_v: highest drive of the rig, in V.
        gain: of the amplifier.
        loop: limits of the desired strain; None: the actuator file has no complete controller.
        name: of the rig.
        simulated: whether it is a twin.
        task: what a study does now; empty without a study.
        done: share of the study's time that has passed, 0 to 1.
        prompt: step that a person must do and confirm; empty: none.
        step: number of this step, which the confirmation must contain.
        events: the last ones, each with its time on the clock of the rig, in s.
        recorded: folder of the last study that was played to its end; empty: none.
        recording: folder of the study that is being played; empty: none.
        requester: page that has requested to arm, and has not typed a limit yet; empty: none.
        computing: whether a simulated bench computes instead of reading blocks.
        extrapolated: whether the capacitance is outside the range in which the strain map was
            fitted, so that the band of the strain is not valid.
    """

    stage: str
    mode: str
    drive_v: float
    target_v: float
    reference: float | None
    limit_v: float
    holder: str
    reason: str
    low_v: float
    high_v: float
    gain: float
    loop: tuple[float, float] | None
    name: str
    simulated: bool
    task: str
    done: float
    prompt: str
    step: int
    events: tuple[tuple[float, str], ...]
    recorded: str
    recording: str
    requester: str
    computing: bool
    extrapolated: bool
