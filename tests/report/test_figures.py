import copy
import math
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from haselab.report.analysis import Section
from haselab.report.figures import PLANS, draw_figure
from haselab.report.figures.chip import draw_loops
from haselab.report.folder import RunFolder, read_folder
from haselab.report.results import Results
from haselab.report.style import figure_style

UNITS = {"px", "mm", "%", "1", "V", "kV", "s", "nF", "a.u.", "N", "rad/s", "Hz", "dB", "°"}
UNITS |= {"0 to 1"}  # range of a quantity without unit, such as the coherence
PANELS = [(plan, panel) for plan in PLANS for panel in plan.panels]
NAMES = [f"{plan.name}{panel.letter}" for plan, panel in PANELS]

# Section of analysis.json: the panels that cannot be drawn without it.
NEEDED_BY = {
    "tracks": {"fig2A", "fig2B", "fig2C"},
    "triangle": {"fig3A"},
    "voltage_map": {"fig3B", "residualsB"},
    "capacitance_map": {"fig3C", "fig3D"},
    "static": {"fig4", "residualsC"},
    "free_response": {"fig5", "residualsD"},
    "steps": {"fig6A", "fig6B"},
    "loop": {"fig7"},
    "chirp": {"bode-plantA", "bode-plantB", "residualsA"},
    "sensing": {"sensing"},
    "chip": {"chip"},
}


@pytest.fixture(scope="module")
def run(run_folder):
    return read_folder(run_folder)


def plan_of(name):
    return next(plan for plan in PLANS if plan.name == name)


def drawn_axes(run, name):
    """The axes of one panel, drawn alone, then every axis in another unit beside them."""
    _, panel = PANELS[NAMES.index(name)]
    figure = Figure(figsize=(6.8, panel.height_in), layout="constrained")
    with figure_style():
        panel.draw(figure, run)
        figure.draw_without_rendering()
    seconds = [child for axes in figure.axes for child in axes.child_axes]
    return figure.axes, seconds


def curve(axes, label):
    return next(line for line in axes.lines if line.get_label() == label)


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_with_numbers_is_labelled_with_a_unit(run, name):
    axes, seconds = drawn_axes(run, name)
    for each in [*axes, *seconds]:
        for axis in (each.xaxis, each.yaxis):
            shows_numbers = any(
                tick.label1.get_visible() or tick.label2.get_visible()
                for tick in axis.get_major_ticks()
            )
            if not (axis.get_visible() and shows_numbers):
                continue
            label = axis.label.get_text()
            unit = re.search(r"\(([^()]+)\)$", label)
            assert unit is not None, f"{name}: axis labelled {label!r}"
            assert unit[1] in UNITS, f"{name}: unit {unit[1]!r}"


@pytest.mark.parametrize("section", NEEDED_BY)
def test_a_missing_section_leaves_out_its_panels_alone_and_says_so(run, section):
    analysis = {name: data for name, data in run.analysis.items() if name != section}
    less = RunFolder(run.path, run.results, analysis)
    for plan in PLANS:
        lost = [p for p in plan.panels if f"{plan.name}{p.letter}" in NEEDED_BY[section]]
        if not lost:
            continue
        drawing = draw_figure(plan, less)
        assert len(drawing.panels) == len(plan.panels) - len(lost)
        assert [note.split(" was left out: ")[1] for note in drawing.notes] == [
            f"analysis.json has no section '{section}'."
        ] * len(lost)
        assert bool(drawing.document) == bool(drawing.panels)


@pytest.mark.parametrize(
    ("name", "path", "value", "note"),
    [
        ("fig3", ("triangle", "strain"), [0.0], "'triangle.strain' in analysis.json has 1 values"),
        ("fig3", ("triangle", "drive_v"), None, "'triangle' in analysis.json has no 'drive_v'"),
        (
            "fig4",
            ("static", "load_n"),
            "much",
            "'static.load_n' in analysis.json contains something other",
        ),
        (
            "fig4",
            ("static", "chosen"),
            3,
            "'static.chosen' in analysis.json is not one of 3 regions",
        ),
        (
            "fig4",
            ("static", "regions"),
            3,
            "'static.regions' in analysis.json is neither a mapping",
        ),
        ("fig5", ("free_response", "trials"), [], "has no 'trials'"),
        ("fig7", ("loop", "plant"), [1], "'loop.plant' in analysis.json is not a mapping"),
        ("fig6", ("steps", "time_s"), [None, None], "has no finite number"),
        ("fig2", ("tracks", "y_px"), [[1.0]], "'tracks.y_px' in analysis.json has shape (1, 1)"),
    ],
)
def test_a_damaged_section_is_reported_in_one_sentence(run, name, path, value, note):
    analysis = copy.deepcopy(dict(run.analysis))
    analysis[path[0]][path[1]] = value
    drawing = draw_figure(plan_of(name), RunFolder(run.path, run.results, analysis))
    assert drawing.notes
    assert note in drawing.notes[0]


def test_the_second_voltage_axis_is_the_amplifier_of_5_kv_per_volt(run):
    axes, seconds = drawn_axes(run, "fig3B")
    assert seconds[0].get_ylabel() == "Actuator (kV)"
    assert seconds[0].get_ylim() == pytest.approx([5.0 * v for v in axes[0].get_ylim()])


@pytest.mark.parametrize("name", ["fig7", "bode-plantA"])
def test_the_upper_frequency_axis_is_the_lower_one_over_two_pi(run, name):
    axes, seconds = drawn_axes(run, name)
    assert axes[-1].get_xlabel() == "Angular frequency (rad/s)"
    assert seconds[0].get_xlabel() == "Frequency (Hz)"
    low_hz, high_hz = seconds[0].get_xlim()
    assert [2 * math.pi * low_hz, 2 * math.pi * high_hz] == pytest.approx(axes[0].get_xlim())


def test_the_plots_of_plant_and_loop_show_the_resonance_at_5_11_rad_per_s(run):
    loop, _ = drawn_axes(run, "fig7")
    chirp, _ = drawn_axes(run, "bode-plantA")
    for line in (curve(loop[0], "open loop (plant)"), curve(chirp[0], "measured ± 1 st. dev.")):
        omega, magnitude_db = line.get_data()
        spacing = omega[1] / omega[0]
        assert omega[np.argmax(magnitude_db)] == pytest.approx(5.11, rel=1.5 * (spacing - 1))


def test_a_crossover_dot_lies_on_its_curve(run):
    (magnitude, phase), _ = drawn_axes(run, "fig7")
    for axes in (magnitude, phase):
        dots = [line for line in axes.lines if line.get_marker() == "o"]
        curves = [line for line in axes.lines if len(line.get_xdata()) == 200][1:]
        assert len(dots) == len(curves) == 2
        for dot, line in zip(dots, curves, strict=True):
            there = np.interp(dot.get_xdata()[0], *line.get_data())
            assert dot.get_ydata()[0] == pytest.approx(there, abs=1e-9)


def test_the_phase_is_drawn_without_jumps(run):
    (_, phase), _ = drawn_axes(run, "fig7")
    for line in phase.lines:
        assert np.abs(np.diff(line.get_ydata())).max(initial=0.0) < 90.0


def test_the_yellow_band_is_the_chosen_region(run):
    axes, _ = drawn_axes(run, "fig4")
    (band,) = [patch for patch in axes[0].patches if patch.get_label() == "chosen region"]
    corners = band.get_extents().transformed(axes[0].transData.inverted())
    assert (corners.x0, corners.x1) == pytest.approx((1.6, 2.5))


def test_strain_is_drawn_in_per_cent_and_displacement_in_millimetres(run):
    steps, _ = drawn_axes(run, "fig6A")
    desired = curve(steps[0], "desired").get_ydata()
    assert np.max(desired) == pytest.approx(5.0)
    free, _ = drawn_axes(run, "fig5")
    assert np.max(curve(free[0], "trial 1").get_ydata()) == pytest.approx(20.0, abs=1.0)


def test_each_further_trial_has_its_title_and_every_line_its_name(run):
    axes, _ = drawn_axes(run, "further")
    titles = [one.get_title(loc="left") for one in axes if one.get_title(loc="left")]
    assert titles[0] == "PI with the paper's sensing chain"
    assert len(titles) == len(run.analysis["further"])
    names = [text.get_text() for one in axes if one.get_legend() for text in
             one.get_legend().get_texts()]  # fmt: skip
    assert "output (right axis)" in names
    assert any(name.startswith("its limit, ") and name.endswith("V (right axis)") for name in names)


def test_residuals_are_what_the_models_leave_over(run):
    axes, _ = drawn_axes(run, "residualsA")
    labels = [line.get_label() for line in axes[0].lines]
    # The second model is the truth: camera noise of 4e-4 in 4000 samples, rms 0.04 %. The noise's
    # variance is known to 4 %, so that less than a fifth of 0.04 % is left as misfit.
    (true,) = [each for each in labels if each.startswith("second order plus slow branch:")]
    misfit, noise = (float(word) for word in re.findall(r"([\d.]+) %", true))
    assert noise == pytest.approx(0.04, abs=0.005) and misfit < 0.2 * noise
    assert "second order: misfit 0.11 %, noise 0.04 % rms" in labels
    (worse,) = [line for line in axes[0].lines if line.get_label().startswith("second order:")]
    strain = np.array(run.analysis["chirp"]["strain"])
    fitted = np.array(run.analysis["chirp"]["fits"]["second order"]["strain"])
    assert worse.get_ydata() == pytest.approx((100 * (strain - fitted))[::2])


def test_a_file_holds_all_panels_and_is_well_formed(run):
    drawing = draw_figure(plan_of("fig2"), run)
    root = ElementTree.fromstring(drawing.document)
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    for heading in ("A  Particle paths", "B  Strain along the length", "C  Lateral motion"):
        assert heading in texts
    assert root[0].text.startswith("Figure 2: A  Particle paths; B ")


def test_tracks_are_drawn_without_the_frame_where_the_folder_has_none(run):
    analysis = copy.deepcopy(dict(run.analysis))
    del analysis["tracks"]["frame_png"]
    drawing = draw_figure(plan_of("fig2"), RunFolder(run.path, Results((), {}), analysis))
    assert not drawing.notes


def test_a_name_from_the_file_is_shown_unchanged(run):
    analysis = copy.deepcopy(dict(run.analysis))
    groups = analysis["steps"]["groups"]
    groups["_costs $1 & $2"] = groups.pop("PI")
    drawing = draw_figure(plan_of("fig6"), RunFolder(run.path, run.results, analysis))
    assert "_costs $1 &amp; $2, camera" in drawing.document


def test_a_loop_that_does_not_settle_leaves_no_part_of_its_figure_empty():
    """A strain that leaves its band until the end; the axis went to 2.5 times the record."""
    time_s = np.linspace(-2.0, 6.0, 400)
    never = np.where(time_s > 0.0, 0.03, 0.0) + 0.01 * np.sin(5.0 * time_s)
    section = Section("chip", {
        "desired": {"time_s": time_s, "strain": np.where(time_s > 0.0, 0.03, 0.0)},
        "loops": {"chip, 1000 Hz": {"time_s": time_s, "strain": never}},
    })  # fmt: skip
    figure = Figure()
    draw_loops(figure, section)
    low, high = figure.axes[0].get_xlim()
    assert low >= -2.0 and high == pytest.approx(6.0)
