"""Faults of a served bench, to practise finding them and to test the checks."""

from __future__ import annotations

from dataclasses import dataclass, field

from haselab.rig.twin.serve.camera_faults import CameraFaults
from haselab.rig.twin.serve.generator.state import GeneratorFaults
from haselab.rig.twin.serve.ni.bus import BoardFaults
from haselab.rig.twin.serve.supply.firmware import SupplyFaults
from haselab.rig.twin.serve.wiring import Wiring

__all__ = ["FAULTS", "BenchFaults"]


@dataclass(frozen=True)
class BenchFaults:
    """Faults of a bench; none by default.

    Args:
        wiring: between the instruments.
        board: of the acquisition.
        generator: of the function generator.
        supply: of the high-voltage supply.
        camera: of the camera, its link and its exposure line.
        at_amplifier_f: capacitor in place of the actuator, in F; None: the actuator.
    """

    wiring: Wiring = field(default_factory=Wiring)
    board: BoardFaults = field(default_factory=BoardFaults)
    generator: GeneratorFaults = field(default_factory=GeneratorFaults)
    supply: SupplyFaults = field(default_factory=SupplyFaults)
    camera: CameraFaults = field(default_factory=CameraFaults)
    at_amplifier_f: float | None = None


FAULTS: dict[str, BenchFaults] = {
    "voltage-monitor-off": BenchFaults(Wiring(v_monitor_gain=0.0)),
    "current-monitor-off": BenchFaults(Wiring(i_monitor_gain=0.0)),
    "monitors-swapped": BenchFaults(Wiring(swapped_monitors=True)),
    "voltage-monitor-reversed": BenchFaults(Wiring(v_monitor_gain=-1.0)),
    "current-monitor-reversed": BenchFaults(Wiring(i_monitor_gain=-1.0)),
    "voltage-monitor-scale": BenchFaults(Wiring(v_monitor_gain=2.5)),
    "current-monitor-scale": BenchFaults(Wiring(i_monitor_gain=0.5), at_amplifier_f=500e-12),
    "output-off": BenchFaults(Wiring(output_gain=0.0)),
    "output-reversed": BenchFaults(Wiring(output_gain=-1.0)),
    "output-scale": BenchFaults(Wiring(output_gain=0.5)),
    "generator-off": BenchFaults(Wiring(carrier_gain=0.0)),
    "generator-load": BenchFaults(Wiring(carrier_gain=0.5)),
    "generator-scale": BenchFaults(Wiring(carrier_gain=4.0)),
    "amplifier-off": BenchFaults(Wiring(carrier_gain=0.0, output_gain=0.0)),
    "input-floats": BenchFaults(Wiring(offset_v=3.0)),
    "mains-hum": BenchFaults(Wiring(hum_v=0.3)),
    "actuator-off": BenchFaults(at_amplifier_f=1e-12),
    "actuator-shorted": BenchFaults(at_amplifier_f=1e-6),
    "route-refused": BenchFaults(board=BoardFaults(refuse_routes=("20MHzTimebase",))),
    "tasks-orphaned": BenchFaults(board=BoardFaults(orphaned_tasks=True)),
    "usb-slow": BenchFaults(board=BoardFaults(usb_lag_samples=6000)),
    "second-program": BenchFaults(generator=GeneratorFaults(connections=0)),
    "supply-on-at-boot": BenchFaults(supply=SupplyFaults(stored_set_v=2000, stored_mode=1)),
    "supply-jack-out": BenchFaults(supply=SupplyFaults(jack_used=True, jack_in=False)),
    "supply-stays-on": BenchFaults(supply=SupplyFaults(stuck_v=800.0)),
    "supply-firmware": BenchFaults(supply=SupplyFaults(version="slave 6")),
    "supply-switchboard": BenchFaults(supply=SupplyFaults(version="slave 1", relays_open=True)),
    "network-lossy": BenchFaults(camera=CameraFaults(lost_share=0.05)),
    "camera-slow": BenchFaults(camera=CameraFaults(real_rate_hz=31.0)),
    "camera-ticks": BenchFaults(camera=CameraFaults(stamps_in_ticks=125e6)),
    "exposure-line-off": BenchFaults(camera=CameraFaults(exposure_line_dead=True)),
    "exposure-line-inverted": BenchFaults(camera=CameraFaults(exposure_line_inverted=True)),
}
"""By name; `haselab twin serve --fault NAME` serves one of them."""
