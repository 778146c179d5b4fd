"""Draw bench.svg: the bench, a camera frame with tracked points, and a step in closed loop.

    python docs/pictures/draw_bench.py

All data are simulated by the twin. The frame is drawn by the twin's camera at the length that it
measured during the step.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Rectangle
from matplotlib.pyplot import subplots

import haselab as hl
from haselab.rig.twin.camera import TwinCamera
from haselab.rig.twin.config import twin_of_reading

PATH = Path(__file__).resolve().with_name("bench.svg")
CYCLE_V = hl.signals.triangle(0.0, 2.0, 0.25, 1, rate_hz=100.0)
STEP, BEFORE_S, AFTER_S = 0.04, 4.0, 3.0
BLUE, ORANGE, GREY = "#1f5fa8", "#d9730d", "#666666"


def played() -> tuple[hl.Recording, np.ndarray]:
    """A step in closed loop, and the strain that the capacitance gave in each row."""
    rig = hl.twin(frequency_unit="hz", seed=1)
    with hl.Runner(rig) as runner:
        first = runner.play(np.tile(CYCLE_V, 3))  # softens the actuator
    rows = (first["time_s"] > 4.0) & (np.abs(first["drive_v"] - 1.0) < 0.03)
    zero_length_m = first.zero_length_m * (1.0 + first["strain"][rows].mean())
    with hl.Runner(rig, zero_length_m=zero_length_m, frame_rate_hz=100.0) as runner:
        slow = runner.play(np.tile(CYCLE_V, 3))
        to_volt = hl.fit_voltage_map(slow["strain"], slow["drive_v"]).map
        to_strain = hl.fit_strain_map(slow["capacitance_f"], slow["strain"])
        runner.hold(1.0, 40.0)
        chirp = runner.play(1.0 + 0.4 * hl.signals.linear_chirp(0.1, 10.0, 20.0, rate_hz=100.0))
        fit = hl.fit_transfer(chirp.records(through=to_volt))
        limits = to_volt.reach((-0.05, 0.1), low_v=0.0, high_v=2.0)
        actuator = hl.Actuator(to_volt, to_strain, hl.design(fit, limits=limits))
        desired = np.repeat([0.0, STEP], [round(100 * BEFORE_S), round(100 * AFTER_S)])
        runner.hold(1.0, 40.0)
        loop = runner.close_loop(desired, actuator)
    return loop, to_strain.strain(loop["capacitance_f"])


def box(axes: Axes, x: float, y: float, text: str, width: float = 2.6) -> None:
    """A device as a box around its name."""
    patch = FancyBboxPatch(
        (x - width / 2, y - 0.45), width, 0.9, boxstyle="round,pad=0.05,rounding_size=0.15",
        facecolor="white", edgecolor="black", linewidth=1.0,
    )  # fmt: skip
    axes.add_patch(patch)
    axes.text(x, y, text, ha="center", va="center", fontsize=8)


def wire(axes: Axes, points: list[tuple[float, float]], text: str, at: tuple[float, float],
         color: str = "black") -> None:  # fmt: skip
    """A connection that ends with an arrow, and its label."""
    x, y = zip(*points, strict=True)
    axes.plot(x, y, color=color, linewidth=1.2, zorder=0)
    axes.annotate(
        "", xy=points[-1], xytext=points[-2],
        arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.2},
    )  # fmt: skip
    axes.text(*at, text, fontsize=7, color=color, ha="center", va="center")


def draw_bench(axes: Axes) -> None:
    """The devices and their connections."""
    axes.set(xlim=(0.2, 10.5), ylim=(0.0, 8.6), aspect="equal")
    axes.axis("off")
    box(axes, 1.7, 7.6, "function\ngenerator")
    box(axes, 1.7, 4.7, "DAQ")
    box(axes, 1.7, 1.4, "computer\n(haselab)")
    box(axes, 5.2, 6.4, "HV amplifier")
    axes.plot(1.7, 6.4, "o", markersize=13, markerfacecolor="white", color="black", zorder=2)
    axes.text(1.7, 6.37, "+", ha="center", va="center", fontsize=10, zorder=3)
    wire(axes, [(1.7, 7.15), (1.7, 6.65)], "2 kHz", (2.35, 6.93))
    wire(axes, [(1.7, 5.2), (1.7, 6.15)], "drive", (1.15, 5.7))
    wire(axes, [(1.95, 6.4), (3.85, 6.4)], "", (0.0, 0.0))
    wire(axes, [(4.7, 5.9), (4.7, 4.9), (3.05, 4.9)], "monitor V", (3.9, 5.13), BLUE)
    wire(axes, [(5.2, 5.9), (5.2, 4.5), (3.05, 4.5)], "monitor I", (4.2, 4.27), BLUE)
    wire(axes, [(6.55, 6.4), (8.9, 6.4)], "0 to 10 kV", (7.65, 6.68), "#b00020")
    wire(axes, [(1.5, 4.2), (1.5, 1.9)], "V, I", (1.1, 3.1), BLUE)
    wire(axes, [(1.9, 1.9), (1.9, 4.2)], "drive", (2.4, 3.1))
    for x, y, width, height, colour in (
        (8.7, 6.95, 1.6, 0.3, "0.75"), (8.9, 4.5, 1.2, 2.45, "#cfe0f3"),
        (8.7, 4.2, 1.6, 0.3, "0.75"), (8.9, 2.9, 1.2, 0.7, "0.45"),
    ):  # fmt: skip
        axes.add_patch(Rectangle((x, y), width, height, facecolor=colour, edgecolor="black"))
    axes.text(9.5, 5.6, "HASEL", ha="center", va="center", fontsize=8)
    axes.plot([9.5, 9.5], [4.2, 3.6], color="black", linewidth=1.0)
    axes.text(9.5, 3.25, "0.25 kg", ha="center", va="center", fontsize=7, color="white")
    box(axes, 6.4, 2.4, "camera", 1.7)
    for y in (4.35, 7.1):
        axes.plot([7.3, 8.6], [2.6, y], color=GREY, linewidth=0.8, linestyle=":")
    wire(axes, [(5.5, 2.4), (4.4, 2.4), (4.4, 1.4), (3.05, 1.4)], "frames", (3.7, 1.65), ORANGE)
    axes.set_title("1. The bench", fontsize=9, loc="left")


def draw_frame(axes: Axes, loop: hl.Recording) -> None:
    """The first and the last position of tracked points on a frame."""
    config = twin_of_reading("hz")
    law = config.law
    camera = TwinCamera(config.camera, 0.5 * law.width_m, law.free_length_m, seed=1)
    ends_m = [loop.length_m[0], loop.length_m[-50:].mean()]
    lengths_m = np.repeat(ends_m, [10, 2])[:, None] * np.ones(camera.config.exposure_samples)
    frames = camera.render(lengths_m, first_index=0)
    tracks = hl.track(frames, rest_frames=10).to_pandas()
    first, last = (tracks[tracks.frame == k] for k in (0, 11))
    axes.imshow(frames[-1][:300], cmap="gray", vmin=30, vmax=255)
    axes.plot(last.x_px, last.y_px, "o", markersize=5, markerfacecolor="none", color=ORANGE)
    axes.set(xticks=[], yticks=[])
    down_px = last.y_px.to_numpy() - first.y_px.to_numpy()
    axes.set_title("2. A camera frame, with tracked points", fontsize=9, loc="left")
    axes.set_xlabel(
        f"{len(first)} points, moved down by up to {np.nanmax(down_px):.1f} px", fontsize=8
    )


def draw_loop(axes: Axes, loop: hl.Recording, sensed: np.ndarray) -> None:
    """Desired strain, sensed strain and the strain of the camera."""
    time_s = loop["time_s"] - BEFORE_S
    axes.step(time_s, 100 * loop["reference"], color="black", linewidth=1.0, label="desired")
    axes.plot(
        time_s, 100 * sensed, color=BLUE, linewidth=1.4, label="self-sensed (the loop uses it)"
    )
    every = slice(None, None, 2)
    camera_s = loop.frame_s - loop.start_s[0] - BEFORE_S
    axes.plot(camera_s[every], 100 * loop.strain[every], ".", markersize=3, color=ORANGE,
              label="camera (a check)")  # fmt: skip
    axes.set(xlim=(-0.5, 2.0), xlabel="Time after the step (s)", ylabel="Strain (%)")
    axes.legend(fontsize=8, loc="lower right", frameon=False)
    axes.set_title("3. A step in closed loop", fontsize=9, loc="left")


def main() -> None:
    """Play the twin and write the picture."""
    mpl.rcParams.update({
        "svg.fonttype": "path", "svg.hashsalt": "haselab", "font.size": 8,
        "axes.spines.top": False, "axes.spines.right": False,
    })  # fmt: skip
    loop, sensed = played()
    figure, axes = subplots(
        1, 3, figsize=(12.5, 3.7), layout="constrained", width_ratios=[4.6, 4.6, 4.4]
    )
    draw_bench(axes[0])
    draw_frame(axes[1], loop)
    draw_loop(axes[2], loop, sensed)
    figure.text(0.005, 0.02, "SIMULATED by the twin", fontsize=8, color=GREY)
    figure.savefig(PATH, metadata={"Date": None}, facecolor="white")
    print(f"{PATH.name}: {PATH.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
