"""The quick study of each kind of actuator, from its example folder, against the twin's own law."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import (
    GRAVITY_M_S2,
    ActuatorLaw,
    equilibrium_m,
    feedthrough,
    linearise,
)
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.strain_map import StrainMap
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_file import load_twin
from haselab.store.actuator_file import read_run
from haselab.store.toml import validated
from haselab.study.fits.resolution import POSITION_PX
from tests.study.conftest import Recorded

KINDS = Path(__file__).parents[2] / "examples" / "kinds"
STD = 5.0  # of an estimate: one of a million deviates further by chance
pytestmark = pytest.mark.long


class Kind:
    """A played study, and the twin on which it was played."""

    def __init__(self, folder: Path, twin: TwinConfig) -> None:
        self.folder, self.twin, self.law = folder, twin, twin.law
        self.recorded = Recorded(folder)
        self.tables = validated(ActuatorTables, read_run(folder), folder)

    @property
    def strain_map(self) -> StrainMap:
        return self.tables.strain_map()

    @property
    def zero_m(self) -> float:
        length_m = self.tables.actuator.geometry.zero_length_m
        assert length_m is not None
        return length_m

    @property
    def baseline_v(self) -> float:
        return self.twin.amplifier.gain * self.recorded.value("S18.baseline")

    @property
    def seen_m(self) -> float:
        """Error of a mean length: the bias of a track, on both clamps."""
        return np.sqrt(2.0) * POSITION_PX * self.twin.camera.scale_m_per_px

    def rest_m(self, voltage_v: float, mass_kg: float | None = None) -> float:
        mass_kg = self.twin.load.mass_kg if mass_kg is None else mass_kg
        return equilibrium_m(self.law, voltage_v, mass_kg * GRAVITY_M_S2)

    def creep(self) -> float:
        """Share of a motion that the slowest branch has not made when frames are recorded."""
        losses, settle_s = self.law.losses, self.recorded.study["static_load"]["settle_s"]
        shares = np.array(losses.branch_share)
        return float(shares @ np.exp(-settle_s / np.array(losses.branch_relaxation_s)))


@pytest.fixture(scope="module", params=["peano-hasel", "dea-stack", "curling-hasel"])
def kind(
    request: pytest.FixtureRequest,
    command: Callable[..., str],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Kind]:
    source, out = KINDS / request.param, tmp_path_factory.mktemp("kind") / "run"
    study, rig = source / "study.toml", source / "rig.toml"
    command("run", study, "--rig", rig, "--quick", "--out", out)
    found = Kind(out, load_twin(source / "twin.toml"))
    yield found
    found.recorded.file.close()


def test_each_mass_and_voltage_has_the_length_of_the_law(kind: Kind) -> None:
    static = kind.recorded.experiment("static")
    moved_m = np.ptp(static.length)
    for mass_kg in np.unique(static.mass):
        seen_m = float(static.length[static.mass == mass_kg].mean())
        within_m = STD * kind.seen_m + kind.creep() * moved_m
        assert seen_m == pytest.approx(kind.rest_m(0.0, float(mass_kg)), abs=within_m), mass_kg
    held = kind.recorded.experiment("hold-1")
    rest_m = kind.rest_m(kind.baseline_v)
    # before, it rested at 0 V
    within_m = STD * kind.seen_m + kind.creep() * abs(rest_m - kind.rest_m(0.0))
    assert held.length.mean() == pytest.approx(rest_m, abs=within_m)
    assert rest_m < kind.rest_m(0.0)  # it contracts


def test_a_video_gives_the_same_length_as_the_run(
    kind: Kind, command: Callable[..., str], tmp_path: Path
) -> None:
    out = tmp_path / "tracks.csv"
    command("track", kind.folder / "video" / "hold-1.avi", "--auto", "--out", out)
    rows = np.genfromtxt(out, delimiter=",", names=True, dtype=None, encoding="utf-8")
    height_px = [
        rows["y_px"][np.char.startswith(rows["point"], end)].mean() for end in ("upper", "lower")
    ]
    length_m = kind.twin.camera.scale_m_per_px * (height_px[1] - height_px[0])
    held = kind.recorded.experiment("hold-1")
    assert length_m == pytest.approx(held.length.mean(), abs=STD * kind.seen_m)


def test_the_capacitance_is_that_of_the_law(
    kind: Kind, command: Callable[..., str], tmp_path: Path
) -> None:
    out = tmp_path / "c.csv"
    command("sense", kind.folder / "session.h5", "--experiment", "hold-1", "--out", out)
    rows = np.genfromtxt(out, delimiter=",", names=True, dtype=None, encoding="utf-8")
    rows = rows[rows["valid"] == 1]
    rest_m = kind.rest_m(kind.baseline_v)
    known_f = float(kind.law.differential_capacitance_f(rest_m, kind.baseline_v))
    # how much it changes with the rest of the creep
    slope = kind.law.differential_capacitance_f(rest_m + 1e-5, kind.baseline_v) - known_f
    late_f = abs(float(slope)) / 1e-5 * kind.creep() * abs(rest_m - kind.rest_m(0.0))
    std_f = float(np.median(rows["capacitance_std_f"]))
    assert rows["capacitance_f"].mean() == pytest.approx(known_f, abs=STD * std_f + late_f)
    # The map gives the true strain within its band, and falls.
    low, high = (float(end) for end in kind.strain_map.interval(known_f))
    assert low <= rest_m / kind.zero_m - 1.0 <= high
    assert kind.strain_map.slope_at(known_f) < 0.0


def _swing(law: ActuatorLaw, twin: TwinConfig, voltage_v: float) -> tuple[float, float]:
    """Natural frequency in rad/s and damping ratio of the resonance."""
    mass_kg = twin.load.mass_kg
    inertia_kg = mass_kg + twin.load.added_inertia_kg
    poles = linearise(law, voltage_v, mass_kg * GRAVITY_M_S2, inertia_kg).poles
    pole = poles[poles.imag.argmax()]
    return abs(pole), -pole.real / abs(pole)


def test_the_resonance_is_one_of_those_that_the_chirp_passes(kind: Kind) -> None:
    """The law is not linear: its linear models within the chirp's voltages are the bounds."""
    swing_v = kind.twin.amplifier.gain * kind.recorded.study["chirp"]["amplitude_v"]
    voltages_v = np.linspace(kind.baseline_v - swing_v, kind.baseline_v + swing_v, 9)
    passed = [_swing(kind.law, kind.twin, float(v)) for v in voltages_v]
    for key, values in zip(("S20.omega_n", "S20.zeta"), zip(*passed, strict=True), strict=True):
        row = kind.recorded.rows[key]
        within = STD * float(row["std"])
        assert min(values) - within <= float(row["value"]) <= max(values) + within, key


def test_the_closed_loop_settles_at_the_step(kind: Kind) -> None:
    """Self-sensing knows the strain to the band of its map; the loop has no other error."""
    steps = kind.recorded.study["steps"]
    assert steps["step"] < 0.0
    band = kind.strain_map.band
    assert band is not None
    for group in ("pi", "pid"):
        trial = kind.recorded.trials(group)[0]
        strain = trial.length / kind.zero_m - 1.0
        last = trial.time > trial.time[-1] - 1.0
        within = max(-band[0], band[1]) + STD * kind.seen_m / kind.zero_m
        # the PI has one slow pole, of which a rise from 10 to 90 % is ln 9 time constants
        rise_s = kind.recorded.value("S24.rise_closed" if group == "pi" else "S25.rise_pid")
        left = np.exp(-steps["step_s"] * np.log(9.0) / rise_s)
        assert strain[last].mean() == pytest.approx(
            steps["step"], abs=within + left * abs(steps["step"])
        )
        assert strain[last].std() < within
    assert 0.0 <= kind.recorded.value("S25.overshoot_pid") < 0.1


def test_the_feedthrough_of_the_chirp_is_that_of_the_law(kind: Kind) -> None:
    """The twin's law knows it exactly; only kinds with pouches have one in their file."""
    load_n = kind.twin.load.mass_kg * GRAVITY_M_S2
    point = linearise(kind.law, kind.baseline_v, load_n, kind.twin.load.mass_kg)
    truth = feedthrough(kind.law, point.length_m, kind.baseline_v, point.gain_m_per_v)
    row = kind.recorded.rows["S20.feedthrough"]
    assert row["ci95"][0] <= truth <= row["ci95"][1]
    assert row["std"] < 0.05
    table = kind.tables.sensing.strain_map
    assert table is not None
    if kind.twin.kind == "dea-stack":
        assert abs(truth) < 1e-6 and table.feedthrough is None
    else:
        assert table.feedthrough == pytest.approx(row["value"])
        assert table.feedthrough_std == pytest.approx(row["std"])


def test_the_predicted_step_of_the_pid_is_the_played_one_but_for_the_strain_map(kind: Kind) -> None:
    """The camera sees the error of the map, which the controller cannot."""
    steps = json.loads((kind.folder / "analysis.json").read_text())["steps"]
    predicted, played = steps["predicted"]["PID"], steps["metrics"]["PID"]
    left = played["error"]["value"] - steps["map_error"]["PID"]
    assert left == pytest.approx(predicted["error"], abs=STD * played["error"]["std"])
    frame_s = 1.0 / kind.recorded.study["steps"]["frame_rate_hz"]
    # one frame at either end, and a tenth for a plant that is not linear
    assert played["rise_time_s"]["value"] == pytest.approx(
        predicted["rise_time_s"], abs=2.0 * frame_s, rel=0.1
    )
    assert played["overshoot"]["value"] == pytest.approx(predicted["overshoot"], abs=0.05)


def test_the_report_shows_what_the_design_relies_on(kind: Kind) -> None:
    page = (kind.folder / "report.html").read_text()
    assert "Worst phase margin (°)" in page and "Predicted and played steps" in page
    assert ("The margins contain a feedthrough of" in page) == (kind.twin.kind != "dea-stack")
    slow = float(kind.recorded.rows["S20.slow_gain"]["value"])
    assert ("the opposite of creep" in page) == (slow * kind.recorded.value("S20.gain") < 0.0)
    # nothing of the paper, and nothing of the planar twin
    assert "elative capacitance" not in page and "S15." not in page and "S10." not in page
    assert "rig_config.shell" not in page and "rig_config.actuator" in page
    assert "[open, open]" not in page


def test_an_interval_of_no_width_is_that_of_a_setting_or_a_designed_gain(kind: Kind) -> None:
    exact = {
        key for key, row in kind.recorded.rows.items()
        if row["ci95"][0] is not None and row["ci95"][0] == row["ci95"][1]
    }  # fmt: skip
    known = ("S18.baseline", "S21.delay", "S22.saturation_", "S25.k", "S25.derivative_filter")
    assert all(key.startswith(known) for key in exact), exact


def test_what_does_not_apply_is_not_determined_for_a_true_reason(kind: Kind) -> None:
    results = json.loads((kind.folder / "results.json").read_text())
    reasons = {key: part["reason"] for part in results["not_played"] for key in part["ids"]}
    assert f"this actuator is a {kind.twin.kind}" in reasons["S16.mu"]
    assert kind.tables.actuator.kind == kind.twin.kind
    assert (kind.folder / "report.html").is_file()


def test_the_design_and_the_firmware_hold_what_they_predict(
    kind: Kind, command: Callable[..., str], tmp_path: Path
) -> None:
    file = tmp_path / "designed.toml"
    design = json.loads(
        command("design", kind.folder / "actuator.toml", "--out", file, "--json")
    )  # exit code 3 if a demand is missed
    assert design["phase_margin_deg"] >= 50.0 and design["gain_margin_db"] >= 6.0
    built = json.loads(command("firmware", "build", file, "--build-dir", tmp_path / "fw", "--json"))
    limits = kind.recorded.study["control"]
    assert built["strain_low"] == limits["saturation_low"]
    assert built["strain_high"] == limits["saturation_high"]
    found = json.loads(command("firmware", "simulate", kind.folder, "--json"))
    assert found["status"] == "ok" and found["overruns"] == 0
    assert found["deviation"] <= found["deviation_tolerated"]


@pytest.mark.slow
def test_the_parameters_of_the_law_are_identified(
    kind: Kind, command: Callable[..., str], tmp_path: Path
) -> None:
    truth = dict(kind.law.parameters())
    file = tmp_path / "a.toml"
    file.write_text((kind.folder / "actuator.toml").read_text())
    if kind.twin.kind == "curling-hasel":  # the default strip is curled twice as much
        file.write_text(file.read_text() + "\n[actuator.parameters]\nactuator.curl_rad = 0.6\n")
    found = json.loads(command("identify", "actuator", kind.folder, "--actuator", file, "--json"))
    assert (found["status"], found["not_identifiable"]) == ("ok", [])
    compared = 0
    for name, estimate in found["parameters"].items():
        key, _, branch = name.partition("[")
        if key in truth:
            known = truth[key]
            known = known[int(branch[:-1])] if isinstance(known, tuple) else known
            assert estimate["value"] == pytest.approx(known, abs=STD * estimate["std"]), name
            compared += 1
    assert compared >= 9
