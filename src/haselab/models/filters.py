"""Filters of scipy.signal, imported at first use, since the import takes half a second."""

from __future__ import annotations

from typing import Any

__all__ = ["fftconvolve", "find_peaks", "lfilter", "resample_poly"]


def lfilter(b: Any, a: Any, x: Any, **options: Any) -> Any:
    """`scipy.signal.lfilter`."""
    from scipy import signal

    return signal.lfilter(b, a, x, **options)


def fftconvolve(first: Any, second: Any, **options: Any) -> Any:
    """`scipy.signal.fftconvolve`."""
    from scipy import signal

    return signal.fftconvolve(first, second, **options)


def resample_poly(x: Any, up: int, down: int, **options: Any) -> Any:
    """`scipy.signal.resample_poly`."""
    from scipy import signal

    return signal.resample_poly(x, up, down, **options)


def find_peaks(x: Any, **options: Any) -> Any:
    """`scipy.signal.find_peaks`."""
    from scipy import signal

    return signal.find_peaks(x, **options)
