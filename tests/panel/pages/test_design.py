"""The requests of the Design page: the numbers of the commands, python-control's, and writing."""

import asyncio
import json
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

from haselab.base import HaselabError, InputError, ResultError, to_plain
from haselab.cli.main import main
from haselab.controllers import CONTROLLERS, ControllerKind, Parameter
from haselab.panel.files import PanelFiles
from haselab.panel.pages import design
from haselab.panel.pages.requests import REQUESTS
from tests.panel.running import connected, ended, started

RATE_HZ = 100.0
GAINS = {"kp": 0.25, "ki": 6.0, "kd": 0.01, "derivative_filter_s": 0.02}
UNSTABLE = GAINS | {"ki": 120.0}
MODEL = """\
# The actuator of bench 3, with the second sheet.
[actuator]
kind = "planar-hasel"
storage_shelf = "B2"
geometry = {zero_length_m = 0.06}

[drive]
voltage_map = {a1_v = 1.588, b1 = 1.688, a2_v = -0.605, b2 = -22.05}

[sensing.strain_map]
slope_per_f = 1.053e9
offset = -0.4339
curvature_per_f2 = -6.163e17
cubic_per_f3 = 1.811e26
range_f = [4.96e-10, 9.01e-10]

[model]  # of the 12th session
gain = 0.8
natural_frequency_rad_s = 32.0
damping_ratio = 0.3
delay_s = 0.01
rate_hz = 100.0
loop_delay_s = 0.01

[model.covariance]
names = ["gain", "natural_frequency_rad_s", "damping_ratio", "delay_s"]
logarithmic = [false, true, true, false]
values = [0.8, 32.0, 0.3, 0.01]
matrix = [[4e-4, 0, 0, 0], [0, 1e-3, 0, 0], [0, 0, 4e-3, 0], [0, 0, 0, 1e-6]]
"""
CONTROLLER = """
[controller]
kind = "pid"
limits = {low = -0.04, high = 0.1}

[controller.parameters]
kp = 0.1  # softer than before
ki = 5.0

[[controller.alternatives]]
kind = "pi"
parameters = {kp = 0.05, ki = 2.0}
"""
GENERAL = """\
[model]
numerator = [800.0]
denominator = [0.1, 3.0, 120.0, 1000.0]
delay_s = 0.005
rate_hz = 200.0
"""
MARGINS = ("stable", "phase_margin_deg", "gain_margin_db", "delay_margin_s", "peak_sensitivity",
           "crossover_rad_s", "rate_hz", "delay_s")  # fmt: skip


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "actuator.toml"
    found.write_text(MODEL + CONTROLLER)
    return found


def ask(path: Path | None, name: str, **values: object) -> dict[str, Any]:
    """The answer of a request, as a page gets it."""
    rig = Path("rig.toml") if path is None else path.with_name("rig.toml")
    answer = REQUESTS[name](PanelFiles(rig, path, rig.with_name("out")), values)
    return json.loads(json.dumps(to_plain(answer), allow_nan=False))


def command(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    """The JSON answer of a command."""
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main([*map(str, words), "--json"])
    return json.loads(capsys.readouterr().out)


def options(gains: dict[str, float]) -> list[object]:
    pairs = [(f"--{name.replace('_', '-')}", value) for name, value in gains.items()]
    return [word for pair in pairs for word in pair]


@pytest.mark.parametrize(
    "text", [MODEL + CONTROLLER, MODEL, GENERAL], ids=["pid", "none", "order 3"]
)
@pytest.mark.parametrize("gains", [GAINS, UNSTABLE, dict.fromkeys(GAINS, 0.0)], ids=str)
def test_the_margins_are_those_of_haselab_margins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, gains: dict[str, float]
) -> None:
    path = tmp_path / "actuator.toml"
    path.write_text(text)
    stated = command(capsys, "margins", path, *options(gains))
    shown = ask(path, "design-loop", **gains)
    assert shown["margins"] == {name: stated[name] for name in MARGINS}
    assert shown["gains"] == gains
    chip = command(capsys, "margins", path, *options(gains), "--rate-hz", 1000,
                   "--delay-s", 14.5 * 125e-6)  # fmt: skip
    assert shown["chip"] == {name: chip[name] for name in MARGINS}


def test_the_gains_and_margins_of_the_file_come_first(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    about = ask(path, "design")
    assert about["gains"] == {"kp": 0.1, "ki": 5.0, "kd": 0.0, "derivative_filter_s": 0.0}
    assert about["kind"] == "pid" and about["is_pid"] and about["warnings"] == []
    assert all(about["ranges"][name] > about["gains"][name] for name in about["gains"])
    shown = ask(path, "design-loop", **about["gains"])["margins"]
    assert shown == {n: v for n, v in command(capsys, "margins", path).items() if n in MARGINS}


def sampled_loop(gains: dict[str, float]) -> tuple[Any, Any]:
    """Controller and plant with two whole samples of delay in z, by python-control."""
    period_s = 1.0 / RATE_HZ
    z = control.tf([1, 0], [1], period_s)
    plant = control.c2d(control.tf([0.8 * 32.0**2], [1, 0.6 * 32.0, 32.0**2]), period_s, "zoh")
    tau = gains["derivative_filter_s"]
    law = gains["kp"] + gains["ki"] * period_s * z / (z - 1)
    law = law + gains["kd"] * (z - 1) / ((tau + period_s) * z - tau)
    return law, plant / z**2


def test_margins_and_bode_plot_are_those_of_python_control(path: Path) -> None:
    found = ask(path, "design-loop", **GAINS)
    law, delayed = sampled_loop(GAINS)
    loop = law * delayed
    hz = np.array(found["bode"]["frequency_hz"])
    assert hz[0] < 0.2 and hz[-1] == pytest.approx(50.0)
    theirs = loop(np.exp(2j * np.pi * hz / RATE_HZ))
    ours = found["bode"]["loop"]
    # Both are sums of a few products in double precision; the loop falls by 60 dB.
    np.testing.assert_allclose(ours["magnitude_db"], 20.0 * np.log10(np.abs(theirs)), atol=1e-6)
    turned = np.radians(ours["phase_deg"]) - np.angle(theirs)
    np.testing.assert_allclose(turned, 2.0 * np.pi * np.round(turned / 2.0 / np.pi), atol=1e-6)
    dense_hz = np.geomspace(hz[0], hz[-1], 20_000)  # so that the phase turns little in each step
    unwrapped = np.unwrap(np.angle(loop(np.exp(2j * np.pi * dense_hz / RATE_HZ))))
    between = np.degrees(np.interp(hz, dense_hz, unwrapped))
    np.testing.assert_allclose(ours["phase_deg"], between, atol=0.5)
    plant = 0.8 / (1.0 + 0.6j * hz * 2 * np.pi / 32.0 - (hz * 2 * np.pi / 32.0) ** 2)
    np.testing.assert_allclose(
        found["bode"]["plant"]["magnitude_db"], 20.0 * np.log10(np.abs(plant)), atol=1e-9
    )
    dense = control.FRD(loop, 2.0 * np.pi * dense_hz, smooth=True)
    gm, pm, sm, _, wc, _ = control.stability_margins(dense)
    margins = found["margins"]
    # python-control interpolates a response at points 0.03 % apart.
    assert margins["gain_margin_db"] == pytest.approx(20.0 * np.log10(gm), rel=1e-6)
    assert margins["phase_margin_deg"] == pytest.approx(pm, rel=1e-6)
    assert margins["peak_sensitivity"] == pytest.approx(1.0 / sm, rel=1e-6)
    assert margins["crossover_rad_s"] == pytest.approx(wc, rel=1e-6)
    assert margins["delay_margin_s"] == pytest.approx(np.radians(pm) / wc, rel=1e-6)


def test_the_step_is_that_of_python_control_where_nothing_saturates(path: Path) -> None:
    step = ask(path, "design-loop", **GAINS)["step"]
    law, delayed = sampled_loop(GAINS)
    # The derivative acts on the measurement alone.
    law_of_reference, _ = sampled_loop(GAINS | {"kd": 0.0})
    closed = control.minreal(law_of_reference * delayed / (1 + law * delayed), verbose=False)
    _, theirs = control.forced_response(closed, np.array(step["time_s"]), step["reference"])
    assert max(step["controller"]) < 0.1  # the limit
    assert set(step["reference"]) == {0.04}
    np.testing.assert_allclose(step["measured"], theirs, atol=1e-8)


def test_a_saturated_unstable_loop_is_drawn_within_its_limits(path: Path) -> None:
    found = ask(path, "design-loop", **UNSTABLE)
    assert found["margins"]["stable"] is False and found["margins"]["phase_margin_deg"] < 0.0
    limits = min(found["step"]["controller"]), max(found["step"]["controller"])
    assert limits == (-0.04, 0.1)  # those of the file


def test_computed_and_written_gains_give_the_section_of_haselab_design(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = path.with_name("other.toml")
    other.write_text(path.read_text())
    answer = command(capsys, "design", other)
    found = ask(path, "design-search")
    assert found["gains"] == {name: answer[name] for name in GAINS}
    assert found["shortfalls"] == answer["shortfalls"]
    assert found["plausible"].startswith(
        f"{100 * answer['posterior']['margins']['value']:.4g} % of"
    )
    assert ask(path, "design-demands", **found["gains"]) == found
    sha256 = ask(path, "design-loop", **found["gains"])["sha256"]
    ask(path, "design-write", **found["gains"], sha256=sha256)
    ours, theirs = (tomllib.loads(p.read_text()) for p in (path, other))
    assert ours["controller"] == theirs["controller"]


def test_writing_keeps_comments_and_all_else_and_states_its_origin(path: Path) -> None:
    before = path.read_text()
    sha256 = ask(path, "design-loop", **GAINS)["sha256"]
    written = ask(path, "design-write", **GAINS, sha256=sha256)
    assert written == {"written": str(path), "sha256": ask(path, "design")["sha256"]}
    text = path.read_text()
    assert text.startswith(MODEL)
    held = tomllib.loads(text)
    assert held["controller"]["parameters"] == GAINS and held["controller"]["kind"] == "pid"
    assert held["controller"]["limits"] == {"low": -0.04, "high": 0.1}
    assert [one["kind"] for one in held["controller"]["alternatives"]] == ["pi"]
    origin = held["provenance"]["controller"]
    assert origin["command"].startswith("haselab panel --actuator ")
    assert origin["input"] == ["actuator.toml"] and origin["sha256"] == [sha256]
    assert held["actuator"] == tomllib.loads(before)["actuator"]
    assert ask(path, "design")["warnings"] == []  # the stated margins are those of the model
    assert ask(path, "design")["gains"] == GAINS


def test_the_name_and_the_kind_of_a_controller_are_kept(path: Path) -> None:
    path.write_text(MODEL + CONTROLLER.replace('kind = "pid"', 'kind = "pi"\nname = "gentle"'))
    gains = GAINS | {"kd": 0.0}
    for given, kind in ((gains, "pi"), (GAINS, "pid")):
        sha256 = ask(path, "design-loop", **given)["sha256"]
        ask(path, "design-write", **given, sha256=sha256)
        held = tomllib.loads(path.read_text())["controller"]
        assert (held["kind"], held["name"]) == (kind, "gentle")
        assert len(held["alternatives"]) == 1


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        (UNSTABLE, "Not written: with these gains the loop is unstable at 100 Hz with a delay of"),
        (GAINS | {"kp": 0.0, "ki": 0.0}, "kp and ki are both 0"),
        (GAINS | {"kp": -1.0}, "kp = -1.0; it must be finite, 0 or more"),
        (GAINS | {"kd": "0.1"}, "kd is '0.1', but it must be a finite number"),
        (GAINS | {"ki": 1e300}, "ki is 1e+300, but it must be 0, or 1e-12 to 1e+12"),
        (GAINS | {"kd": 1e-300}, "kd is 1e-300, but it must be 0, or 1e-12 to 1e+12"),
        ({"kp": 0.1}, "ki is None, but it must be a finite number"),
    ],
)
def test_gains_that_cannot_be_written_are_refused_and_the_file_stays(
    path: Path, gains: dict[str, Any], said: str
) -> None:
    before = path.read_bytes()
    sha256 = ask(path, "design-loop", **GAINS)["sha256"]
    with pytest.raises((InputError, ResultError), match=f"^{re.escape(said)}.*$") as refused:
        ask(path, "design-write", **gains, sha256=sha256)
    assert "\n" not in str(refused.value)
    assert path.read_bytes() == before


def test_a_file_that_changed_meanwhile_is_not_written(path: Path) -> None:
    sha256 = ask(path, "design-loop", **GAINS)["sha256"]
    path.write_text(path.read_text().replace("gain = 0.8", "gain = 1.6"))
    path.write_text(path.read_text().replace("values = [0.8", "values = [1.6"))
    with pytest.raises(InputError, match="Not written: the actuator file has changed since"):
        ask(path, "design-write", **GAINS, sha256=sha256)
    assert "gain = 1.6" in path.read_text() and "0.25" not in path.read_text()


def test_a_read_only_file_is_not_written(path: Path) -> None:
    sha256 = ask(path, "design-loop", **GAINS)["sha256"]
    path.chmod(0o444)
    with pytest.raises(InputError, match="The file is read-only"):
        ask(path, "design-write", **GAINS, sha256=sha256)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "without an actuator file. Start it with --actuator ACTUATOR.toml"),
        (CONTROLLER, r"no \[model\]. Add it by hand, or with this command: haselab identify trans"),
        (MODEL.replace("gain =", "gian ="), r"\[model\] has .*gian.*, but neither gain nor"),
        (MODEL + CONTROLLER.replace("ki =", "kj ="), "lacks ki, has the key kj"),
    ],
    ids=["no file", "no model", "misspelled", "no ki"],
)
def test_what_is_missing_is_said_in_one_line(tmp_path: Path, text: str | None, said: str) -> None:
    path = None if text is None else tmp_path / "actuator.toml"
    if path is not None:
        path.write_text(str(text))
    with pytest.raises(InputError, match=said) as refused:
        ask(path, "design" if path else "design-loop", **GAINS)
    assert "\n" not in str(refused.value)
    if path is None:  # the page is no fault then: the browser reports none
        assert re.search(said, ask(path, "design")["none"])


def test_limits_that_are_not_known_leave_the_margins_but_no_step(tmp_path: Path) -> None:
    path = tmp_path / "actuator.toml"
    path.write_text(GENERAL + 'input_unit = "V"\n')
    assert "Give the limits in V with --limits" in ask(path, "design")["warnings"][0]
    found = ask(path, "design-loop", **GAINS)
    assert found["margins"]["stable"] and found["step"] is None
    with pytest.raises(InputError, match="Give the limits in V"):
        ask(path, "design-write", **GAINS, sha256=found["sha256"])


def test_a_model_through_another_voltage_map_and_stale_margins_are_warned_of(path: Path) -> None:
    stale = CONTROLLER + "\n[controller.margins]\nphase_margin_deg = 12.0\n"
    path.write_text(MODEL.replace("delay_s = 0.01\nrate", "through_voltage_map = [1, 2, 3, 4]\n"
                                  "delay_s = 0.01\nrate") + stale)  # fmt: skip
    warnings = ask(path, "design")["warnings"]
    assert "through another [drive.voltage_map]" in warnings[0]
    assert "states a phase margin of 12 deg" in warnings[1]


class Integral:
    """A controller that is no PID."""

    def __init__(self, gain_per_s: float) -> None:
        self.gain_per_s = gain_per_s

    def start(self, setting: object) -> None: ...

    def step(self, reference: float, measurement: object) -> float:
        return 0.0

    def linear_feedback(self, period_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (self.gain_per_s * period_s, 0.0), (1.0, -1.0)


class Silent:
    """A controller whose margins cannot be computed."""

    def start(self, setting: object) -> None: ...

    def step(self, reference: float, measurement: object) -> float:
        return 0.0


def test_another_kind_has_margins_but_no_sliders(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = (Parameter("gain_per_s", "1/s", 1.0, 0.0),)
    kinds = [ControllerKind("integral", Integral, parameters), ControllerKind("silent", Silent)]
    points = [
        SimpleNamespace(name=kind.name, value="plug_in", dist=None, load=lambda kind=kind: kind)
        for kind in kinds
    ]
    monkeypatch.setattr(CONTROLLERS, "others", lambda: points)
    own = '\n[controller]\nkind = "integral"\nparameters = {gain_per_s = 2.0}\n'
    path.write_text(MODEL + own)
    about = ask(path, "design")
    assert about["is_pid"] is False and about["kind"] == "integral" and "gains" not in about
    stated = command(capsys, "margins", path)
    assert about["found"]["margins"] == {name: stated[name] for name in MARGINS}
    for name in ("design-loop", "design-search", "design-demands", "design-write", "design-budget"):
        with pytest.raises(
            HaselabError, match=r"has kind = 'integral', but this page changes only"
        ):
            ask(path, name, **GAINS, sha256=about["found"]["sha256"])
    path.write_text(MODEL + '\n[controller]\nkind = "silent"\n')
    with pytest.raises(InputError, match="no method linear_feedback, so their margins cannot"):
        ask(path, "design")


def test_the_budget_is_that_of_the_firmware_with_these_gains(
    path: Path, installed: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    installed("avr-gcc", "gcc-avr avr-libc")
    if not Path("/usr/include/simavr/sim_avr.h").is_file():
        pytest.skip("libsimavr is not installed. Run:  sudo apt-get install -y libsimavr-dev")
    path.with_name("rig.toml").write_text('kind = "twin"\n')
    found = ask(path, "design-budget", **GAINS)
    assert 0 < found["longest_update_cycles"] < found["cycles_of_an_update"] == 16e6 / 1000
    assert 0.0 < found["load"] < found["longest_update_cycles"] / found["cycles_of_an_update"]
    assert found["overruns"] == 0
    sha256 = ask(path, "design-loop", **GAINS)["sha256"]
    ask(path, "design-write", **GAINS, sha256=sha256)
    short = ("--before-s", 1, "--after-s", 2, "--precondition", 0)
    alone = command(capsys, "firmware", "simulate", path, *short)
    assert found["flash_bytes"] == alone["flash_bytes"]
    assert found["ram_bytes"] == alone["static_ram_bytes"] + alone["stack_bytes"]
    # The cycles of a product depend on its factors, here on the strain.
    for name in ("longest_update_cycles", "load"):
        assert found[name] == pytest.approx(alone[name], rel=0.05)
    with pytest.raises(ResultError, match="unstable on the microcontroller, at 1000 Hz"):
        ask(path, "design-budget", **(GAINS | {"ki": 1e4}))


def test_the_bench_uses_written_gains_from_the_next_arming_on(path: Path) -> None:
    path.write_text(MODEL)
    panel = started("--actuator", str(path))

    async def play() -> None:
        async with connected(panel) as page:
            state = await page.until(lambda state: bool(state["stage"]))
            assert state["loop"] is None  # the file has no controller
            await page.arm(1.9)
            path.write_text(MODEL + CONTROLLER)
            assert "There is no controller" in (await page.ask("loop", strain=0.02))["error"]
            await page.ask("disarm")
            await page.arm(1.9)
            await page.until(lambda state: state["loop"] == [-0.04, 0.1])
            assert "error" not in await page.ask("loop", strain=0.02)
            path.write_text(MODEL + CONTROLLER.replace("high = 0.1", "high = 0.05"))
            assert "already" in (await page.ask("request"))["error"]
            await page.until(lambda state: state["mode"] == "loop")
            assert page.state["loop"] == [-0.04, 0.1]
            await page.ask("disarm")
            path.write_text(MODEL + CONTROLLER.replace("ki = 5.0", "ki = -5.0"))
            assert "ki" in (await page.ask("request"))["error"]
            path.write_text(MODEL + CONTROLLER.replace("high = 0.1", "high = 0.05"))
            await page.arm(1.9)
            await page.until(lambda state: state["loop"] == [-0.04, 0.05])

    try:
        asyncio.run(play())
    finally:
        assert ended(panel) == 0


def test_a_file_that_changes_while_it_is_written_keeps_the_change(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Computing what is written takes a second, in which another program may write."""
    sha256, compute = ask(path, "design-loop", **GAINS)["sha256"], design._design
    changed = path.read_text().replace("gain = 0.8", "gain = 1.6")

    def meanwhile(*given: Any) -> Any:
        found = compute(*given)
        path.write_text(changed)
        return found

    monkeypatch.setattr(design, "_design", meanwhile)
    with pytest.raises(InputError, match="Not written: the actuator file has changed since"):
        ask(path, "design-write", **GAINS, sha256=sha256)
    assert path.read_text() == changed
