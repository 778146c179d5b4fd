"""A fit that refuses what the run itself recorded: exit 3; recording and other results are kept."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from haselab.base import InputError, ResultError
from haselab.cli.main import main
from haselab.study import definition, pipeline
from haselab.study.definition import builtin_study
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import Loops
from haselab.study.fits.maps import Maps
from haselab.study.fits.paper_chain import PrintedChain
from haselab.study.fits.point import Point
from haselab.study.fits.static import Static
from haselab.study.fits.trials import Comparison

# Where each experiment calls its fit, and what the message names.
FITS = {
    "static_load.fit_static": "Static load",
    "operating_point.find_point": "Operating point",
    "triangle.fit_maps": "Maps",
    "triangle._chain": "Paper's sensing chain",
    "free_response.fit_free": "Free response",
    "chirp.fit_chirp_and_steps": "Transfer function",
    "design.design_loops": "Controllers",
    "steps.compare_trials": "Step trials",
}
GIVEN = {
    "static_load.fit_static": Static,
    "operating_point.find_point": Point,
    "triangle.fit_maps": Maps,
    "triangle._chain": PrintedChain,
    "chirp.fit_chirp_and_steps": Dynamics,
    "design.design_loops": Loops,
}


class _Anything:
    """Stands for every result of a fit that went well."""

    def __getattr__(self, name: str) -> Any:
        return {} if name in {"quantities", "notes", "figures", "groups", "missing"} else self


def _stand_in(kind: type) -> Any:
    """A value of a type, so that other experiments find it, without its numbers."""
    empty = {"quantities", "notes", "figures"}

    def attribute(self: Any, name: str) -> Any:
        return {} if name in empty else _Anything()

    return type(kind.__name__, (kind,), {"__init__": lambda self: None, "__getattr__": attribute})()


def _refuse(*_: object, **__: object) -> None:
    raise InputError("y has 3 samples; needed are 8. Record for longer.")


@pytest.mark.parametrize("failing", FITS)
def test_a_fit_that_refuses_recorded_data_is_a_missing_result(
    failing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = "haselab.study.experiments."
    for name in FITS:
        stand_in = _stand_in(GIVEN[name]) if name in GIVEN else _Anything()
        if name == "steps.compare_trials":
            stand_in = Comparison({}, {}, {}, 0.0)
        monkeypatch.setattr(where + name, lambda *_, value=stand_in, **__: value)
    fixed = {"design.measured_latency": 0.0, "free_response._against_chirp": {}}
    for name, value in (fixed | {"free_response._discussed": ""}).items():
        monkeypatch.setattr(where + name, lambda *_, value=value: value)
    monkeypatch.setattr(where + "steps.further_trials", lambda *_: _Anything())
    for name in ("triangle", "operating_point"):
        monkeypatch.setattr(f"{where}{name}.Cycles.of", lambda *_: _Anything())
    monkeypatch.setattr(where + failing, _refuse)
    found = pipeline.play_and_fit(lambda name: _Anything(), builtin_study(quick=True), _Anything())
    assert len(found.failed) == 1, "one cause, named once"
    with pytest.raises(ResultError, match=rf"{FITS[failing]}.*y has 3 samples.*are kept\. There\."):
        found.require_complete("There.")


def test_a_reason_without_a_full_stop_gets_one() -> None:
    found = pipeline.Findings({}, {}, {}, failed=("no sense in it", "nor here"))
    with pytest.raises(
        ResultError, match=r"^no sense in it\. .* another reason: 1 more\. There\.$"
    ):
        found.require_complete("There.")


def test_a_missing_experiment_is_still_bad_input() -> None:
    def source(name: str) -> Any:
        raise InputError(f"The session holds no experiment {name}.")

    with pytest.raises(InputError, match="no experiment triangle"):
        pipeline.play_and_fit(source, builtin_study(quick=True), _Anything())


def test_a_run_whose_fit_refuses_its_data_exits_with_3_and_keeps_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("haselab.study.experiments.triangle.fit_maps", _refuse)
    builtin = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"
    short = re.sub(
        r"(\[triangle\][^[]*?)frequency_hz = [\d.]+", r"\1frequency_hz = 1.0", builtin.read_text()
    )
    (tmp_path / "study.toml").write_text(short)
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    with pytest.raises(SystemExit) as stop:
        main(["run", str(tmp_path / "study.toml"), "--rig", str(tmp_path / "rig.toml"), "--quick",
              "--keep-video", "none", "--out", str(tmp_path / "out")])  # fmt: skip
    printed = capsys.readouterr().err
    assert stop.value.code == 3, printed
    assert printed.count("\n") == 1
    assert (tmp_path / "out" / "session.h5").is_file()
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    (missing,) = [one for one in results["not_played"] if "y has 3 samples" in one["reason"]]
    assert {"S14.a1", "S24.rise_open"} <= set(missing["ids"])
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert "y has 3 samples" in manifest["ended"]
