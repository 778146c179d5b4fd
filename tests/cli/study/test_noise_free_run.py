"""The noise-free run beside a study: the same results, values that it waits for, and its end."""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import pytest

from haselab.base import ResultError
from haselab.cli.study.noise_free_run import NoiseFreeRun, SentValues
from haselab.rig.twin.config import twin_of_reading
from haselab.study.definition import Study, builtin_study, checked_study
from haselab.study.experiment import ExperimentResult
from haselab.study.fits.maps import Maps
from haselab.study.fits.static import Static
from haselab.study.run import noise_free_results

CONFIG = twin_of_reading("hz")


@pytest.fixture
def study() -> Study:
    """Static loads alone."""
    tables = builtin_study(quick=True).model_dump(mode="json", exclude_none=True)
    return checked_study(
        {"name": "loads", "static_load": tables["static_load"]}, Path("loads.toml")
    )


@pytest.fixture
def pipe() -> Iterator[tuple[BinaryIO, BinaryIO]]:
    come, go = os.pipe()
    with os.fdopen(come, "rb") as source, os.fdopen(go, "wb", buffering=0) as target:
        yield source, target
        pickle.dump(None, target)


def test_the_process_gives_the_numbers_of_the_function(study: Study) -> None:
    with NoiseFreeRun(CONFIG, study) as run:
        found = run.results()
    assert found and str(found) == str(noise_free_results(CONFIG, study, None, {}))  # NaN among it


def test_a_value_is_waited_for_until_it_is_sent(pipe: tuple[BinaryIO, BinaryIO]) -> None:
    source, target = pipe
    values = SentValues(source, builtin_study(), lambda: None)
    found: list[object] = []
    waiting = threading.Thread(target=lambda: found.append(values.get(int)), daemon=True)
    values._kinds.add(int)
    waiting.start()
    waiting.join(0.05)
    assert waiting.is_alive()
    pickle.dump((7,), target)
    waiting.join(60.0)
    assert found == [7]


def test_nothing_is_waited_for_that_no_experiment_gives_or_after_the_end(
    study: Study, pipe: tuple[BinaryIO, BinaryIO]
) -> None:
    source, target = pipe
    values = SentValues(source, study, lambda: None)
    assert values.get(Maps) is None
    pickle.dump(None, target)
    assert values.get(Static) is None


def test_a_process_that_ends_early_takes_nothing_but_its_results(study: Study) -> None:
    with NoiseFreeRun(CONFIG, study) as run:
        run._process.kill()
        run._process.wait()
        run.start(ExperimentResult(values=(1.0,)))
        with pytest.raises(ResultError, match=r"noise-free run ended early: exit code -9\."):
            run.results()


def test_a_value_that_cannot_be_sent_is_named(study: Study) -> None:
    with NoiseFreeRun(CONFIG, study) as run:
        run.start(ExperimentResult(values=(lambda: None,)))
        with pytest.raises(
            ResultError, match=r"A value that the study plays cannot be sent: .*lambda"
        ):
            run.results()


def test_the_process_ends_with_the_study(study: Study) -> None:
    with NoiseFreeRun(CONFIG, study) as run:
        process = run._process
        assert process.poll() is None
    assert process.returncode is not None
