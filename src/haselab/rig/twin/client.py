"""Client of the twin's stand and camera where the twin is served over the wire."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, JsonObject, LimitError
from haselab.rig import Frames

__all__ = ["SentFrame", "TwinClient"]

_KINDS = {"LimitError": LimitError, "InputError": InputError}


@dataclass(frozen=True)
class SentFrame:
    """One frame of the twin's camera as it came over a link.

    Args:
        image: grey levels, shape `(height, width)`.
        number: of the frame, from 1 on; a gap is a lost one.
        ticks: of the camera's clock at the beginning of the exposure.
        arrival_s: when it came, on the clock of the inputs, in s.
        exposure_s: the camera's exposure time.
    """

    image: NDArray[np.uint8]
    number: int
    ticks: int
    arrival_s: float
    exposure_s: float


class TwinClient:
    """Stand, camera and meters of a served twin.

    Args:
        address: host:port.
        timeout_s: for one answer.
    Raises:
        DeviceError: nobody answers there.
    """

    def __init__(self, address: str, timeout_s: float = 30.0) -> None:
        self._address, self._timeout_s = address, timeout_s
        self._turn = threading.Lock()
        self._connect()

    def _connect(self) -> None:
        host, _, port = self._address.rpartition(":")
        try:
            self._socket = socket.create_connection((host, int(port)), timeout=self._timeout_s)
        except (OSError, ValueError) as error:
            raise self._dead(error) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._stream = self._socket.makefile("rwb")
        self._answered = True  # no answer to an earlier request is still to come

    def _dead(self, error: BaseException) -> DeviceError:
        return DeviceError(
            f"The served twin does not answer ({error or type(error).__name__}). Start it with "
            f"haselab twin serve, or correct stand.address. {self._address}"
        )

    def _ask(self, do: str, **values: float) -> tuple[dict[str, Any], bytes]:
        request = json.dumps({"do": do, **values}).encode("ascii") + b"\n"
        try:
            with self._turn:  # one thread looks at the camera, another one ends the run
                if not self._answered:  # the last request was interrupted, as by Ctrl-C
                    self.close()
                    self._connect()
                self._answered = False
                self._stream.write(request)
                self._stream.flush()
                reported: dict[str, Any] = json.loads(self._stream.readline())
                data = self._stream.read(reported["bytes"])
                self._answered = True
        except (OSError, ValueError, KeyError) as error:
            raise self._dead(error) from None
        if "error" in reported:
            raise _KINDS.get(reported.get("kind", ""), DeviceError)(reported["error"])
        return reported, data

    def hang(self, mass_kg: float) -> None:
        """See `haselab.rig.LoadStand`."""
        if not math.isfinite(mass_kg):
            raise LimitError(f"Mass = {mass_kg:g} kg is outside [0, 20] kg. Hang another mass.")
        self._ask("hang", mass_kg=mass_kg)

    def lift(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._ask("lift")

    def drop(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._ask("drop")

    def start(self, rate_hz: float, exposure_s: float = 0.0) -> None:
        """See `haselab.rig.Camera`.

        Args:
            rate_hz: frames a second.
            exposure_s: of each, in s; 0: as in the twin's own file. It moves the edges of the
                exposure line and the frames' arrival; how much a picture blurs stays.
        """
        if not math.isfinite(rate_hz):
            raise LimitError(
                f"Frame rate = {rate_hz:g} Hz is outside (0, inf) Hz. Lower the request."
            )
        self._ask("start_camera", rate_hz=rate_hz, exposure_s=exposure_s)

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`."""
        reported, data = self._ask("take")
        if not reported["time_s"]:
            return None
        images = np.frombuffer(data, dtype=np.uint8).reshape(reported["shape"])
        return Frames(images, np.array(reported["time_s"], dtype=float))

    def take_sent(self) -> list[SentFrame]:
        """Frames as a camera sends them: late, numbered, with stamps of its own clock."""
        reported, data = self._ask("take")
        if not reported["time_s"]:
            return []
        images = np.frombuffer(data, dtype=np.uint8).reshape(reported["shape"])
        columns = zip(
            images, reported["number"], reported["ticks"], reported["arrival_s"], strict=True
        )
        exposure_s = float(reported["exposure_s"])
        return [
            SentFrame(image, int(number), int(ticks), float(arrival_s), exposure_s)
            for image, number, ticks, arrival_s in columns
        ]

    def stop(self) -> None:
        """See `haselab.rig.Camera`.

        Raises:
            DeviceError: the twin is gone.
        """
        self._ask("stop_camera")

    def meters(self) -> JsonObject:
        """Voltmeter and ruler on the bench: `output_v`, `length_m`; `protected`, the reason."""
        return self._ask("meters")[0]

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):  # what was left to write has no reader any more
            self._stream.close()
        self._socket.close()
