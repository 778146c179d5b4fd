"""Play the controllers of the identified physical model at the end of `haselab reproduce`."""

from __future__ import annotations

from dataclasses import replace

from haselab.base import HaselabError, Progress
from haselab.cli.actuator_file import load_actuator
from haselab.cli.bench.arming import arm
from haselab.cli.study.physical_model import PhysicalModel
from haselab.controllers import known_actuator
from haselab.rig import Rig
from haselab.rig.twin.config import TwinConfig
from haselab.safety.guarded import GuardedRig
from haselab.store.actuator_file import ACTUATOR
from haselab.store.folder import write_text
from haselab.store.toml import toml_text
from haselab.study.definition import Study
from haselab.study.feasibility import check_drives, check_study, rating_of_twin
from haselab.study.folder import write_actuator
from haselab.study.physical.session import FOLDER, model_study
from haselab.study.pipeline import Findings
from haselab.study.run import RunOptions, run_study

__all__ = ["play_model_control"]


def play_model_control(
    study: Study,
    rig: Rig,
    config: TwinConfig,
    options: RunOptions,
    found: Findings,
    model: PhysicalModel,
    progress: Progress,
) -> Findings | str:
    """Play rows S25 (observer), S27 and S30 on the twin of a study, which is armed again.

    Its inputs are files in the run's folder, with which `haselab run` repeats it.

    Args:
        study: that was played.
        rig: the bench, at 0 V.
        config: of the twin.
        options: of the run.
        found: by the study.
        model: identified from it.
        progress: in seconds of the rig.
    Returns:
        The findings; or why there are none, while the study keeps its own.
    """
    folder = options.folder
    if model.fit.status != "ok":
        return f"needs the physical model, which was not found: {model.fit.status}"
    try:
        limits = rig.description.drive_limits
        ends = (limits.low, limits.high)
        write_actuator(folder, found, study, ends, rig.description.actuator_kind)
        model.save(folder, folder)
        tables = load_actuator(folder / ACTUATOR)
        known = known_actuator(tables, folder / ACTUATOR)
        assert known is not None  # it was just saved
        plan = model_study(study, found, known)
        check_drives(plan, rig.description)
        check_study(plan, rig.description, rating_of_twin(config, plan)).require()
        write_text(folder / FOLDER / "study.toml", toml_text(plan.model_dump(mode="json")))
        if isinstance(rig, GuardedRig):
            arm(rig.safety, None)
        apart = replace(options, folder=folder / FOLDER, known=tables)
        return run_study(plan, rig, apart, progress)
    except HaselabError as error:  # which leaves the study as it is
        return " ".join(str(error).split())
