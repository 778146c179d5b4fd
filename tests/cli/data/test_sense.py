"""`haselab sense`: files in, the contract's columns out, exit codes."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from haselab.cli.main import main

COLUMNS = [
    "time_s",
    "capacitance_f",
    "capacitance_std_f",
    "resistance_ohm",
    "relative_capacitance",
    "phase_rad",
    "v_pp_v",
    "i_pp_v",
    "valid",
    "resistance_std_ohm",
    "leakage_s",
    "leakage_std_s",
    "reason",
]
RATE_HZ, CARRIER_HZ = 200e3, 2000.0
CAPACITANCE_F, RESISTANCE_OHM = 1.2e-9, 8e3
V_PEAK_V, NOISE_V, BLOCKS = 0.05, 0.3e-3, 30


def series_rc_record(blocks: int, rng: np.random.Generator) -> np.ndarray:
    """Monitors of a series R-C: V from the generator, I = V / Z in the monitors' scales."""
    omega = 2 * np.pi * CARRIER_HZ
    z_ohm = RESISTANCE_OHM + 1 / (1j * omega * CAPACITANCE_F)
    turn = np.exp(1j * omega * np.arange(2000 * blocks) / RATE_HZ)
    record = np.stack([V_PEAK_V * turn, V_PEAK_V * 5000 / 2e-3 / z_ohm * turn], axis=1).real
    return record + NOISE_V * rng.standard_normal(record.shape)


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    return series_rc_record(BLOCKS, np.random.default_rng(5))


def write_csv(path: Path, record: np.ndarray) -> Path:
    np.savetxt(path, record, delimiter=",", header="v_monitor_v,i_monitor_v", comments="")
    return path


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code)


def read(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    with path.open(newline="") as file:
        header, *rows = list(csv.reader(file))
    columns = dict(zip(header, np.array(rows).T, strict=True))
    return header, {k: v if k == "reason" else v.astype(float) for k, v in columns.items()}


@pytest.mark.parametrize("method", ["lockin", "sinefit", "paper"])
def test_each_method_recovers_capacitance_and_resistance(
    method: str, record: np.ndarray, tmp_path: Path
) -> None:
    source, out = write_csv(tmp_path / "m.csv", record), tmp_path / "deep" / "out.csv"
    options = ["--carrier-hz", 2000, "--rate-hz", 200000, "--blank-s", 0, "--method", method]
    assert run("sense", source, *options, "--out", out) == 0
    header, columns = read(out)
    assert header == COLUMNS
    np.testing.assert_allclose(columns["time_s"], 999.5 / RATE_HZ + 0.01 * np.arange(BLOCKS))
    assert (columns["valid"] == 1).all()
    # Five standard errors of the mean; the paper's peak-to-peak reads noise as amplitude: of 100
    # points a few lie near each extreme, so up to 3 sigma of the mean period on each channel.
    mean_std = columns["capacitance_std_f"].mean() / np.sqrt(BLOCKS)
    z = abs(RESISTANCE_OHM + 1 / (2j * np.pi * CARRIER_HZ * CAPACITANCE_F))
    peak_bias = 3 * NOISE_V / np.sqrt(20) / (V_PEAK_V * min(1.0, 2.5e6 / z)) * CAPACITANCE_F
    bias = peak_bias if method == "paper" else 0.0
    assert abs(columns["capacitance_f"].mean() - CAPACITANCE_F) < 5 * mean_std + bias
    ohm_per_farad = 1 / (2 * np.pi * CARRIER_HZ * CAPACITANCE_F**2)
    assert (
        abs(columns["resistance_ohm"].mean() - RESISTANCE_OHM)
        < (5 * mean_std + bias) * ohm_per_farad
    )


def test_relative_capacitance_is_equation_2_and_3_of_the_same_row(
    record: np.ndarray, tmp_path: Path
) -> None:
    source, out = write_csv(tmp_path / "m.csv", record), tmp_path / "out.csv"
    assert run("sense", source, "--carrier-hz", 2000, "--rate-hz", 2e5, "--out", out) == 0
    _, c = read(out)
    reactance = 2.5e6 * np.abs(c["v_pp_v"] / c["i_pp_v"]) * np.sin(np.abs(c["phase_rad"]))
    # Four numbers of nine digits each, half a unit of the last off.
    np.testing.assert_allclose(
        c["relative_capacitance"], 1 / (reactance * 2 * np.pi * 2000 * 10), rtol=4 * 5e-9
    )


def test_the_rate_of_the_file_is_used_when_none_is_given(
    record: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "m.mat"
    savemat(source, {"v_monitor_v": record[:, 0], "i_monitor_v": record[:, 1], "rate_hz": RATE_HZ})
    assert run("sense", source, "--carrier-hz", 2000, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["blocks"] == answer["valid_blocks"] == BLOCKS
    assert set(COLUMNS) <= set(answer)


@pytest.mark.parametrize("start_s", [-0.2, 12.5, 1e5])
@pytest.mark.parametrize("rate", [[], ["--rate-hz", RATE_HZ]])
def test_the_times_are_on_the_clock_of_the_file(
    record: np.ndarray, tmp_path: Path, start_s: float, rate: list[object]
) -> None:
    """So that a strain in the same file belongs to the same times, as after a pre-trigger."""
    source = tmp_path / "m.mat"
    time_s = start_s + np.arange(len(record)) / RATE_HZ
    savemat(source, {"v_monitor_v": record[:, 0], "i_monitor_v": record[:, 1], "time_s": time_s})
    begun_s = []
    for more in (rate, ["--time", "time_s", *rate]):
        out = tmp_path / f"{len(begun_s)}.csv"
        assert run("sense", source, "--carrier-hz", CARRIER_HZ, "--out", out, *more) == 0
        begun_s.append(read(out)[1]["time_s"])
    for found in begun_s:
        wanted = start_s + 0.01 * (np.arange(BLOCKS) + 0.5)
        # Half a sample, because a block's middle is between two; and 15 digits.
        assert np.abs(found - wanted).max() < 0.5 / RATE_HZ + 1e-14 * abs(start_s) + 1e-12


def test_scales_that_nobody_stated_are_named(
    tmp_path: Path, record: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half the scale of the voltage is twice the capacitance, which looks as good."""
    path = write_csv(tmp_path / "record.csv", record)
    options = ["sense", path, "--carrier-hz", 2000, "--rate-hz", 200000]
    assert run(*options) == 0
    assert "no scale of the voltage monitor is stated" in capsys.readouterr().err
    scale = ["--volt-per-monitor-volt", 5000, "--ampere-per-monitor-volt", 0.002]
    assert run(*options, *scale) == 0
    assert "no scale" not in capsys.readouterr().err


def test_a_block_without_carrier_is_marked_and_the_others_are_kept(
    record: np.ndarray, tmp_path: Path
) -> None:
    lost = record.copy()
    lost[2000:4000] = NOISE_V * np.random.default_rng(6).standard_normal((2000, 2))
    source, out = write_csv(tmp_path / "m.csv", lost), tmp_path / "out.csv"
    assert run("sense", source, "--carrier-hz", 2000, "--rate-hz", 2e5, "--out", out) == 0
    _, columns = read(out)
    assert np.flatnonzero(columns["valid"] == 0).tolist() == [1]
    assert "amplitude lost" in columns["reason"][1]
    assert set(np.delete(columns["reason"], 1)) == {""}
    assert np.isnan(columns["capacitance_f"][1])
    assert np.isfinite(columns["capacitance_f"][2:]).all()


def test_the_known_skew_of_the_channels_leaves_no_resistance(
    record: np.ndarray, tmp_path: Path
) -> None:
    omega, skew_s = 2 * np.pi * CARRIER_HZ, 2.5e-6
    time_s = np.arange(20000) / RATE_HZ
    skewed = np.stack(
        [0.05 * np.cos(omega * time_s), 0.1 * np.cos(omega * (time_s + skew_s) + np.pi / 2)], axis=1
    )
    source, out = write_csv(tmp_path / "m.csv", skewed), tmp_path / "out.csv"
    options = ["--carrier-hz", 2000, "--rate-hz", 2e5, "--skew-s", skew_s, "--out", out]
    assert run("sense", source, *options) == 0
    _, columns = read(out)
    # The kernel reads in single precision: half a unit of 24 bits of |Z| = 1.25 Mohm.
    np.testing.assert_allclose(columns["resistance_ohm"], 0.0, atol=1.25e6 * 2**-24)
    np.testing.assert_allclose(columns["phase_rad"], np.pi / 2, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--carrier-hz", "2000"], 2, "--rate-hz"),
        (["--carrier-hz", "0", "--rate-hz", "2e5"], 2, "not a positive number"),
        (["--carrier-hz", "90e3", "--rate-hz", "2e5"], 2, "sample faster"),
        (["--carrier-hz", "2000", "--rate-hz", "2e5", "--block-s", "9"], 2, "--block-s"),
        (["--carrier-hz", "2001", "--rate-hz", "2e5", "--method", "paper"], 2, "whole periods"),
        (["--carrier-hz", "7000", "--rate-hz", "2e5"], 3, "carrier"),
        (["--rate-hz", "2e5"], 2, "--carrier-hz"),
    ],
)
def test_a_request_that_cannot_be_met_is_one_line_and_an_exit_code(
    options: list[str],
    code: int,
    words: str,
    record: np.ndarray,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = write_csv(tmp_path / "m.csv", record[:4000])
    assert run("sense", source, *options) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert words in captured.err


def test_a_missing_column_names_those_that_are_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "m.csv"
    path.write_text("v_monitor_v,amps\n1,2\n3,4\n")
    assert run("sense", path, "--carrier-hz", 2000, "--rate-hz", 2e5) == 2
    message = capsys.readouterr().err
    assert "i_monitor_v" in message
    assert "amps" in message
    assert "--v and --i" in message


def test_columns_of_other_names_are_named_by_options(tmp_path, record):
    path, out = tmp_path / "m.csv", tmp_path / "c.csv"
    np.savetxt(path, record, delimiter=",", header="V [V],I [V]", comments="")
    options = ["--carrier-hz", 2000, "--rate-hz", 2e5, "--v", "V [V]", "--i", "I [V]"]
    assert run("sense", path, *options, "--out", out) == 0
    assert read(out)[1]["valid"].all()


def test_a_tone_beside_the_carrier_is_named(tmp_path, record, capsys):
    time_s = np.arange(len(record)) / RATE_HZ
    other = record + np.outer(np.cos(2 * np.pi * 1950 * time_s), np.abs(record).max(axis=0))
    source = write_csv(tmp_path / "m.csv", other)
    assert run("sense", source, "--carrier-hz", 2300, "--rate-hz", 2e5) == 3
    assert "The voltage has tones at 1950 and 2000 Hz" in capsys.readouterr().err


def test_values_at_the_actuator_are_distinguished_from_those_of_monitors(tmp_path, record, capsys):
    drive = 1000.0 * np.sin(2 * np.pi * 5 * np.arange(len(record)) / RATE_HZ)
    actuator = record * (5000.0, 2e-3) + np.stack([drive, 0.0 * drive], axis=1)
    source = write_csv(tmp_path / "m.csv", actuator)
    assert run("sense", source, "--carrier-hz", 2000, "--rate-hz", 2e5) == 3
    message = capsys.readouterr().err
    assert "--volt-per-monitor-volt 1 --ampere-per-monitor-volt 1" in message
    options = ["--carrier-hz", 2000, "--rate-hz", 2e5, "--full-scale-v", 5000]
    assert run("sense", source, *options) == 0
    assert "more than any monitor output" in capsys.readouterr().err
    options += ["--volt-per-monitor-volt", 1, "--ampere-per-monitor-volt", 1]
    assert run("sense", source, *options) == 0
    assert "more than any monitor output" not in capsys.readouterr().err


def test_a_warning_keeps_the_causes_of_all_blocks(tmp_path, record, capsys):
    time_s = np.arange(len(record)) / RATE_HZ
    late = record.copy()
    turn = np.exp(2j * np.pi * 0.01 * CARRIER_HZ * time_s)  # 1 % off in two blocks of five
    wave = np.exp(2j * np.pi * CARRIER_HZ * time_s) * turn
    z_ohm = RESISTANCE_OHM + 1 / (2j * np.pi * CARRIER_HZ * CAPACITANCE_F)
    off = np.arange(len(record)) // 2000 % 5 < 2
    late[off] = V_PEAK_V * np.stack([wave, 5000 / 2e-3 / z_ohm * wave], axis=1).real[off]
    source = write_csv(tmp_path / "m.csv", late)
    assert run("sense", source, "--carrier-hz", 2000, "--rate-hz", 2e5) == 0
    assert "only 18 of 30 blocks valid: 12 carrier off." in capsys.readouterr().err


def test_the_recording_itself_is_never_the_answers_place(tmp_path, record, capsys):
    file = write_csv(tmp_path / "monitors.csv", record)
    before = file.read_bytes()
    link = tmp_path / "same.csv"
    link.symlink_to(file)
    for out in (file, link):
        assert run("sense", file, "--carrier-hz", 2000, "--rate-hz", 200000, "--out", out) == 2
        assert "names a file that is read" in capsys.readouterr().err
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("good", "code", "words"), [(1, 3, "Too few blocks"), (8, 0, "warning: only")]
)
def test_few_valid_blocks_give_a_warning_or_an_error(
    record: np.ndarray, tmp_path: Path, capfd: pytest.CaptureFixture[str], good: int, code: int,
    words: str,
) -> None:  # fmt: skip
    """A number from one block of many is not printed as if it stood for the record."""
    blocks = np.tile(record, (3, 1))[: 20 * 2000]
    noise = NOISE_V * np.random.default_rng(6).standard_normal((len(blocks), 2))
    blocks = np.where(np.arange(len(blocks))[:, np.newaxis] < good * 2000, blocks, noise)
    source, out = write_csv(tmp_path / "m.csv", blocks), tmp_path / "out.csv"
    assert run("sense", source, "--carrier-hz", 2000, "--rate-hz", 2e5, "--out", out) == code
    printed_err = capfd.readouterr().err
    assert words in printed_err
    assert f"{good} of 20 blocks valid" in printed_err
    assert "amplitude lost" in printed_err
    assert out.exists()


KAPPA_S = 2.5e6 * CAPACITANCE_F  # current over the voltage's slope, both as readings


def triangle_record(low_v: float, rng: np.random.Generator) -> np.ndarray:
    """20 s at 1 kHz without a carrier: a triangle from `low_v` to 2 V, 0.5 Hz."""
    turn = ((np.arange(20_000) + 0.5) / 1e3 * 0.5 + 0.13) % 1.0
    v = 2.0 - (2.0 - low_v) * np.abs(2.0 * turn - 1.0)
    i = KAPPA_S * np.where(turn < 0.5, 1.0, -1.0) * (2.0 - low_v) + 3e-3
    return np.stack([v, i], axis=1) + NOISE_V * rng.standard_normal((20_000, 2))


def test_a_record_without_a_carrier_is_sensed_by_its_charge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = triangle_record(0.0, np.random.default_rng(7))
    source, out = write_csv(tmp_path / "m.csv", record), tmp_path / "out.csv"
    options = ["--method", "charge", "--rate-hz", 1000, "--block-s", 0.5]
    assert run("sense", source, *options, "--out", out) == 0
    capsys.readouterr()
    header, columns = read(out)
    assert header == COLUMNS
    assert (columns["valid"] == 1).all()
    np.testing.assert_allclose(columns["time_s"], 0.2495 + 0.5 * np.arange(40))
    error = np.abs(columns["capacitance_f"] - CAPACITANCE_F) / columns["capacitance_std_f"]
    assert error.max() < 5.0
    for name in ("resistance_ohm", "relative_capacitance", "phase_rad", "resistance_std_ohm"):
        assert np.isnan(columns[name]).all(), name
    assert run("sense", source, *options, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["valid_blocks"] == 40
    assert answer["capacitance_f"] == pytest.approx(columns["capacitance_f"], rel=1e-8)


def test_a_record_that_never_passes_0_v_ends_with_3_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = triangle_record(1.0, np.random.default_rng(8))
    source, out = write_csv(tmp_path / "m.csv", record), tmp_path / "out.csv"
    options = ["--method", "charge", "--rate-hz", 1000, "--out", out]
    assert run("sense", source, *options) == 3
    assert "does not cross 0 V" in capsys.readouterr().err
    assert not read(out)[1]["valid"].any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--carrier-hz", 2000], "--carrier-hz"),
        (["--blank-s", 0], "--blank-s"),
        (["--block-s", 0.01], "--block-s"),
        (["--block-s", 60], "shorten --block-s"),
        (["--skew-s", 1], "skew_s"),
    ],
)
def test_options_that_charge_cannot_use_are_refused_in_one_line(
    options: list[object], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_csv(tmp_path / "m.csv", triangle_record(0.0, np.random.default_rng(9)))
    assert run("sense", source, "--method", "charge", "--rate-hz", 1000, *options) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
