"""Every public function refuses what it cannot use, in one line that says what was found."""

import inspect
import re
import warnings

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import haselab as hl
from haselab import identify
from haselab.base import HaselabError, InputError
from haselab.identify import ArxOrders, FreeTrial, LoopRecord, TransferStructure

RNG = np.random.default_rng(1)
TIME_S = np.arange(300) / 50.0
U = np.repeat(RNG.normal(size=60), 5)
PLANT = hl.Plant(0.5, 9.0, 0.2)
Y = PLANT.simulate(U, 50.0, TIME_S) + 1e-3 * RNG.normal(size=300)
RECORD = hl.Record.sampled(U, Y, 50.0)
STRAIN = np.linspace(0.0, 0.1, 64)
STRETCH = np.linspace(1.0, 3.0, 40)
LOOP = np.tile(np.r_[np.linspace(0, 2, 50), np.linspace(2, 0, 50)], 3)
FRAMES = list(RNG.integers(0, 255, (2, 64, 64)).astype(np.uint8))
MONITORS = {"v_monitor_v": np.sin(0.1 * np.arange(4000)), "i_monitor_v": np.ones(4000)}
CURVE = hl.fit_map(STRAIN, STRAIN**2)
RUNNER = hl.Runner(hl.twin())

# A value that no parameter of a kind may have.
TEXTS = {"bytes": b"words", "folder": ".", "text": "words"}
THINGS = {"nothing": None, "object": object(), "dictionary of texts": {"u": ["a"]}}
NESTED = {"nested": [[1.0, 2.0], [3.0, 4.0]], "ragged": [[1.0], [1.0, 2.0]], "texts": ["a"] * 300}
FRAMES_OF_DATA = {
    "empty DataFrame": pd.DataFrame(),
    "DataFrame of texts": pd.DataFrame({"u": ["a"] * 300, "y": ["b"] * 300}),
}
COMPLEX = {"complex": 1j, "complex array": U + 1j}
NANS = {"NaN": np.nan, "array of NaN": np.full(300, np.nan)}
NOT_A_NUMBER = {
    **TEXTS,
    **THINGS,
    **NESTED,
    **FRAMES_OF_DATA,
    **COMPLEX,
    **NANS,
    "text of a number": "1",
    "boolean": True,
    "list": [1.0, 2.0],
    "empty": [],
    "too large": 10**400,
}
WHOLE = {**NOT_A_NUMBER, "fraction": 1.5, "float": 2.0, "negative": -1}
VECTOR = {
    **TEXTS,
    **THINGS,
    **FRAMES_OF_DATA,
    **COMPLEX,
    **NANS,
    **NESTED,
    "empty": [],
    "scalar": 3.0,
    "list of nothing": [None] * 300,
    "clock times": np.arange(300).astype("M8[s]"),
    "array of bytes": np.array([b"a"] * 300),
}
OBJECT = {
    **TEXTS,
    **THINGS,
    **NESTED,
    **FRAMES_OF_DATA,
    **COMPLEX,
    **NANS,
    "scalar": 3.0,
    "array": U,
    "list": [RECORD, 3],
}
WORD = {**NOT_A_NUMBER, "number": 3, "unknown": "words"}
PATH = {
    **THINGS,
    **NESTED,
    **COMPLEX,
    **NANS,
    "bytes": b"words",
    "number": 3,
    "no such": "no/such.csv",
    "NUL": "a\0b",
}
DATA = {
    **TEXTS,
    **THINGS,
    **NESTED,
    **FRAMES_OF_DATA,
    **COMPLEX,
    **NANS,
    "scalar": 3.0,
    "list": [1.0],
    "array": U,
    "empty": [],
    "empty dictionary": {},
    "scalars": {"u": 1.0, "y": 2.0},
    "complex columns": {"u": U + 1j, "y": U + 1j},
    "no rows": pd.DataFrame({"u": [], "y": []}),
    "two dimensions": xr.Dataset({"u": (("a", "b"), np.ones((3, 3)))}),
    "Series": pd.Series(U),
}
FLAG = {k: v for k, v in NOT_A_NUMBER.items() if k != "boolean"} | {"number": 1}


def without(values, *names):
    return {name: value for name, value in values.items() if name not in names}


OPTIONAL = {"nothing"}  # None is the default
NUMBER_OR_NONE, WHOLE_OR_NONE = without(NOT_A_NUMBER, *OPTIONAL), without(WHOLE, *OPTIONAL)
FINITE = {**NOT_A_NUMBER, "infinite": np.inf}
POSITIVE = {**FINITE, "zero": 0.0, "negative": -1.0}
COLUMN = {**WORD, "unknown": "no such column"}

# Function: its arguments as (right value, wrong values).
RECORDS = (RECORD, OBJECT)
STRUCTURE = (TransferStructure(), without(OBJECT, "nothing"))
CALLS = {
    hl.records: {
        "data": ({"u": U, "y": Y}, DATA),
        "input": ("u", COLUMN),
        "output": ("y", COLUMN),
        "rate_hz": (50.0, without(POSITIVE, "nothing")),
        "time": (None, without(COLUMN, "nothing")),
        "hold": ("zero", without(WORD, "nothing")),
    },
    hl.table: {
        "data": ({"u": U, "y": Y}, without(DATA, "Series")),
        "rate_hz": (50.0, without(POSITIVE, "nothing")),
    },
    hl.load: {"path": ("no.csv", {**PATH, "folder": "."})},
    hl.example: {"name": ("chirp", WORD), "folder": ("no/such", without(PATH, "no such"))},
    hl.sense: {
        "data": (MONITORS, DATA),
        "carrier_hz": (2000.0, POSITIVE),
        "rate_hz": (2e5, without(POSITIVE, "nothing")),
        "v": ("v_monitor_v", COLUMN),
        "i": ("i_monitor_v", COLUMN),
        "block_s": (0.01, POSITIVE),
        "volt_per_monitor_volt": (5000.0, without(POSITIVE, "nothing")),
        "ampere_per_monitor_volt": (2e-3, without(POSITIVE, "nothing")),
    },
    hl.track: {
        "video": (FRAMES, without(OBJECT, "list") | {"no frames": [], "list": [1.0]}),
        "points": (
            np.array([[32.0, 32.0]]),
            without(VECTOR, "nothing") | {"columns": {"x_px": [1.0], "y_px": [1.0, 2.0]}},
        ),
        "rate_hz": (50.0, without(POSITIVE, "nothing")),
        "scale_mm_per_px": (0.1, without(POSITIVE, "nothing")),
        "rest_frames": (1, WHOLE),
        "options": (None, without(OBJECT, "nothing")),
    },
    hl.design: {
        "model": (PLANT, OBJECT),
        "spec": ({"phase_margin_deg": 60.0}, without(OBJECT, "nothing")),
        "controller": ("pi", WORD),
        "limits": ((-0.05, 0.1), without(OBJECT, "nothing") | {"order": (1, 0)}),
        "rate_hz": (100.0, POSITIVE),
        "delay_s": (0.005, FINITE | {"negative": -1.0}),
        "probability": (None, NUMBER_OR_NONE),
        "feedthrough": (0.3, FINITE | {"large": 1.5}),
        "seed": (0, WHOLE),
    },
    hl.twin: {
        "file": (None, without(PATH, "nothing") | {"folder": "."}),
        "frequency_unit": ("hz", WORD),
        "seed": (1, WHOLE),
    },
    hl.Runner: {
        "rig": (hl.twin(), OBJECT),
        "baseline_v": (0.0, NOT_A_NUMBER),
        "zero_length_m": (0.05, without(POSITIVE, "nothing")),
        "carrier_hz": (2000.0, POSITIVE),
        "carrier_v": (0.02, NOT_A_NUMBER),
        "frame_rate_hz": (50.0, NOT_A_NUMBER),
        "progress": (None, {}),
    },
    RUNNER.play: {"drive_v": (U, VECTOR)},
    RUNNER.hold: {"drive_v": (0.0, NOT_A_NUMBER), "duration_s": (1.0, NOT_A_NUMBER)},
    RUNNER.close_loop: {"reference": (U, VECTOR), "actuator": (hl.Actuator(), OBJECT)},
    hl.Actuator: {
        name: (None, without(OBJECT, "nothing"))
        for name in (
            "voltage_map",
            "strain_map",
            "controller",
            "saturation",
            "plant",
            "physical",
        )
    }
    | {"zero_length_m": (None, without(POSITIVE, "nothing"))},
    hl.Actuator.load: {"path": ("no.toml", {**PATH, "folder": "."})},
    hl.Plant: {
        "gain": (1.0, NOT_A_NUMBER),
        "natural_frequency_rad_s": (9.0, POSITIVE),
        "damping_ratio": (0.1, FINITE),
        "delay_s": (0.0, FINITE),
        "slow_modes": ((), OBJECT),
    },
    PLANT.simulate: {
        "u": (U, without(VECTOR, "scalar")),
        "input_rate_hz": (50.0, without(POSITIVE, "infinite")),
        "time_s": (TIME_S, without(VECTOR, "empty")),
        "initial_state": (None, without(VECTOR, "nothing")),
    },
    PLANT.frequency_response: {"omega_rad_s": (U, TEXTS | THINGS | COMPLEX)},
    hl.Record: {
        "u": (U, VECTOR),
        "input_rate_hz": (50.0, without(POSITIVE, "infinite")),
        "y": (Y, VECTOR),
        "output_time_s": (TIME_S, VECTOR),
        "input_before": (0.0, NUMBER_OR_NONE),
        "hold": ("zero", WORD),
        "hold_assumed": (False, FLAG),
        "notes": ((), {}),
    },
    hl.Record.sampled: {
        "u": (U, VECTOR),
        "y": (Y, VECTOR),
        "rate_hz": (50.0, POSITIVE),
        "input_before": (0.0, NUMBER_OR_NONE),
        "hold": ("zero", WORD),
        "held_at_hz": (None, without(POSITIVE, "nothing")),
    },
    LoopRecord: {
        "u": (LOOP, VECTOR),
        "y": (LOOP, VECTOR),
        "rate_hz": (100.0, POSITIVE),
        "counted_from_s": (0.0, FINITE),
    },
    FreeTrial: {"x": (U, VECTOR), "time_s": (TIME_S, VECTOR)},
    TransferStructure: {
        "poles": (2, WHOLE),
        "zeros": (0, WHOLE),
        "delay": (0.0, FINITE),
        "slow_modes": (0, WHOLE),
        "offset": (True, FLAG),
        "initial_state": (True, FLAG),
        "fixed": ({}, OBJECT),
    },
    ArxOrders: {"na": (1, WHOLE), "nb": (1, WHOLE), "nk": (1, WHOLE)},
    hl.estimate_frequency_response: {
        "records": RECORDS,
        "method": ("h1", WORD),
        "period_s": (None, NUMBER_OR_NONE),
        "segment_s": (1.0, NUMBER_OR_NONE),
    },
    hl.fit_transfer: {
        "records": RECORDS,
        "structure": STRUCTURE,
        "applied": (False, FLAG),
        "near": (None, without(OBJECT, "nothing")),
    },
    hl.fit_arx: {
        "records": RECORDS,
        "orders": (None, without(OBJECT, "nothing")),
        "criterion": ("bic", WORD),
        "remove_means": (True, FLAG),
    },
    hl.fit_subspace: {
        "records": RECORDS,
        "order": (2, WHOLE_OR_NONE),
        "block_rows": (9, WHOLE),
        "remove_means": (True, FLAG),
        "bootstrap": (0, WHOLE),
        "seed": (1, WHOLE),
    },
    hl.fit_creep: {"records": RECORDS, "model": ("prony", WORD), "leave_out_s": (0.0, FINITE)},
    hl.fit_hysteresis: {
        "records": (LoopRecord(LOOP, LOOP**1.1, 100.0), OBJECT),
        "model": ("auto", WORD),
        "operators": (1, WHOLE_OR_NONE),
    },
    hl.fit_free_response: {
        "trials": (FreeTrial(U, TIME_S), OBJECT),
        "creep": (None, without(FLAG, "nothing")),
        "near": (None, without(OBJECT, "nothing")),
    },
    hl.fit_map: {"x": (STRAIN, VECTOR), "y": (STRAIN, VECTOR), "monotone": (True, FLAG)},
    hl.fit_voltage_map: {"strain": (STRAIN, VECTOR), "voltage_v": (STRAIN, VECTOR)},
    hl.fit_capacitance_map: {"relative_capacitance": (STRAIN, VECTOR), "strain": (STRAIN, VECTOR)},
    hl.fit_strain_map: {
        "capacitance_f": (STRAIN, VECTOR),
        "strain": (STRAIN, VECTOR),
        "kind": ("line", WORD),
        "coverage": (0.95, FINITE),
    },
    hl.find_regions: {
        "stretch": (STRETCH, VECTOR),
        "load_n": (STRETCH, VECTOR),
        "segments": (2, WHOLE_OR_NONE),
    },
    hl.fit_hyperelastic: {
        "stretch": (STRETCH, VECTOR),
        "nominal_stress_pa": (1e3 * (STRETCH - STRETCH**-2.0), VECTOR),
        "model": ("neo-hooke", WORD),
        "deformation": ("uniaxial", WORD),
        "lateral_stretch": (3.0, POSITIVE),
        "prestretch": (1.0, POSITIVE),
        "electrode_natural": (1.0, NUMBER_OR_NONE),
        "electrode_stiffening": (False, FLAG),
    },
    identify.fit_duffing: {
        "records": RECORDS,
        "structure": STRUCTURE,
        "powers": ((3,), OBJECT),
        "linear": (None, without(OBJECT, "nothing")),
    },
    identify.fit_output_curve: {
        "records": RECORDS,
        "structure": STRUCTURE,
        "powers": ((3,), OBJECT),
        "linear": (None, without(OBJECT, "nothing")),
    },
    identify.fit_hammerstein: {
        "records": RECORDS,
        "structure": STRUCTURE,
        "degree": (2, WHOLE),
        "known": ((), TEXTS | THINGS),
    },
    identify.fit_nonlinear: {"records": RECORDS, "structure": STRUCTURE, "kind": ("duffing", WORD)},
    identify.choose_transfer: {
        "records": RECORDS,
        "start": STRUCTURE,
        "varied": (["delay"], OBJECT),
    },
    CURVE.simulate: {"x": (STRAIN, TEXTS | THINGS | COMPLEX | {"ragged": NESTED["ragged"]})},
    CURVE.compare: {
        "x": (STRAIN, TEXTS | THINGS | COMPLEX),
        "y": (STRAIN, TEXTS | THINGS | COMPLEX),
    },
}
CASES = [
    pytest.param(function, name, wrong, id=f"{function.__qualname__}-{name}-{what}")
    for function, arguments in CALLS.items()
    for name, (_, values) in arguments.items()
    for what, wrong in values.items()
]


@pytest.mark.parametrize(("function", "name", "wrong"), CASES)
def test_a_wrong_argument_is_refused_in_one_line(function, name, wrong):
    arguments = {each: right for each, (right, _) in CALLS[function].items()}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(HaselabError, match=r"^[^\n]{20,400}$") as refused:
            function(**{**arguments, name: wrong})
    assert re.search(r"must|Give|Use|Check|Name|Create|Record|Export|Lower", str(refused.value))


@pytest.mark.parametrize("function", CALLS, ids=lambda function: function.__qualname__)
def test_every_parameter_of_a_function_is_in_the_table(function):
    assert set(CALLS[function]) == set(inspect.signature(function).parameters)


def test_every_public_function_is_in_the_table():
    public = {getattr(hl, name) for name in hl.__all__}
    functions = {each for each in public if inspect.isfunction(each)}
    assert functions - {hl.armed} <= set(CALLS)  # what `armed` takes is in tests/safety


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: hl.load("."), r"The path is a folder, not a file"),
        (lambda: hl.table({"u": U})["x"], r"no column 'x'; the table has u\. Name one"),
        (lambda: CURVE.compare([], []), r"x has shape \(0,\) and y \(0,\)"),
        (lambda: hl.signals.triangle(0.0, 1.0, 0.0, 1, 100.0), r"frequency_hz is 0; it must be"),
        (lambda: hl.signals.multisine([1.0, 2.0], 1.0, 10.0, [1.0] * 3), r"power has shape \(3,\)"),
        (lambda: hl.signals.linear_chirp("1", 2.0, 3.0, 100.0), r"start_hz is '1'; it must be"),
        (lambda: hl.fit_transfer(U, Y, 100.0), r"records is an array of .* Make records of two ar"),
        (lambda: hl.fit_transfer(U, Y, rate_hz=100.0), r"records\(\{'u': u, 'y': y\}, rate_hz"),
        (lambda: hl.fit_free_response(U, 100.0), r"Make one of two columns: .*FreeTrial\(x, time"),
        (lambda: hl.armed(None), r"rig is None; it must be a Rig"),
        (lambda: hl.sense({**MONITORS, "v_monitor_v": np.full(4000, np.nan)}, carrier_hz=2000.0,
                          rate_hz=2e5), r"v_monitor_v has no finite value"),
    ],
)  # fmt: skip
def test_other_wrong_calls_are_refused(call, match):
    with pytest.raises(InputError, match=match):
        call()


def test_a_refusal_says_the_true_reason():
    frame = pd.DataFrame({"u": ["a"] * 300, "y": Y})
    with pytest.raises(InputError, match=r"Column u holds 'a'; it must hold real numbers\. Name"):
        hl.records(frame, rate_hz=50.0)
    with pytest.raises(
        InputError, match=r"no column of numbers\. Column u has shape \(\); it must"
    ):
        hl.table({"u": 1.0, "y": 2.0})
    with pytest.raises(InputError, match=r"Column u holds \(.*j\); it must hold real numbers"):
        hl.records({"u": U + 1j, "y": Y}, rate_hz=50.0)
    with pytest.raises(InputError, match=r"The data are None; they must be a file, a table"):
        hl.table(None)
    with pytest.raises(InputError, match=r"The columns u, y have no rows"):
        hl.table(pd.DataFrame({"u": [], "y": []}))
    with pytest.raises(InputError, match=r"attribute rate_hz is 'fast'"):
        frame = pd.DataFrame({"u": U, "y": Y})
        frame.attrs["rate_hz"] = "fast"
        hl.table(frame)
