"""The twin's physics against independent routes: solve_ivp, root finding, linear systems, phasors.

The oracle below is written from the equations that native/twin/twin.c and twin.h state, in
continuous time, with the energy of Arruda and Boyce differentiated numerically.
"""

import numpy as np
import pytest
from scipy import optimize, signal, stats
from scipy.integrate import solve_ivp

from haselab.base import SafetyError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, TwinBench, describe, native_bench
from haselab.sensing import Lockin, LockinConfig

STEP_S = 1e-4  # of the mechanics: 20 samples of 200 kHz
LSB_V = 20.0 / 2**16


# A bench of its own, without the virgin's stiffness: the default one may be tuned to other data.
BENCH = {
    "shell": {"length_m": 0.0613, "width_m": 0.0392, "thickness_m": 1.2e-3},
    "electrodes": {"stiffness_n_per_m": 125.5, "stiffening": 0.4},
    "viscosity": {
        "share": (0.02, 0.02, 0.5),
        "relaxation_s": (0.1, 1.0, 3.4),
        "damping_n_s_per_m": 1.75,
    },
    "mullins": {"share": 0.0},
    "load": {"mass_kg": 0.25, "added_inertia_kg": 0.0},
    "dielectric": {
        "oil_volume_m3": 0.6e-6,
        "permittivity": 3.0,
        "capacitance_exponent": 3.62,
        "series_ohm": 5e3,
    },
}


def config_of(**sections: dict[str, object]) -> TwinConfig:
    """That bench with some values changed."""
    names = {*BENCH, *sections}
    return TwinConfig.model_validate(
        {name: {**BENCH.get(name, {}), **sections.get(name, {})} for name in names}
    )


class Oracle:
    """Forces and motion of a bench in continuous time."""

    def __init__(self, config: TwinConfig) -> None:
        self.config = config
        shell, oil = config.shell, config.dielectric
        self.rest_m = shell.length_m / np.sqrt(shell.lateral_stretch)
        thickness_m = shell.thickness_m + oil.oil_volume_m3 / (shell.length_m * shell.width_m)
        self.thickness_m = thickness_m / np.sqrt(shell.lateral_stretch)
        area_m2 = self.rest_m * shell.width_m * shell.lateral_stretch
        self.rest_f = 8.8541878128e-12 * oil.permittivity * area_m2 / self.thickness_m
        self.mass_kg = config.load.mass_kg + config.load.added_inertia_kg
        self.branches = list(
            zip(config.viscosity.share, config.viscosity.relaxation_s, strict=True)
        )

    def energy_density(self, stretch: float) -> float:
        shell = self.config.shell
        lateral = shell.lateral_stretch
        i1 = stretch**2 + lateral**2 + (stretch * lateral) ** -2
        terms = zip((1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750), range(1, 6), strict=True)
        return shell.shear_modulus_pa * sum(
            c / shell.locking_stretch ** (2 * i - 2) * (i1**i - 3**i) for c, i in terms
        )

    def elastic_n(self, length_m: float) -> float:
        shell, gel = self.config.shell, self.config.electrodes
        stretch, h = length_m / shell.length_m, 1e-3
        w = [self.energy_density(stretch + k * h) for k in (-2, -1, 1, 2)]
        stress_pa = (w[0] - 8 * w[1] + 8 * w[2] - w[3]) / (12 * h)  # fourth order
        strain = length_m / self.rest_m - 1
        spring_n = gel.stiffness_n_per_m * self.rest_m * strain * (1 + gel.stiffening * strain**2)
        return shell.width_m * shell.thickness_m * stress_pa + spring_n

    def capacitance_f(self, length_m: float) -> float:
        return self.rest_f * (length_m / self.rest_m) ** self.config.dielectric.capacitance_exponent

    def electric_n(self, length_m: float, voltage_v: float) -> float:
        """Half V^2 dC / dx, the derivative taken numerically."""
        h = 1e-6
        slope = (self.capacitance_f(length_m + h) - self.capacitance_f(length_m - h)) / (2 * h)
        return 0.5 * voltage_v**2 * slope

    def rest_length_m(self, load_n: float, voltage_v: float) -> float:
        return optimize.brentq(
            lambda x: load_n + self.electric_n(x, voltage_v) - self.elastic_n(x), 0.03, 0.1
        )

    def motion(self, start: np.ndarray, load_n: float, voltage_v: float, times_s: np.ndarray):
        """Lengths at `times_s`; state: length, speed, branch forces, slow voltage."""
        damping = self.config.viscosity.damping_n_s_per_m
        oil = self.config.dielectric

        def rates(_: float, y: np.ndarray) -> list[float]:
            length, speed, *branches, slow_v = y
            h = 1e-5
            stiffness = (self.elastic_n(length + h) - self.elastic_n(length - h)) / (2 * h)
            pull_v = (1 - oil.relaxation_share) * voltage_v + oil.relaxation_share * slow_v
            force = load_n + self.electric_n(length, pull_v) - self.elastic_n(length)
            force -= sum(branches) + damping * speed
            flows = [
                g * stiffness * speed - b / tau
                for b, (g, tau) in zip(branches, self.branches, strict=True)
            ]
            return [
                speed,
                force / self.mass_kg,
                *flows,
                (voltage_v - slow_v) / oil.relaxation_s,
            ]

        found = solve_ivp(
            rates, (0, times_s[-1]), start, t_eval=times_s, method="LSODA", rtol=1e-9, atol=1e-12
        )
        assert found.success
        return found.y[0]


def moved(config: TwinConfig, load_n: float, voltage_v: float, duration_s: float) -> np.ndarray:
    bench = native_bench(config, 0)
    lengths = np.empty(round(duration_s * config.acquisition.rate_hz / 20))
    bench.move(np.array([voltage_v / config.amplifier.gain]), lengths.size, load_n, lengths)
    return lengths


def trajectory_error(config: TwinConfig, voltage_v: float, load_n: float) -> tuple[float, float]:
    """Largest distance to the oracle over 2 s from rest, and the range of the motion, in m."""
    oracle = Oracle(config)
    step_s = 20 / config.acquisition.rate_hz
    lengths = moved(config, load_n, voltage_v, 2.0)
    every = round(0.01 / step_s)
    times_s = step_s * np.arange(every, lengths.size + 1, every)
    start = np.zeros(3 + len(oracle.branches))
    start[0] = oracle.rest_m
    truth = oracle.motion(start, load_n, voltage_v, np.concatenate([[0.0], times_s]))[1:]
    return float(np.abs(lengths[every - 1 :: every] - truth).max()), float(np.ptp(truth))


# ---- mechanics ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("voltage_v", "load_n", "sections"),
    [
        pytest.param(0.0, 0.4, {}, id="free response to a dropped load"),
        pytest.param(4000.0, 0.0, {}, id="voltage step"),
        pytest.param(4000.0, 1.0, {"viscosity": {"share": (), "relaxation_s": ()}}, id="elastic"),
        pytest.param(
            4000.0,
            1.0,
            {"dielectric": {"relaxation_share": 0.4, "relaxation_s": 0.3}},
            id="oil that charges slowly",
        ),
    ],
)
def test_motion_is_that_of_the_equations(voltage_v, load_n, sections):
    """Order 4 in steps of 2.5 ms, and the law's table: 5e-6 of the motion."""
    error_m, range_m = trajectory_error(config_of(**sections), voltage_v, load_n)
    assert error_m < 5e-6 * range_m


@pytest.mark.parametrize("voltage_v", [0.0, 5000.0, 9000.0])
@pytest.mark.parametrize("mass_kg", [0.0, 0.25])
def test_static_length_balances_load_field_and_shell(voltage_v, mass_kg):
    config = config_of()
    oracle = Oracle(config)
    load_n = mass_kg * GRAVITY_M_S2
    # The slowest branch creeps with 3.4 s (1 + 0.5 k / k_total), at most 15 s where the field
    # takes most of the stiffness k: after 400 s, e^-26 of it is left.
    lengths = moved(config, load_n, voltage_v, 400.0)
    # The table's error between its lengths is below 1e-7 of the force.
    assert lengths[-1] == pytest.approx(oracle.rest_length_m(load_n, voltage_v), rel=1e-8)


def test_elastic_force_is_the_derivative_of_the_energy():
    config = config_of()
    bench, oracle = native_bench(config, 0), Oracle(config)
    for length_m in np.linspace(0.9, 2.2, 14) * oracle.rest_m:
        # The table is good to 1e-7 here, the oracle's fourth-order difference to 1e-10.
        assert bench.elastic_force(length_m) == pytest.approx(
            oracle.elastic_n(length_m), rel=2e-7, abs=2e-8
        )


def test_the_virgin_shell_is_stiffer_and_loses_it_for_good():
    config = config_of(mullins={"share": 0.2, "stretch": 1.3, "width": 0.01})
    bench, soft = native_bench(config, 0), Oracle(config)
    length_m = 1.1 * soft.rest_m
    assert bench.elastic_force(length_m) == pytest.approx(1.2 * soft.elastic_n(length_m), rel=2e-7)
    bench.move(np.array([0.0]), 1, 6.0, lengths := np.empty(20000))
    reached = lengths.max() / soft.rest_m
    assert reached > 1.5
    bench.move(np.array([0.0]), 1, 0.0, lengths)  # back again
    lost = 0.2 / (1 + np.exp((reached - 1.3) / 0.01))
    assert bench.elastic_force(length_m) == pytest.approx(
        (1 + lost) * soft.elastic_n(length_m), rel=2e-7
    )


# ---- charge ---------------------------------------------------------------------------------


def test_capacitance_is_the_plate_formula_at_rest_and_a_power_law_beyond():
    config = config_of()
    bench, oracle = native_bench(config, 0), Oracle(config)
    # By hand: 3 * 8.854 pF/m * 35.39 mm * 117.6 mm / 0.837 mm, in the study's 0.3 to 5 nF.
    assert bench.capacitance(oracle.rest_m) == pytest.approx(0.132e-9, rel=0.01)
    for stretch in (0.9, 1.3, 1.8):
        length_m = stretch * oracle.rest_m
        assert bench.capacitance(length_m) == pytest.approx(
            oracle.capacitance_f(length_m), rel=1e-7
        )


def acquired(config: TwinConfig, *, noise: bool, **settings: float):
    """Blocks of a fresh bench: codes `(blocks, 2000, 2)` and the bench."""
    bench = native_bench(config, int(settings.pop("seed", 0)), noise=noise)
    bench.carrier_v = settings.get("carrier_v", 0.0)
    bench.carrier_rad_s = 2 * np.pi * settings.get("carrier_hz", 2000.0)
    blocks = int(settings.get("blocks", 1))
    codes, lengths = np.empty((blocks, 2000, 2), dtype=np.int16), np.empty(100)
    drive_v = settings.get("drive_v", 0.0)
    for k, block in enumerate(codes):
        bench.acquire(
            0.0 if k == 0 else drive_v, drive_v, int(settings.get("at", 0)),
            settings.get("load_n", 0.0), block, lengths,
        )  # fmt: skip
    return codes, bench


HELD = {"added_inertia_kg": 999.0}  # the sheet stays where it is
FREE = {"slew_v_per_s": 1e15, "current_limit_a": 1e3}


def test_amplifier_step_is_that_of_the_second_order_system():
    config = config_of(amplifier=FREE)
    codes, _ = acquired(config, noise=False, drive_v=1.0, at=400)
    omega, damping = 2 * np.pi * 6000.0, 0.6
    _, response = signal.step(
        ([omega**2], [1, 2 * damping * omega, omega**2]), T=np.arange(1600) / 200e3
    )
    # 1 V of drive is 5 kV at the output and 1 V on the monitor; a code is read to half a step.
    volts = codes[0, :, 0] * LSB_V
    assert (volts[:401] == 0.0).all()
    np.testing.assert_allclose(volts[400:], response, atol=0.5 * LSB_V * (1 + 1e-6))


@pytest.mark.parametrize(
    ("amplifier", "volt_per_s"),
    [
        pytest.param({"slew_v_per_s": 2e6, "current_limit_a": 1e3}, lambda c: 2e6, id="slew"),
        pytest.param(
            {"slew_v_per_s": 1e15, "current_limit_a": 2e-4}, lambda c: 2e-4 / c, id="current"
        ),
    ],
)
def test_a_large_step_rises_at_the_limit_of_slew_or_current(amplifier, volt_per_s):
    config = config_of(amplifier=amplifier, load=HELD)
    codes, bench = acquired(config, noise=False, drive_v=2.0)
    limit = volt_per_s(Oracle(config).capacitance_f(bench.length_m))
    rise_v = np.diff(codes[0, 20:400, 0]) * LSB_V * 5000.0 * 200e3
    code_v_s = LSB_V * 5000.0 * 200e3  # half a code at each of the two ends
    assert rise_v.mean() == pytest.approx(limit, abs=code_v_s / rise_v.size, rel=1e-6)
    assert rise_v.max() <= limit + code_v_s
    assert bench.limited_samples > 380


@pytest.mark.parametrize("series_ohm", [5e3, 100e3])
@pytest.mark.parametrize("skew_s", [0.0, 1e-6, 2.5e-6])
def test_the_carrier_sees_a_series_resistor_and_capacitor(series_ohm, skew_s):
    r"""The converters see the current as the twin forms it, which costs at most 1e-3 at 2 kHz.

    The voltage goes from sample to sample in a straight line, $(\omega T)^2/12$ of its carrier; the
    current is the mean of a sample, $(\omega T)^2/24$, read on a line between the middles of two,
    $(\omega T)^2/8$: together $(\omega T)^2/4$.
    """
    config = config_of(
        dielectric={"series_ohm": series_ohm},
        acquisition={"skew_s": skew_s},
        amplifier=FREE,
        load=HELD,
    )
    codes, bench = acquired(config, noise=True, carrier_v=0.5, blocks=20)
    rig = describe(config)
    lockin = Lockin(
        LockinConfig(
            rate_hz=200e3,
            block_samples=2000,
            carrier_hz=2000.0,
            skew_s=skew_s,
            ohm_per_ratio=rig.i_monitor_v_per_a / rig.v_monitor_v_per_v,
        )
    )
    sensed = lockin.sense(codes[1:])  # the amplifier has settled
    omega = 2 * np.pi * 2000.0
    z = series_ohm + 1 / (1j * omega * bench.capacitance(bench.length_m))
    noise = 5 * sensed.capacitance_std_f.mean() / np.sqrt(19) / sensed.capacitance_f.mean()
    bound = (omega / 200e3) ** 2 / 4 + noise
    assert sensed.capacitance_f.mean() * omega * abs(z.imag) == pytest.approx(
        1.0, abs=bound * abs(z) / abs(z.imag)
    )
    assert sensed.resistance_ohm.mean() == pytest.approx(series_ohm, abs=bound * abs(z))


def test_leakage_draws_its_current_at_rest():
    config = config_of(dielectric={"leakage_ohm": 2e6})
    codes, _ = acquired(config, noise=False, drive_v=1.0, blocks=3)
    # 5 kV over 2 Mohm is 2.5 mA, and 1.25 V on the monitor of 2 mA per V; the sheet moves on.
    assert codes[-1, -1, 1] * LSB_V == pytest.approx(1.25, abs=LSB_V + 1e-3)


# ---- converters -----------------------------------------------------------------------------


def test_codes_are_rounded_to_the_nearest_and_stop_at_the_ends():
    config = config_of(amplifier={**FREE, "volt_per_monitor_volt": 400.0})
    codes, bench = acquired(config, noise=False, drive_v=0.7, blocks=3)
    assert codes[-1, -1, 0] == round(bench.output_v / 400.0 / LSB_V)
    codes, _ = acquired(config, noise=False, drive_v=2.0, blocks=3)  # 10 kV: 25 V on a 10 V range
    assert codes[-1, -1, 0] == 32767
    codes, _ = acquired(config, noise=False, drive_v=-2.0, blocks=3)
    assert codes[-1, -1, 0] == -32768


def test_noise_is_white_normal_and_of_the_configured_size():
    config = config_of(acquisition={"v_noise_v": 3e-3, "i_noise_v": 5e-3})
    codes, _ = acquired(config, noise=True, blocks=100)
    volts = codes.reshape(-1, 2) * LSB_V
    n = len(volts)
    for channel, sigma_v in zip(volts.T, (3e-3, 5e-3), strict=True):
        expected = np.hypot(sigma_v, LSB_V / np.sqrt(12))
        assert channel.std() == pytest.approx(expected, rel=5 / np.sqrt(2 * n))
        assert abs(channel.mean()) < 5 * expected / np.sqrt(n)
        assert abs(stats.skew(channel)) < 5 * np.sqrt(6 / n)
        # Rounding to 10 steps a sigma takes (1/12)^2 1.2 / 10^4 of the kurtosis: nothing.
        assert abs(stats.kurtosis(channel)) < 5 * np.sqrt(24 / n)
        for lag in (1, 2, 100, 2000):
            r = np.corrcoef(channel[lag:], channel[:-lag])[0, 1]
            assert abs(r) < 5 / np.sqrt(n)
    assert abs(np.corrcoef(volts.T)[0, 1]) < 5 / np.sqrt(n)


def test_one_seed_gives_the_same_bits_and_another_seed_others():
    config = config_of()
    settings = {"drive_v": 1.0, "carrier_v": 0.02, "blocks": 20, "load_n": 2.45}
    first, bench = acquired(config, noise=True, seed=3, **settings)
    again, same = acquired(config, noise=True, seed=3, **settings)
    other, moved_alike = acquired(config, noise=True, seed=4, **settings)
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5
    # The noise is the converters': it moves nothing.
    assert bench.length_m == same.length_m == moved_alike.length_m


def test_acquisition_and_motion_alone_are_the_same_mechanics():
    config = config_of()
    both = [native_bench(config, 0) for _ in range(2)]
    lengths, codes = np.empty((2, 1000)), np.empty((20000, 2), dtype=np.int16)
    both[0].acquire(0.0, 0.0, 0, 1.5, codes, lengths[0])
    both[1].move(np.zeros(1), 1, 1.5, lengths[1])
    np.testing.assert_allclose(*lengths, rtol=2e-7)  # steps of 0.1 ms beside such of 2.5 ms
    assert both[0].time_s == pytest.approx(both[1].time_s, rel=1e-12)


# ---- the bench as a rig ---------------------------------------------------------------------


def test_breakdown_comes_at_its_field_and_takes_the_output_away():
    limit_v_m = 5e6
    bench = TwinBench(config_of(dielectric={"breakdown_v_per_m": limit_v_m}), 0)
    with pytest.raises(SafetyError, match=r"Dielectric breakdown .* The output is at 0 V"):
        for drive_v in np.arange(0.0, 2.0, 0.01):
            bench.write(drive_v)
            bench.read()
    oracle = Oracle(config_of())
    # Volume is constant: d ~ 1 / area, and C ~ area / d, so d follows C to the power of -1/2.
    native = bench._native
    ratio = native.capacitance(native.length_m) / oracle.rest_f
    broken_v = limit_v_m * oracle.thickness_m / np.sqrt(ratio)
    assert drive_v * 5000 == pytest.approx(broken_v, abs=0.01 * 5000 * 1.2)
    assert bench.output_v == 0.0
    bench.zero()


def test_a_new_output_takes_effect_where_the_description_says():
    config = config_of(amplifier=FREE)
    bench = TwinBench(config, 0, noise=False)
    bench.write(1.0)
    volts = bench.read()[:, 0] * LSB_V
    at = describe(config).switch_sample
    assert at == 400
    assert (volts[: at + 1] == 0.0).all()
    assert volts[at + 2] > 0.0
    assert volts[-1] == pytest.approx(1.0, abs=LSB_V)


def test_the_weight_hangs_still_when_a_study_begins():
    bench = TwinBench(config_of(), 0)
    start_m = bench._native.length_m
    bench.wait(10.0)
    # Creep of the slowest branch, 3.4 s (1 + 0.5), is over: e^(-120 / 5.1) = 6e-11 of the sag.
    assert bench._native.length_m == pytest.approx(start_m, rel=1e-9)
