"""Physics and model structures: hyperelastic laws, linear plants, maps, hysteresis, creep."""

from haselab.models.arx import ArxModel
from haselab.models.creep import (
    Creep,
    FractionalCreep,
    LogarithmicCreep,
    PowerCreep,
    PronyCreep,
    mittag_leffler,
)
from haselab.models.deformation import DEFORMATIONS, Deformation
from haselab.models.exchange import from_control, from_scipy, to_control, to_scipy
from haselab.models.held_input import HeldInput, PoleResponse
from haselab.models.hyperelastic import (
    LAWS,
    ArrudaBoyce,
    ArrudaBoyceSeries,
    Gent,
    HyperelasticLaw,
    NeoHooke,
    Ogden,
    OgdenThreeTerms,
    OgdenTwoTerms,
    Yeoh,
    YeohTwoTerms,
    inverse_langevin,
    law_from_parameters,
)
from haselab.models.hysteresis.bouc_wen import BoucWen
from haselab.models.hysteresis.common import DeadZones, Hysteresis, HysteresisState
from haselab.models.hysteresis.play import PrandtlIshlinskii
from haselab.models.maps import LinearMap, VoltageMap
from haselab.models.plant import Plant, SlowMode
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel
from haselab.models.spline_map import SplineMap
from haselab.models.state_space import StateSpaceModel
from haselab.models.voltage_plant import VoltagePlant, delayed_square

__all__ = [
    "DEFORMATIONS",
    "LAWS",
    "ArrudaBoyce",
    "ArrudaBoyceSeries",
    "ArxModel",
    "BoucWen",
    "Creep",
    "DeadZones",
    "Deformation",
    "FractionalCreep",
    "Gent",
    "HeldInput",
    "HyperelasticLaw",
    "Hysteresis",
    "HysteresisState",
    "LinearMap",
    "LogarithmicCreep",
    "NeoHooke",
    "Ogden",
    "OgdenThreeTerms",
    "OgdenTwoTerms",
    "Plant",
    "PlantPosterior",
    "PoleResponse",
    "PowerCreep",
    "PrandtlIshlinskii",
    "PronyCreep",
    "RationalModel",
    "SlowMode",
    "SplineMap",
    "StateSpaceModel",
    "VoltageMap",
    "VoltagePlant",
    "Yeoh",
    "YeohTwoTerms",
    "delayed_square",
    "from_control",
    "from_scipy",
    "inverse_langevin",
    "law_from_parameters",
    "mittag_leffler",
    "to_control",
    "to_scipy",
]
