"""`haselab identify actuator` finds the twin's law, and the twin of the result plays like it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.actuators import PlanarHasel, linearise
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.rig.twin.twin_file import load_twin
from haselab.store.toml import toml_text
from haselab.study.definition import builtin_study
from tests.study.conftest import tell

START = """\
[actuator]
kind = "planar-hasel"

[actuator.parameters]
shell.shear_modulus_pa = 12.5e3
electrodes.stiffness_n_per_m = 180.0
viscosity.share = [0.03, 0.015, 0.4]
viscosity.relaxation_s = [0.07, 1.4, 4.0]
viscosity.damping_n_s_per_m = 2.3
dielectric.permittivity = 2.5
"""


@dataclass(frozen=True)
class Identified:
    """A recorded session, and the actuator file with the model identified from it."""

    recorded: dict[str, Any]
    file: Path
    answer: dict[str, Any]


@pytest.fixture(scope="module")
def identified(played, tmp_path_factory) -> Identified:
    file = tmp_path_factory.mktemp("identified") / "actuator.toml"
    file.write_text(START)
    session = played("hz")
    answer = json.loads(tell("identify", "actuator", session.folder, "--actuator", file, "--json"))
    rows = {name: row["measured"] for name, row in session.rows.items() if row["measured"]}
    return Identified(rows, file, answer)


@pytest.mark.long
def test_the_law_of_the_twin_is_found_in_a_quick_study(identified):
    answer = identified.answer
    assert answer["status"] == "ok" and answer["not_identifiable"] == []
    far = {}
    for name, true in fitted_parameters(PlanarHasel()).items():
        found = answer["parameters"][name]
        far[name] = (found["value"] - true) / found["std"]
    for name in ("camera.latency_s", "sensing.latency_s"):  # the amplifier's is measured
        far[name] = answer["parameters"][name]["value"] / answer["parameters"][name]["std"]
    # 19 numbers: one is outside 3.5 by chance once in 100 studies
    assert max(map(abs, far.values())) < 3.5, far
    assert np.sqrt(np.mean(np.square(list(far.values())))) < 1.6, far
    for channel, rms in answer["residual_rms"].items():
        assert rms == pytest.approx(answer["noise_rms"][channel], rel=0.05)
    assert [point["voltage_v"] for point in answer["linear_models"]] == pytest.approx(
        np.linspace(0.0, 1e4, 5), abs=200.0
    )
    text = identified.file.read_text()
    assert text.startswith("[actuator]") and "[model.physical.parameters]" in text
    assert "[provenance.model.physical]" in text


@pytest.mark.long
@pytest.mark.parametrize("mass_kg", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("volt", [110.0, 2e3, 4e3, 5.5e3, 7e3, 8.5e3, 9.5e3, 10e3, 10.4e3, 10.78e3])
def test_its_general_transfer_function_is_that_of_the_true_law(identified, volt, mass_kg):
    """Gain and natural frequency within 1 %, damping within 5 %, also with masses never hung."""
    twin = load_twin(identified.file)
    inertia_kg = mass_kg + twin.load.added_inertia_kg
    found = linearise(twin.law, volt, mass_kg * 9.81, inertia_kg, longest_m=0.1)
    true = linearise(PlanarHasel(), volt, mass_kg * 9.81, mass_kg, longest_m=0.1)
    of_found, of_true = (p.poles[np.argmax(p.poles.imag)] for p in (found, true))
    assert found.gain_m_per_v == pytest.approx(true.gain_m_per_v, rel=0.01)
    assert abs(of_found) == pytest.approx(abs(of_true), rel=0.01)
    assert of_found.real / abs(of_found) == pytest.approx(of_true.real / abs(of_true), rel=0.05)


def rehearsed(identified: Identified, folder: Path, seed: int, *, loops: bool) -> dict[str, float]:
    """Deviations of a study on the twin from the recorded session, in standard deviations.

    The operating point is that of the session: a study that finds its own may choose the
    neighbouring voltage, 10 mV off, to which no interval of the later results extends.
    """
    tables = builtin_study(quick=True).model_dump(mode="json") | {"name": "rehearsal"}
    tables["operating_point"] = {"baseline_v": identified.recorded["S18.baseline"]["value"]}
    if not loops:
        tables = {name: table for name, table in tables.items() if name not in ("steps", "control")}
    (folder / "study.toml").write_text(toml_text(tables))
    (folder / "rig.toml").write_text(f'kind = "twin"\nseed = {seed}\n')
    out = folder / f"run-{seed}"
    tell("run", folder / "study.toml", "--rig", folder / "rig.toml", "--twin", identified.file,
         "--keep-video", "none", "--out", out)  # fmt: skip
    results = json.loads((out / "results.json").read_text())
    origin = results["provenance"]["rig_config"]["origin"]
    assert results["simulated"] and origin["actuator"] == identified.file.stem
    assert "SIMULATED, twin of the identified actuator" in (out / "report.html").read_text()
    far = {}
    for row in results["quantities"]:
        one, other = identified.recorded.get(row["id"]), row["measured"]
        if one and other and one["std"] and other["std"]:
            far[row["id"]] = (other["value"] - one["value"]) / np.hypot(one["std"], other["std"])
    return far


@pytest.mark.long
def test_a_study_on_the_twin_of_the_result_gives_the_results_of_the_session(identified, tmp_path):
    far = rehearsed(identified, tmp_path, 21, loops=False)
    outside = {name: float(z) for name, z in far.items() if abs(z) > 1.96}
    # 33 results, of which groups vary together; one in 20 is outside by chance
    assert len(far) > 30 and len(outside) < 0.1 * len(far), outside
    assert max(map(abs, far.values())) < 4.0, outside


@pytest.mark.slow
def test_twenty_studies_with_loops_give_the_results_of_the_session(identified, tmp_path):
    """Intervals of stability margins are those for given gains, and the gains vary, too."""
    runs = [rehearsed(identified, tmp_path, 200 + k, loops=True) for k in range(20)]
    inside = [abs(z) < 1.96 for far in runs for z in far.values()]
    assert np.mean(inside) > 0.95
    for far in runs:
        free = {name: z for name, z in far.items() if "margin" not in name}
        assert max(map(abs, free.values())) < 4.0, free
