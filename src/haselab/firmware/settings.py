"""Settings compiled into the firmware: gains, maps and limits, as a C header with a checksum."""

from __future__ import annotations

import cmath
import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from haselab import _core
from haselab.base import InputError

__all__ = [
    "CAPACITANCE_NOISE",
    "CARRIER_HZ",
    "CURRENT_SHARE",
    "HIGHEST_DRIVE_V",
    "MOTION_RISE_V_PER_S",
    "OUTPUT_V_PER_CODE",
    "RATE_HZ",
    "UPDATE_AGE_S",
    "UPDATE_DELAY_S",
    "ChipSettings",
    "ControllerStep",
    "FrontEnd",
    "settings_crc",
    "settings_from_dict",
    "settings_header",
]

RATE_HZ = 1000
CARRIER_HZ = 5000.0
_SLOT_S = 125e-6
# From the middle of the samples that are used to the end of their frame, and to the output.
UPDATE_AGE_S, UPDATE_DELAY_S = 7.5 * _SLOT_S, 14.5 * _SLOT_S
CAPACITANCE_NOISE = 2.7e-3  # standard deviation of one update, relative; docs/control/firmware.md
CURRENT_SHARE = 0.2  # least amplitude in the current channel, of the carrier in the voltage channel
HIGHEST_DRIVE_V = 1.9  # of the output, whose converter reaches 2.048 V
MOTION_RISE_V_PER_S = 100.0  # of controllers that give the drive in V, from the identified motion
_SKEW_S = _SLOT_S  # from a reading of the voltage to the next of the current
_OUTPUT_V, _OUTPUT_CODES = 2.048, 4096
OUTPUT_V_PER_CODE = _OUTPUT_V / _OUTPUT_CODES
_TABLE_STEPS = 32
_SINGLE = 1e-6  # relative error of the map in single precision; the firmware limits the drive
_LARGEST = float(np.finfo(np.float32).max)
_PARAMETERS = 8  # HS_CONTROLLER_PARAMETERS of core/include/hs_controller.h
_BAND_PASS = 0.5996  # at 5 kHz, of one pole at 5 kHz and one at 8 kHz: the same in both channels
_FALLS = 5.0  # largest fall of the level per frame, relative to the fastest drive
_FILLED = 0.9  # of the converter's range, by the largest amplitude of the carrier
_FEWEST_CARRIER_CODES = 30  # where the quantisation is 1 % of the amplitude
_FEWEST_LEVEL_CODES = 2.0  # smallest deviation of the level that is a fault
_LEAST_FALL = 3  # codes, above the noise of a level that hardly changes
_MARGIN = 0.1  # plausible strain beyond the saturation: 0 V, creep


@dataclass(frozen=True)
class FrontEnd:
    """Analogue front end: from high voltage to codes, and from the output's code to high voltage.

    Args:
        gain: of the high-voltage module, V of its output for one of its input.
        volt_per_monitor_volt: of its voltage monitor.
        ampere_per_monitor_volt: of its current monitor.
        v_stage: mid-band gain of the band-pass stage before the voltage channel.
        i_stage: the same for the current channel.
        carrier_high_v: expected peak amplitude of the carrier at the actuator, in V.
        correction: complex ratio of measured to computed admittance, from a reference capacitor.
        converter_v: range of the microcontroller's converter, in V.
        converter_codes: number of its codes.
    """

    gain: float = 5000.0
    volt_per_monitor_volt: float = 5000.0
    ampere_per_monitor_volt: float = 2e-3
    v_stage: float = 50.0
    i_stage: float = 0.8
    carrier_high_v: float = 240.0
    correction: complex = 1.0
    converter_v: float = 5.0
    converter_codes: int = 1024

    @property
    def admittance_scale_s(self) -> complex:
        """Admittance, in S, for equal phasors of both channels, corrected for their skew."""
        ampere = self.ampere_per_monitor_volt / self.i_stage
        volt = self.volt_per_monitor_volt / self.v_stage
        turn = cmath.exp(-2j * math.pi * CARRIER_HZ * _SKEW_S)
        return self.correction * ampere / volt * turn

    @property
    def level_per_code(self) -> float:
        """Level codes per output code."""
        volt = _OUTPUT_V / _OUTPUT_CODES * self.gain / self.volt_per_monitor_volt
        return volt * self.converter_codes / self.converter_v

    @property
    def skew_s(self) -> float:
        """Time from a voltage reading to the next current reading, in s."""
        return _SKEW_S

    @property
    def volt_per_code(self) -> float:
        """Resolution of the converter that reads the monitors, in V."""
        return self.converter_v / self.converter_codes

    @property
    def v_stage_at_carrier(self) -> float:
        """Gain of the voltage channel's stage at the carrier."""
        return self.v_stage * _BAND_PASS

    @property
    def i_stage_at_carrier(self) -> float:
        """Gain of the current channel's stage at the carrier."""
        return self.i_stage * _BAND_PASS

    def current_codes(self, capacitance_f: float) -> float:
        """Expected peak amplitude of the current channel, in codes.

        Args:
            capacitance_f: of the actuator.
        """
        ampere = 2.0 * math.pi * CARRIER_HZ * capacitance_f * self.carrier_high_v
        volt = ampere / self.ampere_per_monitor_volt * self.i_stage_at_carrier
        return volt * self.converter_codes / self.converter_v

    @property
    def carrier_codes(self) -> float:
        """Expected peak amplitude of the voltage channel, in codes."""
        volt = self.carrier_high_v / self.volt_per_monitor_volt * self.v_stage_at_carrier
        return volt * self.converter_codes / self.converter_v


@dataclass(frozen=True)
class ControllerStep:
    """A user's controller in C, compiled in place of the PID.

    Args:
        kind: its name.
        parameters: names and values, in the order in which the C step gets them.
        source: text of the C file, see core/include/hs_controller.h.
        in_volts: whether its output is the drive in V, not a corrected strain.
    Raises:
        InputError: There are more parameters than the header can hold.
    """

    kind: str
    parameters: tuple[tuple[str, float], ...]
    source: str
    in_volts: bool = False

    def __post_init__(self) -> None:
        if len(self.parameters) > _PARAMETERS:
            raise InputError(
                f"Controller {self.kind!r} has {len(self.parameters)} parameters; the firmware "
                f"passes at most {_PARAMETERS} to a C step. Combine or drop some."
            )


@dataclass(frozen=True)
class ChipSettings:
    """All constants of `firmware/app`.

    Args:
        kp: strain per strain.
        ki: in 1/s.
        kd: in s.
        derivative_filter_s: time constant of the derivative's filter, in s.
        strain_low: lowest corrected strain.
        strain_high: highest one.
        voltage_map: `(a1_v, b1, a2_v, b2)` of corrected strain to drive.
        strain_map: `(slope_per_f, offset, curvature_per_f2, cubic_per_f3)` of capacitance to
            strain.
        front_end: monitors and stages.
        drive_high_v: highest drive, in V.
        rise_v_per_s: fastest change of the drive, in V/s.
        ramp_v_per_s: the same when ramping down.
        link_s: longest time without a message from the computer before the ramp, in s.
        settle_s: time after arming until the strain must be valid, in s.
        blind_updates: updates without a strain that trip it.
        level_off: largest deviation of the high voltage, as a fraction of its range.
        wrong_output_updates: updates with a larger deviation that trip it.
        own: a user's controller in place of the PID, whose gains are then not used.
        usable_f: capacitances for which the strain map may be used, in F, see
            `StrainMap.usable_f`; None: unknown.
    """

    kp: float
    ki: float
    kd: float
    derivative_filter_s: float
    strain_low: float
    strain_high: float
    voltage_map: tuple[float, float, float, float]
    strain_map: tuple[float, float, float, float]
    front_end: FrontEnd = field(default_factory=FrontEnd)
    drive_high_v: float = HIGHEST_DRIVE_V
    rise_v_per_s: float = 20.0
    ramp_v_per_s: float = 4.0
    link_s: float = 0.15
    settle_s: float = 0.05
    blind_updates: int = 3
    level_off: float = 0.15
    wrong_output_updates: int = 10
    own: ControllerStep | None = None
    usable_f: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd", "strain_low", "strain_high", "voltage_map", "strain_map"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(
                    f"{name} = {getattr(self, name)} of the microcontroller must be finite. Design "
                    "the controller again."
                )
        if not self.strain_low < self.strain_high:
            raise InputError(
                "The strains that the microcontroller's output reaches within the controller's "
                f"limits are {self.strain_low:g} to {self.strain_high:g}: no range is left. Give "
                "other --limits to 'haselab design'."
            )
        if not 0.0 < self.drive_high_v < _OUTPUT_V:
            raise InputError(
                f"drive_high_v is {self.drive_high_v:g} V, but it must be above 0 and below the "
                f"converter's {_OUTPUT_V:g} V. Change drive_high_v."
            )
        self._check_front_end()
        table, slack_v = self.table_v, _SINGLE * self.drive_high_v
        table = table if self.rises else table[::-1]
        ends_v = table[0] + slack_v, table[-1] - slack_v
        zero_v = _core.voltage_from_strain(*self.voltage_map, 0.0)
        if not (np.diff(table) > 0.0).all() or ends_v[0] < 0.0 or ends_v[1] > self.drive_high_v:
            if zero_v > self.drive_high_v:
                raise InputError(
                    f"A loop starts at zero strain, which needs {zero_v:.4g} V by the voltage map, "
                    f"but the microcontroller's output reaches {self.drive_high_v:g} V. Use an "
                    "amplifier with a higher gain, or define zero strain as the length at a lower "
                    "drive, and fit maps and model again."
                )
            raise InputError(
                f"The voltage map goes from {self.table_v[0]:g} V to {self.table_v[-1]:g} V over "
                "the saturation, but it must rise, or fall, everywhere within [0, "
                f"{self.drive_high_v:g}] V. Give narrower --limits to 'haselab design', or measure "
                "the voltage map again."
            )

        beyond = self.strain_high < 0.0 if self.rises else self.strain_low > 0.0
        if beyond:
            raise InputError(
                f"The highest drive, {max(self.table_v):.4g} V, gives a strain of "
                f"{self.strain_high if self.rises else self.strain_low:.3g}, but a loop starts at "
                f"zero strain, which needs {zero_v:.4g} V. Raise high_v in [drive] or drive_high_v "
                "of the rig, or widen the limits of [controller]."
            )

    def _check_front_end(self) -> None:
        """Refuse monitors and stages that saturate the converter, or that it cannot resolve."""
        front = self.front_end
        high_v = self.drive_high_v * front.gain
        monitor_v = high_v / front.volt_per_monitor_volt
        if monitor_v > front.converter_v:
            raise InputError(
                f"At the highest output, {high_v:g} V, the voltage monitor gives {monitor_v:.3g} "
                f"V, but the converter reads at most {front.converter_v:g} V. Use a monitor with "
                f"volt_per_monitor_volt of at least {math.ceil(high_v / front.converter_v)} in "
                "[front_end], or lower drive_high_v."
            )
        codes, fewest = monitor_v / front.volt_per_code, _FEWEST_LEVEL_CODES / self.level_off
        if codes < fewest:
            raise InputError(
                f"At the highest output, {high_v:g} V, the voltage monitor gives only "
                f"{codes:.2g} codes of the converter, but {math.ceil(fewest)} are needed to detect "
                "a wrong output. Use a monitor with volt_per_monitor_volt of at most "
                f"{math.floor(front.volt_per_monitor_volt * codes / fewest)} in [front_end]."
            )
        carrier, most = front.carrier_codes, _FILLED * 0.5 * front.converter_codes
        if not _FEWEST_CARRIER_CODES <= carrier <= most:
            advice = front.v_stage * 0.5 * (most + _FEWEST_CARRIER_CODES) / carrier
            raise InputError(
                f"The carrier of {front.carrier_high_v:g} V has an amplitude of {carrier:.3g} "
                f"codes in the voltage channel, but it must be {_FEWEST_CARRIER_CODES} to "
                f"{most:.0f} codes. Change carrier_high_v or v_stage in [front_end], for example "
                f"v_stage = {advice:.2g}."
            )

    @property
    def table_v(self) -> list[float]:
        """Drive at equal steps of corrected strain, in V, in single precision."""
        span = np.linspace(self.strain_low, self.strain_high, _TABLE_STEPS + 1)
        return [_core.voltage_from_strain(*self.voltage_map, float(u)) for u in span]

    @property
    def rises(self) -> bool:
        """Whether the voltage rises with the strain; it falls for an actuator that contracts."""
        return self.table_v[-1] > self.table_v[0]

    @property
    def strain_start(self) -> float:
        """Corrected strain from which a loop starts: that of the lowest voltage."""
        return self.strain_low if self.rises else self.strain_high

    @property
    def reference_limits(self) -> tuple[float, float]:
        """Lowest and highest desired strain: those of the output, and 0, where a loop starts."""
        return min(self.strain_low, 0.0), max(self.strain_high, 0.0)

    @property
    def sensing(self) -> tuple[float, float, int, int, int]:
        """Fields of `hs_quadrature_config`: the turn, in 1/F, and range of squared amplitudes."""
        turn = 2.0 * math.pi * CARRIER_HZ / self.front_end.admittance_scale_s
        v_low, v_high, i_low = (
            round((4.0 * share * self.front_end.carrier_codes) ** 2)
            for share in (0.6, 1.4, CURRENT_SHARE)
        )
        return turn.real, turn.imag, v_low, v_high, i_low

    @property
    def capacitance_range_f(self) -> tuple[float, float]:
        """Capacitances that count as valid, in F: of plausible strains, where the map is usable."""
        lowest, highest = self.strain_low - _MARGIN, self.strain_high + _MARGIN
        if self.usable_f is None:
            ends = [min(self._capacitances_f(strain), default=None) for strain in (lowest, highest)]
            reached = [end for end in ends if end is not None]
            if len(reached) < len(ends):
                raise InputError(
                    f"The strain map does not reach a strain of {lowest:g} or {highest:g}, but it "
                    f"must cover the saturation with a margin of {_MARGIN:g}. Fit it to a record "
                    "with haselab identify capacitance-map, which also states its range."
                )
            return min(reached), max(reached)
        low_f, high_f = self.usable_f
        middle_f = 0.5 * (low_f + high_f)  # of the record
        slope, offset, curvature, cubic = self.strain_map
        middle = ((cubic * middle_f + curvature) * middle_f + slope) * middle_f + offset
        if not lowest <= middle <= highest:
            raise InputError(
                f"The strain map is usable from {1e9 * max(low_f, 0.0):.3g} to "
                f"{1e9 * high_f:.3g} nF, but the saturation is "
                f"{self.strain_low:g} to {self.strain_high:g}, far from the strain of {middle:.3g} "
                "in its middle. Fit the map over a range that covers the saturation."
            )
        turns_f = _positive_roots([3e-27 * cubic, 2e-18 * curvature, 1e-9 * slope])
        ends_f = [*self._capacitances_f(lowest), *self._capacitances_f(highest), *turns_f]
        below = [end for end in ends_f if end < middle_f]
        return max([low_f, 0.0, *below]), min([high_f, *(end for end in ends_f if end > middle_f)])

    def _capacitances_f(self, strain: float) -> list[float]:
        """Positive capacitances at which the strain map gives a strain."""
        slope, offset, curvature, cubic = self.strain_map
        return _positive_roots([1e-27 * cubic, 1e-18 * curvature, 1e-9 * slope, offset - strain])


def _positive_roots(per_nf: list[float]) -> list[float]:
    """Positive roots, in F, of a polynomial in nF: in F its coefficients are 1e26 and 1."""
    roots = 1e-9 * np.roots(per_nf)
    return [float(r.real) for r in roots if abs(r.imag) <= 1e-9 * abs(r) and r.real > 0.0]


def settings_from_dict(data: Mapping[str, Any]) -> ChipSettings:
    """Read settings from their JSON form.

    Args:
        data: the fields of `ChipSettings`, those of its front end among them, `correction` as real
            and imaginary part.
    Returns:
        The settings.
    Raises:
        InputError: A field is missing, unknown or out of range.
    """
    fields = dict(data)
    try:
        front = dict(fields.pop("front_end"))
        front["correction"] = complex(*front.get("correction", (1.0, 0.0)))
        for name in ("voltage_map", "strain_map"):
            fields[name] = tuple(fields[name])
        # recorded before the map had a cubic factor
        fields["strain_map"] = (*fields["strain_map"], 0.0)[:4]
        if fields.get("usable_f") is not None:
            fields["usable_f"] = tuple(fields["usable_f"])
        if own := fields.get("own"):
            parameters = tuple((str(name), float(value)) for name, value in own["parameters"])
            in_volts = own.get("in_volts", False) is True
            fields["own"] = ControllerStep(
                str(own["kind"]), parameters, str(own["source"]), in_volts
            )
        return ChipSettings(**fields, front_end=FrontEnd(**front))
    except (KeyError, TypeError) as error:
        raise InputError(
            f"The recorded microcontroller settings are not valid ({error}). Record again."
        ) from None


def _single(value: float) -> str:
    """A C float literal that reads back as the nearest float."""
    if abs(value) > _LARGEST:
        raise InputError(
            f"A setting of the microcontroller is {value:.3g}, but it computes in single "
            f"precision, up to {_LARGEST:.3g}. Check the gains and the maps."
        )
    return f"{np.format_float_scientific(np.float32(value), unique=True)}f"


def settings_header(settings: ChipSettings) -> str:
    """settings.h for firmware/app.

    Args:
        settings: its contents.
    Returns:
        The text; its `crc` is the CRC-32 of the rest, which the firmware reports in its identity.
    """
    return _body(settings).replace("@CRC@", f"0x{settings_crc(settings):08x}u")


def settings_crc(settings: ChipSettings) -> int:
    """Checksum by which microcontroller and computer check that they have the same settings.

    Args:
        settings: gains, maps and limits.
    Returns:
        CRC-32 of settings.h without the checksum.
    """
    return zlib.crc32(_body(settings).replace("@CRC@", "").encode("ascii"))


def _row(*values: float) -> str:
    return "{" + ", ".join(map(_single, values)) + "}"


def _own_entries(s: ChipSettings, period_s: float) -> list[tuple[str, str]]:
    """Parameters of the controller: gains of the PID, or those of a user's controller."""
    if s.own is not None:
        values = [value for _, value in s.own.parameters]
        return [("controller.own.parameter", _row(*(values or [0.0])))]
    share = period_s / (period_s + s.derivative_filter_s)
    # An update as the unit of time: a division by 1 takes no cycles.
    gains = (s.kp, s.ki * period_s, s.kd / period_s, 1.0)
    return [("controller.own.pid", _row(*gains, share, s.strain_low, s.strain_high))]


def _title(s: ChipSettings) -> str:
    """First line of the header, which includes a user's controller in the checksum."""
    if s.own is None:
        return "/* Generated by haselab firmware build: change the model or the controller. */"
    source = zlib.crc32(s.own.source.encode())
    kind = re.sub(r"[^\w.-]", "_", s.own.kind)
    return f"/* Generated by haselab firmware build. Controller {kind}, CRC-32 {source}. */"


def _body(s: ChipSettings) -> str:
    codes_per_v = _OUTPUT_CODES / _OUTPUT_V
    level_per_v = codes_per_v * s.front_end.level_per_code
    period_s = 1.0 / RATE_HZ
    low_f, high_f = s.capacitance_range_f
    steps = _TABLE_STEPS / (s.strain_high - s.strain_low)
    fastest_v = max(s.rise_v_per_s, s.ramp_v_per_s) * period_s
    fall = max(math.floor(_FALLS * fastest_v * level_per_v), _LEAST_FALL)

    re, im, *squares = s.sensing
    sensing = ", ".join([_single(re), _single(im), *map(str, squares)])
    entries = [
        ("sensing", f"{{{sensing}}}"),
        ("capacitance_low_f", _single(low_f)),
        ("capacitance_high_f", _single(high_f)),
        ("strain", _row(*s.strain_map)),
        ("controller.period_s", _single(period_s)),
        ("controller.u_low", _single(s.strain_low)),
        ("controller.u_high", _single(s.strain_high)),
        ("controller.u_start", _single(s.strain_start)),
        *_own_entries(s, period_s),
        (
            "voltage",
            f"{{{_single(s.strain_low)}, {_single(steps)}, {_TABLE_STEPS}, voltage_table}}",
        ),
        ("in_volts", "1" if s.own is not None and s.own.in_volts else "0"),
        ("reference_low", _single(s.reference_limits[0])),
        ("reference_high", _single(s.reference_limits[1])),
        ("drive_high_v", _single(s.drive_high_v)),
        ("rise_v", _single(s.rise_v_per_s * period_s)),
        ("ramp_v", _single(s.ramp_v_per_s * period_s)),
        ("codes_per_v", _single(codes_per_v)),
        ("code_high", "SETTINGS_CODE_HIGH"),
        ("level_share", str(round(65536 * s.front_end.level_per_code))),
        ("level_off", str(round(s.level_off * s.drive_high_v * level_per_v))),
        ("link_updates", str(round(s.link_s * RATE_HZ))),
        ("settle_updates", str(round(s.settle_s * RATE_HZ))),
        ("token_updates", str(RATE_HZ)),
        ("blind_updates", str(s.blind_updates)),
        ("wrong_output_updates", str(s.wrong_output_updates)),
        ("rate_hz", str(RATE_HZ)),
        ("crc", "@CRC@"),
    ]
    table = ",\n    ".join(
        ", ".join(map(_single, s.table_v[k : k + 6])) for k in range(0, _TABLE_STEPS + 1, 6)
    )
    return "\n".join(
        [
            _title(s),
            "#ifndef SETTINGS_H",
            "#define SETTINGS_H",
            '#include "app.h"',
            f"#define SETTINGS_CODE_HIGH {math.floor(s.drive_high_v * codes_per_v)}u",
            f"#define SETTINGS_LEVEL_FALL {fall}u",
            f"static const float voltage_table[{_TABLE_STEPS + 1}] = {{\n    {table}}};",
            "static const app_config settings = {",
            *(f"    .{name} = {value}," for name, value in entries),
            "};",
            "#endif",
            "",
        ]
    )
