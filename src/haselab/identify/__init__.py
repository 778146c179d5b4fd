"""From records to models with uncertainty, one file a method."""

from haselab.identify.creep.fit import CreepFit, fit_creep
from haselab.identify.experiment_design.drives import BenchLimits
from haselab.identify.experiment_design.plan import Accuracy, ExperimentPlan, plan_experiment
from haselab.identify.fit import CurveFit, Fit, Prediction, RecordFit
from haselab.identify.free.response import FreeResponseFit, FreeTrial, fit_free_response
from haselab.identify.frequency.charts import BodeChart, NicholsChart, NyquistChart
from haselab.identify.frequency.fit import ResponseFit, fit_response
from haselab.identify.frequency.response import (
    RESPONSE_METHODS,
    FrequencyResponse,
    estimate_frequency_response,
)
from haselab.identify.hysteresis.fit import HysteresisFit, LoopRecord, fit_hysteresis
from haselab.identify.model_comparison.agreement import Agreement, compare_estimates
from haselab.identify.model_comparison.comparison import ModelComparison, compare
from haselab.identify.model_comparison.hypotheses import (
    creep_hypotheses,
    linear_mode_hypotheses,
    mode_hypotheses,
    reading_hypotheses,
)
from haselab.identify.model_comparison.voltage_plant import (
    VoltagePlantFit,
    VoltageStructure,
    fit_voltage_plant,
)
from haselab.identify.nonlinear.hammerstein import fit_hammerstein
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit
from haselab.identify.nonlinear.oscillator import fit_duffing, fit_output_curve
from haselab.identify.prediction import predict
from haselab.identify.record import Record
from haselab.identify.sampled.arx import ArxFit, fit_arx
from haselab.identify.sampled.arx_equation import ArxOrders
from haselab.identify.sampled.subspace import SubspaceFit, fit_subspace
from haselab.identify.statics.capacitance_map import CapacitanceMapFit, fit_capacitance_map
from haselab.identify.statics.hyperelastic import (
    HyperelasticFit,
    StressPrediction,
    TensileTest,
    fit_hyperelastic,
    fit_hyperelastic_tests,
)
from haselab.identify.statics.monotone_map import MapFit, fit_map
from haselab.identify.statics.regions import Region, RegionsFit, find_regions
from haselab.identify.statics.voltage_map import VoltageMapFit, fit_voltage_map
from haselab.identify.transfer.bootstrap import bootstrap_transfer
from haselab.identify.transfer.choice import TransferChoice, choose_transfer
from haselab.identify.transfer.fit import TransferFit, TransferStructure, fit_transfer
from haselab.identify.transfer.nonlinear import fit_nonlinear

__all__ = [
    "RESPONSE_METHODS",
    "Accuracy",
    "Agreement",
    "ArxFit",
    "ArxOrders",
    "BenchLimits",
    "BodeChart",
    "CapacitanceMapFit",
    "CreepFit",
    "CurveFit",
    "ExperimentPlan",
    "Fit",
    "FreeResponseFit",
    "FreeTrial",
    "FrequencyResponse",
    "HyperelasticFit",
    "HysteresisFit",
    "LoopRecord",
    "MapFit",
    "ModelComparison",
    "NicholsChart",
    "NonlinearFit",
    "NyquistChart",
    "Prediction",
    "Record",
    "RecordFit",
    "Region",
    "RegionsFit",
    "ResponseFit",
    "StressPrediction",
    "SubspaceFit",
    "TensileTest",
    "TransferChoice",
    "TransferFit",
    "TransferStructure",
    "VoltageMapFit",
    "VoltagePlantFit",
    "VoltageStructure",
    "bootstrap_transfer",
    "choose_transfer",
    "compare",
    "compare_estimates",
    "creep_hypotheses",
    "estimate_frequency_response",
    "find_regions",
    "fit_arx",
    "fit_capacitance_map",
    "fit_creep",
    "fit_duffing",
    "fit_free_response",
    "fit_hammerstein",
    "fit_hyperelastic",
    "fit_hyperelastic_tests",
    "fit_hysteresis",
    "fit_map",
    "fit_nonlinear",
    "fit_output_curve",
    "fit_response",
    "fit_subspace",
    "fit_transfer",
    "fit_voltage_map",
    "fit_voltage_plant",
    "linear_mode_hypotheses",
    "mode_hypotheses",
    "plan_experiment",
    "predict",
    "reading_hypotheses",
]
