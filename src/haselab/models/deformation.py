"""Deformation of a sheet of constant volume in a test: length and width from the stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, JsonObject, LimitError

__all__ = ["DEFORMATIONS", "Deformation"]

Floats = NDArray[np.float64]
DEFORMATIONS = ("uniaxial", "pure_shear", "equibiaxial", "fixed_lateral", "prestretched")


@dataclass(frozen=True)
class Deformation:
    r"""Kind of deformation in a test.

    - `uniaxial`: length $\lambda$, width free, $1/\sqrt\lambda$.
    - `pure_shear`: length $\lambda$, width held at 1.
    - `equibiaxial`: length and width $\lambda$.
    - `fixed_lateral`: length $\lambda$, width clamped at `lateral_stretch`.
    - `prestretched`: length $\lambda_p \lambda$, width clamped at $\lambda_p$, the `prestretch` of
      both.

    Args:
        kind: one of these kinds.
        lateral_stretch: stretch of a clamped width.
        prestretch: stretch of length and width at which the recorded stretch is 1.
    Raises:
        InputError: an unknown kind, or a stretch not above zero.
    Example:
        >>> Deformation("prestretched", prestretch=3.0).stretches([1.0, 1.2])[0].tolist()
        [3.0, 3.5999999999999996]
    """

    kind: str = "uniaxial"
    lateral_stretch: float = 1.0
    prestretch: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in DEFORMATIONS:
            raise InputError(
                f"deformation = {self.kind}; it must be one of {', '.join(DEFORMATIONS)}."
            )
        for name in ("lateral_stretch", "prestretch"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise InputError(
                    f"{name} = {value:g}; it must be above 0 (1 is the natural length). "
                    "Give a stretch, not a strain."
                )

    def stretches(self, stretch: ArrayLike) -> tuple[Floats, Floats]:
        """Stretches of length and width from the recorded one.

        Args:
            stretch: as recorded, 1 at the start of the test. Shape `(...)`.
        Returns:
            Stretches from the natural length and width. Shape of `stretch` each.
        Raises:
            LimitError: a stretch not above zero.
        """
        x = np.asarray(stretch, dtype=np.float64)
        if not (x > 0.0).all():
            raise LimitError(
                f"stretch = {float(x.min()):g}; it must be above 0 (1 is the natural length). "
                "Give stretch, not strain."
            )
        if self.kind == "uniaxial":
            return x, 1.0 / np.sqrt(x)
        if self.kind == "equibiaxial":
            return x, x
        if self.kind == "prestretched":
            return self.prestretch * x, np.full(x.shape, self.prestretch)
        side = self.lateral_stretch if self.kind == "fixed_lateral" else 1.0
        return x, np.full(x.shape, side)

    def to_dict(self) -> JsonObject:
        """The kind and its parameters."""
        needed = {"fixed_lateral": "lateral_stretch", "prestretched": "prestretch"}.get(self.kind)
        return {"kind": self.kind, **({needed: getattr(self, needed)} if needed else {})}
