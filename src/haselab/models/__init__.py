"""Physics and model structures: hyperelastic laws, linear plants, maps."""

from haselab.models.held_input import HeldInput, PoleResponse
from haselab.models.hyperelastic import (
    LAWS,
    ArrudaBoyce,
    ArrudaBoyceSeries,
    Gent,
    HyperelasticLaw,
    NeoHooke,
    Ogden,
    Yeoh,
    YeohTwoTerms,
    inverse_langevin,
    law_from_parameters,
)
from haselab.models.maps import LinearMap, VoltageMap
from haselab.models.plant import Plant, SlowMode

__all__ = [
    "LAWS",
    "ArrudaBoyce",
    "ArrudaBoyceSeries",
    "Gent",
    "HeldInput",
    "HyperelasticLaw",
    "LinearMap",
    "NeoHooke",
    "Ogden",
    "Plant",
    "PoleResponse",
    "SlowMode",
    "VoltageMap",
    "Yeoh",
    "YeohTwoTerms",
    "inverse_langevin",
    "law_from_parameters",
]
