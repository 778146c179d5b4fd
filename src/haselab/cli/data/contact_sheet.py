"""Tracks as a picture: twelve frames of a clip, or all paths on one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from haselab.store.claim import not_written
from haselab.store.video.grey_range import grey_range
from haselab.tracking import FrameTracks
from haselab.tracking.options import Floats, Frame

__all__ = ["ContactSheet", "draw_paths"]

_PANELS = (3, 4)  # rows, columns
_SHEET_PX = 480
_COLOUR = "#d55e00"


class ContactSheet:
    """Twelve frames evenly over the clip, each with its points, their paths in the last."""

    def __init__(self, path: Path, frame_count: int) -> None:
        panels = _PANELS[0] * _PANELS[1]
        self._path = path
        places = np.linspace(0, max(frame_count - 1, 0), panels - 1)
        self._wanted = set(np.rint(places).astype(int).tolist())
        self._kept: list[tuple[int, Frame, FrameTracks]] = []
        self._numbers: list[int] = []
        self._trail: list[tuple[Floats, Floats]] = []
        self._stride = max(frame_count // 300, 1)

    def look(self, index: int, frame: Frame, found: FrameTracks) -> None:
        """Keep what the sheet will show."""
        if index in self._wanted:
            step = max(max(frame.shape) // _SHEET_PX, 1)
            self._kept.append((step, frame[::step, ::step].copy(), found))
            self._numbers.append(index)
        if index % self._stride == 0:
            self._trail.append((found.x_px, found.y_px))

    def close(self) -> None:
        """Draw and write it."""
        if not self._kept:
            return
        rows, columns = _PANELS
        height, width = self._kept[0][1].shape
        figure = Figure(figsize=(12.0, 12.0 * rows * height / (columns * width)))
        low, high = grey_range(self._kept[0][1])
        axes = [figure.add_subplot(rows, columns, k + 1) for k in range(len(self._kept) + 1)]
        x, y = (np.array(part) for part in zip(*self._trail, strict=True))
        for k, (step, image, found) in enumerate([*self._kept, self._kept[0]]):
            axes[k].imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
            last = k == len(self._kept)
            if last:
                axes[k].plot(x / step, y / step, linewidth=0.6)
            else:
                (dots,) = axes[k].plot(found.x_px / step, found.y_px / step, "o", color=_COLOUR)
                dots.set(markersize=2.5, markerfacecolor="none", markeredgewidth=0.6)
            lost = "" if found.valid.all() else f", {int((~found.valid).sum())} lost"
            label = "paths" if last else f"frame {self._numbers[k]}{lost}"
            _bare(axes[k], image.shape, label)
        figure.subplots_adjust(0.0, 0.0, 1.0, 1.0, 0.01, 0.01)
        _save(figure, self._path)


def _bare(axes: Axes, shape: tuple[int, ...], label: str) -> None:
    axes.set_xlim(-0.5, shape[1] - 0.5)
    axes.set_ylim(shape[0] - 0.5, -0.5)
    axes.set_axis_off()
    box = {"facecolor": "white", "alpha": 0.7, "pad": 1.5, "linewidth": 0}
    axes.text(0.02, 0.03, label, transform=axes.transAxes, fontsize=8, bbox=box)


def _save(figure: Figure, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise not_written(path, error, "The picture cannot be written") from None


def draw_paths(path: Path, image: Frame, x_px: Floats, y_px: Floats) -> None:
    """One frame with all paths on it.

    Args:
        path: of the new picture.
        image: the frame.
        x_px, y_px: positions, NaN where there is none. Shape `(F, P)`.
    """
    height, width = image.shape
    figure = Figure(figsize=(8.0, 8.0 * height / width))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image, cmap="gray", interpolation="nearest")
    axes.plot(x_px, y_px, linewidth=0.8)
    axes.plot(x_px[0], y_px[0], "o", markersize=3, markerfacecolor="none", color="tab:red")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()
    _save(figure, path)
