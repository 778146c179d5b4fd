"""CAMPAIGN.toml: what is varied, how, and what each case computes."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from haselab.base import InputError, Json, JsonObject
from haselab.campaign.kinds.case_kind import CASE_KINDS, CaseKind, Inputs
from haselab.store.toml import Section, read_toml, validated

__all__ = [
    "MOST_CASES", "Axis", "Campaign", "Design", "Distribution", "load_campaign", "refused_value",
    "with_values",
]  # fmt: skip

MOST_CASES = 1_000_000
_SHAPES = {"uniform": 2, "log-uniform": 2, "normal": 2, "choice": 0}
_MOST_LEVELS = 10_000
_LARGEST_INTEGER = 2**63 - 1  # of a column of the table

DesignKind = Literal["grid", "sobol", "latin-hypercube", "random", "saltelli"]


class Design(Section):
    """How points are chosen."""

    kind: DesignKind = Field("grid", description="grid: the axes alone")
    samples: int | None = Field(
        None, ge=1, description="points drawn from the distributions, for each point of the axes"
    )
    repeats: int = Field(
        1, ge=1, description="computations of each point, each with other random numbers"
    )
    same_noise: bool = Field(
        False, description="give all points of the axes the same random numbers"
    )


class _File(Section):
    """The file as it is written; parameters are checked by `_parameters`."""

    name: str = Field(description="title of the report", examples=["tolerance of the PI loop"])
    kind: str = Field(description="what a case computes", examples=["transfer"])
    seed: int = Field(0, ge=0, lt=2**63, description="seed of all random numbers")
    base: dict[str, str] = Field(
        {}, description="files that the cases start from, or built-in names"
    )
    case: dict[str, Any] = Field({}, description="settings of the kind")
    parameters: dict[str, Any] = Field({}, description="axes and distributions")
    time_limit_s: float | None = Field(
        None, gt=0, le=1e7, description="longest time of a case, in s; a case that exceeds it fails"
    )
    design: Design = Design()


@dataclass(frozen=True)
class Axis:
    """A parameter that takes each of some values.

    Args:
        path: of the key, such as `twin.load.mass_kg`.
        values: that it takes.
    """

    path: str
    values: tuple[Json, ...]


@dataclass(frozen=True)
class Distribution:
    """A parameter that is drawn.

    Args:
        path: of the key.
        shape: `uniform`, `log-uniform`, `normal` or `choice`.
        numbers: low and high, mean and standard deviation, or the values of a choice.
    """

    path: str
    shape: str
    numbers: tuple[Json, ...]


@dataclass(frozen=True)
class Campaign:
    """A checked campaign.

    Args:
        name: title.
        kind: what a case computes, by name.
        seed: of all random numbers.
        tables: `case` and the files of `[base]`, complete.
        axes: fully crossed.
        distributions: drawn by the design.
        design: of the points.
        time_limit_s: of a case; None: no limit. The hash of a case does not include it, so it can
            be changed before failed cases are computed again.
        source: path of the file, for messages.
    """

    name: str
    kind: str
    seed: int
    tables: Mapping[str, JsonObject]
    axes: tuple[Axis, ...]
    distributions: tuple[Distribution, ...]
    design: Design
    time_limit_s: float | None = None
    source: str = ""

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of all parameters: axes, then distributions."""
        return tuple(_paths(self.axes, self.distributions))

    @property
    def case_kind(self) -> CaseKind:
        """The object of the kind."""
        return CASE_KINDS.find(self.kind)

    @property
    def points(self) -> int:
        """Points drawn for each point of the axes."""
        samples = self.design.samples or 1
        return (
            samples * (len(self.distributions) + 2) if self.design.kind == "saltelli" else samples
        )

    @property
    def count(self) -> int:
        """Number of cases."""
        axes = math.prod(len(axis.values) for axis in self.axes)
        return axes * self.points * self.design.repeats

    def described(self) -> JsonObject:
        """All that determines the results, except for the time limit, as JSON types."""
        return {
            "name": self.name,
            "kind": self.kind,
            "seed": self.seed,
            "design": self.design.model_dump(mode="json"),
            "parameters": {
                **{axis.path: list(axis.values) for axis in self.axes},
                **{one.path: {one.shape: list(one.numbers)} for one in self.distributions},
            },
            "order of the parameters": list(self.paths),  # of the cases and of the drawn columns
            "tables": dict(self.tables),
        }

    @property
    def base_digest(self) -> str:
        """Hash of what all cases have in common."""
        text = json.dumps([self.kind, self.tables], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def load_campaign(path: Path) -> Campaign:
    """Read CAMPAIGN.toml with the files that it names, and check all of it.

    Args:
        path: of the file; the paths in it are relative to its folder.
    Returns:
        The campaign.
    Raises:
        InputError: a file is missing or wrong, a parameter is unknown, or there are no cases or too
            many.
    """
    file = validated(_File, read_toml(path, "campaign file"), path)
    try:
        return _checked(file, path)
    except InputError as error:
        raise InputError(f"{str(error).rstrip()} {path}") from None


def _checked(file: _File, path: Path) -> Campaign:
    kind = CASE_KINDS.find(file.kind)
    case = validated(kind.settings, file.case, "", "case").model_dump(mode="json")
    tables = {"case": case, **_base(file.base, kind, path.parent)}
    axes, distributions = _parameters(file.parameters)
    for key in _paths(axes, distributions):
        _refuse_unknown(key, tables, kind)
        _refuse_ignored(key, repr(kind.name), kind.ignored)
    found = Campaign(
        file.name, file.kind, file.seed, tables, axes, distributions, file.design,
        file.time_limit_s, str(path),
    )  # fmt: skip
    _check_design(found)
    kind.check(Inputs(tables))
    for axis in axes:
        for value in axis.values:
            _check_value(found, axis.path, value)
    ignored = _ignored_everywhere(found)
    for key in _paths(axes, distributions):
        _refuse_ignored(key, f"{kind.name!r} with this [case]", ignored)
    return found


def _ignored_everywhere(campaign: Campaign) -> tuple[str, ...]:
    """Keys without effect at every value of the axes of `case`."""
    kind, tables = campaign.case_kind, campaign.tables
    cases = [axis for axis in campaign.axes if axis.path.startswith("case.")]
    every = [
        set(kind.ignored_by(Inputs(with_values(tables, {axis.path: value}))))
        for axis in cases
        for value in axis.values
    ]
    return tuple(set.intersection(*every) if every else kind.ignored_by(Inputs(tables)))


def _base(base: Mapping[str, str], kind: CaseKind, folder: Path) -> dict[str, JsonObject]:
    files = {file.name: file for file in kind.files}
    if unknown := [name for name in base if name not in files]:
        raise InputError(
            f"[base] names {', '.join(unknown)}, but the kind {kind.name!r} uses "
            f"{', '.join(files) or 'no file'}. Remove it, or change the kind."
        )
    if missing := [file for name, file in files.items() if name not in base]:
        examples = ", ".join(f'{file.name} = "{file.built_in}"' for file in missing)
        raise InputError(
            f"[base] has no {', '.join(file.name for file in missing)}, which the kind "
            f"{kind.name!r} needs. Name a file, or write {examples}."
        )
    return {name: file.load(base[name], folder) for name, file in files.items()}


# ---- parameters --------------------------------------------------------------------------------


def _parameters(data: Mapping[str, Any]) -> tuple[tuple[Axis, ...], tuple[Distribution, ...]]:
    axes, distributions = [], []
    for path, value in _leaves("", data):
        if isinstance(value, list):
            axes.append(Axis(path, _axis_values(path, value)))
        else:
            distributions.append(_distribution(path, value))
    paths = _paths(axes, distributions)
    if twice := sorted({path for path in paths if paths.count(path) > 1}):
        raise InputError(f"[parameters] names {', '.join(twice)} more than once. Remove one.")
    return tuple(axes), tuple(distributions)


def _paths(axes: Sequence[Axis], distributions: Sequence[Distribution]) -> list[str]:
    return [*(axis.path for axis in axes), *(one.path for one in distributions)]


def _leaves(path: str, data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Axes and distributions in nested tables: `twin.load.mass_kg = [...]` is a table in tables."""
    for key, value in data.items():
        inner = f"{path}.{key}" if path else key
        if isinstance(value, Mapping) and not set(value) & set(_SHAPES):
            if not value:
                raise InputError(
                    f"parameters.{inner} is an empty table. Give it one of {', '.join(_SHAPES)}, "
                    "or a list of values."
                )
            yield from _leaves(inner, value)
        elif isinstance(value, (list, Mapping)):
            yield inner, value
        else:
            raise InputError(
                f"parameters.{inner} is {value!r}, neither a list of values nor a distribution. "
                f"Write [{value!r}] for one value, or for example {{ uniform = [low, high] }}."
            )


def _axis_values(path: str, values: list[Any]) -> tuple[Json, ...]:
    if not values:
        raise InputError(
            f"parameters.{path} has no values, so the campaign has 0 cases. List at least one."
        )
    if len(values) > _MOST_LEVELS:
        raise InputError(
            f"parameters.{path} has {len(values):,} values, but at most {_MOST_LEVELS:,} are "
            "possible. Use a distribution."
        )
    return _alike(path, values)


def _alike(path: str, values: Sequence[Any]) -> tuple[Json, ...]:
    """Values of one type, numbers as float if one of them is."""
    for value in values:
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"parameters.{path} has the value {value}, which is not finite.")
        _refuse_large(path, value)
    kinds = {type(value) for value in values}
    if kinds == {int, float}:
        values, kinds = [float(value) for value in values], {float}
    if len(kinds) > 1 or not kinds <= {int, float, str, bool}:
        raise InputError(
            f"parameters.{path} mixes {', '.join(sorted(kind.__name__ for kind in kinds))}. Give "
            "only numbers, only texts, or only true and false."
        )
    if len(set(values)) < len(values):
        raise InputError(f"parameters.{path} lists a value more than once. Remove it.")
    return tuple(values)


def _refuse_large(path: str, value: Any) -> None:
    if type(value) is int and abs(value) > _LARGEST_INTEGER:
        raise InputError(
            f"parameters.{path} has an integer of {len(str(abs(value)))} digits, but the largest "
            f"possible one is {_LARGEST_INTEGER}. Write it as a float, such as 1e30."
        )


def _distribution(path: str, data: Mapping[str, Any]) -> Distribution:
    if len(data) != 1:
        raise InputError(
            f"parameters.{path} has the keys {', '.join(data)}. Give it exactly one of "
            f"{', '.join(_SHAPES)}."
        )
    ((shape, numbers),) = data.items()
    place = f"parameters.{path}.{shape}"
    if not isinstance(numbers, list) or not numbers:
        raise InputError(f"{place} is {numbers!r}, but must be a list. Write {place} = [...].")
    numbers = _alike(f"{path}.{shape}", numbers) if shape == "choice" else tuple(numbers)
    if shape == "choice":
        return Distribution(path, shape, numbers)
    for number in numbers:
        _refuse_large(f"{path}.{shape}", number)
    numeric = all(type(number) in (int, float) for number in numbers)
    if len(numbers) != _SHAPES[shape] or not numeric or not all(map(math.isfinite, numbers)):
        wanted = "a mean and a standard deviation" if shape == "normal" else "two finite bounds"
        raise InputError(f"{place} is {list(numbers)}, but must be {wanted}. Change it.")
    low, high = map(float, numbers)
    if shape == "normal" and not high > 0.0:
        raise InputError(f"{place} has a standard deviation of {high:g}. Make it positive.")
    if shape != "normal" and not low < high:
        raise InputError(f"{place} is from {low:g} to {high:g}. Make the first number the smaller.")
    if shape == "log-uniform" and not low > 0.0:
        raise InputError(f"{place} begins at {low:g}. Make both bounds positive, or use uniform.")
    return Distribution(path, shape, (low, high))


# ---- tables ------------------------------------------------------------------------------------


def with_values(
    tables: Mapping[str, JsonObject], values: Mapping[str, Json]
) -> dict[str, JsonObject]:
    """Copy tables and set keys in them.

    Args:
        tables: by name.
        values: by their dotted paths; a number in a path is an index of a list, from 0.
    Returns:
        The changed copies.
    Raises:
        InputError: a path leads through something that is not a table.
    Example:
        >>> with_values({"twin": {"load": {"mass_kg": 0.25}}}, {"twin.load.mass_kg": 0.3})
        {'twin': {'load': {'mass_kg': 0.3}}}
    """
    found = copy.deepcopy(dict(tables))
    for path, value in values.items():
        *way, last = path.split(".")
        inner: Any = found
        for k, part in enumerate(way):
            inner = _inside(inner, part, ".".join(way[:k]))
        if isinstance(inner, dict):
            inner[last] = value
        else:
            _inside(inner, last, ".".join(way))
            inner[int(last)] = value
    return found


def _inside(table: Any, part: str, parent: str) -> Any:
    path = f"{parent}.{part}"
    if isinstance(table, list):
        if part not in map(str, range(len(table))):  # only one way to write an index
            raise InputError(
                f"parameters.{path}: {part!r} is not an index of a list of {len(table)} values. "
                f"Use 0 to {len(table) - 1}."
            )
        return table[int(part)]
    if not isinstance(table, dict):
        raise InputError(  # as with a distribution that is spelt wrong
            f"parameters.{parent}: unknown key {part!r}. Use one of {', '.join(_SHAPES)}."
        )
    if part not in table:
        raise InputError(
            f"parameters.{path}: there is no table {part!r}. Use one of {', '.join(table)}."
        )
    return table[part]


def _refuse_unknown(path: str, tables: Mapping[str, JsonObject], kind: CaseKind) -> None:
    first, _, rest = path.partition(".")
    names = " or ".join(f"{name}." for name in tables)
    if first not in tables:
        raise InputError(
            f"parameters.{path}: a campaign of the kind {kind.name!r} has no table {first!r}. "
            f"Begin the path with {names}"
        )
    if not rest:
        raise InputError(
            f"parameters.{path} is a table, not a key. Name one of its keys: "
            f"{', '.join(tables[first])}."
        )
    with_values(tables, {path: None})


def _refuse_ignored(path: str, kind: str, ignored: Sequence[str]) -> None:
    if any(path == key or path.startswith(f"{key}.") for key in ignored):
        raise InputError(
            f"parameters.{path} has no effect on cases of the kind {kind}. Remove it, or choose "
            "another kind."
        )


def _check_value(campaign: Campaign, path: str, value: Json) -> None:
    """Check the tables with one changed value, whatever the others are."""
    try:
        campaign.case_kind.check(Inputs(with_values(campaign.tables, {path: value})))
    except InputError as error:
        raise InputError(refused_value(path, value, error, "Change it.")) from None


def refused_value(path: str, value: Json, error: InputError, advice: str) -> str:
    """Say why a value of a parameter is refused, in one cause and one action.

    Args:
        path: of the parameter.
        value: that is refused.
        error: of the check of the tables with this value.
        advice: what to do if the error names only this parameter.
    """
    own = re.fullmatch(rf"1 error: {re.escape(path)}: (.*)\. Change these values\. *", str(error))
    if own is None:
        return f"parameters.{path} = {value!r}: {str(error).rstrip()}"
    if own[1].startswith("no such key"):
        return f"parameters.{path}: {own[1].partition(' (got')[0]}. Change it."
    return f"parameters.{path}: {own[1]}. {advice}"


# ---- design ------------------------------------------------------------------------------------


def _check_design(campaign: Campaign) -> None:
    design, drawn = campaign.design, len(campaign.distributions)
    if design.kind == "grid":
        if drawn:
            raise InputError(
                f"design.kind is 'grid', but {campaign.distributions[0].path} has a distribution. "
                "Use sobol, latin-hypercube, random or saltelli, or list its values."
            )
        if design.samples is not None:
            raise InputError(
                f"design.samples is {design.samples}, which has no effect with design.kind = "
                "'grid'. Remove it; design.repeats repeats the points."
            )
    elif not drawn:
        raise InputError(
            f"design.kind is {design.kind!r}, but no parameter has a distribution, so the design "
            "is empty (0 points). Add a distribution, or use grid."
        )
    elif design.samples is None:
        raise InputError(f"design.samples is missing; {design.kind} needs it. Add samples = 1024.")
    if campaign.count > MOST_CASES:
        raise InputError(
            f"The campaign has {campaign.count:,} cases, but at most {MOST_CASES:,} are possible. "
            "Lower design.samples, design.repeats or the number of values."
        )
    samples = design.samples or 1
    if design.kind in ("sobol", "saltelli") and samples & (samples - 1):
        near = 2 ** round(math.log2(samples))
        raise InputError(
            f"design.samples is {samples}, but {design.kind} needs a power of two. Use {near}."
        )
    if design.kind == "saltelli":
        if design.repeats > 1:
            raise InputError(
                f"design.repeats is {design.repeats}, but sensitivity indices need one result for "
                "each point. Remove it."
            )
        if any(one.shape == "choice" for one in campaign.distributions):
            raise InputError(
                "design.kind is 'saltelli', but a parameter is a choice of values. Use bounds, or "
                "list its values as an axis."
            )
