"""The fits along the axes of a model's covariance, shared with a second process."""

from dataclasses import dataclass

import numpy as np
import pytest

from haselab.base import DeviceError, ResultError
from haselab.pipelines import model_results
from haselab.pipelines.model_results import _along, _second_process

pytestmark = pytest.mark.unit


@dataclass
class Problem:
    """Its results are the changes themselves."""

    values: object = None
    known: object = None
    study: object = None
    near: object = None

    def fitted(self, source, change):
        return {"row": float(change[0])}, {}


class Helper:
    """Calls the function here."""

    closed = 0

    def __init__(self, modules, patience_s):
        pass

    def call(self, function, *arguments):
        return function(*arguments)

    def close(self):
        type(self).closed += 1


class Refused(Helper):
    def __init__(self, modules, patience_s):
        raise DeviceError("no process can be started")


class Lost(Helper):
    def call(self, function, *arguments):
        raise DeviceError("the process has ended")


class Unknown(Helper):
    def call(self, function, *arguments):
        raise KeyError("a recording that the first fit did not need")


@pytest.mark.parametrize("helper", [Helper, Refused, Lost, Unknown])
@pytest.mark.parametrize("count", [1, 2, 7])
def test_each_change_is_fitted_once_whatever_the_second_process_does(monkeypatch, helper, count):
    monkeypatch.setattr(model_results, "HelperProcess", helper)
    helper.closed = 0
    changes = np.arange(float(count))[:, None]
    with _second_process() as second:
        found = _along(Problem(), lambda name: None, {}, changes, second)
    assert sorted(row["row"] for row in found) == list(range(count))
    assert bool(helper.closed) == (helper is not Refused)


def test_the_second_process_ends_with_a_fit_that_fails(monkeypatch):
    monkeypatch.setattr(model_results, "HelperProcess", Helper)
    Helper.closed = 0
    with pytest.raises(ResultError, match="no result"), _second_process():
        raise ResultError("no result")
    assert Helper.closed == 1


def test_values_that_cannot_be_sent_are_fitted_here():
    never = Lost([], 0.0)
    problem = Problem(values={"of another package": lambda: None})
    assert len(_along(problem, lambda name: None, {}, np.zeros((3, 1)), never)) == 3
