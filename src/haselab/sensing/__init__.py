"""From monitor voltages to capacitance and strain."""

from haselab.sensing.lockin import Lockin
from haselab.sensing.paper import PaperChain
from haselab.sensing.relative import relative_capacitance
from haselab.sensing.sensed import LockinConfig, Sensed
from haselab.sensing.sinefit import SineFit

__all__ = ["Lockin", "LockinConfig", "PaperChain", "Sensed", "SineFit", "relative_capacitance"]
