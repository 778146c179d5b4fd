"""Call the experiments of other packages: name their failures, and check what they return."""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from haselab.base import Estimate, HaselabError, InputError, ResultError, described, to_plain
from haselab.base.exits import no_exit
from haselab.safety.feasibility import Drive
from haselab.study.experiment import Chart, Curve, Experiment, ExperimentResult
from haselab.study.quantity import Quantity

__all__ = [
    "AnyExperiment",
    "check_result",
    "declared",
    "foreign",
    "refuse_repeated",
    "rows_of_experiment",
]

AnyExperiment = Experiment[Any]
Returned = TypeVar("Returned")
_NUMBER = (Real,)  # with the scalars of NumPy
_MAPPINGS = ("quantities", "notes", "figures", "missing")  # of an ExperimentResult
_TEXTS = ("name", "title", "caption", "x_label", "y_label")  # of a Chart


def _is_own(experiment: AnyExperiment) -> bool:
    """Whether an experiment is one of haselab's own."""
    return _package(experiment) == __name__.partition(".")[0]


def _package(experiment: AnyExperiment) -> str:
    return type(experiment).__module__.partition(".")[0]


@contextlib.contextmanager
def foreign(
    experiment: AnyExperiment, doing: str, failed: type[HaselabError] = ResultError
) -> Iterator[None]:
    """Run code of another package; report any failure as that package's, not as a bug of haselab.

    Args:
        experiment: whose code runs.
        doing: the method, such as "fit".
        failed: class of the error; an `InputError` before anything is recorded.
    Raises:
        HaselabError: Of the class `failed`: replaces an error that is not one of haselab's.
    """
    try:
        with no_exit():
            yield
    except HaselabError:
        raise
    except Exception as error:
        if _is_own(experiment):
            raise
        kept = " The recorded data are kept." if issubclass(failed, ResultError) else ""
        raise failed(
            f"The method {doing!r} of the experiment [{experiment.table}], package "
            f"{_package(experiment)!r}, failed: {described(error)}.{kept} Run again "
            "with --debug for the traceback."
        ) from error


def declared(
    experiment: AnyExperiment,
    doing: str,
    kind: type | tuple[type, ...],
    method: Callable[[], Iterable[Returned]],
) -> list[Returned]:
    """Return what an experiment declares before it is played.

    Args:
        experiment: whose code runs.
        doing: name of the method, for the message.
        kind: type of what the method returns a list of.
        method: returns the list.
    Raises:
        InputError: the method failed, or returned something else.
    """
    with foreign(experiment, doing, InputError):
        found = list(method())
    for each in found:
        _require(experiment, doing, each, kind, failed=InputError)
        if isinstance(each, Drive):
            _check_drive(experiment, each)
    return found


def _check_drive(experiment: AnyExperiment, drive: Drive) -> None:
    values = drive.values_v
    where = " as values_v of a Drive"
    _require(experiment, "drives", values, np.ndarray, where, InputError)
    if values.ndim != 1 or values.dtype.kind not in "fiu":
        raise InputError(
            f"The method 'drives' of the experiment [{experiment.table}] returns{where} an array "
            f"of shape {values.shape} and type {values.dtype}. Return one number per block there."
        )


def refuse_repeated(what: str, names: Sequence[str]) -> None:
    """Refuse names that several experiments of a study use, since one would replace the other.

    Args:
        what: is named, such as "result".
        names: of all experiments.
    Raises:
        InputError: the message names the first of them.
    """
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InputError(
            f"Several experiments of the study have a {what} named {repeated[0]!r}. Rename it in "
            "your own experiment."
        )


def rows_of_experiment(experiment: AnyExperiment) -> Mapping[str, Quantity]:
    """Return the rows that an experiment lists.

    Raises:
        ResultError: the method `rows` failed, or returned something else.
    """
    with foreign(experiment, "rows"):
        rows = dict(experiment.rows())
    for key, row in rows.items():
        _require(experiment, "rows", key, str, " as the id of a row")
        _require(experiment, "rows", row, Quantity, f" for {key}")
        for text in (row.name, row.unit):
            _require(experiment, "rows", text, str, f" as name or unit of {key}")
    return rows


def check_result(experiment: AnyExperiment, found: object) -> None:
    """Refuse results that the report would show wrongly, or for which it has no row.

    Raises:
        ResultError: the message names the first of them, the value found and what to do.
    """
    _require(experiment, "fit", found, ExperimentResult)
    assert isinstance(found, ExperimentResult)
    _check_types(experiment, found)
    rows = rows_of_experiment(experiment)
    unnamed = sorted({*found.quantities, *found.missing} - set(rows))
    if unnamed:
        raise ResultError(
            f"The experiment [{experiment.table}] returns {', '.join(unnamed)}, but its method "
            "'rows' does not list them. Add a Quantity for each."
        )
    both = sorted({*found.quantities} & {*found.missing})
    if both and not _is_own(experiment):
        raise ResultError(
            f"The experiment [{experiment.table}] returns {', '.join(both)} both as a result and "
            "as missing. Return it once."
        )
    for key, estimate in found.quantities.items():
        _check_estimate(experiment, key, estimate, rows[key].unit)
    for chart in found.charts:
        for curve in chart.curves:
            _check_curve(experiment, chart, curve)


def _check_types(experiment: AnyExperiment, found: ExperimentResult) -> None:
    """Refuse a result any part of which has the wrong type."""

    def require(value: object, kind: type | tuple[type, ...], where: str) -> None:
        _require(experiment, "fit", value, kind, where)

    for part in _MAPPINGS:
        require(getattr(found, part), Mapping, f" as {part}")
        for key in getattr(found, part):
            require(key, str, f" as a key of {part}")
    for part in ("charts", "values"):
        require(getattr(found, part), tuple, f" as {part}")
    for part, texts in (("notes", found.notes), ("missing", found.missing)):
        for key, text in texts.items():
            require(text, str, f" in {part} for {key}")
    for key, estimate in found.quantities.items():
        require(estimate, Estimate, f" for {key}")
        require(estimate.value, _NUMBER, f" for {key}")
        require(estimate.std, _NUMBER, f" as std of {key}")
        require(estimate.unit, str, f" as unit of {key}")
        ends = list(estimate.ci95) if isinstance(estimate.ci95, np.ndarray) else estimate.ci95
        require(ends, Sequence, f" as ci95 of {key}")
        if len(ends) != 2:
            raise ResultError(
                f"The method 'fit' of the experiment [{experiment.table}] returns a ci95 of {key} "
                f"with {len(ends)} numbers. Return the lower and the upper end."
            )
        for end in ends:
            require(end, _NUMBER, f" in ci95 of {key}")
    for chart in found.charts:
        require(chart, Chart, " among the charts")
        for part in _TEXTS:
            require(getattr(chart, part), str, f" as {part} of a chart")
        require(chart.curves, Sequence, f" as curves of chart {chart.name!r}")
        for curve in chart.curves:
            require(curve, Curve, f" in chart {chart.name!r}")
            require(curve.name, str, f" as name of a curve in chart {chart.name!r}")
    if _is_own(experiment):
        return
    for key, section in found.figures.items():  # converted twice, so only where it may fail
        try:
            json.dumps(to_plain(section))
        except (TypeError, ValueError) as error:
            raise ResultError(
                f"The method 'fit' of the experiment [{experiment.table}] returns in figures for "
                f"{key} what JSON cannot hold: {error}. Return numbers, texts, arrays, lists and "
                "mappings there."
            ) from error


def _check_estimate(experiment: AnyExperiment, key: str, estimate: Estimate, unit: str) -> None:
    where = f"The experiment [{experiment.table}] returns {key}"
    if estimate.unit != unit:
        raise ResultError(
            f"{where} in {estimate.unit or 'no unit'!r}, but its row is in {unit or 'no unit'!r}. "
            "Convert the estimate, or change the unit in 'rows'."
        )
    if _is_own(experiment):  # where NaN stands for a metric that a trial does not have
        return
    low, high = estimate.ci95
    if not all(map(math.isfinite, (estimate.value, estimate.std, low, high))):
        raise ResultError(
            f"{where} = {estimate.value:g} with a standard deviation of {estimate.std:g} and the "
            f"interval {low:g} to {high:g}, which are not all finite. Return it in 'missing' with "
            "the reason instead."
        )
    if estimate.std < 0.0 or not low <= estimate.value <= high:
        raise ResultError(
            f"{where} = {estimate.value:g} with a standard deviation of {estimate.std:g} and the "
            f"interval {low:g} to {high:g}. Return a standard deviation of at least 0 and an "
            "interval around the value, the lower end first."
        )


def _check_curve(experiment: AnyExperiment, chart: Chart, curve: Curve) -> None:
    with foreign(experiment, "fit"):
        shapes = [np.asarray(values, dtype=np.float64).shape for values in (curve.x, curve.y)]
    if len(shapes[0]) != 1 or shapes[0] != shapes[1]:
        raise ResultError(
            f"The experiment [{experiment.table}] returns chart {chart.name!r}, whose curve "
            f"{curve.name!r} has x of shape {shapes[0]} and y of shape {shapes[1]}. Give both the "
            "same length."
        )


def _require(
    experiment: AnyExperiment,
    method: str,
    value: object,
    kind: type | tuple[type, ...],
    where: str = "",
    failed: type[HaselabError] = ResultError,
) -> None:
    """Refuse an object of the wrong type, which would fail later in code of haselab."""
    if not isinstance(value, kind):
        wanted = kind.__name__ if isinstance(kind, type) else "number"
        shown = repr(value).partition("\n")[0][:40]
        raise failed(
            f"The method {method!r} of the experiment [{experiment.table}] returns{where} {shown} "
            f"({type(value).__name__}), which is no {wanted}. Return a {wanted} there."
        )
