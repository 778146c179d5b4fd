"""From records to models with uncertainty, one file a method."""

from haselab.identify.arx import ArxFit, ArxOrders, fit_arx
from haselab.identify.capacitance_map import CapacitanceMapFit, fit_capacitance_map
from haselab.identify.creep import CreepFit, fit_creep
from haselab.identify.free_response import FreeResponseFit, FreeTrial, fit_free_response
from haselab.identify.frequency_response import (
    RESPONSE_METHODS,
    FrequencyResponse,
    estimate_frequency_response,
)
from haselab.identify.hyperelastic import (
    HyperelasticFit,
    SheetTest,
    StressPrediction,
    fit_hyperelastic,
    fit_hyperelastic_tests,
)
from haselab.identify.hysteresis import HysteresisFit, LoopRecord, fit_hysteresis
from haselab.identify.monotone_map import MapFit, fit_map
from haselab.identify.record import Record
from haselab.identify.regions import Region, RegionsFit, find_regions
from haselab.identify.response_charts import BodeChart, NicholsChart, NyquistChart
from haselab.identify.response_fit import ResponseFit, fit_response
from haselab.identify.transfer import TransferFit, TransferStructure, fit_transfer
from haselab.identify.voltage_map import VoltageMapFit, fit_voltage_map

__all__ = [
    "RESPONSE_METHODS",
    "ArxFit",
    "ArxOrders",
    "BodeChart",
    "CapacitanceMapFit",
    "CreepFit",
    "FreeResponseFit",
    "FreeTrial",
    "FrequencyResponse",
    "HyperelasticFit",
    "HysteresisFit",
    "LoopRecord",
    "MapFit",
    "NicholsChart",
    "NyquistChart",
    "Record",
    "Region",
    "RegionsFit",
    "ResponseFit",
    "SheetTest",
    "StressPrediction",
    "TransferFit",
    "TransferStructure",
    "VoltageMapFit",
    "estimate_frequency_response",
    "find_regions",
    "fit_arx",
    "fit_capacitance_map",
    "fit_creep",
    "fit_free_response",
    "fit_hyperelastic",
    "fit_hyperelastic_tests",
    "fit_hysteresis",
    "fit_map",
    "fit_response",
    "fit_transfer",
    "fit_voltage_map",
]
