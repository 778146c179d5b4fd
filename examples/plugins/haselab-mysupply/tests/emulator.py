"""The supply of the example as a TCP server: written from its manual, not from the driver.

Run it as a program to try the driver without the instrument: python emulator.py [PORT]
"""

from __future__ import annotations

import contextlib
import socketserver
import sys
import threading
import time
from typing import Self

IDENTITY = "ACME,HV-3000,A1234,1.0"
_REACH_V = 3000.0
_TIME_CONSTANT_S = 0.05  # of its output


class Emulator:
    """Serves SCPI on a loopback port (0: a free one). `commands` are all lines that it got."""

    def __init__(self, port: int = 0) -> None:
        self.set_v, self.is_on = 0.0, False
        self.commands: list[str] = []
        self._output_v, self._changed_s = 0.0, time.monotonic()
        self._lock = threading.Lock()
        emulator = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    answer = emulator.answer(line.decode("ascii").strip())
                    if answer:
                        self.wfile.write(answer.encode("ascii") + b"\n")

        class Server(socketserver.ThreadingTCPServer):
            daemon_threads, allow_reuse_address = True, True

        self._server = Server(("127.0.0.1", port), Handler)
        self.port = int(self._server.server_address[1])
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def output_v(self) -> float:
        """What an independent voltmeter at its terminals shows."""
        target_v = self.set_v if self.is_on else 0.0
        now_s = time.monotonic()
        decay = 2.718281828 ** (-(now_s - self._changed_s) / _TIME_CONSTANT_S)
        return target_v + (self._output_v - target_v) * decay

    def answer(self, line: str) -> str:
        """The answers to one line of commands."""
        with self._lock:
            self.commands.append(line)
            found = [self._one(part.strip().lstrip(":")) for part in line.split(";")]
            return ";".join(each for each in found if each)

    def _one(self, command: str) -> str:
        word, _, value = command.upper().partition(" ")
        if word in ("VOLT", "OUTP"):
            self._output_v, self._changed_s = self.output_v, time.monotonic()
            if word == "VOLT":
                self.set_v = min(max(float(value), 0.0), _REACH_V)
            else:
                self.is_on = value in ("ON", "1")
            return ""
        return {
            "*IDN?": IDENTITY,
            "VOLT?": f"{self.set_v:.1f}",
            "OUTP?": str(int(self.is_on)),
            "MEAS:VOLT?": f"{self.output_v:.1f}",
        }.get(word, "")

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


if __name__ == "__main__":
    with Emulator(int(sys.argv[1]) if len(sys.argv) > 1 else 5025) as emulator:
        print(f'host = "127.0.0.1"\nport = {emulator.port}', flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
