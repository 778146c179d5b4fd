"""`haselab sense` in chunks: any file, any length, bad blocks reported, little memory."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import asdict, replace
from datetime import date
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from haselab.cli.main import main
from haselab.pipelines.calibration_file import save_calibration
from haselab.pipelines.prefetch import map_in_order, prefetch
from haselab.pipelines.sensing import source as sense_source
from haselab.pipelines.sensing.table import Summary
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.sensing import Lockin, LockinConfig
from haselab.sensing.calibration import Calibration, Reference, ReferenceReading
from haselab.store.session.writer import ExperimentPlan, SessionWriter

RATE_HZ, CARRIER_HZ, BLOCK = 200e3, 2000.0, 2000
OMEGA = 2 * np.pi * CARRIER_HZ
CAPACITANCE_F, RESISTANCE_OHM, NOISE_V = 1.2e-9, 8e3, 0.3e-3
ASK = ["--carrier-hz", "2000", "--rate-hz", "200000"]
NUMBERS = [
    "time_s", "capacitance_f", "capacitance_std_f", "resistance_ohm", "phase_rad", "v_pp_v",
    "i_pp_v", "resistance_std_ohm",
]  # fmt: skip


def volts(blocks: int, seed: int = 3) -> np.ndarray:
    """Both monitors of a series R-C, shape `(samples, 2)`."""
    z_ohm = RESISTANCE_OHM + 1 / (1j * OMEGA * CAPACITANCE_F)
    turn = np.exp(1j * OMEGA * np.arange(blocks * BLOCK) / RATE_HZ)
    record = np.stack([0.05 * turn, 0.05 * 2.5e6 / z_ohm * turn], axis=1).real
    return record + NOISE_V * np.random.default_rng(seed).standard_normal(record.shape)


RECORD = volts(12)


def save(path: Path, record: np.ndarray) -> Path:
    """The same record as whatever the name says."""
    columns = {"v_monitor_v": record[:, 0].copy(), "i_monitor_v": record[:, 1].copy()}
    match path.name:
        case "pairs.npy":
            np.save(path, record)
        case "channels.npy":
            np.save(path, np.ascontiguousarray(record.T))
        case "fields.npy":
            names = [(name, "f8") for name in columns]
            np.save(path, np.ascontiguousarray(record).view(names).reshape(-1))
        case "stored.npz":
            np.savez(path, **columns)
        case "deflated.npz":
            np.savez_compressed(path, **columns)
        case "five.mat":
            savemat(path, columns)
        case "packed.mat":
            savemat(path, columns, do_compression=True)
        case "plain.h5" | "seven.mat":
            with h5py.File(path, "w") as file:
                file.update({name: values[None, :] for name, values in columns.items()})
        case "chunked.h5":
            with h5py.File(path, "w") as file:
                for name, values in columns.items():
                    file.create_dataset(name, data=values, chunks=(777,), compression="gzip")
        case "a.csv":
            np.savetxt(path, record, "%.17g", ",", header=",".join(columns), comments="")
        case "a.tdms":
            nptdms = pytest.importorskip("nptdms")
            with nptdms.TdmsWriter(path) as writer:
                writer.write_segment(
                    [nptdms.ChannelObject("bench", name, v) for name, v in columns.items()]
                )
        case _:
            raise AssertionError(path)
    return path


KINDS = ["pairs.npy", "channels.npy", "fields.npy", "stored.npz", "deflated.npz", "five.mat",
         "packed.mat", "seven.mat", "plain.h5", "chunked.h5", "a.csv", "a.tdms"]  # fmt: skip


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main(["sense", *map(str, arguments)])
    return int(stop.value.code)


def read(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="") as file:
        header, *rows = list(csv.reader(file))
    columns = dict(zip(header, np.array(rows).T, strict=True))
    return {k: v if k == "reason" else v.astype(float) for k, v in columns.items()}


def lockin(**changes: object) -> Lockin:
    config = LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 2.5e6, search_updates=True,
                          min_amplitude_codes=1e-6)  # fmt: skip
    return Lockin(replace(config, **changes))


def test_each_kind_of_file_gives_the_same_rows_as_the_lockin_itself(tmp_path, monkeypatch):
    monkeypatch.setattr(sense_source, "_CHUNK_ROWS", 5 * BLOCK)  # 12 blocks in 5, 5 and 2
    sensed = lockin().sense(RECORD.reshape(-1, BLOCK, 2))
    rows = {}
    for kind in KINDS:
        source, out = save(tmp_path / kind, RECORD), tmp_path / f"{kind}.csv"
        assert run(source, *ASK, "--out", out) == 0
        rows[kind] = out.read_text()
        columns = read(out)
        for name, values in zip(NUMBERS, (
            sensed.time_s, sensed.capacitance_f, sensed.capacitance_std_f, sensed.resistance_ohm,
            sensed.phase_rad, sensed.v_pp, sensed.i_pp, sensed.resistance_std_ohm,
        ), strict=True):  # fmt: skip
            # Nine digits in the file.
            np.testing.assert_allclose(columns[name], values, rtol=5e-9, err_msg=f"{kind} {name}")
        assert columns["valid"].tolist() == sensed.valid.astype(float).tolist()
    assert len(set(rows.values())) == 1


@pytest.mark.parametrize("method", ["lockin", "sinefit", "paper"])
def test_the_length_of_the_pieces_leaves_no_trace(tmp_path, monkeypatch, method):
    source = save(tmp_path / "pairs.npy", RECORD)
    printed = []
    for blocks in (1, 3, 100):
        monkeypatch.setattr(sense_source, "_CHUNK_ROWS", blocks * BLOCK)
        out = tmp_path / f"{blocks}.csv"
        assert run(source, *ASK, "--method", method, "--out", out) == 0
        printed.append(out.read_text())
    assert printed[0] == printed[1] == printed[2]


def test_float32_readings_give_what_their_rounding_allows(tmp_path):
    one, other = tmp_path / "one.csv", tmp_path / "other.csv"
    assert run(save(tmp_path / "pairs.npy", RECORD), *ASK, "--out", one) == 0
    assert run(save(tmp_path / "pairs.npy", RECORD.astype("f4")), *ASK, "--out", other) == 0
    # Half a unit of 24 bits of the largest reading, 2 V, as noise: far below 0.3 mV.
    a, b = read(one), read(other)
    bound_f = a["capacitance_std_f"] * (2.0 * 2**-24 / NOISE_V)
    valid = a["valid"] == 1
    assert (b["valid"] == a["valid"]).all()
    # Beside it nine digits in the file.
    off_f = np.abs(a["capacitance_f"] - b["capacitance_f"])[valid]
    assert (off_f < 5 * bound_f[valid] + 1e-8 * CAPACITANCE_F).all()


# ---- bad input: figure 5 --------------------------------------------------------------------


def spoiled(**changes: object) -> np.ndarray:
    record = RECORD.copy()
    for name, value in changes.items():
        record[5 * BLOCK + 700, 0 if name == "v" else 1] = value
    return record


@pytest.mark.parametrize("kind", ["pairs.npy", "a.csv", "five.mat"])
@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({"v": np.nan}, [], "not a finite number"),
        ({"i": np.inf}, [], "not a finite number"),
        ({"v": -10.0}, [], "clipped"),
        ({"i": 10.0 * (1 - 2**-15)}, [], "clipped"),
        ({"i": 5.0}, ["--full-scale-v", "5"], "clipped"),
        ({"i": 4.1}, ["--current-limit-a", "8e-3"], "current limit"),
    ],
)
def test_one_bad_reading_costs_its_block_alone_and_says_why(
    tmp_path, kind, changes, options, words
):
    whole, out = tmp_path / "whole.csv", tmp_path / "out.csv"
    assert run(save(tmp_path / kind, RECORD), *ASK, *options, "--out", whole) == 0
    assert run(save(tmp_path / kind, spoiled(**changes)), *ASK, *options, "--out", out) == 0
    columns = read(out)
    assert columns["valid"][5] == 0
    assert words in columns["reason"][5]
    assert np.isnan(columns["capacitance_f"][5])
    without = [line for k, line in enumerate(whole.read_text().splitlines()) if k != 6]
    assert [line for k, line in enumerate(out.read_text().splitlines()) if k != 6] == without


@pytest.mark.parametrize(
    ("change", "options", "code", "words", "reason"),
    [
        (lambda r: r[:, ::-1], [], 3, "swapped, or one monitor inverted", "phase out of band"),
        (lambda r: r * [1, -1], [], 3, "swapped, or one monitor inverted", "phase out of band"),
        (lambda r: r * np.nan, [], 3, "NaN or infinite", "not a finite number"),
        (lambda r: np.clip(60 * r, -10, 10), [], 3, "clipped", "clipped"),
        (lambda r: r * [1, 0], [], 3, "None of 12 blocks shows a carrier", "amplitude lost"),
        (lambda r: r, ["--rate-hz", "100000"], 3, "Check --carrier-hz, --rate-hz", None),
        (lambda r: r, ["--rate-hz", "250000"], 3, "Check --carrier-hz, --rate-hz", None),
    ],
)
def test_a_record_without_one_valid_block_is_one_line_and_rows_with_the_reason(
    tmp_path, capsys, change, options, code, words, reason
):
    source, out = save(tmp_path / "pairs.npy", change(RECORD)), tmp_path / "out.csv"
    assert run(source, *ASK, *options, "--out", out) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = [line for line in printed.err.splitlines() if "do not fill a block" not in line]
    assert len(lines) == 1
    assert words in lines[0]
    columns = read(out)
    assert (columns["valid"] == 0).all()
    assert np.isnan(columns["capacitance_f"]).all()
    assert reason is None or all(reason in text for text in columns["reason"])


@pytest.mark.parametrize(
    ("kind", "record", "words"),
    [
        ("pairs.npy", RECORD[: BLOCK - 1], "has 1999 samples, but a block has 2000"),
        ("a.csv", RECORD[: BLOCK - 1], "has 1999 samples, but a block has 2000"),
        ("pairs.npy", RECORD[:0], "is empty"),
        ("stored.npz", RECORD[:0], "is empty"),
        ("a.csv", RECORD[:0], "is empty"),
        ("five.mat", RECORD[:0], "is empty"),
    ],
)
def test_a_record_that_fills_no_block_is_refused_and_leaves_nothing(
    tmp_path, capsys, kind, record, words
):
    source, out = save(tmp_path / kind, record), tmp_path / "out.csv"
    assert run(source, *ASK, "--out", out) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert words in printed
    assert printed.endswith(f"{source}\n")
    assert not out.exists()


@pytest.mark.parametrize("suffix", ["csv", "npy", "npz", "mat", "h5", "tdms"])
def test_a_file_without_a_byte_is_one_line(tmp_path, capsys, suffix):
    source = tmp_path / f"nothing.{suffix}"
    source.write_bytes(b"")
    assert run(source, *ASK) == 2
    assert "is empty" in capsys.readouterr().err


def test_a_missing_channel_names_what_is_there(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", v_monitor_v=RECORD[:, 0], current=RECORD[:, 1])
    assert run(tmp_path / "a.npz", *ASK) == 2
    assert "lacks i_monitor_v; it has v_monitor_v, current" in capsys.readouterr().err
    np.save(tmp_path / "a.npy", RECORD[:, 0])
    assert run(tmp_path / "a.npy", *ASK) == 2
    assert "or two columns with shape (n, 2)" in capsys.readouterr().err


def test_samples_beyond_the_last_block_are_reported(tmp_path, capsys):
    assert run(save(tmp_path / "pairs.npy", RECORD[: 3 * BLOCK + 17]), *ASK, "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["blocks"] == 3
    assert "the last 17 samples do not fill a block" in printed.err


def test_a_rate_that_contradicts_the_file_is_refused(tmp_path, capsys):
    source = tmp_path / "a.npz"
    np.savez(source, v_monitor_v=RECORD[:, 0], i_monitor_v=RECORD[:, 1], rate_hz=100e3)
    assert run(source, *ASK) == 2
    assert "but the file's own rate has 100000 rows" in capsys.readouterr().err


@pytest.mark.parametrize(("share", "code"), [(2.0, 2), (0.5, 2), (1.01, 2), (1.0, 0)])
def test_a_rate_that_contradicts_the_times_is_refused(tmp_path, capsys, share, code):
    source = tmp_path / "a.npz"
    time_s = np.arange(len(RECORD)) / RATE_HZ * share
    np.savez(source, v_monitor_v=RECORD[:, 0], i_monitor_v=RECORD[:, 1], time_s=time_s)
    assert run(source, *ASK) == code
    assert ("but column time_s has" in capsys.readouterr().err) == (code == 2)


def test_times_in_ms_are_hinted_at(tmp_path, capsys):
    source = tmp_path / "a.npz"
    time_ms = np.arange(len(RECORD)) / RATE_HZ * 1e6
    np.savez(source, v_monitor_v=RECORD[:, 0], i_monitor_v=RECORD[:, 1], time_s=time_ms)
    assert run(source, "--method", "charge") == 2
    assert "convert the file's times if they are not in s" in capsys.readouterr().err


def test_samples_that_are_missing_in_the_middle_are_one_line(tmp_path, capsys):
    time_s = np.arange(len(RECORD)) / RATE_HZ
    time_s[9000:] += 0.01
    source = tmp_path / "a.npz"
    np.savez(source, v_monitor_v=RECORD[:, 0], i_monitor_v=RECORD[:, 1], time_s=time_s)
    assert run(source, "--carrier-hz", 2000) == 2
    assert "time_s has a step of 0.010005 s before row 9001" in capsys.readouterr().err


# ---- sessions and calibrations --------------------------------------------------------------

RIG = make_twin(TwinConfig(), 1).description


def session(path: Path, blocks: int = 23, **header: object) -> np.ndarray:
    """A session whose experiment `play` holds these codes; the clock begins at 7 s."""
    codes = np.round(volts(blocks) / RIG.volt_per_code).astype(np.int16).reshape(-1, BLOCK, 2)
    whole = {"rig": asdict(RIG), "study": {"sensing": {"carrier_hz": CARRIER_HZ}}} | header
    plans = [ExperimentPlan(name, "play", 1, {}) for name in ("play", "never")]
    with SessionWriter(path, plans, BLOCK, whole) as writer:
        for k, block in enumerate(codes):
            writer.append_block("play", block, 7.0 + k * 0.01, 0.0, np.nan)
    return codes


def test_a_session_states_everything_that_its_codes_need(tmp_path, monkeypatch):
    monkeypatch.setattr(sense_source, "_CHUNK_ROWS", 7 * BLOCK)  # chunks of 10 blocks
    codes = session(tmp_path / "session.h5")
    out = tmp_path / "out.csv"
    assert run(tmp_path / "session.h5", "--experiment", "play", "--out", out) == 0
    columns = read(out)
    settled = RIG.switch_sample + 100  # 0.5 ms
    sensed = Lockin(
        LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, RIG.skew_s,
                     RIG.i_monitor_v_per_a / RIG.v_monitor_v_per_v, full_scale=32767.0,
                     blank=(RIG.switch_sample, settled))
    ).sense(codes)  # fmt: skip
    for name, values in (
        ("time_s", 7.0 + sensed.time_s), ("capacitance_f", sensed.capacitance_f),
        ("v_pp_v", sensed.v_pp * RIG.volt_per_code), ("resistance_ohm", sensed.resistance_ohm),
    ):  # fmt: skip
        np.testing.assert_allclose(columns[name], values, rtol=5e-9)


def test_updates_at_known_times_cost_no_accuracy(tmp_path):
    """A staircase of the twin: as a session, which knows the updates, and as plain columns."""
    bench = make_twin(TwinConfig(), 1)
    bench.generator.sine(CARRIER_HZ, 0.02)
    whole = {"rig": asdict(RIG), "study": {"sensing": {"carrier_hz": CARRIER_HZ}}}
    codes = []
    with SessionWriter(
        tmp_path / "session.h5", [ExperimentPlan("play", "play", 1, {})], BLOCK, whole
    ) as writer:
        for k in range(80):
            volt = 0.4 + 0.75 * (1.0 - np.cos(0.078 * k))  # steps of up to 59 mV
            bench.source.write(volt)
            codes.append(bench.acquisition.read())
            writer.append_block("play", codes[-1], 7.0 + k * 0.01, volt, np.nan)
    np.save(tmp_path / "monitors.npy", np.concatenate(codes) * RIG.volt_per_code)
    known, sought = tmp_path / "known.csv", tmp_path / "sought.csv"
    assert run(tmp_path / "session.h5", "--experiment", "play", "--out", known) == 0
    options = [*ASK, "--skew-s", RIG.skew_s, "--out", sought]
    assert run(tmp_path / "monitors.npy", *options) == 0
    ours, theirs = read(known), read(sought)
    assert ours["valid"].all()
    both = theirs["valid"] > 0.0
    assert both.sum() > 40
    std, other = (columns["capacitance_std_f"][both] for columns in (ours, theirs))
    # At worst the 15 carrier periods after the update count, and 19 of 20 without that knowledge.
    assert np.median(std / other) < 1.05 * np.sqrt(19 / 15)
    # Other samples count, so the middles differ, by up to 1 ms of the motion.
    there = np.interp(theirs["time_s"], ours["time_s"] - 7.0, ours["capacitance_f"])
    far = (there - theirs["capacitance_f"])[both] / np.hypot(std, other)
    assert np.sqrt(np.mean(far**2)) < 0.6  # the same samples: less than independent errors


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        ({}, ["--experiment", "never"], "no experiment 'never' with blocks, only play."),
        ({}, ["--experiment", "play", "--block-s", "0.02"], "with one output each, have 0.01 s"),
        ({"rig": {}}, ["--experiment", "play"], "lacks rig.rate_hz"),
        ({"study": {}}, ["--experiment", "play"], "lacks study.sensing"),
    ],
)
def test_what_a_session_lacks_is_one_line(tmp_path, capsys, header, options, words):
    session(tmp_path / "session.h5", 2, **header)
    assert run(tmp_path / "session.h5", *options) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert words in printed


def test_a_file_that_is_no_session_has_no_experiment(tmp_path, capsys):
    assert run(save(tmp_path / "plain.h5", RECORD), "--experiment", "play") == 2
    assert "The file is not a complete haselab session" in capsys.readouterr().err


def calibration(**changes: object) -> Calibration:
    scale_s = np.exp(-1j * OMEGA * 2e-6) / 2.5e6 / 1.12
    references = (Reference(0.5e-9), Reference(2e-9))
    readings = tuple(
        ReferenceReading((c.admittance_s(CARRIER_HZ) + 30e-12j * OMEGA) / scale_s, 1e-6, (0.0, 0.0))
        for c in references
    )
    values = Calibration(complex(scale_s), 1j * OMEGA * 30e-12, (0.01, -0.02), CARRIER_HZ, RATE_HZ,
                         RIG.amplifier, date(2024, 5, 6).isoformat(), references, readings, 0.0,
                         1e-10)  # fmt: skip
    return replace(values, **changes)


def test_a_calibration_takes_the_place_of_scales_and_skew(tmp_path):
    known, out = calibration(), tmp_path / "out.csv"
    save_calibration(known, tmp_path / "calibration.toml")
    source = save(tmp_path / "pairs.npy", RECORD)
    assert run(source, *ASK, "--calibration", tmp_path / "calibration.toml", "--out", out) == 0
    method = lockin(scale_s=known.scale_s, stray_s=known.stray_s, offsets=known.offsets_v)
    sensed = method.sense(RECORD.reshape(-1, BLOCK, 2))
    np.testing.assert_allclose(read(out)["capacitance_f"], sensed.capacitance_f, rtol=5e-9)


def test_a_calibration_of_something_else_is_refused(tmp_path, capsys):
    save_calibration(calibration(), tmp_path / "calibration.toml")
    source = save(tmp_path / "pairs.npy", RECORD)
    use = ["--calibration", tmp_path / "calibration.toml"]
    assert run(source, *ASK, *use, "--amplifier", "another") == 2
    assert "for the amplifier" in capsys.readouterr().err
    assert run(source, "--carrier-hz", 4000, "--rate-hz", 2e5, *use) == 2
    assert "for a carrier of 2000 Hz" in capsys.readouterr().err
    assert run(source, *ASK, "--calibration", tmp_path / "none.toml") == 2
    assert "none.toml" in capsys.readouterr().err


# ---- the answer -----------------------------------------------------------------------------


def test_json_holds_every_column_to_the_last_digit(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sense_source, "_CHUNK_ROWS", 5 * BLOCK)
    record = spoiled(v=np.nan)
    assert run(save(tmp_path / "pairs.npy", record), *ASK, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    sensed = lockin(full_scale=10.0).sense(record.reshape(-1, BLOCK, 2))
    expected = [None if np.isnan(value) else value for value in sensed.capacitance_f.tolist()]
    assert answer["capacitance_f"] == expected
    assert answer["capacitance_f"][5] is None
    assert answer["valid"] == sensed.valid.astype(int).tolist()
    assert answer["reason"][5] == "not a finite number"
    assert answer["invalid"]["not a finite number"] == 1


def test_the_median_of_a_long_record_is_that_of_an_even_share_of_it():
    rng = np.random.default_rng(2)
    values, summary = 1.0 + 0.01 * rng.standard_normal(1_000_000), Summary()
    for part in np.split(values, np.cumsum(rng.integers(1, 9000, 180))):
        columns = {"capacitance_f": part, "resistance_ohm": -part, "v_pp_v": part}
        summary.write(columns, np.zeros(part.size, np.uint8))
    answer = summary.answer("lockin")
    assert answer["blocks"] == answer["valid_blocks"] == values.size
    # Five standard deviations of the median of the fewest that are kept, 65,536 values.
    bound = 5 * 1.2533 * 0.01 / np.sqrt(65536)
    assert answer["median_capacitance_f"] == pytest.approx(1.0, abs=bound)
    assert answer["median_resistance_ohm"] == -answer["median_capacitance_f"]


def test_the_median_of_a_short_record_is_that_of_all_blocks():
    values, summary = np.random.default_rng(1).standard_normal(1001), Summary()
    for part in np.split(values, 7 * [143]):
        columns = {"capacitance_f": part, "resistance_ohm": part, "v_pp_v": part}
        summary.write(columns, np.zeros(part.size, np.uint8))
    whole = {"capacitance_f": values, "resistance_ohm": values, "v_pp_v": values}
    other = Summary()
    other.write(whole, np.zeros(values.size, np.uint8))
    assert other.answer("")["median_capacitance_f"] == np.median(values)


def test_work_in_threads_keeps_its_order_and_its_errors():
    assert list(prefetch(iter(range(50)))) == list(range(50))
    assert list(map_in_order(lambda k: k * k, iter(range(50)), 3)) == [k * k for k in range(50)]

    def failing():
        yield 1
        raise OSError("the disk is gone")

    taken = []
    with pytest.raises(OSError, match="the disk is gone"):
        for item in map_in_order(abs, prefetch(failing()), 2):
            taken.append(item)
    assert taken == []  # two workers: the first result comes when two more items are there
    with pytest.raises(ZeroDivisionError, match="division"):
        list(map_in_order(lambda k: 1 / k, iter([1, 0]), 2))


PEAK = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, done.returncode)
"""


@pytest.mark.parametrize("kind", ["pairs.npy", "stored.npz"])
def test_memory_is_flat_in_the_length_of_the_record(tmp_path, kind):
    peaks = []
    for blocks in (4000, 12000):  # 128 and 384 MB
        source = save(tmp_path / kind, np.tile(volts(100), (blocks // 100, 1)))
        command = [sys.executable, "-m", "haselab.cli", "sense", str(source), *ASK]
        done = subprocess.run(
            [sys.executable, "-c", PEAK, *command, "--out", str(tmp_path / f"{blocks}.csv")],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        peak, code = map(int, done.stdout.split())
        assert code == 0
        peaks.append(peak * 1024)
    assert peaks[1] < 300e6
    # Pieces of both columns in flight: one read, two ahead, one a worker, one waiting for its turn.
    # A reader that kept what it read would need 256 MB more.
    in_flight = 4 + min(4, os.cpu_count() or 1)
    assert peaks[1] - peaks[0] < min(in_flight * 16.8e6, 0.5 * 256e6)
