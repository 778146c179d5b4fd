"""The cases of a campaign: values, identity and random numbers of each."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, Json, JsonObject
from haselab.campaign.definition import Campaign, Distribution, refused_value, with_values
from haselab.campaign.kinds.case_kind import CASE_KINDS, Inputs
from haselab.store.optional import library
from haselab.store.source_digest import source_digest

__all__ = ["Job", "Plan", "Problem", "code_of"]

Floats = NDArray[np.float64]
_DESIGN_KEY = 2**32 - 1  # of the random numbers of the design, apart from those of the cases
_DIGITS = 32  # of a hash


@dataclass(frozen=True)
class Problem:
    """What all cases share; sent to each worker.

    Args:
        kind: of the cases.
        tables: of the base.
        seed: of all random numbers.
        code: version of the code that must compute them.
    """

    kind: str
    tables: Mapping[str, JsonObject]
    seed: int
    code: str


@dataclass(frozen=True)
class Job:
    """One case to compute.

    Args:
        case: hash.
        index: in the campaign.
        values: of the parameters, by their paths.
        key: of its random numbers, for `SeedSequence`.
        attempt: 1, or more after it was repeated.
    """

    case: str
    index: int
    values: Mapping[str, Json]
    key: tuple[int, ...]
    attempt: int = 1


class Plan:
    """All cases of a campaign.

    The case with index `(axes * points + point) * repeats + repeat` has the values of one point of
    the axes and of one drawn point. Its random numbers come from `SeedSequence(seed,
    spawn_key=(axes, point, repeat))`.

    Args:
        campaign: checked.
        drawn: values of an earlier plan of the same campaign; None: they are drawn.
    Raises:
        InputError: a drawn value is outside the limits of its key; a library is missing.
    """

    def __init__(self, campaign: Campaign, drawn: Floats | None = None) -> None:
        self.campaign = campaign
        self.code = code_of(campaign.kind)
        self.count, self._repeats = campaign.count, campaign.design.repeats
        self._levels = _crossed([len(axis.values) for axis in campaign.axes])
        self.drawn = _drawn(campaign) if drawn is None else drawn
        self._check_drawn()
        self.paths = campaign.paths

    @property
    def problem(self) -> Problem:
        """What all cases share."""
        one = self.campaign
        return Problem(one.kind, one.tables, one.seed, self.code)

    def values(self, index: int) -> dict[str, Json]:
        """Values of the parameters of a case, by their paths."""
        level, point, _ = self._place(index)
        found: dict[str, Json] = {}
        for k, axis in enumerate(self.campaign.axes):
            found[axis.path] = axis.values[self._levels[level, k]]
        for k, one in enumerate(self.campaign.distributions):
            found[one.path] = _value(one, self.drawn[point, k])
        return found

    def job(self, index: int, case: str, attempt: int = 1) -> Job:
        """A case with all that its worker needs."""
        return Job(case, index, self.values(index), self._key(index), attempt)

    def _place(self, index: int) -> tuple[int, int, int]:
        rest, repeat = divmod(index, self._repeats)
        return (*divmod(rest, self.campaign.points), repeat)

    def _key(self, index: int) -> tuple[int, int, int]:
        level, point, repeat = self._place(index)
        return (0 if self.campaign.design.same_noise else level), point, repeat

    def hashes(self) -> list[str]:
        """Hash of each case: kind, base, values, seed, and version of the code."""
        one = self.campaign
        common = json.dumps([self.code, one.base_digest, one.seed, self.paths])
        start = hashlib.sha256(common.encode())
        axes = [[json.dumps(value).encode() for value in axis.values] for axis in one.axes]
        levels = [
            b"\0".join(axes[k][at] for k, at in enumerate(row)) for row in self._levels.tolist()
        ]
        points = [row.tobytes() for row in self._identity()]
        same_noise = one.design.same_noise
        found = []
        for place, level in enumerate(levels):  # the order of the indices
            of_level = start.copy()
            of_level.update(b"%b\1%d " % (level, 0 if same_noise else place))
            for number, point in enumerate(points):
                of_point = of_level.copy()
                of_point.update(b"%d %b" % (number, point))
                for repeat in range(self._repeats):
                    digest = of_point.copy()
                    digest.update(b"%d" % repeat)
                    found.append(digest.hexdigest()[:_DIGITS])
        return found

    def _identity(self) -> Floats:
        """Drawn numbers; of a choice, a number that stands for the value and not for its place."""
        columns = self.drawn.astype("<f8")
        for k, one in enumerate(self.campaign.distributions):
            if one.shape == "choice":
                stands = [
                    int.from_bytes(hashlib.sha256(json.dumps(value).encode()).digest()[:6])
                    for value in one.numbers
                ]
                columns[:, k] = np.array(stands)[self.drawn[:, k].astype(np.int64)]
        return columns

    def _check_drawn(self) -> None:
        """Check the smallest and the largest drawn value of each parameter."""
        one, kind = self.campaign, self.campaign.case_kind
        for k, about in enumerate(one.distributions):
            column = self.drawn[:, k]
            if about.shape == "choice":
                ends: Sequence[Json] = about.numbers
            else:
                ends = sorted({float(column.min()), float(column.max())})
            for value in ends:
                try:
                    kind.check(Inputs(with_values(one.tables, {about.path: value})))
                except InputError as error:
                    said = refused_value(about.path, value, error, "Change its distribution.")
                    raise InputError(f"{said} {one.source}") from None


def code_of(kind: str) -> str:
    """Version of the code that computes a kind of case.

    Args:
        kind: name.
    Returns:
        Version of haselab, and of the package of the kind if that is another one.
    """
    package = CASE_KINDS.packages()[kind]
    return source_digest() if package == "haselab" else f"{source_digest()} {package}"


def _crossed(sizes: Sequence[int]) -> NDArray[np.int64]:
    """All combinations of places. Shape `(product, axes)`."""
    if not sizes:
        return np.zeros((1, 0), dtype=np.int64)
    grids = np.meshgrid(*map(np.arange, sizes), indexing="ij")
    return np.stack([grid.reshape(-1) for grid in grids], axis=1)


def _value(about: Distribution, number: float) -> Json:
    return about.numbers[int(number)] if about.shape == "choice" else float(number)


def _drawn(campaign: Campaign) -> Floats:
    """Drawn values, of a choice the place in its list. Shape `(points, distributions)`."""
    unit = _unit(campaign)
    columns = [_from_unit(one, unit[:, k]) for k, one in enumerate(campaign.distributions)]
    return np.stack(columns, axis=1) if columns else unit


def _unit(campaign: Campaign) -> Floats:
    """Points of the design in the unit cube."""
    design, width = campaign.design, len(campaign.distributions)
    if width == 0:
        return np.zeros((1, 0))
    samples = design.samples or 1
    root = np.random.SeedSequence(campaign.seed, spawn_key=(_DESIGN_KEY,))
    rng = np.random.default_rng(root)
    if design.kind == "random":
        return rng.random((samples, width))
    if design.kind == "saltelli":
        sample = library("SALib.sample.sobol", "campaign").sample
        bounds = {"num_vars": width, "names": [str(k) for k in range(width)],
                  "bounds": [[0.0, 1.0]] * width}  # fmt: skip
        seed = int(rng.integers(2**31))
        return np.asarray(sample(bounds, samples, calc_second_order=False, seed=seed))
    from scipy.stats import qmc  # slow to import

    if design.kind == "sobol":
        return np.asarray(qmc.Sobol(width, seed=rng).random_base2(int(math.log2(samples))))
    return np.asarray(qmc.LatinHypercube(width, seed=rng).random(samples))


def _from_unit(about: Distribution, unit: Floats) -> Floats:
    """Values of a distribution at some probabilities."""
    if about.shape == "choice":
        return np.floor(unit * len(about.numbers))
    first, second = (float(number) for number in about.numbers)  # type: ignore[arg-type]
    if about.shape == "normal":
        from scipy.special import ndtri

        with np.errstate(divide="ignore"):
            values = first + second * ndtri(unit)
    elif about.shape == "log-uniform":
        values = np.exp(math.log(first) + unit * math.log(second / first))
    else:
        values = first + unit * (second - first)
    if not np.isfinite(values).all():
        raise InputError(
            f"parameters.{about.path}: a drawn value is not finite. Choose another seed."
        )
    return np.asarray(values)
