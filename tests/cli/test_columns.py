"""Strains in per cent whose file states no unit are refused, with the option that states it."""

from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.models import VoltageMap

STRAIN = 0.04 - 0.04 * np.cos(np.linspace(0.0, 25.0, 800))
VOLTS = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(STRAIN)


def put(folder: Path, strain: np.ndarray) -> str:
    path = folder / "a.csv"
    columns = np.column_stack([np.arange(800) / 100.0, VOLTS, 5e-10 * (1 + 2 * STRAIN), strain])
    head = "time_s,voltage_v,capacitance_f,strain"
    np.savetxt(path, columns, delimiter=",", header=head, comments="")
    return str(path)


def code_of(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    "command",
    [
        ["voltage-map"],
        ["capacitance-map"],
        ["transfer", "--input", "voltage_v", "--output", "strain"],
    ],
)
def test_a_strain_above_one_needs_a_unit(tmp_path, capsys, command):
    path = put(tmp_path, 50.0 * STRAIN)  # up to 4 %
    assert code_of("identify", *command, path) == 2
    error = capsys.readouterr().err
    assert "Column strain reaches 4 and states no unit" in error
    assert "Add --unit 'strain=%' if it is in per cent, --unit 'strain=1' if it is a" in error
    if command[0] == "transfer":
        return
    for unit in ("%", "1"):
        assert code_of("identify", *command, path, "--unit", f"strain={unit}") == 0


def test_a_strain_far_above_the_map_of_the_actuator_needs_a_unit(tmp_path, capsys):
    actuator = str(tmp_path / "A.toml")
    assert code_of("init", "a", "--out", actuator) == 0
    maps = ["identify", "capacitance-map", "--actuator", actuator]
    assert code_of(*maps, put(tmp_path, STRAIN)) == 0
    wanted = ["identify", "voltage-map", "--actuator", actuator]
    assert code_of(*wanted, put(tmp_path, 9.0 * STRAIN)) == 0  # a larger motion is possible
    capsys.readouterr()
    path = put(tmp_path, 12.0 * STRAIN)  # 0.96 %
    assert code_of(*wanted, path) == 2
    reason = "reaches 0.96 and states no unit, but [sensing.strain_map] of the actuator file ends"
    assert reason in capsys.readouterr().err
    assert code_of(*wanted, path, "--unit", "strain=%") == 0
    assert code_of(*maps, put(tmp_path, 100.0 * STRAIN)) == 2
    assert "but [drive.voltage_map] of the actuator file ends" in capsys.readouterr().err
