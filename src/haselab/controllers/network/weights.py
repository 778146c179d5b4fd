"""The weights of a small integer network: the same bits in numpy, in Python and on the chip."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, described, shown

__all__ = [
    "FEATURES",
    "HIDDEN",
    "LARGEST_FEATURE",
    "LARGEST_WEIGHT",
    "ONE",
    "WEIGHT_ONE",
    "Network",
    "features_of",
]

FEATURES = 6
HIDDEN = 8
ONE = 1024  # of a feature, of a hidden unit and of the output
WEIGHT_ONE = 32  # of a weight
LARGEST_WEIGHT = 127
LARGEST_FEATURE = 8 * ONE


@dataclass(frozen=True)
class Network:
    """Weights of the network: drive change = output(hidden(features)).

    Features are, with the error and strain over 0.05 and the drive from -1 to 1: error, change of
    strain and the one before (times 10), half the reference, drive, and its last change times 4.

    Args:
        hidden: weights of the features and, last, the bias. Shape `(HIDDEN, FEATURES + 1)`.
        output: weights of the hidden units and the bias. Shape `(HIDDEN + 1,)`.
    Raises:
        InputError: A shape is wrong, or a weight is not a whole number from -127 to 127.
    """

    hidden: tuple[tuple[int, ...], ...]
    output: tuple[int, ...]

    def __post_init__(self) -> None:
        rows = [*self.hidden, self.output]
        sizes = [len(row) for row in rows]
        if sizes != [FEATURES + 1] * HIDDEN + [HIDDEN + 1]:
            raise InputError(
                f"The network has rows of {sizes} weights. It must have {HIDDEN} rows of "
                f"{FEATURES + 1}, and an output of {HIDDEN + 1}."
            )
        for weight in (weight for row in rows for weight in row):
            if type(weight) is not int or abs(weight) > LARGEST_WEIGHT:
                raise InputError(
                    f"The network has a weight of {shown(weight)}. All weights must be whole "
                    f"numbers from -{LARGEST_WEIGHT} to {LARGEST_WEIGHT}."
                )

    @classmethod
    def from_vector(cls, values: NDArray[np.float64]) -> Network:
        """Round a vector of weights, in units of 1.

        Args:
            values: hidden weights row by row, then those of the output. Shape
                `(HIDDEN * (FEATURES + 2) + 1,)`.
        """
        scaled = np.clip(np.rint(values * WEIGHT_ONE), -LARGEST_WEIGHT, LARGEST_WEIGHT)
        numbers = scaled.astype(int)
        hidden = numbers[: HIDDEN * (FEATURES + 1)].reshape(HIDDEN, FEATURES + 1)
        output = numbers[HIDDEN * (FEATURES + 1) :]
        return cls(tuple(tuple(row) for row in hidden.tolist()), tuple(output.tolist()))

    def to_vector(self) -> NDArray[np.float64]:
        """The weights as `from_vector` takes them."""
        return np.concatenate([np.ravel(self.hidden), self.output]) / WEIGHT_ONE

    def change(self, features: tuple[int, ...]) -> int:
        """Change of the drive, where `ONE` is half of its half range.

        Args:
            features: `FEATURES` numbers, where `ONE` is 1.
        """
        clipped = [min(max(x, -LARGEST_FEATURE), LARGEST_FEATURE) for x in features]
        units = []
        for row in self.hidden:
            total = row[-1] * ONE + sum(w * x for w, x in zip(row, clipped, strict=False))
            units.append(min(max(total >> 5, -ONE), ONE))
        total = self.output[-1] * ONE + sum(w * x for w, x in zip(self.output, units, strict=False))
        return min(max(total >> 5, -ONE), ONE)

    def to_dict(self) -> JsonObject:
        """For JSON."""
        return {"hidden": [list(row) for row in self.hidden], "output": list(self.output)}

    @classmethod
    def load(cls, path: Path) -> Network:
        """Read a JSON file of `to_dict`.

        Raises:
            InputError: The file is missing or holds no network.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            return cls(
                tuple(tuple(row) for row in data["hidden"]),
                tuple(data["output"]),
            )
        except InputError as error:
            raise InputError(f"{error} {path}") from None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(
                f"No network can be read ({described(error)}). Train one. {path}"
            ) from None


Number = TypeVar("Number", int, NDArray[np.int32])


def features_of(
    wanted: Number, strain: tuple[Number, Number, Number], drive: Number, last_drive: Number
) -> tuple[Number, ...]:
    """The features of a network, of one loop or of many.

    Args:
        wanted: reference.
        strain: sensed now and one and two steps ago, in the unit of the reference.
        drive: in force.
        last_drive: before it.
    Returns:
        `FEATURES` numbers, each of the shape of the arguments.
    """
    now, before, earlier = strain
    return (
        wanted - now, 10 * (now - before), 10 * (before - earlier), wanted >> 1,
        drive, 4 * (drive - last_drive),
    )  # fmt: skip
