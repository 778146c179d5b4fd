"""Strains and times without a unit are refused where another unit is likely, with the option."""

import json
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.models import Plant, VoltageMap

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


@pytest.mark.parametrize(
    ("rate_hz", "factor", "options", "code", "words"),
    [
        (1000.0, 1e3, (), 2, "in seconds it has 1 rows per second, in milliseconds 1000. State"),
        (10_000.0, 1e3, (), 2, "--unit t=s or --unit t=ms"),
        (1000.0, 1e3, ("--rate-hz", 1000), 2, "They agree if it is in ms: add --unit t=ms"),
        (1000.0, 1e6, ("--rate-hz", 1000), 2, "They agree if it is in us: add --unit t=us"),
        (1000.0, 1e3, ("--rate-hz", 500), 2, "--rate-hz is 500, but column t has 1 rows"),
        (1000.0, 1e3, ("--unit", "t=ms"), 0, ""),
        (5.0, 1.0, ("--unit", "t=s"), 0, ""),
        (5.0, 1.0, ("--rate-hz", 5), 0, ""),  # stated and the same: nothing to ask
        (50.0, 1.0, (), 0, "its values are taken as times in seconds"),
    ],
)
def test_times_without_a_unit_are_not_believed_where_milliseconds_are_as_likely(
    rate_hz, factor, options, code, words, tmp_path, capsys
):
    """A resonance at a tenth of the rate; the same file is sensed or identified."""
    file, rng = tmp_path / "t.csv", np.random.default_rng(1)
    time_s = np.arange(600) / rate_hz
    u = np.repeat(rng.normal(size=60), 10)
    y = Plant(0.7, 0.6 * rate_hz, 0.3).simulate(u, rate_hz, time_s) + 1e-3 * rng.normal(size=600)
    table = np.column_stack([factor * time_s, u, y])
    np.savetxt(file, table, "%.12g", ",", header="t,u,y", comments="")
    with pytest.raises(SystemExit) as ended:
        main(["identify", "transfer", str(file), "--json", *map(str, options)])
    printed = capsys.readouterr()
    assert ended.value.code == code and words in printed.err
    if code == 0:
        found = json.loads(printed.out)["natural_frequency_rad_s"]
        assert abs(found["value"] - 0.6 * rate_hz) < 4.0 * found["std"]
    elif not options:  # the same rule for everything that needs a rate
        for command in (["sense", str(file), "--v", "u", "--i", "y", "--carrier-hz", "0.1"],
                        ["session", "import", str(file), "--v", "u", "--i", "y", "--out",
                         str(tmp_path / "s")]):  # fmt: skip
            with pytest.raises(SystemExit) as ended:
                main(command)
            assert ended.value.code == 2 and words in capsys.readouterr().err
