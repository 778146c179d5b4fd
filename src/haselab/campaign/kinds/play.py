"""Case kind `play`: a study on the twin, from raw samples to results with their intervals."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from pydantic import Field

from haselab.base import JsonObject, ResultError, SilentProgress
from haselab.campaign.kinds.base_files import LABELS, TWIN, twin_of
from haselab.campaign.kinds.case_kind import BaseFile, CaseKind, Inputs, Results
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.armed import armed
from haselab.store.toml import Section
from haselab.study.definition import Study, builtin_study, checked_study, load_study
from haselab.study.experiment import ExperimentResult
from haselab.study.feasibility import check_drives, check_settings
from haselab.study.run import RunOptions, noise_free_results, run_study
from haselab.study.simulated.truth import parameters

__all__ = ["PLAY", "PlaySettings"]

_BUILT_IN = {"reference-quick": True, "reference": False}  # whether it is the quick version


def _table(source: str, folder: Path) -> JsonObject:
    if source in _BUILT_IN:
        study = builtin_study(quick=_BUILT_IN[source])
    else:
        study = load_study(folder / source)
    return study.model_dump(mode="json", exclude_none=True)


_STUDY = BaseFile("study", "reference-quick", _table)


def _study_of(inputs: Inputs) -> Study:
    return checked_study(inputs.tables["study"], "[study]")


class PlaySettings(Section):
    """Which results of the study are kept, and with what they are compared."""

    results: tuple[str, ...] = Field(
        (), description="ids, all if there are none", examples=[["S20.omega_n"]]
    )
    noise_free: bool = Field(
        False,
        description="also play the study without noise; its results count as the true values",
    )


class _Play(CaseKind):
    name = "play"
    files = (TWIN, _STUDY)
    settings = PlaySettings
    ignored = LABELS

    def check(self, inputs: Inputs) -> None:
        inputs.settings(PlaySettings)
        check_settings(_study_of(inputs))
        check_drives(_study_of(inputs), make_twin(twin_of(inputs), 0).description)

    def compute(self, inputs: Inputs, rng: np.random.Generator) -> Results:
        case, twin = inputs.settings(PlaySettings), twin_of(inputs)
        seed, study = int(rng.integers(2**31)), _study_of(inputs)
        played: dict[type, object] = {}

        def fitted(outcome: ExperimentResult) -> None:
            played.update((type(value), value) for value in outcome.values)

        with tempfile.TemporaryDirectory(prefix="haselab-case-") as folder:
            options = RunOptions(Path(folder), seed, "none", twin.model_dump(mode="json"))
            with armed(make_twin(twin, seed)) as bench:
                found = run_study(study, bench, options, SilentProgress(), fitted)
        if not case.results:
            found.require_complete()
        wanted = case.results or tuple(found.quantities)
        missing = [name for name in wanted if name not in found.quantities]
        if missing:
            why = "; ".join(found.missing.get(name, "no such result") for name in missing)
            raise ResultError(f"The study has no result {', '.join(missing)}: {why}.")
        noise_free = noise_free_results(twin, study, None, played) if case.noise_free else {}
        true = {**noise_free, **parameters(twin)}
        return {name: found.quantities[name] for name in wanted} | {
            f"{name}.true": true[name] for name in wanted if name in true
        }


PLAY = _Play()
