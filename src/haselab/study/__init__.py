"""Studies: experiments as objects, played and fitted, and what packages need to add their own."""

from haselab.study.analysis import Analysis
from haselab.study.experiment import Chart, Curve, Experiment, ExperimentResult, NotPlayedError
from haselab.study.player import UPDATE_HZ, Player
from haselab.study.quantity import Quantity

__all__ = [
    "UPDATE_HZ",
    "Analysis",
    "Chart",
    "Curve",
    "Experiment",
    "ExperimentResult",
    "NotPlayedError",
    "Player",
    "Quantity",
]
