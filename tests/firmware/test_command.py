"""`haselab firmware`, run as a user runs it; the chip beside the desktop's loops."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from haselab.base import InputError
from haselab.cli.main import main
from haselab.control import step_metrics
from haselab.firmware import ChipSettings, FrontEnd, settings_header
from haselab.models.maps import VoltageMap
from haselab.rig.chip import ChipFile, Firmware, find_tool, read_design
from haselab.rig.chip.design import strains_within
from haselab.rig.chip.opening import FrontEndConfig
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.study.chip.loops import SLOW, StepPlan, desktop_loop

DATA = Path(__file__).resolve().parent / "data"


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[object, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


@pytest.fixture(scope="module", params=["hz", "rad"])
def answer(
    request: pytest.FixtureRequest,
    firmware: Firmware,
    cosim_program: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("simulate")
    reading = request.param
    data = DATA if reading == "hz" else DATA / "rad"
    with pytest.raises(SystemExit) as stop:
        main(["firmware", "simulate", str(data), "--reading", reading, "--before-s", "6",
              "--after-s", "6", "--plot", str(folder / "step.png"), "--out",
              str(folder / "step.json")])  # fmt: skip
    assert stop.value.code == 0
    assert (folder / "step.png").stat().st_size > 10_000
    return dict(json.loads((folder / "step.json").read_text(encoding="utf-8")))


def test_the_chip_steps_like_the_desktop_at_its_rate(answer: dict[str, Any]) -> None:
    slow, fast, chip = answer["loops"]
    assert [row["loop"] for row in answer["loops"]] == [
        "desktop, 100 Hz", "desktop, 1000 Hz", "chip, 1000 Hz"
    ]  # fmt: skip
    assert abs(chip["delay_s"] / fast["delay_s"] - 1.0) < 0.05
    # The same rate, delay, limits and start; another sensor and another noise: over seeds the rise
    # time scatters by 2 %, overshoot and error by one hundredth of the step.
    assert abs(chip["rise_time_s"] / fast["rise_time_s"] - 1.0) < 0.08
    assert abs(chip["overshoot"] - fast["overshoot"]) < 0.05
    assert abs(chip["steady_state_error"] - fast["steady_state_error"]) < 0.05
    # As designed, for the desktop's loop: 7 % at most (`study/loops.py`). The chip's loop has
    # another delay than the one of the design.
    assert slow["overshoot"] < 0.07
    assert chip["overshoot"] < 0.12
    assert chip["phase_margin_deg"] > 45.0
    assert answer["status"] == "ok"
    assert answer["deviation"] < answer["deviation_tolerated"] < 0.2
    assert abs(chip["overshoot"] - chip["predicted"]["overshoot"]) < 0.1
    assert chip["phase_margin_deg"] > slow["phase_margin_deg"]
    # Noise of one update asks for more than 20 V/s: see study/simulated/scatter.py.
    assert 0.5 < answer["scatter"] / answer["scatter_predicted"] < 2.0
    assert answer["scatter_predicted"] > 0.8 * answer["scatter_without_rate_limit"]
    assert answer["load"] <= 0.60
    assert answer["overruns"] == 0
    assert answer["static_ram_bytes"] + answer["stack_bytes"] < 1024
    # The reference capacitor: the simulated charge is a mean over 6.25 us, sinc(pi f T) cos(pi f T)
    # smaller than it ought to be, 0.7 %; the band-pass of both channels is the same.
    assert 1.0 < answer["calibration"] < 1.015


def test_a_step_that_differs_from_the_prediction_says_why_and_exits_with_3(
    firmware: Firmware, cosim_program: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, error = run(capsys, "firmware", "simulate", DATA, "--precondition", 0,
                            "--before-s", 3, "--after-s", 3, "--json")  # fmt: skip
    assert code == 3
    answer = json.loads(text)
    assert answer["status"] == "differs from the prediction"
    assert answer["deviation"] > answer["deviation_tolerated"]
    assert "Cause: the step stretches the twin farther than before" in error
    assert error.count("\n") == 1
    chip = answer["loops"][-1]
    assert chip["overshoot"] > chip["predicted"]["overshoot"] + 0.15


def test_a_loop_that_is_unstable_on_the_twin_is_refused_at_the_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(capsys, "firmware", "simulate", DATA, "--reading", "rad")
    assert code == 3
    assert "unstable on this twin" in error and "rad/s" in error
    # Without an option, the twin is that of the run.
    for name in ("model.json", "controller.toml"):
        shutil.copy(DATA / name, tmp_path)
    twin = twin_of_reading("rad").model_dump(mode="json")
    (tmp_path / "results.json").write_text(json.dumps({"provenance": {"rig_config": twin}}))
    code, _, again = run(capsys, "firmware", "simulate", tmp_path)
    assert code == 3
    assert again == error.replace(str(DATA), str(tmp_path))


SMALL = """\
[actuator.geometry]
zero_length_m = 0.05
[drive]
low_v = 0.0
high_v = 1.5
voltage_map = {a1_v = 0.811, b1 = 8.67, a2_v = -0.807, b2 = -65.1}
[sensing]
strain_map = {slope_per_f = 5.33e8, offset = -0.08, range_f = [1.49e-10, 2.84e-10]}
[model]
gain = 1.0
natural_frequency_rad_s = 38.0
damping_ratio = 0.16
[controller]
kind = "pi"
parameters = {kp = 0.0, ki = 5.0}
limits = {low = 0.0, high = 0.07}
"""


def test_a_twin_with_another_capacitance_is_refused_before_anything_is_built(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    code, _, err = run(capsys, "firmware", "simulate", path)
    assert code == 2
    # 14 and 419 pF: the record of 149 to 284 pF, and its width on either side
    assert "The actuator of the twin has 474 pF at 0 V" in err
    assert "accepts 14 to 419 pF" in err and "--twin TWIN.toml" in err
    assert "haselab identify actuator RECORDS --actuator A.toml" in err


def test_a_capacitance_that_saturates_the_converter_is_refused_with_the_gain_that_it_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """240 V of 5 kHz at 2 nF are 15.1 mA, 3.62 V behind the stage of 0.8 * 0.5996; 2.5 V fit."""
    path, rig = tmp_path / "large.toml", tmp_path / "chip.toml"
    path.write_text(
        SMALL.replace("slope_per_f = 5.33e8", "slope_per_f = 5.33e7").replace(
            "[1.49e-10, 2.84e-10]", "[1.49e-9, 2e-9]"
        )
    )
    for words in (("simulate",), ("build", "--build-dir", tmp_path / "fw")):
        code, _, err = run(capsys, "firmware", words[0], path, *words[1:])
        assert code == 2 and "reaches 2 nF" in err and "saturates at 1.38 nF" in err
        assert "i_stage = 0.44 in [front_end]" in err
    rig.write_text(f'kind = "chip"\nrun = "{path}"\n[simulator]\n[front_end]\ni_stage = 0.44\n')
    code, _, err = run(
        capsys, "firmware", "build", path, "--build-dir", tmp_path / "fw", "--rig", rig
    )
    assert code == 0, err


@pytest.mark.parametrize(
    ("recorded", "front_end", "code"), [(1000.0, None, 2), (5050.0, None, 0), (1000.0, 1000.0, 0)]
)
def test_a_module_whose_gain_differs_from_that_of_the_records_is_refused(
    recorded: float,
    front_end: float | None,
    code: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, rig = tmp_path / "small.toml", tmp_path / "chip.toml"
    path.write_text(SMALL.replace("[drive]", f"[drive]\ngain_v_per_v = {recorded}"))
    rig.write_text(f'kind = "chip"\nrun = "{path}"\n[simulator]\n[front_end]\ngain = {front_end}\n')
    which = [] if front_end is None else ["--rig", rig]
    found, _, err = run(capsys, "firmware", "build", path, "--build-dir", tmp_path / "fw", *which)
    assert found == code, err
    assert ("it would put out 5 times the high voltage of the records" in err) == (code == 2)
    assert ("as gain in [front_end]" in err and "firmware.md" in err) == (code == 2)


def test_simulate_refuses_the_same_gain_as_build(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "small.toml"
    path.write_text(SMALL.replace("[drive]", "[drive]\ngain_v_per_v = 4000.0"))
    code, _, err = run(capsys, "firmware", "simulate", path)
    assert code == 2 and "it would put out 1.25 times the high voltage of the records" in err
    assert "'firmware simulate' cannot simulate it" in err


def test_the_rig_file_of_the_page_builds_for_another_gain(
    firmware: Firmware, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its keys are all those of the file, with their defaults."""
    page = (Path(__file__).resolve().parents[2] / "docs/control/firmware.md").read_text("utf-8")
    part = page.split("### The rig file of a microcontroller")[1]
    (tmp_path / "chip.toml").write_text(part.split("```toml\n")[1].split("```")[0])
    (tmp_path / "actuator.toml").write_text(
        SMALL.replace("[drive]", "[drive]\ngain_v_per_v = 4000.0")
    )
    code, _, err = run(capsys, "firmware", "build", tmp_path / "actuator.toml", "--rig",
                       tmp_path / "chip.toml", "--build-dir", tmp_path / "fw")  # fmt: skip
    assert code == 0, err
    table = part.split("| key of `[front_end]`")[1].split("\n\n")[0]
    for name, field in FrontEndConfig.model_fields.items():
        row = next(line for line in table.splitlines() if line.startswith(f"| `{name}` |"))
        stated = row.split("|")[3].strip().strip("`")
        assert stated == (
            str(list(field.default)) if name == "correction" else f"{field.default:g}"
        )


@pytest.mark.long
def test_an_actuator_below_500_pf_is_calibrated_within_its_range(
    tmp_path: Path, firmware: Firmware, cosim_program: Path
) -> None:
    """The usual reference of 500 pF is outside the range of such an actuator."""
    path, twin = tmp_path / "small.toml", tmp_path / "twin.toml"
    path.write_text(SMALL)
    with pytest.raises(SystemExit):
        main(["twin", "new", "--set", "dielectric.permittivity=1.5", "--out", str(twin)])
    with pytest.raises(SystemExit) as stop:
        main(["firmware", "simulate", str(path), "--twin", str(twin), "--before-s", "1.5",
              "--after-s", "1.5", "--out", str(tmp_path / "step.json")])  # fmt: skip
    assert stop.value.code == 3  # another actuator than that of [model]
    answer = json.loads((tmp_path / "step.json").read_text(encoding="utf-8"))
    # The current has 100 codes peak at 217 pF: the rounding of each sample is at most 0.5 of them.
    assert abs(answer["calibration"] - 1.0) < 0.01


def test_build_gives_a_program_for_the_programmer(
    firmware: Firmware, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, error = run(capsys, "firmware", "build", DATA, "--structure", "pi", "--json",
                            "--build-dir", tmp_path)  # fmt: skip
    assert (code, error) == (0, "")
    answer = json.loads(text)
    assert answer["flash_bytes"] < 16 * 1024
    assert (tmp_path / "firmware.hex").read_text(encoding="ascii").endswith(":00000001FF\n")
    assert "settings" in (tmp_path / "settings.h").read_text(encoding="ascii")


def test_build_takes_the_front_end_of_a_rig_file(
    firmware: Firmware, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "chip.toml"
    rig.write_text(f'kind = "chip"\nrun = "{DATA}"\n[simulator]\n[front_end]\n'
                   "correction = [1.01, 0.002]\n", encoding="utf-8")  # fmt: skip
    code, _, error = run(capsys, "firmware", "build", DATA, "--rig", rig, "--build-dir", tmp_path)
    assert (code, error) == (0, "")
    file = load_rig(rig)
    assert isinstance(file, ChipFile)
    settings = read_design(DATA, "pid", file.front_end.front_end()).settings
    assert settings.front_end.correction == 1.01 + 0.002j
    assert (tmp_path / "settings.h").read_text(encoding="ascii") == settings_header(settings)
    code, _, error = run(capsys, "firmware", "build", DATA, "--rig", rig, "--board", "stm32g071")
    assert code == 2
    assert "only kind 'chip' with board" in error


def test_a_build_says_which_strains_the_module_does_not_reach(
    firmware: Firmware, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    designed = read_design(DATA, "pid", FrontEnd()).limits
    rig = tmp_path / "chip.toml"
    rig.write_text(f'kind = "chip"\nrun = "{DATA}"\ndrive_high_v = 1.5\n[simulator]\n')
    code, text, error = run(capsys, "firmware", "build", DATA, "--rig", rig, "--build-dir",
                            tmp_path, "--json")  # fmt: skip
    answer = json.loads(text)
    assert code == 0 and error.count("\n") == 1
    assert "the chip's output, which reaches 1.5 V, limit the drive" in error
    assert f"instead of {designed[0]:.4g} to {designed[1]:.4g}" in error
    assert 0.0 < answer["strain_high"] < designed[1] and answer["strain_low"] == designed[0]


def test_a_lowest_drive_narrows_the_strains_as_well() -> None:
    eq4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
    low, high = strains_within((-0.1, 0.05), eq4, 1.9, 0.8)
    assert -0.1 < low < 0.0 and high == 0.05
    assert eq4.voltage_v(low) == pytest.approx(0.8, abs=0.01)
    assert strains_within((-0.1, 0.05), eq4, 1.9, 1.2) == (-0.1, 0.05)  # not even zero strain


def test_a_folder_without_a_run_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(capsys, "firmware", "build", tmp_path)
    assert code == 2
    assert "There is no such actuator file" in error
    assert error.count("\n") == 1
    shutil.copy(DATA / "model.json", tmp_path)
    code, _, error = run(capsys, "firmware", "build", tmp_path)
    assert code == 2
    assert "controller.toml" in error


def test_a_tool_that_is_not_there_is_named_with_its_package() -> None:
    with pytest.raises(ValueError, match=r"no-such-tool is not installed.*apt-get install -y pkg"):
        find_tool("no-such-tool", "pkg")


def test_flash_asks_first_and_passes_on_the_programmers_fault(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    image = tmp_path / "firmware.hex"
    image.write_text(":00000001FF\n", encoding="ascii")
    tool = tmp_path / "avrdude"
    tool.write_text("#!/bin/sh\necho \"$@\" > called\necho 'no sync' >&2\nexit 1\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.chdir(tmp_path)
    code, _, error = run(capsys, "firmware", "flash", image, "--port", "/dev/null", "--yes")
    assert code == 4
    assert "avrdude failed: no sync" in error
    assert f"-P /dev/null -b 115200 -D -U flash:w:{image}:i" in (tmp_path / "called").read_text()
    (tmp_path / "called").unlink()
    monkeypatch.setattr("sys.stdin", io.StringIO("n\n"))
    code, _, error = run(capsys, "firmware", "flash", image, "--port", "/dev/null")
    assert code == 130
    assert not (tmp_path / "called").exists()  # the answer was no: nothing is written


@pytest.mark.parametrize(
    "text", [":020000040800F2\n:00000001FF\n", "not a program\n"], ids=["another chip", "text"]
)
def test_an_image_for_another_chip_is_not_written(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = tmp_path / "firmware.hex"
    image.write_text(text, encoding="ascii")
    code, _, error = run(capsys, "firmware", "flash", image, "--port", "/dev/null", "--yes")
    assert code == 2
    assert "not a program for the ATmega2560" in error


@pytest.mark.long
def test_on_a_new_sheet_the_same_gains_overshoot(settings: ChipSettings) -> None:
    """A designed loop is one for the sheet that was measured: the Mullins effect."""
    zero_m = read_design(DATA, "pid", settings.front_end).zero_length_m
    overshoots = []
    for precondition_v in (2.0, 0.0):
        plan = StepPlan(0.0, 0.04, 6.0, 4.0, zero_m, precondition_v)
        run = desktop_loop(twin_of_reading("hz"), 1, settings, SLOW, plan)
        found = step_metrics(run.time_s, run.strain, run.reference)
        overshoots.append(found.trials[0].overshoot)
    assert overshoots[0] < 0.07  # the design's demand
    assert overshoots[1] > 3.0 * 0.07


def test_a_current_channel_that_loses_the_carrier_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "chip.toml"
    rig.write_text(
        f'kind = "chip"\nrun = "{DATA}"\n[simulator]\n[front_end]\nampere_per_monitor_volt = 1.0\n'
    )
    code, _, error = run(capsys, "firmware", "build", DATA, "--rig", rig, "--build-dir", tmp_path)
    assert code == 2
    assert "codes in the current channel of the front end, but the chip needs 59" in error
    assert not (tmp_path / "settings.h").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--step", 0, 0.5), "--step is 0 0.5, but the microcontroller accepts only strains of"),
        (("--step", 0.02, 0.02), "--step is 0.02 0.02, which does not change the desired strain"),
        (("--before-s", 0), "'--before-s': 0.0 is not in the range 0.1<=x<=600.0"),
        (("--after-s", 0.01), "'--after-s': 0.01 is not in the range 0.1<=x<=600.0"),
        (("--after-s", 1e12), "'--after-s': 1000000000000.0 is not in the range"),
        (("--precondition", -1), "--precondition is -1 V, but it must be 0 to 2 V"),
        (("--precondition", 3), "--precondition is 3 V, but it must be 0 to 2 V"),
    ],
)
def test_an_option_out_of_its_range_is_named(
    arguments: tuple[object, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(capsys, "firmware", "simulate", DATA, *arguments)
    assert code == 2
    assert said in error and error.count("\n") == 1


def test_limits_that_exclude_the_designed_step_are_named_with_the_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "small.toml"
    path.write_text(
        SMALL.replace("high = 0.07", "high = 0.02") + "[controller.demands]\nstep = 0.04\n"
    )
    code, _, error = run(capsys, "firmware", "simulate", path)
    assert code == 2
    assert "--step is 0 0.04" in error and "strains of 0 to 0.02" in error


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("low = 0.0, high = 0.07", "low = 0.01, high = 0.07", "they must contain zero strain"),
        ("gain = 1.0", 'gain = 1.0\noutput_unit = "mm"', "The output of [model] is in mm"),
        ("gain = 1.0", 'gain = 1.0\noutput_unit = "%"', "The output of [model] is in %"),
        ("gain = 1.0", 'gain = 1.0\ninput_unit = "V"', "The input of [model] is in V"),
        ("[1.49e-10, 2.84e-10]", "[1e-10, 2e-9]", "usable from 0 to 3.9 nF"),
    ],
)  # fmt: skip
def test_a_firmware_that_cannot_run_is_not_built(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    path = tmp_path / "small.toml"
    path.write_text(SMALL.replace(old, new))
    code, _, error = run(capsys, "firmware", "build", path, "--build-dir", tmp_path / "fw")
    assert code == 2
    assert said in error and error.count("\n") == 1
    assert not (tmp_path / "fw" / "firmware.hex").exists()


def test_a_firmware_starts_at_zero_strain_just_outside_its_output() -> None:
    """Zero strain is the length at 0 V, where the fitted map gives a slightly larger strain."""
    settings = read_design(DATA, "pid", FrontEnd()).settings
    near = replace(settings, strain_low=0.0008)
    assert near.reference_limits == (0.0, near.strain_high)
    assert settings_header(near).count(".reference_low = 0") == 1
    assert settings.reference_limits == (settings.strain_low, settings.strain_high)


def test_a_drive_that_does_not_reach_zero_strain_is_refused() -> None:
    """The chip's loop starts at zero strain, but would stay below it."""
    settings = read_design(DATA, "pid", FrontEnd()).settings
    zero_v = float(VoltageMap(*settings.voltage_map).voltage_v(0.0))
    with pytest.raises(InputError, match=rf"zero strain, which needs {zero_v:.4g} V"):
        replace(settings, strain_high=-0.0003)
