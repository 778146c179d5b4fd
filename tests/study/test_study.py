"""One quick run under each reading: every answer, its interval, and what acceptance asks for.

Tolerances are those of the acceptance, not of the numbers that came out.
"""

from __future__ import annotations

import importlib
import json
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import haselab.study
from haselab.cli.main import cli
from haselab.models.maps import VoltageMap

CONTRACT = {
    "S14": "a1 b1 a2 b2",
    "S15": "slope offset",
    "S16": "mu lambda_m",
    "S17": "region_low region_high",
    "S19": "omega_d decay_1 decay_2 omega_0",
    "S20": "gain omega_n zeta slow_gain slow_tau",
    "S21": "phase_margin gain_margin",
    "S24": "rise_open rise_closed error_open error_closed overshoot_closed",
}
IDS = [f"{row}.{name}" for row, names in CONTRACT.items() for name in names.split()]
NARROW = {"S20.omega_n": 0.02, "S19.omega_0": 0.02, "S20.zeta": 0.15}


def value(run: Any, key: str) -> float:
    return float(run.rows[key]["measured"]["value"])


@pytest.mark.parametrize("key", IDS)
def test_every_answer_has_an_interval_and_a_truth(run: Any, key: str) -> None:
    row = run.rows[key]
    low, high = row["measured"]["ci95"]
    assert row["measured"]["std"] > 0.0
    assert low < row["measured"]["value"] < high
    assert math.isfinite(row["noise_free"])
    assert row["verdict"] in ("agrees", "disagrees", "inconclusive", "not in paper")


@pytest.mark.parametrize("key", IDS)
def test_no_answer_is_farther_than_four_deviations_from_the_truth(run: Any, key: str) -> None:
    row = run.rows[key]
    assert abs(row["measured"]["value"] - row["noise_free"]) <= 4.0 * row["measured"]["std"]


@pytest.mark.parametrize("key", NARROW)
def test_frequency_and_damping_meet_the_truth_and_say_so(run: Any, key: str) -> None:
    row, part = run.rows[key], NARROW[key]
    low, high = row["measured"]["ci95"]
    assert value(run, key) == pytest.approx(row["noise_free"], rel=part)
    assert 0.5 * (high - low) <= part * row["noise_free"]


def test_the_voltage_map_is_true_to_two_percent_of_its_span(run: Any) -> None:
    drawn = json.loads((run.folder / "analysis.json").read_text())["voltage_map"]
    names = [f"S14.{key}" for key in ("a1", "b1", "a2", "b2")]
    measured = VoltageMap(*(value(run, name) for name in names))
    true = VoltageMap(*(run.rows[name]["noise_free"] for name in names))
    strain = np.linspace(min(drawn["strain"]), max(drawn["strain"]), 200)
    off_v = measured.voltage_v(strain) - true.voltage_v(strain)
    assert np.abs(off_v).max() <= 0.02 * np.ptp(drawn["voltage_v"])
    assert measured.is_monotone(strain[0], strain[-1])


def test_the_open_loop_is_slow_and_keeps_an_error(run: Any) -> None:
    assert 6.0 <= value(run, "S24.rise_open") <= 8.0
    low, high = run.rows["S24.error_open"]["measured"]["ci95"]
    assert low * high > 0.0
    assert min(abs(low), abs(high)) > 0.03


def test_the_pi_loop_is_as_fast_as_printed_and_keeps_no_error(run: Any) -> None:
    assert 2.5 <= value(run, "S24.rise_closed") <= 3.0
    assert abs(value(run, "S24.error_closed")) < 0.03


def test_the_pid_loop_is_faster_still_and_well_damped(run: Any) -> None:
    assert value(run, "S25.phase_margin") >= 45.0
    assert value(run, "S25.rise_pid") < 1.0
    assert value(run, "S25.overshoot_pid") < 0.10


def test_self_sensing_follows_the_camera_within_two_percent_of_the_span(run: Any) -> None:
    assert run.results["sensing_error"] <= 0.02


def test_the_data_tell_which_reading_is_right(run: Any, reading: str) -> None:
    verdict = json.loads((run.folder / "analysis.json").read_text())["reading"]["verdict"]
    word = {"rad": "the data support rad/s, as printed", "hz": "the data support Hz"}[reading]
    assert re.search(word, verdict)


def test_the_folder_holds_what_the_contract_names(run: Any) -> None:
    for name in ("report.html", "session.h5", "actuator.toml"):
        assert (run.folder / name).stat().st_size > 100
    assert {f"fig{k}.svg" for k in range(2, 8)} <= {
        path.name for path in (run.folder / "figures").iterdir()
    }


def test_the_session_holds_every_raw_block(run: Any) -> None:
    """Twenty seconds and a fifth of triangle are 2,020 blocks of two channels, as converted."""
    shapes: list[tuple[int, ...]] = []
    with h5py.File(run.folder / "session.h5", "r") as file:
        file.visititems(
            lambda name, item: (
                shapes.append(item.shape)
                if isinstance(item, h5py.Dataset) and item.dtype == np.int16 and item.ndim == 3
                else None
            )
        )
    assert (2020, 2000, 2) in shapes


def test_analyse_finds_the_same_bits_in_the_recorded_data(
    played: Callable[[str], Any], command: Callable[..., str], tmp_path: Path
) -> None:
    run = played("hz")
    answer = json.loads(command("analyse", run.folder, "--out", tmp_path / "again", "--json"))
    assert answer["quantities"] == run.results["quantities"]
    assert answer["sensing_error"] == run.results["sensing_error"]
    again, first = (
        tomllib.loads((folder / "actuator.toml").read_text())
        for folder in (tmp_path / "again", run.folder)
    )
    assert again.pop("provenance")["model"]["command"].startswith("haselab analyse")
    first.pop("provenance")
    assert again == first


def test_run_on_a_rig_file_plays_what_reproduce_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same study, twin and seed go into the same function: `analyse` shows what comes out."""
    played: list[tuple[Any, ...]] = []

    def execute(study: Any, rig: Any, config: Any, seed: int, *others: Any, **_: Any) -> None:
        played.append((study, rig.description, config, seed))

    (tmp_path / "rig.toml").write_text('kind = "twin"\nreading = "hz"\nseed = 11\n')
    builtin = Path(haselab.study.__file__).parent / "studies" / "hasel-iros2018.toml"
    (tmp_path / "study.toml").write_text(builtin.read_text())
    run = ("run", tmp_path / "study.toml", "--rig", tmp_path / "rig.toml")
    for order in (("reproduce", "--no-physical-model", "--reading", "hz", "--seed", 11), run):
        name = importlib.import_module(f"haselab.cli.study.{order[0]}")
        monkeypatch.setattr(name, "execute", execute)
        out = ("--quick", "--out", tmp_path / str(order[0]))
        cli.main([str(word) for word in (*order, *out)], standalone_mode=False)
    assert len(played) == 2
    assert played[0] == played[1]


def test_the_model_feeds_design(run: Any, command: Callable[..., str], tmp_path: Path) -> None:
    """Designed at the delay and saturation of the rig, margins like those of the study's PID."""
    known = tomllib.loads((run.folder / "actuator.toml").read_text())["controller"]
    out = tmp_path / "mine.toml"
    answer = json.loads(command("design", run.folder / "actuator.toml", "--out", out, "--json"))
    assert answer["phase_margin_deg"] >= 45.0
    assert answer["rise_time_s"] < 1.0
    designed = tomllib.loads(out.read_text())["controller"]
    assert designed["parameters"]["kp"] == answer["kp"]
    for part in ("loop", "limits"):
        assert designed[part] == pytest.approx(known[part])
