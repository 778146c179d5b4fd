"""A design from a fit, and what an actuator file knows."""

import json

import numpy as np
import pytest

import haselab as hl
from haselab.base import InputError
from haselab.cli.main import main
from haselab.controllers.builtin import pid_controller
from haselab.models import Plant, RationalModel, VoltageMap
from haselab.models.actuator.strain_map import StrainMap
from tests.cli.model.physical_files import ZERO_M, written

PLANT = hl.Plant(1.0, 32.0, 0.3)
TO_VOLT = VoltageMap(1.3, 3.1, -0.28, -26.9)
TO_STRAIN = StrainMap(4.9e8, -0.27)
FILE = """
[drive.voltage_map]
a1_v = 1.3
b1 = 3.1
a2_v = -0.28
b2 = -26.9
[sensing.strain_map]
slope_per_f = 4.9e8
offset = -0.27
[model]
gain = 1.0
natural_frequency_rad_s = 32.0
damping_ratio = 0.3
delay_s = 0.0
slow_modes = []
[controller]
kind = "pi"
parameters = { kp = 0.5, ki = 2.0 }
limits = { low = -0.02, high = 0.08 }
"""


@pytest.mark.long
def test_a_fit_brings_the_plausible_plants_with_it():
    u = np.random.default_rng(1).normal(size=1500)
    time_s = np.arange(1500) / 100.0
    y = PLANT.simulate(u, 100.0, time_s) + 0.01 * np.random.default_rng(2).normal(size=1500)
    fit = hl.fit_transfer(hl.Record(u, 100.0, y, time_s))
    found = hl.design(fit, {"phase_margin_deg": 60.0}, limits=(-0.02, 0.08))
    assert found.plausible is not None
    assert found.setting.saturation.high == 0.08
    assert hl.Actuator(TO_VOLT, TO_STRAIN, found).loop().saturation.low == -0.02
    assert "phase_margin_deg" in found._repr_html_()


@pytest.mark.long
def test_python_and_the_command_make_the_same_design(tmp_path, capsys):
    u = np.random.default_rng(1).normal(size=1500)
    time_s = np.arange(1500) / 100.0
    y = PLANT.simulate(u, 100.0, time_s) + 0.01 * np.random.default_rng(2).normal(size=1500)
    data, model = tmp_path / "chirp.csv", tmp_path / "model.json"
    np.savetxt(
        data, np.column_stack([time_s, u, y]), "%.17g", ",", header="time_s,u,y", comments=""
    )
    arguments = ["identify", "transfer", data, "--input", "u", "--output", "y", "--out", model]
    for line in (arguments, ["design", model, "--json"]):
        with pytest.raises(SystemExit) as stop:
            main([str(word) for word in line])
        out = capsys.readouterr().out
        assert stop.value.code == 0
    command = json.loads(out)
    found = hl.design(hl.fit_transfer(hl.Record(u, 100.0, y, time_s)))
    for name in ("kp", "ki", "kd", "derivative_filter_s"):
        assert command[name] == pytest.approx(getattr(found.gains, name), rel=1e-6, abs=1e-12)
    assert found.gains.kd > 0.0 and found.setting.measurement_delay_s == 0.01


def test_the_usual_limits_are_for_a_model_from_strain_to_strain():
    metres_per_volt = Plant(3.1e-6, 60.0, 0.2)
    with pytest.raises(InputError, match=r"gain of the model is 3.1e-06.*Give limits=\(LOW"):
        hl.design(metres_per_volt)
    found = hl.design(metres_per_volt, limits=(0.0, 5000.0))
    assert "with an output of 0 to 5000, 100 Hz and a delay of 0.01 s" in found.summary()
    assert found.spec.step == pytest.approx(0.5 * 3.1e-6 * 5000.0)


def test_what_cannot_be_designed_is_refused():
    with pytest.raises(InputError, match="controller is 'lqg'"):
        hl.design(PLANT, controller="lqg")
    with pytest.raises(InputError, match="covariance of the model"):
        hl.design(PLANT, probability=0.9)


def test_an_actuator_file_gives_its_maps_model_and_controller(tmp_path):
    path = tmp_path / "actuator.toml"
    path.write_text(FILE)
    found = hl.Actuator.load(path)
    assert found.plant == PLANT
    loop = found.loop()
    assert loop.controller.summary() == "pi, kp = 0.5, ki = 2 1/s"
    assert (loop.saturation.low, loop.saturation.high) == (-0.02, 0.08)
    assert loop.voltage_map.voltage_v(0.01) == pytest.approx(TO_VOLT.voltage_v(0.01))


def test_a_loop_needs_both_maps_and_a_controller():
    chosen = pid_controller(0.5, 2.0, 0.0, 0.0)
    for known, lacks in (
        (hl.Actuator(None, TO_STRAIN, chosen), r"drive\.voltage_map"),
        (hl.Actuator(TO_VOLT, None, chosen), r"sensing\.strain_map"),
        (hl.Actuator(TO_VOLT, TO_STRAIN), "controller"),
    ):
        with pytest.raises(InputError, match=lacks):
            known.loop()


def with_observer(path, **absent):
    """The twin's own actuator file with a controller that uses the physical model."""
    text = written(path).read_text().replace(
        "[drive]\n",
        "[drive]\nlow_v = 0.0\nhigh_v = 2.0\n"
        "voltage_map = { a1_v = 1.588, b1 = 1.688, a2_v = -0.605, b2 = -22.05 }\n",
    )  # fmt: skip
    text = text.replace(f"zero_length_m = {ZERO_M}", "zero_length_m = 0.05114")  # of the maps
    for key in absent:
        text = text.replace(key, "# " + key)
    path.write_text(
        text
        + "[sensing.strain_map]\nslope_per_f = 1.053e9\noffset = -0.4339\n"
        + "curvature_per_f2 = -6.163e17\ncubic_per_f3 = 1.811e26\n"
        + '[controller]\nkind = "observer"\nlimits = { low = -0.05, high = 0.27 }\n'
        + "[controller.parameters]\nbandwidth_rad_s = 26.8\nload_n = 0.5\nshake_m_s2 = 0.01\n"
        + "reserve = 0.15\n"
    )
    return path


def test_a_controller_of_the_physical_model_closes_a_loop_in_python(tmp_path):
    known = hl.Actuator.load(with_observer(tmp_path / "actuator.toml"))
    assert known.physical is not None
    with hl.Runner(hl.twin(seed=1), baseline_v=1.0) as runner:
        found = runner.close_loop(np.repeat([0.0, 0.03], 150), known)
    sensed = known.strain_map.strain(found.capacitance_f)
    assert sensed[120:150].mean() == pytest.approx(0.0, abs=1e-3)
    assert sensed[-30:].mean() == pytest.approx(0.03, abs=1e-3)


def test_a_file_without_what_its_controller_needs_says_what_is_missing(tmp_path):
    path = with_observer(tmp_path / "actuator.toml", high_v=None)
    with pytest.raises(InputError, match=r"needs drive\.high_v for a controller"):
        hl.Actuator.load(path)


def test_an_actuator_file_may_have_a_model_in_general_form(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("[model]\nnumerator = [800.0]\ndenominator = [0.1, 3.0, 120.0, 1000.0]\n")
    plant = hl.Actuator.load(path).plant
    assert isinstance(plant, RationalModel) and plant.denominator == (1.0, 30.0, 1200.0, 10000.0)
    path.write_text("[model]\nnumerator = [1000.0]\ndenominator = [1.0, 20.0, 1000.0]\n")
    plant = hl.Actuator.load(path).plant  # one resonance
    assert isinstance(plant, hl.Plant)
    assert plant.natural_frequency_rad_s == pytest.approx(1000.0**0.5)
