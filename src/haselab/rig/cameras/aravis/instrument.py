"""`kind = "aravis"`: GenICam cameras as an instrument of rig files."""

from __future__ import annotations

from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.aravis.source import AravisSource
from haselab.rig.cameras.config import AravisConfig
from haselab.rig.cameras.opened import OpenedCamera, opened_timed
from haselab.rig.cameras.timed import TimedCamera
from haselab.rig.instruments.instrument import CameraContext, CameraInstrument, SystemNeeds

__all__ = ["AravisInstrument"]


class AravisInstrument(CameraInstrument[AravisConfig]):
    """GenICam over GigE Vision or USB3 Vision."""

    kind = "aravis"
    config = AravisConfig
    library = "Aravis"
    purpose = "GenICam cameras"

    def check_driver(self) -> list[str]:
        """See `Instrument`."""
        AravisLibrary()
        return ["aravis"]

    def system_needs(self, config: AravisConfig) -> SystemNeeds:
        """See `Instrument`: the network or the USB port, and the size of a frame."""
        frame_bytes = None
        if config.width_px is not None and config.height_px is not None:
            frame_bytes = config.width_px * config.height_px
        return SystemNeeds(genicam=config.name or "", frame_bytes=frame_bytes)

    def open(self, config: AravisConfig, context: CameraContext) -> OpenedCamera:
        """See `CameraInstrument`."""
        source, exposures = AravisSource(config, context.exposure_line), context.exposures
        return opened_timed(TimedCamera(source, context.clock, config.timing, exposures=exposures))
