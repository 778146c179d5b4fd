"""Compute the load of a network link by camera frames."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["GVSP_HEADERS", "LinkLoad"]

GVSP_HEADERS = 36  # header bytes of a packet: IP 20, UDP 8, GVSP 8
_ETHERNET = 38  # bytes around a packet: preamble 8, header 14, checksum 4, gap 12


@dataclass(frozen=True)
class LinkLoad:
    """Frames over an Ethernet link.

    Args:
        payload_bytes: of a frame.
        rate_hz: of the frames.
        packet_bytes: of a packet with its IP header, as `GevSCPSPacketSize` counts.
        link_bit_s: of the link.
    Example:
        >>> load = LinkLoad(512 * 512, 400.0, 1500, 1e9)
        >>> round(load.byte_s / 1e6, 1), round(load.share, 3)
        (104.9, 0.881)
    """

    payload_bytes: int
    rate_hz: float
    packet_bytes: int
    link_bit_s: float

    @property
    def byte_s(self) -> float:
        """Image data per second, in bytes."""
        return self.payload_bytes * self.rate_hz

    @property
    def share(self) -> float:
        """Load of the link, with headers and gaps; above 1 the frames do not fit."""
        whole = self.packet_bytes + _ETHERNET
        return 8.0 * self.byte_s * whole / (self.packet_bytes - GVSP_HEADERS) / self.link_bit_s

    @property
    def most_hz(self) -> float:
        """Highest frame rate that fits."""
        return self.rate_hz / self.share
