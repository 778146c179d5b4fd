"""The twin's stand, camera and meters over a socket: what has no instrument's protocol of its own.

A request is a line of JSON, `{"do": "hang", "mass_kg": 0.25}`; the answer is a line of JSON,
followed by as many bytes as its `bytes` says: frames.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from haselab.base import HaselabError
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.lines import LineServer

__all__ = ["HandsServer"]


class HandsServer:
    """Serves a hub's stand, camera and meters on a loopback port.

    Args:
        hub: the bench.
        port: 0: any free one.
    """

    def __init__(self, hub: TwinHub, port: int = 0) -> None:
        self._hub = hub
        self._acts: dict[str, Callable[..., dict[str, Any] | None]] = {
            "hang": hub.hang,
            "lift": hub.lift,
            "drop": hub.drop,
            "start_camera": hub.start_camera,
            "stop_camera": hub.stop_camera,
            "meters": lambda: {
                "output_v": hub.output_v,
                "length_m": hub.length_m,
                "protected": hub.protected,
                "sample_zero_s": hub.sample_zero_s,
                "stalled_s": hub.stalled_s,
            },
        }
        self._server = LineServer(self.answer, port, "twin hands")
        self.address = f"127.0.0.1:{self._server.port}"

    def close(self) -> None:
        """Stop serving."""
        self._server.close()

    def answer(self, line: str) -> bytes:
        """The answer to one request, with its frames."""
        images = b""
        try:
            request = json.loads(line)
            do = request.pop("do")
            if do == "take":
                told, images = self._take()
            else:
                told = self._acts[do](**request) or {}
        except HaselabError as error:
            told = {"error": str(error), "kind": type(error).__name__}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            told = {"error": f"Not a request: {error}.", "kind": "InputError"}
        return json.dumps({**told, "bytes": len(images)}).encode("ascii") + b"\n" + images

    def _take(self) -> tuple[dict[str, Any], bytes]:
        frames = self._hub.take_frames()
        if frames is None:
            return {"shape": [0, 0, 0], "time_s": []}, b""
        images = np.ascontiguousarray(frames.images)
        return {"shape": list(images.shape), "time_s": frames.time_s.tolist()}, images.tobytes()
