"""The feedthrough of an actuator file: stated, measured by a study, or by the physical model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from haselab.actuators import (
    ActuatorLaw,
    CurlingHasel,
    DeaStack,
    PeanoHasel,
    PlanarHasel,
    equilibrium_m,
    feedthrough,
    linearise,
)
from haselab.base import InputError
from haselab.cli.main import cli
from haselab.control import LoopSetting, Saturation
from haselab.control.feedthrough import with_feedthrough
from haselab.controllers import KnownActuator
from haselab.models.actuator import ActuatorTables

_MODEL = """
[model]
gain = 0.9133
natural_frequency_rad_s = 44.06
damping_ratio = 1.242
slow_modes = [{gain = 0.0517, time_constant_s = 0.818}]
rate_hz = 100.0
loop_delay_s = 0.00565
"""
_MAP = """
[sensing.strain_map]
slope_per_f = 1e9
offset = -0.4
"""
_ZERO_M = equilibrium_m(PeanoHasel(), 4500.0, 0.1 * 9.80665)  # of a Peano-HASEL with 0.1 kg
_GAINS = ["--kp", "1.499", "--ki", "38.6", "--kd", "0.0438", "--derivative-filter-s", "0.05404"]


def _margins(path: Path, text: str) -> dict[str, float]:
    path.write_text(text, encoding="utf-8")
    found = CliRunner().invoke(cli, ["margins", str(path), *_GAINS, "--json"])
    assert found.exit_code == 0, found.output
    answer: dict[str, float] = json.loads(found.stdout)
    return answer


@pytest.mark.parametrize(
    ("law", "load_n"), [(PlanarHasel(), 2.45), (DeaStack(), 1.0), (PeanoHasel(), 1.0),
                        (CurlingHasel(curl_rad=0.6), 0.3)],
)  # fmt: skip
def test_the_share_is_what_a_held_length_keeps_of_a_change(law: ActuatorLaw, load_n: float) -> None:
    """By the law itself: the capacitance at the old length, over that at the new equilibrium."""
    low_v, high_v = 5000.0, 5010.0
    old_m, new_m = (equilibrium_m(law, volt, load_n) for volt in (low_v, high_v))
    before, held, after = (
        float(law.differential_capacitance_f(length, volt))
        for length, volt in ((old_m, low_v), (old_m, high_v), (new_m, high_v))
    )
    middle_v = 0.5 * (low_v + high_v)
    point = linearise(law, middle_v, load_n, load_n / 9.81)
    found = feedthrough(law, point.length_m, middle_v, point.gain_m_per_v)
    # 10 V change both slopes by less than 1 %, and the softening of a new elastomer one of them
    assert found == pytest.approx((held - before) / (after - before), rel=0.05, abs=1e-3)
    assert (found > 0.1) == isinstance(law, PeanoHasel | CurlingHasel)


def test_a_known_actuator_has_the_share_of_its_law() -> None:
    known = KnownActuator(PeanoHasel(), 0.1, _ZERO_M, 0.0, 1.6, 5000.0)
    low, high = known.reachable()
    strain = 0.5 * (low + high)
    volt = 5000.0 * known.static_drive_v(strain)
    point = linearise(known.law, volt, 0.1 * 9.80665, 0.1)
    wanted = feedthrough(known.law, point.length_m, volt, point.gain_m_per_v)
    assert known.feedthrough(strain) == pytest.approx(wanted, rel=0.02)
    assert known.feedthrough(high) > known.feedthrough(low)  # largest where it is slack
    planar = KnownActuator(PlanarHasel(), 0.25, 0.0965, 0.0, 1.6, 5000.0)
    assert planar.feedthrough(0.0) == 0.0


def test_the_margins_of_a_file_are_those_with_its_share(tmp_path: Path) -> None:
    path = tmp_path / "actuator.toml"
    plain = _margins(path, _MODEL + _MAP)
    assert plain["stable"]
    assert plain["phase_margin_deg"] == pytest.approx(54.6, abs=0.3)
    shared = _margins(path, _MODEL + _MAP + "feedthrough = 0.8\nfeedthrough_std = 0.01\n")
    assert not shared["stable"]
    text = _MODEL + _MAP + "feedthrough = 1.2\n"
    path.write_text(text, encoding="utf-8")
    refused = CliRunner().invoke(cli, ["margins", str(path), *_GAINS])
    assert isinstance(refused.exception, InputError)
    assert "sensing.strain_map.feedthrough: must be less than or equal to 0.98" in str(
        refused.exception
    )


def test_a_design_reports_its_share_and_keeps_the_margins_with_it(tmp_path: Path) -> None:
    path = tmp_path / "actuator.toml"
    share = "feedthrough = 0.8\nfeedthrough_std = 0.01\n"
    path.write_text(_MODEL + _MAP + share, encoding="utf-8")
    found = CliRunner().invoke(cli, ["design", str(path), "--limits", "-0.01", "0.01", "--json"])
    assert found.exit_code == 0, found.output
    answer = json.loads(found.stdout)
    assert answer["feedthrough"] == 0.8
    assert answer["feedthrough_range"] == pytest.approx([0.78, 0.82])
    again = CliRunner().invoke(cli, ["margins", str(path), "--json"])
    assert json.loads(again.stdout)["stable"]
    assert json.loads(again.stdout)["phase_margin_deg"] == pytest.approx(
        answer["phase_margin_deg"], rel=1e-6
    )


def test_the_share_of_a_physical_model_is_that_of_its_limits() -> None:
    known = KnownActuator(PeanoHasel(), 0.1, _ZERO_M, 0.0, 1.6, 5000.0)
    low, high = known.sensed_range()
    physical = {"kind": "peano-hasel", "status": "ok", "parameters": {}, "mass_kg": 0.1}
    tables = ActuatorTables.model_validate({
        "actuator": {"kind": "peano-hasel", "geometry": {"zero_length_m": _ZERO_M}},
        "drive": {"low_v": 0.0, "high_v": 1.6, "gain_v_per_v": 5000.0},
        "model": {"physical": physical},
    })  # fmt: skip
    setting = LoopSetting(saturation=Saturation(low + 0.01, min(high, 0.005)))
    found = with_feedthrough(setting, tables)
    assert found.feedthrough_range is not None
    shares = [known.feedthrough(s) for s in np.linspace(low + 0.01, min(high, 0.005), 9)]
    assert found.feedthrough_range == pytest.approx((min(shares), max(shares)), rel=1e-6)
    assert found.feedthrough_range[0] < found.feedthrough < found.feedthrough_range[1]
    wrong = tables.model_copy(deep=True)
    bad = ActuatorTables.model_validate({
        **wrong.model_dump(exclude_none=True),
        "model": {"physical": physical | {"status": "model error"}},
    })  # fmt: skip
    assert with_feedthrough(setting, bad) == setting


@pytest.mark.parametrize("kind", ["planar-hasel", "dea-stack", "peano-hasel", "curling-hasel"])
def test_only_kinds_with_pouches_ask_for_their_feedthrough(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "actuator.toml"
    path.write_text(f'[actuator]\nkind = "{kind}"\n' + _MODEL + _MAP, encoding="utf-8")
    found = CliRunner().invoke(cli, ["margins", str(path), *_GAINS, "--json"])
    asked = "follows the drive in part at once" in found.stderr
    assert asked == (kind in ("peano-hasel", "curling-hasel"))
