"""Hidden laws of other kinds of actuators are found from starts that are off by up to 30 %."""

import numpy as np
import pytest

from haselab.actuators import with_parameters
from haselab.identify.physical import fit_actuator
from haselab.identify.physical.unknowns import fitted_parameters


@pytest.fixture(scope="module")
def kinds(benchmarks):
    from benchmarks.identification import physical_kinds

    return physical_kinds


SLOW = [pytest.param("peano-hasel", marks=pytest.mark.slow),
        pytest.param("curling-hasel", marks=pytest.mark.slow)]  # fmt: skip


@pytest.mark.parametrize("name", ["dea-stack", *SLOW])
def test_a_hidden_law_is_found(kinds, name):
    kind = kinds.KINDS[name]
    truth, record = kind.drawn(1)
    fit = fit_actuator(kind.law, [record], mass_kg=kind.mass_kg)
    assert (fit.status, fit.not_identifiable) == ("ok", ())
    far = {n: (e.value - truth.get(n, 0.0)) / e.std for n, e in fit.parameters.items()}
    # 15 to 19 numbers: one in a thousand records has one of them farther off by chance
    assert max(map(abs, far.values())) < 4.0, far


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dea-stack", "peano-hasel", "curling-hasel"])
def test_two_actuators_in_one_fit_give_no_numbers(kinds, name):
    kind = kinds.KINDS[name]
    records = [kind.drawn(seed)[1] for seed in (1, 1001)]
    fit = fit_actuator(kind.law, records, mass_kg=kind.mass_kg)
    assert not fit.parameters and "one actuator" in fit.status, fit.status


def test_a_planted_branch_is_found(kinds):
    kind = kinds.KINDS["dea-stack"]
    more = with_parameters(kind.law, kind.branch(kind.law))
    fit = fit_actuator(kind.law, [kinds.short_record(kind, more, 1)], mass_kg=kind.mass_kg)
    assert fit.status == "ok"
    truth = fitted_parameters(more)
    far = {n: (fit.parameters[n].value - truth[n]) / fit.parameters[n].std for n in truth}
    assert np.abs(list(far.values())).max() < 4.0, far
