"""Section `daq` of RIG.toml for NI-DAQmx."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from haselab.rig.instruments.sections import DaqConfig, ExposureConfig

__all__ = ["NidaqConfig"]


class NidaqConfig(DaqConfig):
    """NI-DAQmx: two inputs, one output, and a counter that ties the output to the blocks."""

    kind: Literal["nidaq"] = "nidaq"
    device: str = Field("Dev1", min_length=1, description="name in NI MAX or `nilsdev`")
    server: str | None = Field(None, description="host:port of an NI gRPC device server")
    serial_number: str | None = Field(None, description="hexadecimal, as printed on the device")
    v_monitor: str = "ai0"
    i_monitor: str = "ai1"
    output: str = "ao0"
    counter: str = "ctr0"
    wiring: Literal["RSE", "NRSE", "DIFF"] = "DIFF"
    buffer_s: float = Field(10.0, ge=0.5, le=60)
    timeout_s: float = Field(1.0, gt=0, le=30, description="beyond the duration of a block")
    server_patience_s: float = Field(
        2.0, gt=0, le=30, description="for a server's reply, beyond the duration of the call"
    )

    def check_exposure(self, line: ExposureConfig) -> None:
        """See `DaqConfig.check_exposure`: the line needs a separate counter."""
        if line.counter == self.counter:
            raise ValueError(f"exposure.counter: {self.counter} clocks the output; choose another")
