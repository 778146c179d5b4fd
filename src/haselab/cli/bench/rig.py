"""`haselab rig`: check a bench in stages, take it to 0 V, and show its state."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, replace
from pathlib import Path

import click

from haselab.base import DeviceError, HaselabError, InputError, SilentProgress, text_of
from haselab.cli.bench.arming import Operator, acknowledge_option, arm, gated_rig
from haselab.cli.bench.check_report import write_check_report
from haselab.cli.bench.revoke_first import REASON
from haselab.cli.common import Real, answer_options
from haselab.cli.interrupt import Interruptible
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig, BenchOutputs
from haselab.rig.checks import (
    CARRIER_V,
    SUPPLY_V,
    CheckResult,
    DryPlan,
    LivePlan,
    dry_checks,
    edge_check,
    live_checks,
    live_step_v,
)
from haselab.rig.chip import ChipFile, key_of_port
from haselab.rig.instruments.registry import daq_of, reported_faults
from haselab.rig.rig_file import ReplayFile, RigFile, load_rig, load_rig_to_shut_down
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.gate import Gate
from haselab.safety.guarded import guard
from haselab.safety.guardian.client import Guardians, guardian_command
from haselab.safety.guardian.make_safe import revoke_and_make_safe
from haselab.safety.interlock import Interlock, interlock_folder
from haselab.safety.rig_limits import safety_of
from haselab.safety.state_machine import Safety
from haselab.store.folder import write_new, write_text

__all__ = ["check", "command", "safe", "status"]

_RANGE_SHARE = 0.98  # share of an input's range that a signal may use
_LEAST_F = 3e-10  # smallest known capacitor of a bench
_SUPPLY_SHARE = 0.1  # share of the supply's limit that the live checks use
_LIVE_S = 10.0  # limit for one live check; the loop-back and the supply check take longest
_ROUTES_S = 5.0  # limit for one call of the board
_PROGRAM_S = 5.0  # limit for a program to stop its bench
_NOTHING = "NOTHING WAS COMMANDED TO 0 V: switch the high voltage off by hand."
_SWITCH_OFF_FIRST = "First switch the amplifier and the supply off and discharge the electrodes."
_BY_HAND = "Switch the high voltage off by hand."
_REPORTED_OFF = "off, as reported by the instrument"
_DONE = {
    "daq": "board reset, 0 V set; the output was not measured",
    "program": "permission revoked; its program reported 0 V",
    "chip": "permission revoked; it ramps down by itself, the output was not measured",
}


@click.group("rig")
def command() -> None:
    """Check a bench in stages, or take it to 0 V."""


def _mock(file: RigFile, path: Path) -> Iterator[CheckResult]:
    """Check the file and its drivers, and run the checks on a twin; no instrument is used."""
    safety_of(file, getattr(file, "safety", {}), path)
    yield CheckResult("mock", "rig file", f"kind {file.kind}, valid", True)
    if isinstance(file, BenchConfig):
        if not file.rating:
            yield CheckResult(
                "mock", "rating", "none: 'run' does not check a study against limits", True
            )
        d = file.describe()
        limits = d.drive_limits
        top_kv = 1e-3 * d.drive_reach_v * d.amplifier_gain
        at_input_v = d.drive_reach_v * d.monitor_v_per_drive_v
        yield CheckResult(
            "mock",
            "range of the inputs",
            f"{at_input_v:.3g} V at the voltage monitor, range {file.daq.range_v:g} V",
            at_input_v <= _RANGE_SHARE * file.daq.range_v,
            "Raise daq.range_v, or lower daq.drive_high_v",
            criterion=f"at most {100.0 * _RANGE_SHARE:g} % of the range",
        )
        yield CheckResult(
            "mock",
            "limits",
            f"{limits.low:g} to {limits.high:g} V of drive, {top_kv:g} kV at most",
            True,
        )
        yield _drivers(file)
    if isinstance(file, ReplayFile):
        return
    rig = make_twin(twin_of_reading("hz"), 1)
    for each in (*dry_checks(rig, DryPlan()), *live_checks(rig, LivePlan())):
        yield replace(each, step="mock", what=f"{each.what} on a twin", recommended={})


def _drivers(file: BenchConfig) -> CheckResult:
    """Check the drivers of all instruments, and name each that is missing."""
    drivers: list[str] = []
    missing: list[str] = []
    for found in file.instruments():
        try:
            with reported_faults(found.config):
                drivers += found.instrument.check_driver()
        except HaselabError as error:
            missing.append(f"{found.section}: {text_of(error).rstrip('.')}")
    return CheckResult("mock", "drivers", "; ".join(missing) or ", ".join(drivers), not missing)


def _checks(
    file: RigFile, path: Path, operator: Operator | None, plan: LivePlan, frames_hz: float | None
) -> Generator[CheckResult, None, None]:
    yield from _mock(file, path)
    if isinstance(file, BenchConfig):
        yield from _routes(file)
        with contextlib.closing(edge_check(file, lambda changed: gated_rig(changed, path))) as edge:
            yield from edge
    with gated_rig(file, path) as rig:
        if isinstance(file, ReplayFile):
            yield CheckResult(
                "dry", "recording", f"block of {len(_first_block(rig))} samples", True
            )
            return
        for name, reported in (
            ("source", rig.source),
            ("generator", rig.generator),
            ("supply", rig.supply),
            ("camera", rig.camera),
        ):
            identity = getattr(reported, "identity", "")
            if identity:
                yield CheckResult("dry", name, identity, True)
        daq = None
        if isinstance(file, BenchConfig) and not file.stand.lock_step:
            daq = file.daq
        yield from dry_checks(rig, DryPlan(_by_hand(file), daq, frames_hz))
        if operator is not None:
            click.echo(_live_warning(rig, plan, file), err=True)
            with _armed(rig, file, path, operator) as alive:
                yield from live_checks(rig, replace(plan, alive=alive))
                alive()


def _routes(file: BenchConfig) -> Iterator[CheckResult]:
    """Try the board's tasks while no other program can use the bench."""
    daq, gate = daq_of(file.daq), Gate()
    link = daq.connect(file.daq)
    with contextlib.ExitStack() as opened:
        opened.callback(link.close)
        gate.claim(link.key, _ROUTES_S, file.shared_instruments)
        opened.callback(gate.release)
        with reported_faults(file.daq):
            yield from daq.route_checks(file.daq, file.exposure, link)


@contextlib.contextmanager
def _armed(
    rig: Rig, file: RigFile, path: Path, operator: Operator
) -> Iterator[Callable[[], object]]:
    """Arm the bench, with guardians, for checks outside of a run.

    The guardians log to a file beside the rig file.

    Yields:
        A function to call every few seconds, as a sign of life.
    """
    guarded = guard(rig, Safety(safety_of(file, getattr(file, "safety", {}), path)))
    safety = guarded.safety
    with contextlib.ExitStack() as opened:
        if isinstance(file, BenchConfig):
            log = path.with_suffix(".guardian.log")
            safety.guardians = opened.enter_context(
                Guardians(guardian_command(path), log, safety.gate.interlock)
            )
        arm(safety, operator)
        safety.gate.interlock.lease(_LIVE_S)
        try:
            yield lambda: safety.heartbeat(_LIVE_S)
        except KeyboardInterrupt as stop:
            guarded.command_zero()
            reported = guarded.read_back().text  # raises if 0 V is not confirmed
            stop.add_note(f"{reported[:1].upper()}{reported[1:].rstrip('.')}.")
            raise
        finally:
            try:
                guarded.safe()
            finally:
                safety.end_run()


def _live_warning(rig: Rig, plan: LivePlan, file: RigFile) -> str:
    """The voltages that the live checks will apply."""
    d = rig.description
    if isinstance(file, ChipFile) and plan.capacitor_f is not None:
        volts = (
            f"the microcontroller's sensing signal of {file.front_end.carrier_high_v:g} V peak, at "
            "a drive of 0 V, into the capacitor"
        )
    elif rig.controller is not None:
        what = "the microcontroller closes its loop at zero strain for 0.5 s, up to "
        ends = d.drive_limits.low, d.drive_limits.high
        low_kv, high_kv = (1e-3 * end * d.amplifier_gain for end in ends)
        volts = f"{what}{f'{low_kv:g} or ' if low_kv < 0.0 else ''}{high_kv:g} kV"
    else:
        volts = (
            f"a step of {1e-3 * live_step_v(d) * d.amplifier_gain:g} kV, a sensing signal of "
            f"{CARRIER_V * d.amplifier_gain:g} V peak"
        )
    if plan.loop_back:
        volts = (
            f"50 steps of {live_step_v(d):g} V at the board's output, which would be "
            f"{1e-3 * live_step_v(d) * d.amplifier_gain:g} kV with the amplifier connected"
        )
    elif rig.supply is not None:
        volts += f", {plan.supply_v:g} V from the supply"
    return f"HIGH VOLTAGE WILL BE APPLIED to {d.name}: {volts}. Keep clear."


def _supply_v(file: RigFile) -> float:
    """Voltage that the live checks set on the supply: a tenth of its limit in the rig file."""
    if isinstance(file, BenchConfig) and file.supply is not None:
        highest_v = file.supply.highest_v
        return min(highest_v, max(SUPPLY_V, _SUPPLY_SHARE * highest_v))
    return SUPPLY_V


def _by_hand(file: RigFile) -> bool:
    """Whether a person operates the bench in real time; a served twin has its own clock."""
    if isinstance(file, ChipFile):
        return file.port is not None
    return isinstance(file, BenchConfig) and file.stand.kind == "operator"


def _first_block(rig: Rig) -> bytes:
    return bytes(len(rig.acquisition.read()))


@command.command("check")
@click.argument("rig", type=click.Path(path_type=Path))
@click.option(
    "--live",
    is_flag=True,
    help="Apply HIGH VOLTAGE too: the sensing signal, a step to 10 % of the drive range (1 kV at "
    "2 V x 5000) and 10 % of the supply's highest voltage, but at least 100 V; on a "
    "microcontroller, closed loop at zero strain for 0.5 s, or with --capacitor only the sensing "
    "signal. Keep clear. Requires --yes.",
)
@shared_option(
    "--yes", is_flag=True,
    detail="High voltage WILL be applied at once; keep clear. Required with --live.",
)  # fmt: skip
@shared_option(
    "--capacitor", type=Real(1e-12, 1e-6), metavar="FARAD",
    detail="It must withstand high voltage. Also checks the scale of the current monitor; on a "
    "microcontroller, measures the capacitor instead of closing the loop. Needs --live. Default: "
    "none.",
)  # fmt: skip
@click.option(
    "--loop-back",
    is_flag=True,
    help="Check only 50 starts of the output, with the board's output wired to the voltage "
    "monitor's input and the amplifier disconnected. Needs --live.",
)
@click.option(
    "--frames",
    type=Real(0.01, 1e5),
    metavar="HZ",
    help="Record frames for 10 s at this frame rate, in Hz. Default: 0.5 s at up to 100 Hz.",
)
@click.option(
    "--save",
    type=click.Path(path_type=Path),
    metavar="CHECK.json",
    help="Write a report to attach to an issue: rig file, computer, instruments, all checks. "
    "--out has the checks only. Default: none.",
)
@acknowledge_option
@answer_options(OutputRule(options=("save",)))
def check(
    rig: Path,
    live: bool,
    yes: bool,
    acknowledge: bool,
    capacitor: float | None,
    loop_back: bool,
    frames: float | None,
    save: Path | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Check the bench of RIG in stages.

    The stages are mock (no instrument), dry (no high voltage) and, with --live, live. With --live
    and --yes, HIGH VOLTAGE WILL BE APPLIED AT ONCE, without a question. After a trip, the bench is
    armed only with --acknowledge. The command stops at the first check that fails and commands all
    outputs to 0 V.
    """
    if live and not yes:
        raise click.UsageError(
            "--live applies high voltage. Keep clear of the bench, then add --yes."
        )
    given = {
        "--yes": yes,
        "--acknowledge": acknowledge,
        "--capacitor": capacitor is not None,
        "--loop-back": loop_back,
    }
    if loop_back and capacitor is not None:
        raise click.UsageError(
            "--loop-back needs the amplifier disconnected, --capacitor connected. Leave one out."
        )
    if not live and any(given.values()):
        first = next(option for option, used in given.items() if used)
        raise click.UsageError(
            f"{first} has no effect without --live. Add --live, or leave it out."
        )
    file = load_rig(rig)
    Interruptible(SilentProgress())  # a signal ends the checks, and that ends at 0 V
    checks: list[CheckResult] = []
    finished = False
    daq = file.daq if isinstance(file, BenchConfig) else None
    if loop_back and daq is None:
        raise InputError(f"--loop-back needs a rig of kind = 'bench', found {file.kind!r}. {rig}")
    if capacitor is not None and capacitor < _LEAST_F and not isinstance(file, ChipFile):
        raise InputError(
            f"--capacitor is {capacitor:g} F, but must be at least {_LEAST_F:g} F: the check "
            f"tolerates the stray capacitance of cable and fixture. {rig}"
        )
    plan = LivePlan(capacitor, _supply_v(file), loop_back, daq)
    try:
        # Closed at once if a check fails: 0 V must not wait for the garbage collector.
        operator = Operator(yes, acknowledge) if live else None
        with contextlib.closing(_checks(file, rig, operator, plan, frames)) as coming:
            for each in coming:
                checks.append(each)
                _print_check(each, as_json)
                if not each.passed:
                    advice = f"{each.advice}. Then" if each.advice else "Fix this, then"
                    if each.step == "live":
                        advice = f"{_SWITCH_OFF_FIRST} {advice}"
                    raise DeviceError(
                        f"{each.step}: {each.what}: {each.found}. {advice} run 'haselab rig "
                        f"check' again. {rig}"
                    )
        finished = True
    except HaselabError as error:
        if not checks or checks[-1].passed:
            step = checks[-1].step if checks else "mock"
            checks.append(CheckResult(step, "bench", str(error), False))
            _print_check(checks[-1], as_json)
        raise
    except KeyboardInterrupt as stop:
        if live and not getattr(stop, "__notes__", []):  # the interrupt came between two checks
            stop.add_note("All outputs were commanded to 0 V, not read back.")
        raise
    finally:
        if save is not None:
            write_check_report(save, rig, checks, finished=finished)
        _answer(checks, as_json, out, write_text)
        if not as_json:
            _recommend(checks, file)


def _recommend(checks: list[CheckResult], file: RigFile) -> None:
    """Print measured values that differ from those of the rig file."""
    for each in checks:
        for key, value in each.recommended.items():
            section, _, name = key.partition(".")
            there = getattr(getattr(file, section, None), name, None)
            if there is None or abs(there - value) > 1e-3 * abs(value):
                click.echo(f"        recommended for the rig file: {key} = {value:g}")


def _print_check(each: CheckResult, as_json: bool) -> None:
    if not as_json:
        mark = "ok" if each.passed else "FAILED"
        limits = f" (accepted: {each.criterion})" if each.criterion else ""
        click.echo(f"{mark:6s}  {each.step:5s} {each.what:32s} {each.found}{limits}")


def _answer(
    checks: list[CheckResult], as_json: bool, out: Path | None, write: Callable[[Path, str], None]
) -> None:
    text = json.dumps({"checks": [asdict(each) for each in checks]}, indent=2)
    if out is not None:
        write(out, text + "\n")
    if as_json:
        click.echo(text)


@command.command("safe")
@click.argument("rig", type=click.Path(path_type=Path), required=False)
@click.option(
    "--bench", metavar="KEY",
    help="Name a bench of your own drivers by its key in Gate.claim. Default: the bench of RIG.",
)  # fmt: skip
@answer_options(
    OutputRule("last"),
    "It is a JSON file, written after 0 V was commanded: a path that exists does not stop the "
    "command. Default: none.",
    force_detail="Not in this command: an existing --out is kept, and the exit code is 2.",
)
def safe(rig: Path | None, bench: str | None, as_json: bool, out: Path | None) -> None:
    """Command 0 V on every output of the bench of RIG.

    IN AN EMERGENCY, PRESS THE EMERGENCY STOP FIRST. Give either RIG or --bench; without them,
    NOTHING IS COMMANDED TO 0 V (exit code 2). The command revokes the permission of whichever
    program on this computer uses the bench. That program stays at 0 V until you arm the bench again
    and acknowledge the reason. Other benches are not affected, except those that use the same
    generator or supply. With --bench, this command cannot reach the outputs: it revokes the
    permission and waits up to 5 s for the program to command 0 V.
    """
    if (rig is None) == (bench is None):
        raise InputError(f"{_NOTHING} Then give either a rig file or --bench KEY.")
    if bench is not None:
        _report_safe([_safe_by_its_program(bench)], bench, as_json, out)
        return
    assert rig is not None
    try:
        file, broken = load_rig_to_shut_down(rig)
    except (InputError, DeviceError) as error:
        raise type(error)(f"{_NOTHING} {error}") from None
    if not isinstance(file, BenchOutputs) and (not isinstance(file, ChipFile) or file.port is None):
        raise InputError(
            f"The rig has kind {file.kind!r}, which cannot energise anything outside the program "
            "that runs it. Stop that program with Ctrl-C. 'rig safe' needs kind = 'bench', or "
            f"'chip' with a port. {rig}"
        )
    click.echo(
        "Revoking the permission and commanding 0 V. If this does not finish, switch the "
        "amplifier off by hand.",
        err=True,
    )
    if isinstance(file, ChipFile):
        faults = [_safe_by_its_program(key_of_port(file.port or ""), "chip")]
    else:
        faults = revoke_and_make_safe(file, REASON) + broken
    _report_safe(faults, rig, as_json, out)


def _report_safe(
    faults: list[tuple[str, str]], bench: object, as_json: bool, out: Path | None
) -> None:
    rests = [
        CheckResult("safe", name, fault or _DONE.get(name, _REPORTED_OFF), not fault)
        for name, fault in faults
    ]
    for each in rests:
        _print_check(each, as_json)
    bad = [each.what for each in rests if not each.passed]
    energised = [name for name in bad if name != "interlock"]
    reported = ["Permission not revoked: stop the program that uses this bench."] * (
        len(bad) - len(energised)
    )
    if energised:
        reported.append(f"Not confirmed at 0 V: {', '.join(energised)}. {_BY_HAND}")
    try:
        _answer(rests, as_json, out, write_new)
    finally:  # more important than an answer that cannot be written
        if bad:
            raise DeviceError(f"{' '.join(reversed(reported))} {bench}")


def _safe_by_its_program(key: str, what: str = "program") -> tuple[str, str]:
    """Make the bench's program command 0 V; a microcontroller also ramps down by itself."""
    with contextlib.closing(Interlock(key)) as interlock:
        used = interlock.owner_pid
        interlock.revoke(REASON)
        if what == "program" and not used:
            return (
                what,
                "no running program has claimed the bench; check the key against Gate.claim",
            )
        interlock.make_safe(lambda: True, 0.0)
        end_s = time.monotonic() + _PROGRAM_S
        while interlock.live and interlock.owner_pid and time.monotonic() < end_s:
            time.sleep(0.02)
        if interlock.live and interlock.owner_pid:
            return what, f"process {interlock.owner_pid} has not stopped within {_PROGRAM_S:g} s"
        if interlock.live and what == "program":
            return what, "the program ended without confirming 0 V"
    return what, ""


@command.command("status")
@answer_options()
def status(as_json: bool, out: Path | None) -> None:
    """Show which benches of this computer are armed.

    For the others it shows why they tripped. Armed benches are first, then those
    that were used last. It reads what programs have recorded since the computer started. It does
    not contact any instrument: this is NOT a measurement of a voltage.
    """
    places = sorted(interlock_folder().glob("*.state"), key=_changed_s, reverse=True)
    benches = [_state_of(place.stem) for place in places]
    benches.sort(key=lambda bench: not bench["armed"])
    text = json.dumps({"benches": benches}, indent=2)
    if out is not None:
        write_text(out, text + "\n")
    if as_json:
        click.echo(text)
        return
    width = max((len(place.stem) for place in places), default=0)
    for bench in benches:
        click.echo(f"{bench['bench']:<{width}}  {bench['state']}")
    if not benches:
        click.echo("No bench has been used since this computer started.")


def _changed_s(place: Path) -> float:
    """When a file was last written; 0 if it is gone."""
    try:
        return place.stat().st_mtime
    except OSError:
        return 0.0


def _state_of(key: str) -> dict[str, object]:
    """The state of a bench's interlock, as text and for JSON."""
    with contextlib.closing(Interlock(key)) as interlock:
        live, reason = interlock.live, interlock.reason
        pid = interlock.owner_pid if interlock.in_use else 0  # it may have been killed
    if live and pid:
        state = f"ARMED by process {pid}. The output may be energised"
    elif live:
        state = "NOT CONFIRMED AT 0 V. Its last program ended while the bench was armed"
    else:
        state = "not armed"
    if reason:
        state += f"; tripped: {reason}. Acknowledge this reason to arm the bench again"
    return {"bench": key, "armed": live, "process": pid or None, "reason": reason, "state": state}
