"""A chirp without a triangle: the transfer function from the drive voltage itself."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from haselab.cli.main import main

STUDY = """\
name = "chirp alone"
[operating_point]
baseline_v = 1.0
[chirp]
amplitude_v = 0.1
start_hz = 0.2
stop_hz = 12.0
duration_s = 20.0
hold_s = 30.0
frame_rate_hz = 60.0
"""


@pytest.mark.long
def test_a_chirp_alone_gives_gain_frequency_and_damping(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, rig, out = tmp_path / "study.toml", tmp_path / "rig.toml", tmp_path / "out"
    study.write_text(STUDY)
    rig.write_text('kind = "twin"\n')
    with pytest.raises(SystemExit) as stop:
        main(["run", str(study), "--rig", str(rig), "--keep-video", "none", "--out", str(out)])
    assert stop.value.code == 0, capsys.readouterr().err
    results = json.loads((out / "results.json").read_text())
    rows = {row["id"]: row for row in results["quantities"]}
    assert set(rows) == {"S20.gain_per_volt", "S20.eq8_omega_n", "S20.eq8_zeta"}
    gain = rows["S20.gain_per_volt"]
    assert gain["unit"] == "1/V" and "no voltage map is known" in gain["note"]
    # The noise-free run of the same experiment is the truth that the intervals are about.
    for row in rows.values():
        measured = row["measured"]
        assert abs(measured["value"] - row["noise_free"]) < 5.0 * measured["std"]
    (missing,) = results["not_played"]
    assert missing["reason"].startswith("needs the voltage map of [triangle]")
    assert (out / "figures" / "bode-plant.svg").is_file()
