"""`haselab run`: any study on any rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from haselab.base import InputError, Limits
from haselab.cli.actuator_file import load_actuator
from haselab.cli.bench.arming import Operator, armed_rig, arming_options, gated_rig
from haselab.cli.common import actuator_option, answer_options
from haselab.cli.output import OutputRule
from haselab.cli.study.chip_run import play_on_chip
from haselab.cli.study.study_run import execute, execute_on, twin_rig
from haselab.pipelines.calibration_file import load_calibration
from haselab.rig import Rig
from haselab.rig.chip import ChipFile
from haselab.rig.protocols import MonitorCalibration
from haselab.rig.rig_file import TwinFile, load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.runtime.runner import lockin_of
from haselab.store.actuator_file import ACTUATOR
from haselab.store.folder import write_text
from haselab.store.text_file import read_text
from haselab.study.definition import Study, load_step_study, load_study
from haselab.study.known import with_known

__all__ = ["command", "planned", "rig_file"]


def rig_file(path: Path) -> tuple[TwinConfig, int]:
    """The twin that a rig file describes, and its seed, for what only a twin can do.

    Args:
        path: of the TOML file.
    Returns:
        Configuration and seed.
    Raises:
        InputError: no such file, a fault in it, another kind of rig, or both a twin and a reading.
    """
    file = load_rig(path)
    if not isinstance(file, TwinFile):
        raise InputError(
            f"RIG has kind = {file.kind!r}, but this command needs kind = 'twin'. {path}"
        )
    return file.configuration(path), file.seed


@click.command("run")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--rig", required=True, type=click.Path(path_type=Path), help="RIG.toml")
@click.option("--quick", is_flag=True, help="Apply the study's table `quick`.")
@click.option(
    "--keep-video",
    type=click.Choice(["none", "sample", "all"]),
    default="sample",
    show_default=True,
    help="Camera frames to keep.",
)
@actuator_option(
    "its limits and its calibration apply; its maps and its controller are used where the study "
    "has no [triangle] and no [control]; the run's actuator.toml starts from it."
)
@arming_options
@answer_options(OutputRule("folder"), "New folder for the recording and the results.  [required]")
def command(
    study: Path,
    rig: Path,
    quick: bool,
    keep_video: str,
    actuator: Path | None,
    yes: bool,
    acknowledge: bool,
    as_json: bool,
    out: Path | None,
) -> None:
    """Play STUDY.toml on a rig, fit all results and write the report.

    HIGH VOLTAGE WILL BE APPLIED on a real bench. The study is checked against [rating] first;
    without [rating] it is not checked. Then you acknowledge the last trip, if there was one, and
    confirm. A microcontroller rig (kind = "mega") takes a study of step trials. The folder gets an
    actuator.toml with the maps, the model and the controllers found; --actuator itself stays as it
    is. With --actuator, a study of [steps] alone plays the controller of the file.
    """
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    file = load_rig(rig)

    operator = Operator(yes, acknowledge)
    known = None if actuator is None else load_actuator(actuator)
    if isinstance(file, ChipFile):
        if actuator is not None:
            raise InputError(
                "A microcontroller takes its limits from the firmware. Leave --actuator out, and "
                f"build the firmware with: haselab firmware build {actuator}"
            )
        trials = load_step_study(study, quick=quick)
        armed_by = operator if file.port is not None else None
        play_on_chip(trials, file, rig, out, keep_video, armed_by, as_json)
        return
    plan = planned(load_study(study, quick=quick), actuator)
    if isinstance(file, TwinFile):
        config = file.configuration(rig)
        limited = _prepared(twin_rig(config, file.seed), plan, actuator)
        with armed_rig(limited, file, rig, plan, out) as bench:
            _start_from(actuator, out)
            execute(plan, bench, config, file.seed, out, keep_video, as_json, known=known)
        return
    with (
        gated_rig(file, rig) as opened,
        armed_rig(_prepared(opened, plan, actuator), file, rig, plan, out, operator) as bench,
    ):
        _start_from(actuator, out)
        execute_on(plan, bench, file.model_dump(mode="json"), out, keep_video, as_json, known)


def planned(study: Study, actuator: Path | None) -> Study:
    """The study with what an actuator file adds to it, see `with_known`.

    Args:
        study: as its file says.
        actuator: the actuator file; None: there is none.
    Returns:
        The study that is played.
    Raises:
        InputError: the file cannot be used.
    """
    if actuator is None:
        return study
    try:
        return with_known(study, load_actuator(actuator))
    except InputError as error:
        raise InputError(f"{error} {actuator}") from None


def _prepared(rig: Rig, study: Study, actuator: Path | None) -> Rig:
    """The bench with the calibration of an actuator file, and its drive limited by that file.

    Raises:
        InputError: no voltage is within both limits, or the calibration is for another carrier,
            sampling rate or amplifier.
    """
    if actuator is None:
        return rig
    _limit(rig, actuator)
    if load_actuator(actuator).sensing.is_calibrated:
        found, d = load_calibration(actuator), rig.description
        found.apply(lockin_of(d, study.sensing.carrier_hz).config, amplifier=d.amplifier)
        scale_s, stray_s = ((z.real, z.imag) for z in (found.scale_s, found.stray_s))
        calibration = MonitorCalibration(scale_s, stray_s, found.offsets_v)
        rig.description = replace(d, calibration=calibration)
    return rig


def _limit(rig: Rig, actuator: Path) -> None:
    """Limit the drive to what the actuator withstands as well.

    Raises:
        InputError: no voltage is within both limits.
    """
    limits = rig.description.drive_limits
    low, high = load_actuator(actuator).drive_ends_v(rig.description.amplifier_gain)
    low_v = limits.low if low is None else max(limits.low, low)
    high_v = limits.high if high is None else min(limits.high, high)
    if not low_v < high_v:
        raise InputError(
            f"[drive] allows {low} to {high} V, but the rig puts out {limits.low:g} to "
            f"{limits.high:g} V. Correct low_v, high_v and highest_field_v_per_m. {actuator}"
        )
    narrowed = Limits(limits.name, low_v, high_v, limits.unit)
    rig.description = replace(rig.description, drive_limits=narrowed)


def _start_from(actuator: Path | None, folder: Path) -> None:
    """The run's actuator file starts as a copy."""
    if actuator is not None:
        write_text(folder / ACTUATOR, read_text(actuator, "actuator file"))
