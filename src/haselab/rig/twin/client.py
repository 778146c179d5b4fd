"""Client of a served twin's stand, camera and meters."""

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
    """One frame of the twin's camera as it arrived over a link.

    Args:
        image: grey levels, shape `(height, width)`.
        number: of the frame, starting with 1; a gap is a lost frame.
        ticks: of the camera's clock at the beginning of the exposure.
        arrival_s: arrival on the clock of the inputs, in s.
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
        timeout_s: for one reply.
    Raises:
        DeviceError: The twin does not reply.
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
        self._answered = True  # whether the last request has got its reply

    def _dead(self, error: BaseException) -> DeviceError:
        return DeviceError(
            f"The served twin does not reply ({error or type(error).__name__}). Start it with "
            f"haselab twin serve, or change stand.address. {self._address}"
        )

    def _ask(self, do: str, **values: float) -> tuple[dict[str, Any], bytes]:
        request = json.dumps({"do": do, **values}).encode("ascii") + b"\n"
        try:
            with self._turn:  # one thread reads the camera, another one ends the run
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
            raise LimitError(
                f"The mass is {mass_kg:g} kg, but it must be within [0, 20] kg. Use another mass."
            )
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
            rate_hz: frames per second.
            exposure_s: of each frame, in s; 0: as in the twin's file. It shifts the edges of the
                exposure line and the frames' arrival; the blur of the images does not change.
        """
        if not math.isfinite(rate_hz):
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, but it must be above 0. Change the frame rate."
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
        """Return frames as a camera sends them: late, numbered, with stamps of its own clock."""
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
            DeviceError: The twin does not reply.
        """
        self._ask("stop_camera")

    def meters(self) -> JsonObject:
        """True values of the bench: `output_v`, `length_m`; `protected`, the reason of a trip."""
        return self._ask("meters")[0]

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):  # nothing reads what was left to write
            self._stream.close()
        self._socket.close()
