"""A fit that refuses what the run itself recorded: no result, exit 3, and the recording is kept."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from haselab.base import InputError, ResultError
from haselab.cli.main import main
from haselab.study import definition, pipeline
from haselab.study.definition import builtin_study

FITS = {
    "fit_static": "Static load",
    "find_point": "Operating point",
    "fit_maps": "Maps",
    "_chain": "Paper's sensing chain",
    "fit_free": "Free response",
    "fit_chirp_and_steps": "Transfer function",
    "design_loops": "Controllers",
    "compare_trials": "Step trials",
}


class _Anything:
    """Stands for every result of a fit that went well."""

    def __getattr__(self, name: str) -> Any:
        return {} if name in {"quantities", "notes", "figures"} else self


def _refuse(*_: object, **__: object) -> None:
    raise InputError("y has 3 samples; needed are 8. Record for longer.")


@pytest.mark.parametrize("failing", FITS)
def test_a_fit_that_refuses_recorded_data_is_a_missing_result(
    failing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in FITS:
        monkeypatch.setattr(pipeline, name, lambda *_, **__: _Anything())
    for name, value in (("measured_latency", 0.0), ("_against_chirp", {})):
        monkeypatch.setattr(pipeline, name, lambda *_, value=value: value)
    monkeypatch.setattr(pipeline, "further_trials", lambda *_: ({}, {}))
    monkeypatch.setattr(pipeline.Cycles, "of", lambda *_: _Anything())
    monkeypatch.setattr(pipeline, failing, _refuse)
    with pytest.raises(ResultError, match=rf"{FITS[failing]}.*y has 3 samples.*is kept"):
        pipeline.investigate(lambda name: _Anything(), builtin_study(quick=True), _Anything())


def test_a_missing_experiment_is_still_bad_input() -> None:
    def source(name: str) -> Any:
        raise InputError(f"The session holds no experiment {name}.")

    with pytest.raises(InputError, match="no experiment triangle"):
        pipeline.investigate(source, builtin_study(quick=True), _Anything())


def test_a_run_whose_fit_refuses_its_data_exits_with_3_and_keeps_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pipeline, "fit_maps", _refuse)
    builtin = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"
    short = re.sub(
        r"(\[triangle\][^[]*?)frequency_hz = [\d.]+", r"\1frequency_hz = 2.0", builtin.read_text()
    )
    (tmp_path / "study.toml").write_text(short)
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    with pytest.raises(SystemExit) as stop:
        main(["run", str(tmp_path / "study.toml"), "--rig", str(tmp_path / "rig.toml"), "--quick",
              "--keep-video", "none", "--out", str(tmp_path / "out")])  # fmt: skip
    told = capsys.readouterr().err
    assert stop.value.code == 3, told
    assert told.count("\n") == 1
    assert (tmp_path / "out" / "session.h5").is_file()
