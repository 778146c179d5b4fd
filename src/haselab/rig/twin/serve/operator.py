"""Serve the twin's stand, camera and meters, which have no instrument protocol, over a socket.

A request is a line of JSON, `{"do": "hang", "mass_kg": 0.25}`; the reply is a line of JSON,
followed by frames with as many bytes as its `bytes` states.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from haselab.base import HaselabError, InputError
from haselab.rig.twin.serve.camera_faults import CameraLink
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.lines import LineServer

__all__ = ["TwinClientServer"]

_Act = Callable[..., dict[str, Any] | None]


class TwinClientServer:
    """Serves a hub's stand, camera and meters on a loopback port.

    Args:
        hub: the bench.
        port: 0: any free one.
        allow_others: also serve clients of other users of this computer.
    """

    def __init__(self, hub: TwinHub, port: int = 0, *, allow_others: bool = False) -> None:
        self._hub = hub
        self._camera, self._exposure_s = CameraLink(hub.camera_faults), hub.exposure_s
        # by name: the numbers that it takes, and what it does with them
        self._acts: dict[str, tuple[tuple[str, ...], _Act]] = {
            "hang": (("mass_kg",), hub.hang),
            "lift": ((), hub.lift),
            "drop": ((), hub.drop),
            "start_camera": (("rate_hz", "exposure_s"), self._start_camera),
            "stop_camera": ((), hub.stop_camera),
            "meters": ((), self._meters),
        }
        self._server = LineServer(self, port, "twin client", allow_others=allow_others)
        self.address = f"127.0.0.1:{self._server.port}"

    def close(self) -> None:
        """Stop serving."""
        self._server.close()

    def answer(self, line: str) -> bytes:
        """The answer to one request, with its frames."""
        images = b""
        try:
            do, numbers = self._request(line)
            if do == "take":
                reported, images = self._take()
            else:
                reported = self._acts[do][1](*numbers) or {}
        except HaselabError as error:
            reported = {"error": str(error), "kind": type(error).__name__}
        return _encoded(reported, images)

    def refuse_line(self, longest: int) -> bytes:
        """The answer to a line that is too long to be a request."""
        return _encoded({"error": f"A request has at most {longest} bytes.", "kind": "InputError"})

    def fail(self) -> bytes:
        """The answer after a defect of this program."""
        return _encoded({"error": "The served twin failed; see its stderr.", "kind": "DeviceError"})

    def _request(self, line: str) -> tuple[str, list[float]]:
        """Name and numbers of a request.

        Raises:
            InputError: it is not one.
        """
        try:
            request = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(f"Not a request: {error}.") from None
        if not isinstance(request, dict) or not isinstance(request.get("do"), str):
            raise InputError('Not a request: it needs an object with a text "do".')
        do = request.pop("do")
        if do != "take" and do not in self._acts:
            raise InputError(f"Not a request: {do[:40]!r}. Use take, {', '.join(self._acts)}.")
        names = () if do == "take" else self._acts[do][0]
        if set(request) != set(names):
            raise InputError(f"Not a request: {do} takes {', '.join(names) or 'nothing else'}.")
        numbers = [request[name] for name in names]
        if not all(_is_number(value) for value in numbers):
            raise InputError(f"Not a request: {', '.join(names)} of {do} must be a finite number.")
        return do, [float(value) for value in numbers]

    def _meters(self) -> dict[str, Any]:
        hub = self._hub
        return {
            "output_v": hub.output_v,
            "length_m": hub.length_m,
            "protected": hub.protected,
            "sample_zero_s": hub.sample_zero_s,
            "stalled_s": hub.stalled_s,
        }

    def _start_camera(self, rate_hz: float, exposure_s: float) -> None:
        self._hub.exposure_s = exposure_s or self._exposure_s
        self._camera.start(self._hub.exposure_s)
        self._hub.start_camera(self._camera.real_rate_hz(rate_hz))

    def _take(self) -> tuple[dict[str, Any], bytes]:
        now_s = self._hub.acquired / self._hub.rate_hz
        frames = self._camera.send(self._hub.take_frames(), now_s)
        if frames is None:
            return {"shape": [0, 0, 0], "time_s": []}, b""
        images = np.ascontiguousarray(frames.images)
        reported = {
            "shape": list(images.shape),
            "time_s": frames.time_s.tolist(),
            "number": frames.number.tolist(),
            "ticks": frames.ticks.tolist(),
            "arrival_s": frames.arrival_s.tolist(),
            "exposure_s": self._hub.exposure_s,
        }
        return reported, images.tobytes()


def _is_number(value: object) -> bool:
    """A finite number that a float can hold; an integer of JSON may be longer."""
    known = isinstance(value, (int, float)) and not isinstance(value, bool)
    return known and abs(value) <= sys.float_info.max  # type: ignore[arg-type]


def _encoded(reported: dict[str, Any], images: bytes = b"") -> bytes:
    return json.dumps({**reported, "bytes": len(images)}).encode("ascii") + b"\n" + images
