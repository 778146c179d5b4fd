"""Draws docs/pictures/sensing-triangle.svg: a plain CSV through `haselab sense`."""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import matplotlib
import numpy as np

from haselab.app.main import cli
from haselab.rig.twin.bench import make_twin
from haselab.rig.twin.config import twin_of_reading
from haselab.signals import triangle

matplotlib.use("Agg")
from matplotlib import pyplot as plt

_PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "sensing-triangle.svg"


def _record(path: Path) -> None:
    """One cycle of the study's triangle on the twin, as a plain CSV in volts."""
    rig = make_twin(twin_of_reading("hz"), seed=4)
    rig.generator.sine(2000.0, 0.02)
    blocks = []
    for drive_v in triangle(0.0, 2.0, 0.25, 1, 100.0):
        rig.source.write(float(drive_v))
        blocks.append(rig.acquisition.read())
    rig.safe()
    volts = np.concatenate(blocks) * rig.description.volt_per_code
    np.savetxt(path, volts, "%.6f", ",", header="v_monitor_v,i_monitor_v", comments="")


def _sense(table: Path, method: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    out = table.with_name(f"{method}.csv")
    options = ["--carrier-hz", "2000", "--rate-hz", "200000", "--skew-s", "2.5e-6"]
    blank = ["--blank-s", "0.0035"] if method == "lockin" else []
    cli.main(
        ["sense", str(table), *options, *blank, "--method", method, "--out", str(out)],
        standalone_mode=False,
    )
    with out.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = ("time_s", "capacitance_f", "capacitance_std_f")
    return tuple(np.array([float(row[name]) for row in rows]) for name in columns)  # type: ignore[return-value]


def main() -> None:
    """Record, sense by both methods, draw."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "monitors.csv"
        _record(table)
        sensed = {method: _sense(table, method) for method in ("lockin", "paper")}
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(6.8, 4.6), sharex=True, layout="constrained"
    )
    for method, colour in (("paper", "#d55e00"), ("lockin", "#0072b2")):
        time_s, capacitance_f, std_f = sensed[method]
        above.plot(time_s, 1e9 * capacitance_f, colour, lw=1.0, label=method)
        below.plot(time_s, 1e12 * std_f, colour, lw=0.8, label=method)
    above.set_ylabel("Capacitance (nF)")
    below.set_ylabel("Stated std (pF)")
    below.set_yscale("log")
    below.set_xlabel("Time (s)")
    above.legend()
    _PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(_PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
