"""What is compiled in: the maps of the core, limits in order, one checksum."""

from __future__ import annotations

import cmath
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab import _core
from haselab.base import InputError
from haselab.firmware import ChipSettings, FrontEnd, settings_header
from haselab.firmware.messages import VERSION, Hello, Identity
from haselab.rig.chip import CoSim, read_design

ACTUATOR = """\
[drive]
[drive.voltage_map]  # eq. 4
a1_v = 1.324
b1 = 3.124
a2_v = -0.2805
b2 = -26.92
[sensing.strain_map]
slope_per_f = 8.09e8
offset = -0.38
[controller]
kind = "pid"
[controller.parameters]
kp = 0.85
ki = 1.5
[controller.limits]
low = -0.05
high = 0.1
"""


@pytest.fixture
def actuator(tmp_path: Path) -> Path:
    path = tmp_path / "a.toml"
    path.write_text(ACTUATOR)
    return path


def numbers_of(header: str, name: str) -> list[float]:
    found = re.search(rf"\.{name} = \{{?([^}};]*?)\}}?,\n", header)
    assert found is not None, name
    return [float(word.strip().rstrip("f")) for word in found[1].split(",")]


def test_the_table_is_the_map_in_single_precision(settings: ChipSettings) -> None:
    strain = np.linspace(settings.strain_low, settings.strain_high, 33)
    expected = [_core.voltage_from_strain(*settings.voltage_map, float(u)) for u in strain]
    text = settings_header(settings)
    table = re.search(r"voltage_table\[33\] = \{(.*?)\}", text, re.DOTALL)
    assert table is not None
    reported = [float(np.float32(word.strip().rstrip("f"))) for word in table[1].split(",")]
    assert reported == expected
    # Straight lines between: the error of a chord is at most h^2 / 8 of the second derivative.
    a1, b1, a2, b2 = settings.voltage_map
    fine = np.linspace(settings.strain_low, settings.strain_high, 3201)
    exact = a1 * np.exp(b1 * fine) + a2 * np.exp(b2 * fine)
    bend = np.abs(a1 * b1**2 * np.exp(b1 * fine) + a2 * b2**2 * np.exp(b2 * fine)).max()
    h = strain[1] - strain[0]
    assert np.abs(np.interp(fine, strain, reported) - exact).max() <= bend * h**2 / 8.0 + 1e-6


def test_gains_are_those_of_an_update_as_the_unit_of_time(settings: ChipSettings) -> None:
    kp, ki, kd, period, share, low, high = numbers_of(settings_header(settings), "pid")
    assert (kp, period) == (pytest.approx(settings.kp, rel=1e-7), 1.0)
    assert ki == pytest.approx(settings.ki * 1e-3, rel=1e-7)
    assert kd == pytest.approx(settings.kd * 1e3, rel=1e-7)
    assert share == pytest.approx(1e-3 / (1e-3 + settings.derivative_filter_s), rel=1e-7)
    assert (low, high) == (pytest.approx(settings.strain_low), pytest.approx(settings.strain_high))


def test_the_scale_is_that_of_monitors_and_stages_turned_back_by_the_skew() -> None:
    front = FrontEnd()
    capacitance_f, omega = 500e-12, 2.0 * math.pi * 5000.0
    v = 239.0 * cmath.exp(0.3j)
    i = 1j * omega * capacitance_f * v
    v_code = v / 5000.0 * 50.0
    i_code = i / 2e-3 * 0.8 * cmath.exp(1j * omega * 125e-6)  # seen a slot later
    assert front.admittance_scale_s * i_code / v_code == pytest.approx(1j * omega * capacitance_f)


def test_the_level_may_fall_by_five_times_what_the_fastest_drive_does(
    settings: ChipSettings,
) -> None:
    def fall(changed: ChipSettings) -> int:
        found = re.search(r"SETTINGS_LEVEL_FALL (\d+)u", settings_header(changed))
        assert found is not None
        return int(found[1])

    # 20 V/s in 1 ms, the module's gain back through its monitor, in steps of 5 V / 1024.
    assert fall(settings) == math.floor(5 * 0.02 * 1024 / 5.0) == 20
    assert fall(replace(settings, rise_v_per_s=40.0)) == math.floor(10 * 0.02 * 1024 / 5.0)
    finer = FrontEnd(converter_v=3.3, converter_codes=4096)
    assert fall(replace(settings, front_end=finer)) == math.floor(5 * 0.02 * 4096 / 3.3)
    # Of a slow module the ramp to 0 V is faster, and the last code of the converter is noise.
    assert fall(replace(settings, rise_v_per_s=0.2)) == math.floor(5 * 0.004 * 1024 / 5.0) == 4
    assert fall(replace(settings, rise_v_per_s=0.2, ramp_v_per_s=0.2)) == 3


def test_another_converter_reads_the_same_world(settings: ChipSettings) -> None:
    """Range and codes scale what is in codes, and nothing that is not."""
    front = FrontEnd(converter_v=3.3, converter_codes=4096)
    other, scale = replace(settings, front_end=front), (4096 / 3.3) / (1024 / 5.0)
    text, known = settings_header(other), settings_header(settings)
    for name in ("level_share", "level_off"):
        ours, theirs = numbers_of(text, name)[0], numbers_of(known, name)[0]
        assert abs(ours - scale * theirs) <= 0.5 + 0.5 * scale  # both were rounded
    re_, im, *squares = numbers_of(text, "sensing")
    was = numbers_of(known, "sensing")
    assert [re_, im] == was[:2]  # a ratio of codes
    for ours, theirs in zip(squares, was[2:], strict=True):
        assert abs(ours - scale**2 * theirs) <= 0.5 + 0.5 * scale**2
    for name in ("strain", "pid", "codes_per_v", "drive_high_v", "rise_v", "capacitance_low_f"):
        assert numbers_of(text, name) == numbers_of(known, name)


def test_the_range_of_the_strain_map_is_compiled_in(actuator: Path) -> None:
    """The width of the fitted range beyond it, where that is less than the plausible strains."""
    free = read_design(actuator, None, FrontEnd()).settings
    low_f, high_f = free.capacitance_range_f
    map_ = "offset = -0.38\n"
    text = actuator.read_text()
    # the saturation, -0.05 to 0.1, is 408 to 593 pF of this map
    actuator.write_text(text.replace(map_, f"{map_}range_f = [4.5e-10, 5.5e-10]\n"))
    found = read_design(actuator, None, FrontEnd()).settings
    assert found.capacitance_range_f == pytest.approx((3.5e-10, 6.5e-10))
    assert low_f < 3.5e-10 and high_f > 6.5e-10
    text_h = settings_header(found)
    assert numbers_of(text_h, "capacitance_high_f") == [6.5e-10]
    assert settings_header(free) != text_h  # and so the checksums
    actuator.write_text(text.replace(map_, f"{map_}range_f = [9.0e-10, 9.5e-10]\n"))
    with pytest.raises(InputError, match=r"usable from 0\.85 to 1 nF, but the satur"):
        _ = read_design(actuator, None, FrontEnd()).settings.capacitance_range_f


@pytest.mark.parametrize(
    ("strain_map", "usable_f"),
    [
        # fitted to 149 to 284 pF; the cubics turn back beyond, or reach no strain of -0.1 or 0.17
        ((4.54e8, -0.07437, 3.68e17, -5.52e26), (1.35e-11, 4.2e-10)),
        ((-4.36e8, -0.01287, 4.579e18, -7.0796e27), (1.35e-11, 4.2e-10)),
        ((5.33e8, -0.08, 0.0, 0.0), (1.35e-11, 4.2e-10)),
    ],
)
def test_the_range_of_an_actuator_that_doubles_its_capacitance_is_about_its_record(
    strain_map: tuple[float, float, float, float],
    usable_f: tuple[float, float],
    settings: ChipSettings,
) -> None:
    found = replace(
        settings, strain_low=0.0, strain_high=0.0715, strain_map=strain_map, usable_f=usable_f
    )
    low_f, high_f = found.capacitance_range_f
    assert usable_f[0] <= low_f < 1.49e-10 and 2.84e-10 < high_f <= usable_f[1]
    c = np.linspace(low_f, high_f, 500)
    assert (np.diff(np.polyval([*strain_map[:1:-1], *strain_map[:2]], c)) > 0.0).all()


def test_the_range_of_capacitance_covers_the_saturation(settings: ChipSettings) -> None:
    low_f, high_f = settings.capacitance_range_f
    slope, offset, curvature, cubic = settings.strain_map
    strain = [((cubic * c + curvature) * c + slope) * c + offset for c in (low_f, high_f)]
    assert strain == pytest.approx([settings.strain_low - 0.1, settings.strain_high + 0.1])


def test_the_firmware_reports_its_checksum(settings: ChipSettings, chip: CoSim) -> None:
    text = settings_header(settings)
    crc = int(re.search(r"\.crc = (0x\w+)u", text)[1], 16)  # type: ignore[index]
    assert crc == zlib.crc32(re.sub(r"0x\w+u", "", text).encode("ascii"))
    assert chip.query(Hello(VERSION)) == Identity(VERSION, crc, 1000, 225)
    assert settings_header(replace(settings, kp=settings.kp * 1.01)) != text


def test_a_run_of_an_older_version_gives_settings() -> None:
    found = read_design(Path(__file__).parent / "data", "pi", FrontEnd()).settings
    assert (found.kp, found.ki) == (0.42775446150769936, 0.7548608144253519)
    assert found.voltage_map[0] == 1.5864046147442545
    assert found.strain_map[0] == 809223847.7412881


def test_an_actuator_file_gives_settings_and_its_drive_limits_them(actuator: Path) -> None:
    found = read_design(actuator, "pid", FrontEnd()).settings
    assert (found.kp, found.ki, found.strain_high) == (0.85, 1.5, 0.1)
    assert found.voltage_map == (1.324, 3.124, -0.2805, -26.92)
    assert found.drive_high_v == 1.9  # what the chip's own output may reach
    text = actuator.read_text()
    actuator.write_text(text.replace("[drive]", "[drive]\nhigh_v = 1.8"))
    assert read_design(actuator, "pid", FrontEnd()).settings.drive_high_v == 1.8
    actuator.write_text(text.replace("[drive]", "[drive]\nhigh_v = 1.5"))
    design = read_design(actuator, "pid", FrontEnd())
    # 1.5 V is at a strain of 0.053738 (test_maps); the search has steps of 1e-4.
    assert design.limits == (-0.05, 0.1)
    assert 0.053638 <= design.settings.strain_high <= 0.053738
    assert design.settings.table_v[-1] <= 1.5
    actuator.write_text(text.replace("[drive]", "[drive]\nhigh_v = 0.9"))
    with pytest.raises(InputError, match=r"zero strain, which needs 1\.04.*a\.toml"):
        read_design(actuator, "pid", FrontEnd())


def test_a_map_that_reaches_exactly_the_highest_drive_is_used(settings: ChipSettings) -> None:
    """Rounding to single precision is no reason to refuse it: the firmware limits the drive."""
    highest_v = np.float32(settings.table_v[-1])
    for end in (0.0, np.inf):
        beside_v = float(np.nextafter(highest_v, np.float32(end)))
        assert replace(settings, drive_high_v=beside_v).drive_high_v == beside_v
    with pytest.raises(InputError, match=r"everywhere within"):
        replace(settings, drive_high_v=float(highest_v) - 1e-4)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"drive_high_v": 1.2}, "everywhere within"),
        ({"drive_high_v": 0.9}, r"zero strain, which needs .* V by the voltage map, but the"),
        ({"drive_high_v": 2.5}, "below the converter's"),
        ({"kp": math.nan}, "must be finite"),
        ({"strain_low": 0.2}, "no range is left"),
        ({"voltage_map": (0.4, -30.0, 0.4, 30.0)}, "must rise, or fall, everywhere"),
        # 1.9 V times 5000 through the monitor is 19 V, or 0.95 V * 0.15 / (5 V / 1024) < 2 codes
        (
            {"front_end": FrontEnd(volt_per_monitor_volt=500.0)},
            "the voltage monitor gives 19 V, .* at least 1900 in",
        ),
        (
            {"front_end": FrontEnd(volt_per_monitor_volt=1e5, gain=500.0)},
            r"only 1\.9 codes of the converter, but 14 are needed .* at most 14592 in",
        ),
        ({"front_end": FrontEnd(v_stage=100.0)}, "amplitude of 589 codes .* 30 to 461 codes"),
        ({"front_end": FrontEnd(carrier_high_v=20.0)}, r"amplitude of 24\.6 codes"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(
    changes: dict[str, Any], match: str, settings: ChipSettings
) -> None:
    with pytest.raises(InputError, match=match):
        replace(settings, **changes)


@pytest.mark.parametrize("changes", [{"kd": 1e36}, {"strain_map": (8.09e8, -0.38, 0.0, 1e39)}])
def test_a_number_beyond_single_precision_is_refused(
    changes: dict[str, Any], settings: ChipSettings
) -> None:
    with pytest.raises(InputError, match=r"is 1e\+39, but it computes in single precision"):
        settings_header(replace(settings, **changes))


def test_an_actuator_that_contracts_starts_at_its_longest(settings: ChipSettings) -> None:
    """Mirrored maps: the strain of 0 V is at the upper end, and all numbers are mirrored."""
    a1_v, b1, a2_v, b2 = settings.voltage_map
    mirrored = replace(
        settings,
        voltage_map=(a1_v, -b1, a2_v, -b2),
        strain_map=tuple(-x for x in settings.strain_map),
        strain_low=-settings.strain_high,
        strain_high=-settings.strain_low,
    )
    assert (settings.strain_start, settings.rises) == (settings.strain_low, True)
    assert (mirrored.strain_start, mirrored.rises) == (mirrored.strain_high, False)
    assert mirrored.table_v == pytest.approx(settings.table_v[::-1], rel=1e-6)
    assert mirrored.capacitance_range_f == pytest.approx(settings.capacitance_range_f)
    text = settings_header(mirrored)
    assert numbers_of(text, "controller.u_start") == numbers_of(text, "controller.u_high")


def test_the_capacitances_are_on_the_branch_of_the_fitted_range(settings: ChipSettings) -> None:
    """A falling cubic has a minimum below its range, where the same strains occur again."""
    # strain = 0.02 - (c - 1)^2 (c + 0.5) / 10 with c in nF: falls from 1 nF on, rises below
    slope, offset, curvature, cubic = 0.0, 0.02 - 0.05, 0.15, -0.1
    map_ = (1e9 * slope, offset, 1e18 * curvature, 1e27 * cubic)
    wide = replace(settings, strain_low=-0.02, strain_high=0.015, strain_map=map_)
    low_f, high_f = replace(wide, usable_f=(0.6e-9, 2.2e-9)).capacitance_range_f
    assert low_f == pytest.approx(1e-9)  # its turning point
    c = 1e9 * high_f
    assert offset + curvature * c**2 + cubic * c**3 == pytest.approx(-0.12)


def test_a_map_that_does_not_cover_the_saturation_is_refused(settings: ChipSettings) -> None:
    flat = replace(settings, strain_map=(1e6, 0.0, -1e20, 0.0))
    with pytest.raises(InputError, match="does not reach a strain"):
        settings_header(flat)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[drive.voltage_map]", "[other]", r"no \[drive\.voltage_map\].*identify voltage-map"),
        ("[sensing.strain_map]", "[other]", r"no \[sensing\.strain_map\].*identify capacitance"),
        ("[controller.parameters]", "[other]", r"no \[controller\].*haselab design"),
        ('kind = "pid"', 'kind = "pi"', r"no controller of kind 'pid', only pi"),
        ("[controller.limits]", "[other]", "no limits of its output"),
        ("kp =", "kq =", r"\[controller\.parameters\] lacks kp"),
    ],
)
def test_a_section_that_is_missing_is_named_with_what_writes_it(
    old: str, new: str, match: str, actuator: Path
) -> None:
    actuator.write_text(actuator.read_text().replace(old, new))
    with pytest.raises(InputError, match=match) as caught:
        read_design(actuator, "pid", FrontEnd())
    assert str(actuator) in str(caught.value)
