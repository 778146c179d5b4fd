"""Check that the recorded edge begins an exposure, by means of two exposure times."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager

from haselab.base import DeviceError
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.pairing import ExposureTrial, starts_with_edge
from haselab.rig.check_result import CheckResult

__all__ = ["edge_check"]

_RATE_HZ = 25.0
_FILM_S = 1.0
_BEFORE = 5  # blocks before the first frame, for the clock
_LONGER_S = 8e-3  # difference of the two exposure times
_UNCERTAINTY_S = 1.5e-3  # uncertainty of a lag; arrivals over a network scatter less
_SWITCH = (
    "Set exposure.edge to the other edge, or exposure.inverted if the camera's line can be inverted"
)


def edge_check(
    config: BenchConfig, opened: Callable[[BenchConfig], AbstractContextManager[Rig]]
) -> Generator[CheckResult, None, None]:
    """Film with two exposure times, if the exposure line is recorded and the time can be set.

    Args:
        config: of the bench.
        opened: opens a bench with a changed configuration; its output stays at 0 V.
    Yields:
        One result.
    Raises:
        DeviceError: An instrument failed.
    """
    line, camera = config.exposure, config.camera
    if line is None or camera is None or "exposure_s" not in type(camera).model_fields:
        return
    trials = []
    for exposure_s in (line.duration_s, line.duration_s + _LONGER_S):
        changed = config.model_copy(
            update={
                "camera": camera.model_copy(update={"exposure_s": exposure_s}),
                "exposure": line.model_copy(update={"duration_s": exposure_s}),
            }
        )
        with opened(changed) as rig:
            try:
                lag_s = _lag_s(rig)
            except DeviceError as error:
                yield CheckResult("dry", "exposure line", str(error).rstrip("."), False)
                return
        if math.isnan(lag_s):
            yield CheckResult(
                "dry",
                "exposure line",
                "no frame arrived with an edge",
                False,
                "Check its wire to exposure.input, its levels and its pull-up",
            )
            return
        trials.append(ExposureTrial(exposure_s, lag_s))
    begins = starts_with_edge(trials[0], trials[1], _UNCERTAINTY_S)
    found = ", ".join(f"{1e3 * t.lag_s:.2f} ms after {1e3 * t.exposure_s:.3g} ms" for t in trials)
    yield CheckResult(
        "dry",
        "exposure line",
        f"frames arrive {found} of exposure: the edge {'begins' if begins else 'ends'} it",
        bool(begins),
        _SWITCH,
        criterion="the edge begins the exposure: the lag does not depend on the exposure time",
    )


def _lag_s(rig: Rig) -> float:
    """Delay from an exposure's recorded middle to its estimate from the frame, in s."""
    for _ in range(_BEFORE):
        rig.acquisition.read()
    rig.camera.start(_RATE_HZ)
    try:
        for _ in range(round(_FILM_S / rig.description.block_s)):
            rig.acquisition.read()
            rig.camera.take()
        return float(getattr(rig.camera, "lag_s", math.nan))
    finally:
        rig.camera.stop()
