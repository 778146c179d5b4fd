"""`kind = "nidaq"`: NI boards as an instrument of rig files."""

from __future__ import annotations

from collections.abc import Iterator

from haselab.rig.check_result import CheckResult
from haselab.rig.drivers import load_driver
from haselab.rig.instruments.devices import DaqDevice
from haselab.rig.instruments.instrument import DaqInstrument, OpenContext, SystemNeeds
from haselab.rig.instruments.nidaq.board import NidaqBoard
from haselab.rig.instruments.nidaq.link import NidaqLink, key_of
from haselab.rig.instruments.nidaq.routes import verify_routes
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.sections import ExposureConfig

__all__ = ["NidaqInstrument"]


class NidaqInstrument(DaqInstrument[NidaqConfig]):
    """NI boards through NI-DAQmx, on this computer or over NI's gRPC device server."""

    kind = "nidaq"
    config = NidaqConfig
    packages = ("nidaqmx", "grpcio")
    purpose = "NI boards, also over NI's gRPC device server"

    def check_driver(self) -> list[str]:
        """See `Instrument`."""
        for module in ("nidaqmx", "grpc"):
            load_driver(module, "The NI board")
        return ["nidaqmx", "grpc"]

    def system_needs(self, config: NidaqConfig) -> SystemNeeds:
        """See `Instrument`."""
        return SystemNeeds(local_daq=config.server is None)

    def connect(self, config: NidaqConfig) -> NidaqLink:
        """See `DaqInstrument`."""
        return NidaqLink(config)

    def key_of(self, config: NidaqConfig) -> str | None:
        """See `DaqInstrument`: by the serial number."""
        return key_of(config.serial_number) if config.serial_number else None

    def open(self, config: NidaqConfig, context: OpenContext, connection: NidaqLink) -> DaqDevice:
        """See `DaqInstrument`."""
        d = context.description
        return NidaqBoard(
            config, d.drive_limits, d.monitor_v_per_drive_v, context.exposure, connection
        )

    def route_checks(
        self, config: NidaqConfig, exposure: ExposureConfig | None, connection: NidaqLink
    ) -> Iterator[CheckResult]:
        """See `DaqInstrument`; verifies, reserves and commits every task."""
        for row in verify_routes(config, exposure, connection):
            found, recommended = "accepted", {}
            if row.skew_s is not None:
                found, recommended = f"{1e6 * row.skew_s:g} us", {"daq.skew_s": row.skew_s}
            yield CheckResult(
                "dry",
                f"board: {row.task}",
                row.fault.rstrip(".") or found,
                row.ok,
                recommended=recommended,
                criterion="the board accepts the task",
            )
