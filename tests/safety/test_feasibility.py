"""Closed forms, and the twin's own monitors, against the numbers of the checks."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from haselab.base import InputError, LimitError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.safety.feasibility import Drive, Feasibility, Rating, check_feasibility

RIG = describe(TwinConfig())
RATING = Rating(12e-3, 350e6, 6e3, 1.3e-9, 310e-6, 40e6, stretch_high=9.0, stretch=2.7)
REST = Drive("rest", np.zeros(3))


def asked(found: Feasibility) -> dict[str, float]:
    return {check.name: check.requested for check in found.checks}


def test_the_numbers_are_the_closed_forms() -> None:
    ramp = Drive("ramp", np.array([0.2, 0.4, 0.6, 0.8, 1.0, 1.2]), 0.25)
    got = asked(check_feasibility(RIG, RATING, [REST, ramp], 2000.0, 0.02))
    ripple_a = 2 * math.pi * 2000.0 * 1.3e-9 * 100.0
    assert got["peak current"] == pytest.approx(1e3 * (ripple_a + 1.3e-9 * 1000.0 / 0.01))
    rise_s = 1.3e-9 * 1000.0 / (12e-3 - ripple_a) + 3.0 / (2 * math.pi * 6e3)
    assert got["time of an update"] == pytest.approx(1e3 * rise_s)
    assert got["slew of the carrier"] == pytest.approx(2 * math.pi * 2000.0 * 100.0 / 1e6)
    assert got["field"] == pytest.approx(6100.0 / 310e-6 / 1e6)


def test_the_carrier_s_current_is_what_the_twin_s_monitor_shows() -> None:
    twin = TwinBench(TwinConfig(), 1, noise=False)
    rating = dataclasses.replace(
        RATING, capacitance_f=twin._native.capacitance(twin._native.length_m)
    )
    told_a = 1e-3 * asked(check_feasibility(RIG, rating, [REST], 2000.0, 0.02))["peak current"]
    twin.sine(2000.0, 0.02)
    for _ in range(3):
        codes = twin.read()
    seen_a = abs(codes[:, 1]).max() * RIG.volt_per_code / RIG.i_monitor_v_per_a
    # The amplifier raises 2 kHz by 2.6 %; 5 kohm in series take less than 0.1 %; a code is 0.6 uA.
    assert seen_a == pytest.approx(1.026 * told_a, rel=0.005, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "drive", "carrier", "words"),
    [
        ({"current_limit_a": 1e-3}, [0.5], (2000.0, 0.02), r"peak current is \d.* \(limit 1 mA"),
        ({"capacitance_f": 2e-8}, [2.0], (200.0, 0.02), r"time of an update is \d.* in x"),
        ({"slew_v_per_s": 1e6}, [0.5], (2000.0, 0.02), r"slew of the carrier is 1\.257 V/us"),
        ({"bandwidth_hz": 1e3}, [0.5], (2000.0, 0.02), r"carrier frequency is 2000 Hz"),
        ({"thickness_m": 1e-4}, [1.0], (2000.0, 0.02), r"field is 51 MV/m in x \(limit 36 MV/m"),
        ({"stretch_high": 2.0}, [1.0], (2000.0, 0.02), r"stretch is 2\.7"),
        (
            {},
            [2.5],
            (2000.0, 0.02),
            r"highest drive voltage is 2\.5 V in x \(limit 2 V\)\. Lower the voltage, or raise the "
            "limit in the rig file",
        ),
        (
            {},
            [-0.5],
            (2000.0, 0.02),
            r"lowest drive voltage is -0\.5 V in x \(limit 0 V\)\. Raise the voltage, or lower",
        ),
    ],
)
def test_a_study_beyond_the_bench_is_refused(change, drive, carrier, words) -> None:
    found = check_feasibility(
        RIG, dataclasses.replace(RATING, **change), [REST, Drive("x", np.array(drive))], *carrier
    )
    assert not found.ok
    with pytest.raises(LimitError, match=rf"Not feasible on this bench: .*{words}"):
        found.require()


def test_a_signal_that_the_updates_cannot_make_is_refused() -> None:
    found = check_feasibility(RIG, RATING, [Drive("fast", np.zeros(2), 60.0)], 2000.0, 0.02)
    with pytest.raises(LimitError, match=r"signal frequency is 60 Hz in fast \(limit 50 Hz"):
        found.require()


def test_an_unknown_stretch_passes() -> None:
    rating = dataclasses.replace(RATING, stretch=math.nan)
    assert check_feasibility(RIG, rating, [REST], 2000.0, 0.02).ok


def test_ratings_that_are_not_positive_and_missing_drives_are_refused() -> None:
    with pytest.raises(InputError, match=r"rating\.thickness_m is 0, but"):
        dataclasses.replace(RATING, thickness_m=0.0)
    with pytest.raises(InputError, match="no drive to check"):
        check_feasibility(RIG, RATING, [], 2000.0, 0.02)
