"""Predictive control: an observer with a feedback whose reference is planned by programs.

The quadratic program of `predicted_plan` finds, in each update, the motion that reaches the desired
strain best within the limits of drive and field. The observer and feedback of `observer` lead the
actuator along it. So what the limits permit is decided over a horizon, while the feedback keeps
the gains and the robustness of its design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.model_based.predicted_plan import PredictedPlan
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.observer import ObserverController
from haselab.controllers.observer_design import OBSERVER, design_observer
from haselab.controllers.observer_law import ObserverLaw
from haselab.controllers.protocol import ControllerSetting

__all__ = ["MPC", "PredictiveController", "design_mpc", "fastest_move_s"]

_STAGES_A_MOVE = 8.0  # of the fastest one through the whole range
_POLE = 1.8  # of a stage: faster on the model, but more overshoot on other devices
_LEAST_STAGE_S = 0.01


class PredictiveController(ObserverController):
    """Predictive control with box constraints.

    Args:
        bandwidth_rad_s: of the feedback, see `ObserverController`.
        load_n: see there.
        shake_m_s2: see there.
        reserve: share of the force's range that the plan leaves to the feedback.
        pole_rad_s: of the planned motion where no limit acts.
        stage_s: duration of one of the sixteen stages of the horizon.
    """

    def __init__(
        self, bandwidth_rad_s: float, load_n: float, shake_m_s2: float, reserve: float,
        pole_rad_s: float, stage_s: float,
    ) -> None:  # fmt: skip
        super().__init__(bandwidth_rad_s, load_n, shake_m_s2, reserve)
        self._pole, self._stage_s = pole_rad_s, stage_s

    def _new_plan(self, law: ObserverLaw, setting: ControllerSetting) -> PredictedPlan:
        assert setting.actuator is not None
        return PredictedPlan(
            law.model, setting.actuator, setting.period_s, self._reserve,
            setting.highest_rate_per_s, self._pole, self._stage_s,
        )  # fmt: skip


def fastest_move_s(known: KnownActuator) -> float:
    """About the shortest time from one end of the reachable range to the other.

    Half of the range of the electric force accelerates over half of the way, and brakes then.

    Args:
        known: the actuator.
    """
    model = MotionModel(known)
    low, high = known.reachable()
    length_m = known.length_m(0.5 * (low + high))
    ends_n = [model.pull_n(length_m, volt)
              for volt in (max(known.low_v, 0.0), known.highest_drive_v(length_m))]  # fmt: skip
    pushed = 0.5 * abs(ends_n[1] - ends_n[0]) / model.inertia_kg
    return 2.0 * math.sqrt(known.zero_length_m * (high - low) / pushed)


def design_mpc(setting: ControllerSetting) -> Mapping[str, float]:
    """Take the design of `observer` for the feedback, and a horizon of twice the longest move.

    Minimises the integral of time times the squared error after a step of the load. The peak
    sensitivity is at most 2.5 with the stiffness 10 % higher, and with it 10 % lower and the delay
    a fifth longer; at most 5 with the delay longer by half. While no limit
    acts, the plan does not use the measurement, so it changes none of these.

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `PredictiveController`.
    Raises:
        ResultError: No parameters keep the loop stable.
    """
    feedback = design_observer(setting)
    assert setting.actuator is not None
    stage_s = max(fastest_move_s(setting.actuator) / _STAGES_A_MOVE, _LEAST_STAGE_S,
                  setting.period_s)  # fmt: skip
    stage_s = setting.period_s * round(stage_s / setting.period_s)
    return {**feedback, "pole_rad_s": float(f"{_POLE / stage_s:.4g}"),
            "stage_s": float(f"{stage_s:.4g}")}  # fmt: skip


MPC = ControllerKind(
    "mpc",
    PredictiveController,
    (
        *OBSERVER.parameters,
        Parameter("pole_rad_s", "rad/s", None, 1e-2, 1e4),
        Parameter("stage_s", "s", None, 1e-4, 10.0),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_mpc,
    preview_s=OBSERVER.preview_s,
)
