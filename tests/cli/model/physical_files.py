"""An actuator file, a session and tables of one actuator, for the tests of its predictions."""

import json

import numpy as np

from haselab.actuators import GRAVITY_M_S2, Drive, SampledLaw
from haselab.base import SilentProgress
from haselab.identify.physical.unknowns import INSTRUMENTS, fitted_parameters, usual
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.observer import FIDUCIALS
from haselab.runtime.runner import Runner
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.layout import ExperimentPlan
from haselab.study.definition import builtin_study
from haselab.study.run import RunOptions, recording, session_header

LAW = twin_of_reading("hz").planar_hasel
LENGTH_STD_M, CAPACITANCE_STD_F = 4e-6, 3.3e-13
GAIN, MASS_KG, ZERO_M = 5000.0, 0.2, 0.05


def written(path, *, status="ok", kind="planar-hasel", residuals=True, left_out="", **changed):
    """An actuator file whose model is the twin's truth, known to a part in 100,000."""
    values = {**fitted_parameters(LAW), "load.added_inertia_kg": 0.0}
    values |= {name: usual(name) for name in INSTRUMENTS}
    values |= {name.replace("__", "."): value for name, value in changed.items()}
    std = {name: 1e-5 * abs(value) or 1e-7 for name, value in values.items()}
    rows = np.diag(np.array(list(std.values())) ** 2).tolist()
    sections = {
        "actuator": f'[actuator]\nkind = "{kind}"\nmass_kg = {MASS_KG}\n',
        "geometry": f"[actuator.geometry]\nzero_length_m = {ZERO_M}\n",
        "drive": f"[drive]\ngain_v_per_v = {GAIN}\n",
        "physical": f'[model.physical]\nkind = "planar-hasel"\nstatus = "{status}"\n'
        "mass_kg = 0.25\n[model.physical.parameters]\n"
        + "".join(f'"{name}" = {value!r}\n' for name, value in values.items()),
        "covariance": f"[model.physical.covariance]\nnames = {json.dumps(list(values))}\n"
        f"matrix = {rows}\n",
        "residuals": f"[model.physical.residuals]\nlength_noise_m = {LENGTH_STD_M}\n"
        f"length_worst_m = {LENGTH_STD_M}\nlength_factor = 0.95\n"
        f"capacitance_noise_f = {CAPACITANCE_STD_F}\ncapacitance_worst_f = {CAPACITANCE_STD_F}\n"
        "hidden_variance = 1.0\n",
    }
    without = {left_out} | (set() if residuals else {"residuals"})
    without |= {"covariance", "residuals"} if left_out == "physical" else set()
    wanted = [text for name, text in sections.items() if name not in without]
    path.write_text("\n".join(wanted))
    return path


def played(folder):
    """Two short experiments of the twin with another mass. The first one begins under voltage."""
    config = twin_of_reading("hz")
    load = config.load.model_copy(update={"mass_kg": MASS_KG})
    config = config.model_copy(update={"load": load})
    rig = guard(make_twin(config, 3), Safety(SafetySettings()))
    arm_simulated(rig)
    options = RunOptions(folder, 3, "none", config.model_dump(mode="json"))
    header = session_header(builtin_study(quick=True), rig.description, options)
    plans = [ExperimentPlan(name, "steps", FIDUCIALS, {}) for name in ("step", "held")]
    with (
        recording(rig, options, header, plans) as (writer, camera),
        Runner(rig, writer, camera, 2000.0, 0.02, SilentProgress()) as runner,
    ):
        runner.settle(1.2, 0.5)
        runner.play("step", np.repeat([1.2, 0.4, 1.6], 60), 100.0, MASS_KG)
        runner.play("held", np.repeat([1.6, 0.9], 40), 100.0, MASS_KG)
    return folder


def table(path, *, seed=1, law=LAW, unit="m", first_v=0.0):
    """A table of the drive and what the law does, by the simulation alone."""
    rng = np.random.default_rng(seed)
    count = 800
    time_s = 0.01 * np.arange(count)
    u = np.repeat(rng.uniform(0.0, 1.8, 40), 20)
    u[:20] = first_v
    drive = Drive(
        np.append(time_s, 8.0), GAIN * u, np.full(count, MASS_KG * GRAVITY_M_S2),
        np.full(count, MASS_KG), np.zeros(count),
    )  # fmt: skip
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(GAIN * u[0], 0.0, MASS_KG * GRAVITY_M_S2)
    seen = sampled.respond(drive, time_s, start)
    length_m = seen.length_m + LENGTH_STD_M * rng.standard_normal(count)
    capacitance_f = law.capacitance_f(seen.length_m)
    measured = {
        "m": ("length_m", length_m),
        "1": ("strain", length_m / ZERO_M - 1.0),
        "F": ("capacitance_f", capacitance_f + CAPACITANCE_STD_F * rng.standard_normal(count)),
        "N": ("force_n", length_m),
    }
    name, values = measured[unit]
    rows = np.column_stack([time_s, u, values])
    np.savetxt(path, rows, "%.12g", ",", header=f"time_s,voltage_v,{name}", comments="")
    return path
