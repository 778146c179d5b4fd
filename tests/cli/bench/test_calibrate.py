"""`haselab calibrate`: the procedure on the twin, the file, and every way out at 0 V."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from haselab.base import DeviceError, InputError
from haselab.cli import main as entry
from haselab.cli.bench import calibrate
from haselab.pipelines.calibration_file import load_calibration, save_calibration
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, rig_of

TWIN = """
[amplifier]
i_monitor_gain_error = 0.12
v_monitor_lag_s = 3e-6
i_monitor_lag_s = 8e-6
i_monitor_offset_v = -3e-3
stray_f = 30e-12
"""
TWO = ["--capacitor", "0.47e-9", "--capacitor", "2.2e-9,5,0.01", "--duration-s", "0.3"]


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as stop:
        entry.main(["calibrate", *arguments])
    return int(stop.value.code)


@pytest.fixture
def rig_file(tmp_path: Path) -> str:
    (tmp_path / "twin.toml").write_text(TWIN, encoding="utf-8")
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\ntwin = "twin.toml"\n', encoding="utf-8")
    return str(path)


def test_the_monitors_errors_are_found_reported_and_stored(rig_file, tmp_path, capsys):
    out = tmp_path / "new" / "calibration.toml"
    assert run(["--rig", rig_file, *TWO, "--json", "--out", str(out)]) == 0
    answer = json.loads(capsys.readouterr().out)
    # Two lags take 1 - (omega lag)^2 / 2 each, the converters 1e-3 (see test_twin_physics).
    assert answer["gain_error"] == pytest.approx(0.12, abs=1.12 * (0.0101**1 / 2 + 1e-3))
    # 2.5 us of skew ahead, 5 us of lag behind, 12.566 rad/ms; noise is 100 times smaller.
    assert answer["phase_rad"] == pytest.approx(12566 * (2.5e-6 - 5e-6), abs=1e-3)
    assert answer["stray_f"] == pytest.approx(30e-12, abs=0.3e-12)
    assert answer["offsets_v"] == pytest.approx([0.0, -3e-3], abs=1e-5)
    assert [row["nominal_f"] for row in answer["references"]] == [0.47e-9, 2.2e-9]
    assert answer["references"][1]["std_f"] == pytest.approx(0.0058 * 2.2e-9, rel=0.02)
    loaded = load_calibration(out)
    assert [loaded.scale_s.real, loaded.scale_s.imag] == pytest.approx(answer["scale_s"])
    assert loaded.references[1].tolerance == 0.01
    assert (loaded.amplifier, loaded.date) == ("twin amplifier", answer["date"])


def test_the_table_says_what_was_removed(rig_file, capsys):
    assert run(["--rig", rig_file, *TWO, "--capacitor", "4.7e-9"]) == 0
    page = capsys.readouterr().out
    for words in ("uncalibrated nF", "gain error of the monitors   +11.", "deg at 2000 Hz",
                  "stray capacitance            ", "-3.00 mV",
                  "tolerances of the references included"):  # fmt: skip
        assert words in page
    assert "two references leave nothing to check" not in page


def test_the_default_twin_has_nothing_to_remove(capsys):
    assert run(["--rig", "twin", "--capacitor", "0.5e-9", "--capacitor", "2e-9", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert abs(answer["gain_error"]) < 1e-3
    assert answer["phase_rad"] == pytest.approx(12566 * 2.5e-6, abs=1e-3)
    assert abs(answer["stray_f"]) < 0.5e-12


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--capacitor", "1e-9"], 2, "at least 2 that differ"),
        (["--capacitor", "1e-9", "--capacitor", "1e-9"], 2, "equal readings within noise"),
        (["--capacitor", "1e-9", "--capacitor", "x"], 2, "is not FARAD"),
        (["--capacitor", "1e-9", "--capacitor", "1,2,3,4"], 2, "is not FARAD"),
        (["--capacitor", "1e-9", "--capacitor", "-2e-9"], 2, "must be in"),
        (["--capacitor", "1e-9", "--capacitor", "2e-3"], 2, "Use another one"),
        ([*TWO, "--carrier-hz", "90e3"], 2, "Sine of 90000 Hz"),
        ([*TWO, "--carrier-hz", "70e3"], 2, "70000 Hz"),
        ([*TWO, "--carrier-v", "1e-7"], 3, "no carrier at 2000 Hz"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(arguments, code, words, capsys):
    assert run(["--rig", "twin", *arguments]) == code
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1


def test_swapped_references_are_refused(rig_file, monkeypatch, capsys):
    bench_that_connects(monkeypatch, 2.2e-9, 0.47e-9, None)
    assert run(["--rig", "twin", "--capacitor", "0.47e-9", "--capacitor", "2.2e-9"]) == 3
    assert "phase error of -178 deg" in capsys.readouterr().err


def test_a_rig_file_that_is_not_there_is_refused(tmp_path, capsys):
    path = tmp_path / "none.toml"
    assert run(["--rig", str(path), *TWO]) == 2
    assert capsys.readouterr().err.endswith(f"{path}\n")


def test_a_reference_that_is_another_one_is_refused(monkeypatch, capsys):
    bench_that_connects(monkeypatch, 0.47e-9, 22e-9, None)
    assert run(["--rig", "twin", "--capacitor", "0.47e-9", "--capacitor", "2.2e-9"]) == 3
    assert "times their nominal gain" in capsys.readouterr().err


class Mistaken:
    """A fixture that connects other capacitors than it was asked for."""

    def __init__(self, bench: TwinBench, values: Iterator[float | None]) -> None:
        self.bench, self.values = bench, values

    def connect(self, capacitance_f: float | None, series_ohm: float = 0.0) -> None:
        self.bench.connect(next(self.values), series_ohm)


def bench_that_connects(monkeypatch: pytest.MonkeyPatch, *values: float | None) -> TwinBench:
    bench = TwinBench(TwinConfig(), 1)
    rig = rig_of(bench, TwinConfig())
    if values:
        rig.fixture = Mistaken(bench, iter(values))
    monkeypatch.setattr(calibrate, "_rig_of", lambda name: rig)
    return bench


@pytest.mark.parametrize("failure", [DeviceError("gone"), KeyboardInterrupt()])
def test_every_way_out_ends_at_0_v_without_a_carrier(failure, monkeypatch, capsys):
    bench = bench_that_connects(monkeypatch)
    blocks = iter(range(20))
    read = bench.read

    def failing():
        if next(blocks) == 15:
            raise failure
        return read()

    monkeypatch.setattr(bench, "read", failing)
    assert run(["--rig", "twin", *TWO]) == (4 if isinstance(failure, DeviceError) else 130)
    assert bench.output_v == 0.0
    assert bench._native.carrier_v == 0.0
    capsys.readouterr()


# ---- the file -------------------------------------------------------------------------------


@pytest.fixture
def stored(rig_file, tmp_path, capsys) -> Path:
    path = tmp_path / "calibration.toml"
    assert run(["--rig", rig_file, *TWO, "--out", str(path)]) == 0
    capsys.readouterr()
    return path


def test_a_stored_calibration_comes_back_whole(stored, tmp_path):
    first = load_calibration(stored)
    save_calibration(first, tmp_path / "again.toml")
    assert load_calibration(tmp_path / "again.toml") == first


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("stray_s = [", "stray_s = [1e-6 , 0.0] #", "stray_s is .* but the references"),
        ("tolerance = 0.01", "tolerance = 2.0", "tolerance 2; they must be in"),
        ("carrier_hz = 2000.0", "", "1 error.*the file has no key carrier_hz"),
        ("carrier_hz = 2000.0", "carrier_hz = 3000.0", "but the references in the file give"),
        ("amplifier =", "amplifer =", "amplifer: no such key"),
        ("ratio_std = ", "ratio_std = nan #", "calibration"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused_with_its_path(stored, old, new, words):
    text = stored.read_text(encoding="utf-8")
    assert old in text
    stored.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=words) as fault:
        load_calibration(stored)
    assert str(fault.value).endswith(str(stored))
    assert "\n" not in str(fault.value)


def test_a_file_whose_references_contradict_each_other_is_refused(rig_file, tmp_path, capsys):
    path = tmp_path / "three.toml"
    three = ["--capacitor", "0.47e-9", "--capacitor", "1e-9", "--capacitor", "2.2e-9"]
    assert run(["--rig", rig_file, *three, "--out", str(path)]) == 0
    capsys.readouterr()
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("capacitance_f = 1e-09", "capacitance_f = 1.1e-09"))
    with pytest.raises(InputError, match=r"contradict each other .*three\.toml$"):
        load_calibration(path)


def test_no_file_is_one_line(tmp_path):
    with pytest.raises(InputError, match="No such calibration file"):
        load_calibration(tmp_path / "none.toml")
