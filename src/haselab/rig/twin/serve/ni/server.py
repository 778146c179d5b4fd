"""The twin as an NI board behind NI's gRPC device server."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from haselab.base import InputError
from haselab.rig.drivers import load_driver
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.local_user import LocalUserFilter
from haselab.rig.twin.serve.ni.bus import BoardFaults
from haselab.rig.twin.serve.ni.devices import DEVICES
from haselab.rig.twin.serve.ni.driver import DEVICE, NiDriver
from haselab.rig.twin.serve.ni.samples import EXPOSURE_LINE, NiSamples
from haselab.rig.twin.serve.ni.settings import NiSettings
from haselab.rig.twin.serve.ni.status import StatusError

__all__ = ["DEVICE", "EXPOSURE_LINE", "PRODUCT", "DaqServer"]

PRODUCT = "USB-6212"
_THREADS = 8
_OTHER_USER = (
    "Another user of this computer runs this server. Start your own, or have it started with "
    "--allow-other-users."
)


def _address(peer: str) -> tuple[str, int]:
    """A client as gRPC names it, "ipv4:127.0.0.1:40000"; one that has gone has no address."""
    _, _, address = peer.partition(":")
    host, _, port = address.rpartition(":")
    return host, int(port) if port.isascii() and port.isdigit() else 0


class DaqServer:
    """Serves a hub's inputs and output on a loopback port.

    Args:
        hub: the bench.
        port: 0: any free one.
        allow_others: also serve clients of other users of this computer.
        board: NI product that it acts as, one of `ni_devices.DEVICES`.
        faults: planted in the board.
    Raises:
        DeviceError: nidaqmx with gRPC is not installed.
        InputError: no such board.
    """

    def __init__(
        self,
        hub: TwinHub,
        port: int = 0,
        *,
        allow_others: bool = False,
        board: str = PRODUCT,
        faults: BoardFaults | None = None,
    ) -> None:
        if board not in DEVICES:
            raise InputError(f"Board is {board!r}, but must be one of {', '.join(DEVICES)}.")
        grpc = load_driver("grpc", "The served board")
        stubs = load_driver("nidaqmx._stubs.nidaqmx_pb2_grpc", "The served board")
        messages = load_driver("nidaqmx._stubs.nidaqmx_pb2", "The served board")
        # Each served board is another device: what was latched for one is not for the next.
        self.serial_number = secrets.randbits(31) | 1
        self.device = DEVICES[board]
        driver = NiDriver(hub, self.device, faults or BoardFaults())
        settings = NiSettings(driver, self.serial_number)
        calls = {**driver.calls, **settings.calls, **NiSamples(driver).calls}

        def method(name: str) -> Callable[[Any, Any, Any], Any]:
            def call(_servicer: Any, request: Any, context: Any) -> Any:
                if not self._gate.admits_call(_address(context.peer())):
                    return context.abort(grpc.StatusCode.PERMISSION_DENIED, _OTHER_USER)
                try:
                    answer = calls[name](request) or {}
                except StatusError as error:
                    reported = [("ni-error", str(error.code))]
                    if error.written is not None:
                        reported.append(("ni-samps-per-chan-written", str(error.written)))
                    context.set_trailing_metadata(tuple(reported))
                    return context.abort(grpc.StatusCode.UNKNOWN, str(error))
                return getattr(messages, f"{name}Response")(**answer)

            return call

        servicer = type(
            "_Servicer", (stubs.NiDAQmxServicer,), {name: method(name) for name in calls}
        )
        self._pool = ThreadPoolExecutor(_THREADS)
        self._server = grpc.server(self._pool)
        stubs.add_NiDAQmxServicer_to_server(servicer(), self._server)
        port = self._server.add_insecure_port(f"127.0.0.1:{port}")
        self.address = f"127.0.0.1:{port}"
        self._gate = LocalUserFilter(port, allow_others=allow_others)
        self._server.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.stop(grace=None).wait()
        self._pool.shutdown()
