"""Draws the pictures of docs/measure/sensing.md and docs/measure/how-self-sensing-works.md.

    python -m benchmarks.sensing.pictures [docs/pictures/measure]

Two minutes on one core. What each picture is of: `pictures_error.py` has the errors
beside their bound, `pictures_bench.py` what is done on the twin.
"""

import csv
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.sensing.pictures_bench import bench_figures
from benchmarks.sensing.pictures_error import draw_error, draw_steps
from haselab.cli.main import cli
from haselab.report.style import BLUE, RED, figure_style, to_svg
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.signals import triangle

TITLES = {
    "sensing-triangle": "Capacitance of one triangle cycle, and its stated standard deviation",
    "sensing-error": "Error of capacitance over its bound against amplitude, ramp and frequency",
    "sensing-steps": "Error of capacitance over its bound with a step in each block",
    "sensing-calibration": "Errors over known loads before and after calibration",
    "sensing-strain": "Strain from the monitors beside the camera's",
    "sensing-carrier": "What each carrier costs, and the study's 2 kHz",
}


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


def _sense(table: Path, method: str) -> dict[str, np.ndarray]:
    out = table.with_name(f"{method}.csv")
    options = ["--carrier-hz", "2000", "--rate-hz", "200000", "--skew-s", "2.5e-6"]
    cli.main(
        ["sense", str(table), *options, "--method", method, "--out", str(out)],
        standalone_mode=False,
    )
    with out.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = ("time_s", "capacitance_f", "capacitance_std_f")
    return {name: np.array([float(row[name]) for row in rows]) for name in names}


def draw_triangle() -> Figure:
    """A plain CSV through `haselab sense`, by two methods."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "monitors.csv"
        _record(table)
        sensed = {method: _sense(table, method) for method in ("paper", "lockin")}
    figure = Figure(figsize=(6.8, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for method, colour in (("paper", RED), ("lockin", BLUE)):
        rows = sensed[method]
        above.plot(rows["time_s"], 1e9 * rows["capacitance_f"], color=colour, label=method)
        claimed = 1e12 * rows["capacitance_std_f"]
        below.plot(rows["time_s"], claimed, color=colour, lw=0.8, label=method)
        # Third differences of a smooth curve are noise alone: their variance is 20 of it.
        third = np.diff(rows["capacitance_f"], n=3)
        print(f"{method}: claimed {np.nanmedian(claimed):.3g} pF, scatter "
              f"{1e12 * np.nanmedian(np.abs(third)) / 0.6745 / np.sqrt(20):.3g} pF")  # fmt: skip
    above.set_ylabel("capacitance / nF")
    below.set(xlabel="time / s", ylabel="claimed std / pF", yscale="log")
    above.legend()
    return figure


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with figure_style():
        figures = {
            "sensing-triangle": draw_triangle(),
            "sensing-error": draw_error(),
            "sensing-steps": draw_steps(),
            **bench_figures(),
        }
        for name, figure in figures.items():
            svg = to_svg(figure, name, TITLES[name])
            (folder / f"{name}.svg").write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "measure"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
