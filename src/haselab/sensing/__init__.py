"""From monitor voltages to capacitance and strain."""

from haselab.sensing.charge.estimate import Charge, ChargeConfig
from haselab.sensing.latency import latency, step_latencies
from haselab.sensing.lockin import Lockin
from haselab.sensing.paper import PaperChain
from haselab.sensing.quadrature import sense_quadrature
from haselab.sensing.relative import relative_capacitance
from haselab.sensing.sensed import REASONS, LockinConfig, Sensed, reason_text
from haselab.sensing.sinefit import SineFit

__all__ = [
    "REASONS",
    "Charge",
    "ChargeConfig",
    "Lockin",
    "LockinConfig",
    "PaperChain",
    "Sensed",
    "SineFit",
    "latency",
    "reason_text",
    "relative_capacitance",
    "sense_quadrature",
    "step_latencies",
]
