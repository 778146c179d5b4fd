"""The noise-free reference run of a simulated study, in its own process while the study plays.

It plays the same experiments on the same twin with all noise off. What the study finds and plays
(baseline, maps, controllers) is sent to it as soon as it is known.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import IO, BinaryIO, Self

from haselab.base import HaselabError, ResultError
from haselab.models.actuator import ActuatorTables
from haselab.rig.twin.config import TwinConfig
from haselab.runtime.scheduling import lower_priority
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study
from haselab.study.experiment import ExperimentResult
from haselab.study.run import noise_free_results

__all__ = ["NoiseFreeRun", "SentValues", "main"]

_END_S = 10.0


class NoiseFreeRun:
    """The process. Use as a context, which ends it.

    Args:
        config: of the twin.
        study: that is played.
        known: the actuator file that the study starts from; None: there is none.
    """

    def __init__(
        self, config: TwinConfig, study: Study, known: ActuatorTables | None = None
    ) -> None:
        self._problem = (config, study, known)
        self._obstacle = ""

    def __enter__(self) -> Self:
        self._errors: IO[bytes] = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors,
            process_group=0,  # Ctrl-C is for the study, whose end ends this process
        )  # fmt: skip
        self._send(self._problem)
        return self

    def start(self, outcome: ExperimentResult) -> None:
        """Send what a fit of the study gives.

        Args:
            outcome: of one fit.
        """
        self._send(outcome.values)

    def _send(self, message: object) -> None:
        """Send a message; a process that has ended is reported by `results`."""
        assert self._process.stdin is not None
        try:
            data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            self._obstacle = f"A value that the study plays cannot be sent: {error}."
            return
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(data)
            self._process.stdin.flush()

    def results(self) -> dict[str, float]:
        """Wait for the end.

        Returns:
            What the study gives without noise, by id.
        Raises:
            ResultError: a fit has no result there, or the process failed.
        """
        self._send(None)
        assert self._process.stdout is not None
        if self._obstacle:
            raise ResultError(self._obstacle)
        try:
            found = pickle.load(self._process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            self._process.wait()
            self._errors.seek(0)
            lines = self._errors.read().decode(errors="replace").strip().splitlines()
            last = lines[-1] if lines else f"exit code {self._process.returncode}"
            raise ResultError(f"The process of the noise-free run ended early: {last}.") from None
        if isinstance(found, HaselabError):  # of any kind: only the reference values are missing
            raise ResultError(str(found))
        return found  # type: ignore[no-any-return]

    def __exit__(self, *_: object) -> None:
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()  # which the process takes for the end
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()


class SentValues(Mapping[type, object]):
    """Values of the study by type; a value that will still come is waited for.

    Args:
        source: messages of `NoiseFreeRun`.
        study: whose experiments give the values.
        ended: is called when the source ends, because nobody waits for results any more.
    """

    def __init__(self, source: BinaryIO, study: Study, ended: Callable[[], None]) -> None:
        self._kinds = {kind for one in experiments_of(study) for kind in one.gives}
        self._values: dict[type, object] = {}
        self._complete = False
        self._news = threading.Condition()
        threading.Thread(target=self._receive, args=(source, ended), daemon=True).start()

    def _receive(self, source: BinaryIO, ended: Callable[[], None]) -> None:
        while True:
            try:
                values = pickle.load(source)
            except (EOFError, OSError, ValueError, pickle.UnpicklingError):
                return ended()  # a message may have been cut, or the source closed
            with self._news:
                self._complete = self._complete or values is None
                self._values |= {type(value): value for value in values or ()}
                self._news.notify_all()

    def __getitem__(self, kind: type) -> object:
        with self._news:
            while kind in self._kinds and kind not in self._values and not self._complete:
                self._news.wait()
            return self._values[kind]

    def __iter__(self) -> Iterator[type]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def main() -> None:
    """Play and fit what standard input brings, and write the results to standard output."""
    lower_priority()  # the study, which takes longest, goes first
    gc.freeze()  # the garbage collector need not look at the modules again
    source, target = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing that is printed may come between
    config, study, known = pickle.load(source)
    values = SentValues(source, study, lambda: os._exit(1))
    found: dict[str, float] | HaselabError
    try:
        found = noise_free_results(config, study, known, values)
    except HaselabError as error:
        found = error
    pickle.dump(found, target, pickle.HIGHEST_PROTOCOL)
    target.flush()


if __name__ == "__main__":
    main()
