"""Figure 3: the triangle test and the two maps identified from it."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from haselab.report.analysis import Section
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREEN, GREY, RED, band, legend_below, scale_by, thinned

__all__ = ["PLAN"]

_KV_PER_DAQ_VOLT = 5.0
_SAMPLES_DRAWN = 4000


def _add_kv(axes: Axes) -> None:
    """Right-hand axis: the voltage at the output of the amplifier."""
    right = axes.secondary_yaxis("right", functions=scale_by(_KV_PER_DAQ_VOLT))
    right.set_ylabel("Actuator (kV)")


def _triangle(host: FigureBase, run: RunFolder) -> None:
    section = run.section("triangle")
    time_s = section.array("time_s")
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    drive, strain, capacitance = host.subplots(
        3, 1, sharex=True, gridspec_kw={"height_ratios": (2, 3, 3)}
    )
    drive.plot(time_s[step], section.array("drive_v", like=time_s)[step], color=GREY)
    drive.set_ylabel("DAQ output (V)")
    _add_kv(drive)
    percent = 100.0 * section.array("strain", like=time_s)
    std = section.optional("strain_std", like=time_s)
    strain.plot(time_s[step], percent[step], color=BLUE)
    band(strain, time_s[step], percent[step], None if std is None else 100.0 * std[step], BLUE)
    strain.set_ylabel("Strain (%)")
    farad = section.optional("capacitance_f", like=time_s)
    if farad is not None:
        capacitance.plot(time_s[step], 1e9 * farad[step], color=GREEN)
        capacitance.set_ylabel("Capacitance (nF)")
    else:
        relative = section.array("relative_capacitance", like=time_s)
        capacitance.plot(time_s[step], relative[step], color=GREEN)
        capacitance.set_ylabel("Rel. capacitance (a.u.)")
    capacitance.set_xlabel("Time (s)")
    host.align_ylabels()


def _voltage_map(host: FigureBase, run: RunFolder) -> None:
    section = run.section("voltage_map")
    strain = section.array("strain")
    fit_strain = section.array("fit_strain")
    step = thinned(strain.size, _SAMPLES_DRAWN)
    axes = host.subplots()
    axes.plot(
        100.0 * strain[step],
        section.array("voltage_v", like=strain)[step],
        color=BLUE,
        linewidth=0.8,
        alpha=0.8,
        label="measured loop",
    )
    fit_v = section.array("fit_voltage_v", like=fit_strain)
    axes.plot(100.0 * fit_strain, fit_v, color=RED, linewidth=2.0, label="two exponentials")
    paper_v = section.optional("paper_voltage_v", like=fit_strain)
    if paper_v is not None:
        axes.plot(100.0 * fit_strain, paper_v, color="black", linestyle="--", label="paper, eq. 4")
    axes.set_xlabel("Strain about the operating point (%)")
    axes.set_ylabel("DAQ output (V)")
    _add_kv(axes)
    axes.legend(loc="best")


def _capacitance_map(host: FigureBase, run: RunFolder) -> None:
    section = run.section("capacitance_map")
    if "relative_capacitance" not in section and "each_capacitance_f" in section:
        _map_of_loops(host, section)
        return
    relative = section.array("relative_capacitance")
    fit_relative = section.array("fit_relative_capacitance")
    axes = host.subplots()
    each = section.optional("each_relative_capacitance")
    if each is not None:
        axes.plot(
            each,
            100.0 * section.array("each_strain", like=each),
            ".",
            color=GREY,
            markersize=2,
            alpha=0.4,
            rasterized=each.size > 400,
            label="single buffers",
        )
    axes.plot(
        relative,
        100.0 * section.array("strain", like=relative),
        ".",
        color=BLUE,
        markersize=3,
        alpha=0.6,
        rasterized=relative.size > 400,
        label="edges averaged over time",
    )
    axes.plot(
        fit_relative,
        100.0 * section.array("fit_strain", like=fit_relative),
        color=RED,
        linewidth=2.0,
        label="straight line",
    )
    axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
    axes.set_xlabel("Relative capacitance (a.u.)")
    axes.set_ylabel("Strain (%)")
    axes.legend(loc="best")


def _map_of_loops(host: FigureBase, section: Section) -> None:
    """Strain against capacitance in nF, with the map that the loops use."""
    axes = host.subplots()
    each_f = section.array("each_capacitance_f")
    axes.plot(
        1e9 * each_f, 100.0 * section.array("each_strain", like=each_f), ".", color=GREY,
        markersize=2, alpha=0.4, rasterized=each_f.size > 400, label="single blocks",
    )  # fmt: skip
    farad = section.array("map_capacitance_f")
    percent = 100.0 * section.array("map_strain", like=farad)
    axes.plot(1e9 * farad, percent, color=RED, linewidth=2.0, label="map of the loops")
    ends = section.optional("reconstructed_band")
    if ends is not None and ends.size == 2:
        low, high = (percent + 100.0 * end for end in ends)
        axes.fill_between(1e9 * farad, low, high, color=RED, alpha=0.2, linewidth=0.0,
                          label="its 95 % band")  # fmt: skip
    axes.set_xlabel("Capacitance (nF)")
    axes.set_ylabel("Strain (%)")
    axes.legend(loc="best")


def _reconstruction(host: FigureBase, run: RunFolder) -> None:
    section = run.section("capacitance_map")
    time_s = section.array("time_s")
    tracked = 100.0 * section.array("strain_time", like=time_s)
    rebuilt = 100.0 * section.array("reconstructed_strain", like=time_s)
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    axes = host.subplots()
    band = section.optional("reconstructed_band")
    if band is not None and band.size == 2:
        low, high = (rebuilt[step] + 100.0 * end for end in band)
        axes.fill_between(time_s[step], low, high, color=RED, alpha=0.2, linewidth=0.0,
                          label="its 95 % band")  # fmt: skip
    axes.plot(time_s[step], tracked[step], color=BLUE, linewidth=1.6, label="camera")
    axes.plot(
        time_s[step], rebuilt[step], color=RED, linewidth=1.0, linestyle="--", label="capacitance"
    )
    axes.set_xlabel("Time (s)")
    axes.set_ylabel("Strain (%)")
    legend_below(host, axes, 3)


PLAN = FigurePlan(
    "fig3",
    "Figure 3",
    "triangle and maps",
    "Voltage, strain and capacitance in the triangle test. A: drive voltage (DAQ output, and the "
    "amplifier's 5 kV per volt), strain from the camera about the operating point (mean and "
    "standard deviation of three points at the lower clamp), capacitance. The first cycle is not "
    "repeatable and is excluded from the fits; the others still drift (S13). B: voltage against "
    "strain, with its hysteresis loop, the fit of eq. 4, and eq. 4 with the paper's own "
    "constants; zero strain is the chosen baseline. C: strain against capacitance: every buffer of "
    "cycles 2 to 5 (grey), means of the rising and the falling edge at equal times from the peak "
    "(blue), and the line of eq. 5 through these means. D: strain measured by the camera, and "
    "strain computed from capacitance with the map that the control loops use; its 95 % band comes "
    "from leaving out cycles.",
    (
        Panel("A", "Triangle test", _triangle, wide=True, height_in=5.0),
        Panel("B", "Voltage map", _voltage_map, height_in=3.0),
        Panel("C", "Capacitance map", _capacitance_map, height_in=3.0),
        Panel("D", "Strain computed from capacitance", _reconstruction, wide=True, height_in=2.4),
    ),
    plain_caption="Voltage, strain and capacitance in the triangle test. A: drive voltage (DAQ "
    "output), strain from the camera about the operating point (mean and standard deviation of "
    "three points at the lower clamp), capacitance. The first cycles are excluded from the fits. "
    "B: voltage against strain, with its hysteresis loop, and the fit of two exponentials; zero "
    "strain is the chosen baseline. C: strain against capacitance: every block of the fitted "
    "cycles (grey), and the map that the control loops use (orange-red). D: strain measured by the "
    "camera, and strain computed from capacitance with the map that the control loops use.",
)
