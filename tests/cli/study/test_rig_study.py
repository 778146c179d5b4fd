"""A short study over the wire, in the time of the served twin: what the twin itself gives."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from haselab.cli.study.run import command
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin
from haselab.store.session.writer import SessionReader
from haselab.study import definition
from haselab.study.definition import load_study

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")

BUILTIN = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"
# As short as the fits of the study allow.
SHORT: dict[str, dict[str, Any]] = {
    "triangle": {"cycles": 3, "frame_rate_hz": 100.0},
    "static_load": {"settle_s": 40.0},
    "free_response": {"trials": 1, "settle_s": 10.0, "record_s": 4.0, "frame_rate_hz": 100.0},
    "chirp": {"duration_s": 10.0, "hold_s": 20.0, "frame_rate_hz": 50.0},
    "steps": {"zero_s": 5.0, "step_s": 15.0, "rest_s": 30.0, "frame_rate_hz": 10.0,
              "open_trials": 1, "pi_trials": 1, "pid_trials": 1},
}  # fmt: skip


def short_study(path: Path) -> None:
    """STUDY.toml: the builtin one, whose table `quick` is replaced by SHORT."""
    plain = BUILTIN.read_text().partition("[quick")[0]
    # The derived baseline is rounded to 0.01 V, which may fall otherwise with other noise.
    plain = re.sub(r"(\[operating_point\][^\n]*\n)", r"\1baseline_v = 1.0\n", plain)
    assert "baseline_v = 1.0" in plain
    tables = [
        "\n".join([f"[quick.{name}]", *(f"{key} = {json.dumps(v)}" for key, v in table.items())])
        for name, table in SHORT.items()
    ]
    path.write_text("\n".join([plain, *tables]) + "\n")
    load_study(path, quick=True)


def results(folder: Path, rig: Path, study: Path) -> dict[str, dict[str, float]]:
    command.main(
        [
            str(study),
            "--rig",
            str(rig),
            "--quick",
            "--keep-video",
            "none",
            "--out",
            str(folder),
            "--yes",
        ],
        standalone_mode=False,
    )
    rows = json.loads((folder / "results.json").read_text())["quantities"]
    return {row["id"]: row["measured"] for row in rows if row["measured"]}


@pytest.mark.slow
def test_a_study_over_the_wire_gives_what_the_twin_gives(tmp_path: Path, capsys) -> None:
    study = tmp_path / "study.toml"
    short_study(study)
    (tmp_path / "twin.toml").write_text('kind = "twin"\n')
    direct = results(tmp_path / "direct", tmp_path / "twin.toml", study)
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as served:
        (tmp_path / "wire.toml").write_text(served.rig_file(ahead_blocks=0))
        wire = results(tmp_path / "wire", tmp_path / "wire.toml", study)
        assert abs(served.hub.output_v) < 50.0
    assert not (tmp_path / "wire" / "guardian.log").exists()
    assert set(wire) == set(direct)
    for key, one in direct.items():
        if one["std"] is None or wire[key]["std"] is None:  # of one trial, or no number
            assert (one["value"] is None) == (wire[key]["value"] is None), key
            continue
        if key == "S24.rise_open_raw":  # 90 % lies at the first peak of the ringing
            continue
        if key == "S25.overshoot_pid":  # of other gains: what both designs must keep
            assert max(one["value"], wire[key]["value"]) < 0.07, key
            continue
        if key.startswith("S25."):  # gains chosen for the plant that was found, and their effect
            continue
        # Two runs with other noise: four standard deviations of their difference.
        spread = (one["std"] ** 2 + wire[key]["std"] ** 2) ** 0.5
        close = max(4.0 * spread, 1e-3 * abs(one["value"]))  # a delay known to 5 us has no spread
        assert abs(wire[key]["value"] - one["value"]) <= close, key
    with SessionReader(tmp_path / "wire" / "session.h5") as session:
        for name in ("triangle", "chirp", "open-1", "pi-1", "pid-1"):
            starts_s = session.experiment(name).block_start_s
            assert abs((starts_s[1:] - starts_s[:-1]) - 0.01).max() < 1e-9, name


@pytest.mark.slow
@pytest.mark.parametrize(("ahead_blocks", "line"), [(1, False), (2, True)])
def test_a_study_ends_well_on_each_rig_file_that_a_served_twin_writes(
    tmp_path: Path, capsys, ahead_blocks: int, line: bool
) -> None:
    """Outputs that wait, and frames by the exposure line, after waits of 40 s."""
    study = tmp_path / "study.toml"
    short_study(study)
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as served:
        rig = served.rig_file(ahead_blocks=ahead_blocks, exposure_line=line)
        (tmp_path / "wire.toml").write_text(rig)
        found = results(tmp_path / "wire", tmp_path / "wire.toml", study)
    waited_s = found["S21.delay"]["value"]
    assert waited_s == pytest.approx(0.0107 + 0.01 * ahead_blocks, abs=5e-4)
    assert found["S21.gain_margin"]["value"] >= 2.0
    assert abs(found["S24.error_closed"]["value"]) < 0.02
    with SessionReader(tmp_path / "wire" / "session.h5") as session:
        for name in ("pi-1", "pid-1", "late-1", "printed-1", "saturating-1"):
            drive_v = session.experiment(name).drive_v
            assert drive_v[-100:].std() < 0.02, name  # no loop swings
