"""Step trials that cannot be evaluated cost their own results, not those of the others."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from haselab.base import InputError
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.study.definition import builtin_study
from haselab.study.experiment import ExperimentResult
from haselab.study.fits.further import further_trials
from haselab.study.fits.maps import Maps
from haselab.study.fits.trials import compare_trials
from haselab.study.own_controller import OWN
from haselab.study.tables import Control

STUDY = builtin_study().model_copy(update={"control": Control(kind="mine")})
MAPS = Maps(
    0.05, VoltageMap(1.324, 3.124, -0.2805, -26.92), StrainMap(1.0, -1.0), {}, {}, {}
)  # fmt: skip


class Trial:
    """A step trial that reaches a share of the step within a time constant of 50 ms."""

    name = "trial"

    def __init__(self, share: float) -> None:
        steps = STUDY.steps
        self.frame_time_s = np.arange(0.0, steps.zero_s + steps.step_s, 1.0 / steps.frame_rate_hz)
        since_s = np.maximum(self.frame_time_s - steps.zero_s, 0.0)
        strain = share * steps.step * (1.0 - np.exp(-since_s / 0.05))
        self.length_m = MAPS.length_m * (1.0 + strain)
        self.block_start_s = self.sensed_s = self.frame_time_s
        self.capacitance_f = 1.0 + strain


def trials(share: float) -> Any:
    return [Trial(share), Trial(1.01 * share)]


@pytest.mark.parametrize(
    ("wrong", "key", "shown"),
    [
        (OWN, "S25.rise_own", "the controller 'mine'"),
        ("PID", "S25.error_pid", "PID"),
        ("PI", "S24.rise_closed", "PI"),
    ],
)
def test_a_wrong_sign_costs_the_results_of_this_controller_alone(
    wrong: str, key: str, shown: str
) -> None:
    given = {"open loop": 0.8, "PI": 1.0, "PID": 1.0, OWN: 1.0} | {wrong: -0.5}
    right = compare_trials(
        {name: trials(share) for name, share in given.items() if name != wrong}, MAPS, STUDY, 1e-4
    )
    found = compare_trials(
        {name: trials(share) for name, share in given.items()}, MAPS, STUDY, 1e-4
    )
    assert found.quantities == right.quantities
    assert found.reason(key).startswith(f"step trials with {shown}: response moves by -0.0")
    assert found.reason("S24.error_open") == found.reason("S22.saturated_fraction") == ""


@pytest.mark.parametrize("kept", [0, 1, 30, -30])
def test_a_trial_without_frames_is_named(kept: int) -> None:
    """No frame, one, those of a beginning or those of an end: nothing is extrapolated."""
    lost: Any = Trial(1.0)
    lost.sensed_s, part = lost.frame_time_s, slice(kept) if kept >= 0 else slice(kept, None)
    lost.frame_time_s, lost.length_m = lost.frame_time_s[part], lost.length_m[part]
    given = {"open loop": trials(0.8), "PI": [Trial(1.0), lost]}
    found = compare_trials(given, MAPS, STUDY, 1e-4)
    said = r"step trials with PI: 'trial' has no valid camera frame for [\d.]+ s \(at most 0\.5 s\)"
    assert re.match(said, found.reason("S24.rise_closed"))


def test_a_trial_without_capacitance_is_named() -> None:
    lost = Trial(1.0)
    lost.capacitance_f[100:130] = np.nan
    given = {"open loop": trials(0.8), "PI": [lost]}
    found = compare_trials(given, MAPS, STUDY, 1e-4)
    assert "'trial' has no valid capacitance for 1.55 s" in found.reason("S24.rise_closed")


def test_a_controller_played_alone_has_its_own_results() -> None:
    """`open_trials = 0`; if its trials cannot be evaluated either, the message has both reasons."""
    own = {OWN: trials(1.0)}
    both = compare_trials({"open loop": trials(0.8)} | own, MAPS, STUDY, 1e-4)
    alone = compare_trials({"open loop": []} | own, MAPS, STUDY, 1e-4)
    kept = {key: value for key, value in both.quantities.items() if key.startswith("S25.")}
    assert alone.quantities == kept and len(kept) == 3
    assert alone.reason("S24.rise_open") == "not played (steps.open_trials = 0)"
    with pytest.raises(InputError, match=r"not played .* controller 'mine': response moves by"):
        compare_trials({"open loop": [], OWN: trials(-0.5)}, MAPS, STUDY, 1e-4)


def test_the_open_loop_is_needed() -> None:
    with pytest.raises(InputError, match="response moves by -"):
        compare_trials({"open loop": trials(-0.5), "PI": trials(1.0)}, MAPS, STUDY, 1e-4)


def test_a_further_trial_that_moves_away_is_left_out() -> None:
    """An extra delay can make a loop unstable."""
    unused: Any = None
    observed = {"late": trials(-0.5), "printed": trials(1.0)}
    found = further_trials(observed, None, MAPS, unused, STUDY, 1e-4)
    assert isinstance(found, ExperimentResult)
    assert set(found.quantities) == {"S10.rise_printed_chain", "S10.error_printed_chain"}
    assert set(found.missing) == {"S24.rise_delayed", "S24.error_delayed"}
    assert found.missing["S24.rise_delayed"].startswith("step trials 'late': response moves by -")
