"""One physical model of an actuator, identified jointly from all its experiments."""

from haselab.identify.physical.fit import fit_actuator
from haselab.identify.physical.misfit import TRACKED_ZERO_M
from haselab.identify.physical.prediction import (
    ChannelNoise,
    IdentifiedModel,
    MotionPrediction,
    PredictedPart,
    predict_motion,
)
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.result import ActuatorFit

__all__ = [
    "TRACKED_ZERO_M",
    "ActuatorFit",
    "ChannelNoise",
    "IdentifiedModel",
    "MotionPrediction",
    "MotionRecord",
    "PredictedPart",
    "fit_actuator",
    "predict_motion",
]
