"""The twin of an identified actuator: what is used of its file, drawn parameters, refusals."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.actuators import DeaStack, PlanarHasel
from haselab.base import InputError
from haselab.models.actuator.sections import PhysicalCovariance
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import SETTLE_S, Amplifier, TwinConfig, twin_of_reading
from haselab.rig.twin.twin_file import identified_twin, is_actuator_file, load_twin
from haselab.store.toml import toml_text

VALUES = {
    "shell.shear_modulus_pa": 15.0e3,
    "shell.locking_stretch": 3.5,
    "viscosity.share[1]": 0.03,
    "load.added_inertia_kg": 2e-3,
    "camera.latency_s": 2e-3,
    "sensing.scale": 1.02,
}
STD = {
    "shell.shear_modulus_pa": 500.0,
    "shell.locking_stretch": 0.2,
    "viscosity.share[1]": 0.001,
    "load.added_inertia_kg": 1e-4,
    "camera.latency_s": 1e-5,
    "sensing.scale": 1e-3,
}


@dataclass
class Parts:
    """What an actuator file holds."""

    actuator: dict[str, Any] = field(
        default_factory=lambda: {"name": "leg", "kind": "planar-hasel", "mass_kg": 0.2}
    )
    physical: dict[str, Any] | None = field(
        default_factory=lambda: {
            "kind": "planar-hasel",
            "mass_kg": 0.25,
            "parameters": dict(VALUES),
            "std": dict(STD),
            "not_identifiable": [],
        }
    )
    covariance: Any = None

    def written(self, path: Path) -> Path:
        tables = {"actuator": self.actuator, "drive": {"low_v": 0.0}}
        if self.physical is not None:
            names = list(self.physical["parameters"])
            spread = np.diag([STD.get(name, 1.0) ** 2 for name in names])
            if len(names) > 1:  # the law's first two compensate each other
                spread[0, 1] = spread[1, 0] = 0.99 * np.sqrt(spread[0, 0] * spread[1, 1])
            if self.covariance is None:
                self.covariance = {"names": names, "matrix": spread.tolist()}
            tables["model"] = {"physical": {**self.physical, "covariance": self.covariance}}
        quoted = {
            part: {f'"{key}"': value for key, value in table.items()}
            for part, table in (self.physical or {}).items()
            if part in ("parameters", "std")
        }
        if quoted:
            tables["model"]["physical"] |= quoted
        for part in ("parameters", "distribution"):
            if part in self.actuator:
                self.actuator[part] = {f'"{k}"': v for k, v in self.actuator[part].items()}
        path.write_text(toml_text(tables))
        return path


@pytest.fixture
def parts() -> Parts:
    return Parts()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "leg.toml"


def test_the_estimates_replace_the_actuator_and_the_bench_stays(parts: Parts, path: Path) -> None:
    parts.actuator["parameters"] = {"shell.width_m": 0.06, "shell.shear_modulus_pa": 1e3}
    bench = TwinConfig(amplifier=Amplifier(gain=4000.0, i_monitor_gain_error=0.01))
    twin = identified_twin(parts.written(path), bench)
    law = twin.law
    assert isinstance(law, PlanarHasel)
    assert law.shear_modulus_pa == 15e3  # of the model, not where its fit began
    assert law.shell_width_m == 0.06  # measured otherwise
    assert law.branch_share == (0.02, 0.03, 0.5)
    assert twin.load.mass_kg == 0.2 and twin.load.added_inertia_kg == 2e-3
    assert twin.amplifier.gain == 4000.0
    # capacitances read 2 % too high, on top of the bench's own error; latencies are not used
    assert twin.amplifier.i_monitor_gain_error == pytest.approx(1.02 * 1.01 - 1.0, rel=1e-12)
    assert twin.camera == bench.camera
    assert twin.origin is not None
    assert (twin.origin.actuator, twin.origin.file, twin.origin.draw) == ("leg", "leg.toml", None)
    assert twin.name == "twin of the identified actuator 'leg'"
    assert TwinConfig.model_validate(twin.model_dump(mode="json")) == twin
    assert load_twin(path) == identified_twin(path, TwinConfig())


def test_a_drift_begins_with_the_study(parts: Parts, path: Path) -> None:
    drift = {"drift.stiffness_per_s": -5e-5, "drift.stiffness_s": 600.0}
    parts.physical["parameters"] |= drift
    effects = load_twin(parts.written(path)).unmodelled
    assert effects.stiffness_loss == pytest.approx(0.03) and effects.ageing_s == 600.0
    assert effects.capacitance_rise == 0.0 and effects.begins_s == SETTLE_S


def test_another_kind_takes_its_own_parameters(parts: Parts, path: Path) -> None:
    parts.actuator |= {"kind": "dea-stack"}
    del parts.actuator["mass_kg"]
    assert parts.physical is not None
    parts.physical |= {"kind": "dea-stack", "parameters": {"actuator.permittivity": 3.3}}
    parts.covariance = {"names": ["actuator.permittivity"], "matrix": [[1e-4]]}
    twin = identified_twin(parts.written(path), twin_of_reading("rad"))
    assert twin.law == DeaStack(permittivity=3.3)
    assert twin.load.mass_kg == 0.25 and twin.load.added_inertia_kg == 0.0


def test_draws_follow_the_joint_distribution(parts: Parts, path: Path) -> None:
    file = parts.written(path)
    laws = [identified_twin(file, TwinConfig(), seed).law for seed in range(200)]
    mu = np.array([law.parameters()["shell.shear_modulus_pa"] for law in laws], dtype=float)
    locking = np.array([law.parameters()["shell.locking_stretch"] for law in laws], dtype=float)
    # 200 draws: the mean is off by 4 standard errors once in 16,000, the spread by 4 x 5 %
    assert np.log(mu).mean() == pytest.approx(np.log(15e3), abs=4.0 * 0.0333 / np.sqrt(200))
    assert np.log(mu).std() == pytest.approx(0.0333, rel=0.2)
    # both vary as they do in the fit: by a logarithm, and by an inverse square
    assert np.corrcoef(np.log(mu), locking**-2.0)[0, 1] == pytest.approx(-0.99, abs=0.01)
    again = identified_twin(file, TwinConfig(), 7)
    assert again.law == laws[7] and again.origin is not None and again.origin.draw == 7


def test_what_is_not_identifiable_is_drawn_from_its_distribution(parts: Parts, path: Path) -> None:
    assert parts.physical is not None
    parts.physical["not_identifiable"] = ["shell.locking_stretch"]
    parts.actuator["distribution"] = {
        "shell.locking_stretch": [3.3, 3.4], "shell.width_m": [0.04, 0.05],
    }  # fmt: skip
    file = parts.written(path)
    laws = [identified_twin(file, TwinConfig(), seed).law.parameters() for seed in range(50)]
    locking, mu, width = (
        np.array([law[f"shell.{name}"] for law in laws], dtype=float)
        for name in ("locking_stretch", "shear_modulus_pa", "width_m")
    )
    assert locking.min() >= 3.3 and locking.max() <= 3.4
    assert width.min() >= 0.04 and width.max() <= 0.05
    # the modulus goes along: its records say what the two are together
    gain = 0.99 * (500.0 / 15e3) / (2.0 * 0.2 / 3.5**3)
    expected = np.log(15e3) - gain * (locking**-2.0 - 3.5**-2.0)
    left = np.sqrt(1.0 - 0.99**2) * 500.0 / 15e3
    assert np.abs(np.log(mu) - expected).max() < 4.0 * left


def test_a_slightly_negative_inertia_is_an_error_of_its_estimate(parts: Parts, path: Path) -> None:
    assert parts.physical is not None
    parts.physical["parameters"]["load.added_inertia_kg"] = -1e-4
    assert load_twin(parts.written(path)).load.added_inertia_kg == 0.0
    drawn = [identified_twin(path, TwinConfig(), seed) for seed in range(20)]
    assert all(twin.load.added_inertia_kg >= 0.0 for twin in drawn)


def refused(parts: Parts, path: Path, words: str, draw: int | None = None) -> None:
    with pytest.raises(InputError, match=words) as found:
        identified_twin(parts.written(path), TwinConfig(), draw)
    assert str(path) in str(found.value) and "\n" not in str(found.value)


def test_a_file_that_gives_no_twin_is_refused_in_one_line(path: Path) -> None:
    refused(Parts(physical=None), path, r"no \[model\.physical\], .* identify actuator RUN")
    for change, words in (
        ({"status": "model error: the lengths are off"}, r"has the status 'model error: the len"),
        ({"kind": "dea-stack"}, r"of the kind 'dea-stack', but \[actuator\] of 'planar-hasel'"),
        ({"parameters": {"shell.shear_modulus_pa": 1e9}}, r"shell\.shear_modulus_pa = 1e\+09 is"),
        ({"parameters": {"shell.shear_modulus_pa": "soft"}}, r"parameters\.shell\.shear_modulus_"),
        ({"parameters": {"load.added_inertia_kg": -1.0}}, r"is -1 kg, but it must not be below 0"),
    ):
        parts = Parts()
        assert parts.physical is not None
        parts.physical |= change
        parts.covariance = {"names": [], "matrix": []}
        refused(parts, path, words)
    parts = Parts()
    parts.actuator["kind"] = "jellyfish"
    assert parts.physical is not None
    parts.physical["kind"] = "jellyfish"
    refused(parts, path, r"'jellyfish'.*planar-hasel")


def test_a_draw_without_a_distribution_is_refused_with_the_reason(path: Path) -> None:
    parts = Parts()
    assert parts.physical is not None
    parts.physical["not_identifiable"] = ["shell.locking_stretch"]
    refused(parts, path, r"shell\.locking_stretch cannot be drawn: it is not identifiable", 1)
    parts.actuator["distribution"] = {"shell.locking_stretch": [1.0, 2.0]}
    refused(parts, path, r"shell\.locking_stretch = 1 is outside \[1\.5, 50\]", 1)
    parts = Parts(covariance={"names": ["sensing.scale"], "matrix": [[1e-6]]})
    refused(parts, path, r"not that of its parameters \(load\.added_inertia_kg, shell", 1)
    parts = Parts(covariance={"names": ["sensing.scale"], "matrix": [[1e-6, 0.0]]})
    refused(parts, path, r"1 names need as many rows of as many numbers", 1)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ((0, 0, -1.0), r"covariance: the matrix has a negative variance \(-1\)"),
        ((0, 1, 1e9), r"covariance: the matrix is not symmetric"),
        ((None, 0, 1.01), r"covariance: the matrix has a negative eigenvalue"),
    ],
)
def test_an_edited_covariance_gives_no_draw(
    path: Path, changed: tuple[int | None, int, float], words: str
) -> None:
    parts = Parts()
    parts.written(path)
    matrix = parts.covariance["matrix"]
    row, column, value = changed
    if row is None:  # a correlation above 1, both ways
        matrix[0][1] = matrix[1][0] = value * np.sqrt(matrix[0][0] * matrix[1][1])
    else:
        matrix[row][column] = value
    refused(Parts(covariance=parts.covariance), path, words, 1)


def test_an_infinite_variance_is_no_fault_of_the_covariance() -> None:
    matrix = ((1.0, 0.5, np.nan), (0.5, 1.0, np.nan), (np.nan, np.nan, np.inf))
    assert PhysicalCovariance(names=("a", "b", "c"), matrix=matrix).matrix[0] == matrix[0]


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("mass_kg", 5000.0, r"mass_kg is 5000 kg, but a twin carries less than 20 kg"),
        ("sensing.scale", 1e6, r"sensing\.scale is 1e\+06, but a twin's current monitor"),
    ],
)
def test_a_value_beyond_the_twin_is_named_as_in_the_file(
    path: Path, key: str, value: float, words: str
) -> None:
    parts = Parts()
    assert parts.physical is not None
    table = parts.actuator if key == "mass_kg" else parts.physical["parameters"]
    table[key] = value
    refused(parts, path, words)


def test_a_rig_file_names_the_actuator_the_instruments_and_the_draw(
    parts: Parts, path: Path, tmp_path: Path
) -> None:
    parts.written(path)
    (tmp_path / "bench.toml").write_text("[amplifier]\ngain = 4000.0\n")
    rig = tmp_path / "rig.toml"
    rig.write_text('kind = "twin"\ntwin = "leg.toml"\nbench = "bench.toml"\ndraw = 3\n')
    twin = load_rig(rig).configuration(rig)
    assert twin.amplifier.gain == 4000.0 and twin.origin.draw == 3
    assert is_actuator_file(path) and not is_actuator_file(tmp_path / "bench.toml")
    rig.write_text('kind = "twin"\ntwin = "bench.toml"\ndraw = 3\n')
    with pytest.raises(InputError, match=r"draw = 3 needs an identified actuator\. Set twin to"):
        load_rig(rig).configuration(rig)
