"""Capabilities of the emulated NI devices: rates, counters, timebases, terminals, routes.

Sources, by the letters used below:

- (a) NI USB-621x User Manual: p. 4-14 to 4-17 (sample and convert clock), 5-8 (AO sample clock),
  8-33 (counter triggering), 9-27 (gate), 10-1 (timebases).
- (b) X Series User Manual: tables 4-5 and 4-8 (rates), p. 5-9 (AO sample clock), 7-38 (gate), 7-45
  (counter triggering), 7-47 (100 MHz source).
- (c) Linux, drivers/comedi/drivers/ni_routing/ni_device_routes/pci-6221.c: the direct routes that
  NI MAX shows for a PCI-6221, whose counters are those of the USB-621x.
- (d) labscript-devices, NI_DAQmx/models/capabilities.json: attributes read from real devices
  (output rates, delay of the first conversion after the start trigger).
- (e) ni.com, cDAQ-9178 and cDAQ-9187 manuals, Counter n Source and Counter n Sample Clock: the same
  timing chip as the X Series. That an X Series device takes the same there is inferred, and so are
  the output rates of USB-6212 (a vendor's data sheet) and PCIe-6321.

Only direct routes are accepted. A real device with RTSI lines may find an indirect one: this one is
stricter, so that what passes here needs nothing that another program could occupy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from haselab.rig.twin.serve.ni.status import StatusError, StatusNumber

__all__ = ["DEVICES", "NiDevice", "check_route"]

_M_SERIES, _X_SERIES = 14643, 15858  # DAQmx product categories
_USB, _PCIE, _PXIE = 12586, 13612, 14706  # DAQmx bus types
_PADDING_S = 10e-6  # settling time that the driver adds between two conversions: (a) 4-16
_M_TIMEBASES = {"20MHzTimebase": 20e6, "80MHzTimebase": 80e6, "100kHzTimebase": 100e3}
_X_TIMEBASES = {"20MHzTimebase": 20e6, "100MHzTimebase": 100e6, "100kHzTimebase": 100e3}


@dataclass(frozen=True)
class NiDevice:
    """One product.

    Args:
        product: name, as the device reports it.
        category: DAQmx product category.
        bus: DAQmx bus type.
        inputs: analogue, single-ended.
        outputs: analogue.
        counters: general-purpose, 32 bit.
        single_rate_hz: highest rate of one input.
        aggregate_rate_hz: of all inputs together; of a simultaneous device that of each input.
        output_rate_hz: highest of the outputs.
        timebases: by name, in Hz.
        clock_hz: timebase that the sample and the convert clock are divided from.
        start_ticks: of `clock_hz` from the start trigger to the first sample clock.
        convert_ticks: of `clock_hz` from a sample clock to its first conversion.
        trigger_lines: name of its eight lines to other boards; empty: none, as on all USB devices.
        simultaneous: one converter for each input.
    """

    product: str
    category: int
    bus: int
    inputs: int
    outputs: int
    counters: int
    single_rate_hz: float
    aggregate_rate_hz: float
    output_rate_hz: float
    timebases: dict[str, float] = field(default_factory=lambda: dict(_X_TIMEBASES))
    clock_hz: float = 100e6
    start_ticks: int = 4
    convert_ticks: int = 3
    trigger_lines: str = ""
    simultaneous: bool = False

    @property
    def usb(self) -> bool:
        """Its samples travel over USB."""
        return self.bus == _USB

    @property
    def m_series(self) -> bool:
        """M Series: a counter's sample clock and its start trigger share the gate input."""
        return self.category == _M_SERIES

    @property
    def first_sample_s(self) -> float:
        """From the start trigger to the first conversion, in s."""
        convert = 0 if self.simultaneous else self.convert_ticks
        return (self.start_ticks + convert) / self.clock_hz

    def terminals(self) -> frozenset[str]:
        """Names of the terminals that can be a source, without the device."""
        names = [f"PFI{k}" for k in range(16)]
        names += [f"{self.trigger_lines}{k}" for k in range(8) if self.trigger_lines]
        names += [*self.timebases]
        names += ["ai/SampleClock", "ai/StartTrigger", "ai/ReferenceTrigger", "ai/ConvertClock"]
        names += ["ao/SampleClock", "ao/StartTrigger", "di/SampleClock", "do/SampleClock"]
        for k in range(self.counters):
            names += [f"Ctr{k}{what}" for what in ("InternalOutput", "Source", "Gate")]
        return frozenset(names)

    def sources(self, destination: str) -> frozenset[str]:
        """Terminals that are wired to an input of the device.

        Args:
            destination: as `Ctr0Source`, `Ctr1ArmStartTrigger`, `ao/SampleClock`.
        """
        starts = ("PFI", self.trigger_lines) if self.trigger_lines else ("PFI",)
        lines = {name for name in self.terminals() if name.startswith(starts)}
        if not destination.startswith("Ctr"):
            return frozenset(lines | self._clock_sources(destination))
        counter, what = destination[:4], destination[4:]
        others = [f"Ctr{k}" for k in range(self.counters) if f"Ctr{k}" != counter]
        gate_only = {"ai/StartTrigger", "ai/ReferenceTrigger"}
        if what == "Source":  # (c), (e)
            found = {*self.timebases} | {f"{other}Gate" for other in others}
        elif what == "ArmStartTrigger":  # (c); on X Series inferred from (b) 7-45
            found = gate_only | {f"{other}InternalOutput" for other in others}
        else:  # (a) 9-27, (b) 7-38; a counter's sample clock is its gate there, (e) here
            found = gate_only | {"ao/SampleClock"}
            found |= {f"{o}{end}" for o in others for end in ("InternalOutput", "Source")}
            if self.m_series or what == "SampleClock":
                found |= {"ai/SampleClock", "ai/ConvertClock"}
            if not self.m_series:
                found |= {"di/SampleClock", "do/SampleClock"}
        return frozenset(lines | found)

    def _clock_sources(self, destination: str) -> set[str]:
        outputs = {f"Ctr{k}InternalOutput" for k in range(self.counters)}
        if destination == "ao/SampleClock":  # (a) 5-8, (b) 5-9
            clocks = {"ai/SampleClock", "ai/ConvertClock", "di/SampleClock", "do/SampleClock"}
            return outputs | (set() if self.m_series else clocks)
        return outputs  # ai/SampleClock, ai/StartTrigger: (a) 4-14, 4-21

    def convert_rate_hz(self, channels: int, rate_hz: float) -> float:
        """Rate of the convert clock that the driver chooses.

        The fastest conversion with 10 us for settling, or spread evenly where that does not fit:
        USB-621x User Manual p. 4-16. It is divided down from the timebase.

        Args:
            channels: in the task.
            rate_hz: of the sample clock.
        """
        period_s = 1.0 / self.aggregate_rate_hz + _PADDING_S
        if channels * period_s > 1.0 / rate_hz:
            period_s = 1.0 / (channels * rate_hz)
        return self.clock_hz / math.floor(period_s * self.clock_hz + 1e-6)

    def allowed_rate_hz(self, channels: int) -> float:
        """Highest sample clock for so many inputs."""
        if self.simultaneous or channels <= 1:
            return self.single_rate_hz
        return self.aggregate_rate_hz / channels


def _m_series_usb(product: str, rate_hz: float) -> NiDevice:
    """Delay of 250 ns: 2 + 3 ticks of 20 MHz, (a) 4-14 and 4-17, as (d) reads from a USB-6229."""
    return NiDevice(
        product, _M_SERIES, _USB, 16, 2, 2, rate_hz, rate_hz, 250e3,
        timebases=dict(_M_TIMEBASES), clock_hz=20e6, start_ticks=2,
    )  # fmt: skip


DEVICES: dict[str, NiDevice] = {
    device.product: device
    for device in (
        _m_series_usb("USB-6212", 400e3),
        # 16 inputs, 2 MS/s and 1 MS/s, 2.86 MS/s out: (b) table 4-5, (d) PXIe-6361.
        NiDevice("USB-6361", _X_SERIES, _USB, 16, 2, 4, 2e6, 1e6, 20e6 / 7),
        NiDevice(
            "PCIe-6321", _X_SERIES, _PCIE, 16, 2, 4, 250e3, 250e3, 900e3, trigger_lines="RTSI"
        ),
        NiDevice(
            "PXIe-6363", _X_SERIES, _PXIE, 32, 4, 4, 2e6, 1e6, 20e6 / 7, trigger_lines="PXI_Trig"
        ),
        # Simultaneous: (b) table 4-8, (d).
        NiDevice("USB-6366", _X_SERIES, _USB, 8, 2, 4, 2e6, 2e6, 10e6 / 3, simultaneous=True),
    )
}


def check_route(
    device: NiDevice, name: str, source: str, destination: str, refused: tuple[str, ...] = ()
) -> str:
    """Refuse a route that the device does not have.

    Args:
        device: the product.
        name: of the device, as `Dev1`.
        source: terminal, as `/Dev1/PFI0`.
        destination: input of the device, see `NiDevice.sources`.
        refused: terminals, or `source>destination`, that a planted fault has broken.
    Returns:
        The terminal without the device.
    Raises:
        StatusError: no such terminal, or no such route.
    """
    prefix, _, terminal = source.removeprefix("/").partition("/")
    known = {one.lower(): one for one in device.terminals()}
    if prefix != name or terminal.lower() not in known:
        raise StatusError(StatusNumber.UNKNOWN_TERMINAL, route=(terminal or source, destination))
    terminal = known[terminal.lower()]
    broken = terminal in refused or f"{terminal}>{destination}" in refused
    if broken or terminal not in device.sources(destination):
        raise StatusError(StatusNumber.NO_ROUTE, route=(terminal, destination))
    return terminal
