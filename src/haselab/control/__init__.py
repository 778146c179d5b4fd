"""From a model to gains with margins."""

from haselab.control.ensemble import (
    LoopSummaries,
    LoopTraces,
    simulate_ensemble,
    trace_ensemble,
)
from haselab.control.gains import PidGains, Saturation
from haselab.control.linear import LinearController
from haselab.control.loop_shaping import Design, Prediction, design_pi, design_pid, predict
from haselab.control.plants.loop_table import WhiteNoise
from haselab.control.plausible_design import design_controller
from haselab.control.simulate import LoopSetting, LoopTrace, simulate_drive, simulate_loop
from haselab.control.spec import DesignSpec
from haselab.control.stability.margins import Crossover, Margins, loop_response, margins
from haselab.control.stability.plausible import (
    PlausibleMargins,
    binomial_proportion,
    plausible_margins,
)
from haselab.control.step_metrics import StepMetrics, StepNumbers, over_trials, step_metrics

__all__ = [
    "Crossover",
    "Design",
    "DesignSpec",
    "LinearController",
    "LoopSetting",
    "LoopSummaries",
    "LoopTrace",
    "LoopTraces",
    "Margins",
    "PidGains",
    "PlausibleMargins",
    "Prediction",
    "Saturation",
    "StepMetrics",
    "StepNumbers",
    "WhiteNoise",
    "binomial_proportion",
    "design_controller",
    "design_pi",
    "design_pid",
    "loop_response",
    "margins",
    "over_trials",
    "plausible_margins",
    "predict",
    "simulate_drive",
    "simulate_ensemble",
    "simulate_loop",
    "step_metrics",
    "trace_ensemble",
]
