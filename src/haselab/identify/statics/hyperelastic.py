"""Hyperelastic law from stress and stretch, optionally with the stiffness of the electrodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, JsonObject, LimitError, check_fields, checked
from haselab.base.chart import Chart, Curve, Panel
from haselab.identify.fit import CurveFit
from haselab.identify.statics.columns import check_pair, plausible_stretch
from haselab.identify.statics.hyperelastic_search import (
    ELECTRODE_NAMES,
    Candidate,
    Electrodes,
    Sample,
    fit_law,
)
from haselab.models import LAWS, Deformation, HyperelasticLaw, law_from_parameters

__all__ = [
    "HyperelasticFit",
    "StressPrediction",
    "TensileTest",
    "fit_hyperelastic",
    "fit_hyperelastic_tests",
]

Floats = NDArray[np.float64]
_LEAST_SAMPLES = 6
_GRID = 200
_MOVED = 2.0  # standard deviations by which a parameter changes on half the range
_SOFT_PA, _STIFF_PA = 100.0, 1e9  # plausible moduli of a rubber
_STANDARD = ("uniaxial", "pure_shear", "equibiaxial")


@dataclass(frozen=True)
class TensileTest:
    """Stress and stretch of one test, in any order.

    Args:
        stretch: as recorded, 1 at the start of the test. Shape `(N,)`.
        nominal_stress_pa: force along the length over the natural cross-section, in Pa. `(N,)`.
        deformation: what the test does to the width.
    Raises:
        InputError: fewer than 6 samples, unequal lengths, NaN, a constant column, or a
            column that is not a stretch.
    """

    stretch: Floats
    nominal_stress_pa: Floats
    deformation: Deformation = field(default_factory=Deformation)

    def __post_init__(self) -> None:
        check_fields(self)
        x, y = check_pair(
            "stretch", self.stretch, "nominal_stress_pa", self.nominal_stress_pa,
            least=_LEAST_SAMPLES, record="record a tensile test",
        )  # fmt: skip
        plausible_stretch(x, "nominal_stress_pa", y)
        order = np.argsort(x, kind="stable")
        length, width = self.deformation.stretches(x)
        pull = length - 1.0 / (length**3 * width**2)
        if float(pull @ y) < 0.0 and float(pull.min()) < 0.0 < float(y.min() + np.ptp(y)):
            raise InputError(
                f"nominal_stress_pa is tensile where the stretch, in [{x.min():g}, {x.max():g}], "
                "is below 1; stress and deformation must have the same sign. "
                "Give stretch, not strain."
            )
        object.__setattr__(self, "stretch", x[order])
        object.__setattr__(self, "nominal_stress_pa", y[order])

    @property
    def sample(self) -> Sample:
        """The test in the form that the search uses."""
        length, width = self.deformation.stretches(self.stretch)
        return Sample(self.stretch, length, width, self.nominal_stress_pa)

    @property
    def stretch_range(self) -> tuple[float, float]:
        """Lowest and highest stretch."""
        return float(self.stretch[0]), float(self.stretch[-1])


@dataclass(frozen=True)
class StressPrediction:
    """Stress predicted by a fitted law, without the electrodes.

    Args:
        stretch: as requested. Shape `(M,)`.
        nominal_stress_pa: of the law, in Pa. Shape `(M,)`.
        std_pa: standard deviation from the covariance of the parameters; infinite where a relevant
            one is not identifiable. Shape `(M,)`.
        notes: remarks for the user, one sentence each.
    """

    stretch: Floats
    nominal_stress_pa: Floats
    std_pa: Floats
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class HyperelasticFit(CurveFit):
    """The chosen law and its rivals; see `Fit` for what all fits have.

    Its `parameters` are those of the law; its `residuals` are stresses of each test, in Pa.

    Args:
        best: the chosen candidate.
        candidates: all that were fitted, the best first.
        tests: the data, each in the order of its stretch.
    """

    best: Candidate
    candidates: tuple[Candidate, ...]
    tests: tuple[TensileTest, ...]

    @property
    def r_squared(self) -> float:
        """Share of the variance that the law explains."""
        return self.best.r_squared

    @property
    def stretch_range(self) -> tuple[float, float]:
        """Lowest and highest recorded stretch of all tests; the parameters depend on it."""
        ranges = [test.stretch_range for test in self.tests]
        return min(low for low, _ in ranges), max(high for _, high in ranges)

    @property
    def lateral_stretch(self) -> float | None:
        """Lateral stretch of the first test where the width is clamped; None elsewhere."""
        first = self.tests[0].deformation
        held = {"pure_shear": 1.0, "fixed_lateral": first.lateral_stretch,
                "prestretched": first.prestretch}  # fmt: skip
        return held.get(first.kind)

    @property
    def law(self) -> HyperelasticLaw:
        """The chosen law with its fitted parameters, without the electrode spring.

        A parameter that is not identifiable keeps the value of the fitted curve.

        Raises:
            ResultError: the fit has no result.
        """
        self._require()
        return _law(self.best)

    @checked
    def simulate(self, x: ArrayLike) -> Floats:
        """Nominal stress at stretches, in Pa, deformed as the first test; see `CurveFit`."""
        return self.predict(x).nominal_stress_pa

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`; all tests, and the law in the deformation of each."""
        curves = []
        for test in self.tests:
            kind = test.deformation.kind
            curves.append(
                Curve(test.stretch, test.nominal_stress_pa, f"measured, {kind}", "points")
            )
            law = self.predict(np.linspace(*test.stretch_range, 300), test.deformation)
            curves.append(Curve(law.stretch, law.nominal_stress_pa, "law", "line", law.std_pa))
        panel = Panel(*(names or ("Stretch", "Nominal stress (Pa)")), curves)
        return Chart(f"Hyperelastic law, {self.best.model}", (panel,))

    def predict(
        self, stretch: ArrayLike, deformation: Deformation | None = None
    ) -> StressPrediction:
        """Predict the stress, with its standard deviation and a note outside the data.

        Args:
            stretch: stretches. Shape `(M,)`.
            deformation: how the sheet is deformed; None: as in the first test.
        Returns:
            The prediction.
        Raises:
            ResultError: the fit has no result.
            LimitError: a stretch not above zero, or beyond the full length of the chains.
        """
        law, kind = self.law, deformation or self.tests[0].deformation
        x = np.atleast_1d(np.asarray(stretch, dtype=np.float64))
        length, width = kind.stretches(x)
        stress_pa = law.nominal_stress_pa(length, width)
        return StressPrediction(
            x, stress_pa, _spread(self.best, length, width), self._asked_outside(x, kind)
        )

    def _asked_outside(self, stretch: Floats, kind: Deformation) -> tuple[str, ...]:
        same = [test.stretch_range for test in self.tests if test.deformation == kind]
        if not same:
            return (f"No {kind.kind} test was fitted; the law is extrapolated to it.",)
        low, high = min(r[0] for r in same), max(r[1] for r in same)
        outside = stretch[(stretch < low) | (stretch > high)]
        if not outside.size:
            return ()
        far = float(outside[np.argmax(np.maximum(low - outside, outside - high))])
        return (
            f"Stretch {far:g} is outside the data of [{low:g}, {high:g}]; "
            "the prediction is an extrapolation.",
        )

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "model": self.best.model,
            "parameters": dict(self.best.parameters),
            "stretch_range": list(self.stretch_range),
            "lateral_stretch": self.lateral_stretch,
            "tests": [
                test.deformation.to_dict() | {"stretch_range": list(test.stretch_range)}
                for test in self.tests
            ],
            "r_squared": self.best.r_squared,
            "aic": self.best.aic,
            "aicc": self.best.aicc,
            "bic": self.best.bic,
            "candidates": [
                {
                    "model": candidate.model,
                    "aic": candidate.aic,
                    "aicc": candidate.aicc,
                    "bic": candidate.bic,
                    "r_squared": candidate.r_squared,
                    "parameters": dict(candidate.parameters),
                }
                for candidate in self.candidates
            ],
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_hyperelastic(
    stretch: ArrayLike,
    nominal_stress_pa: ArrayLike,
    model: str = "auto",
    *,
    deformation: str = "uniaxial",
    lateral_stretch: float = 3.0,
    prestretch: float = 1.0,
    electrode_natural: float | None = None,
    electrode_stiffening: bool = False,
) -> HyperelasticFit:
    r"""Least squares of nominal stress over one test; see `fit_hyperelastic_tests`.

    Args:
        stretch: stretch along the length, 1 at the natural length. Shape `(N,)`.
        nominal_stress_pa: force over natural cross-section, in Pa. Shape `(N,)`.
        model: name of a law, or "auto" for all of them and the lowest AICc.
        deformation: kind of the test, see `Deformation`.
        lateral_stretch: the fixed lateral stretch, where the width is clamped.
        prestretch: of a sheet stretched both ways before the test.
        electrode_natural: stretch at which electrodes bonded to the sheet are free of force; their
            linear spring is then fitted together with the law. None: no electrodes.
        electrode_stiffening: fit a cubic term of that spring too.
    Returns:
        The chosen law and all candidates.
    Raises:
        InputError: as `TensileTest`, unknown names.
    Source: unweighted least squares; Akaike, IEEE Trans. Autom. Control 19 (1974), 716.
    Example:
        >>> from haselab.models import Ogden
        >>> stretch = np.linspace(1.0, 3.0, 40)
        >>> noise_pa = 20.0 * np.random.default_rng(2).normal(size=40)
        >>> fit = fit_hyperelastic(stretch, Ogden(15e3, 2.4).nominal_stress_pa(stretch) + noise_pa)
        >>> fit.best.r_squared > 0.999
        True
    """
    kind = Deformation(deformation, lateral_stretch=lateral_stretch, prestretch=prestretch)
    test = TensileTest(np.asarray(stretch), np.asarray(nominal_stress_pa), kind)
    return fit_hyperelastic_tests(
        [test], model, electrode_natural=electrode_natural,
        electrode_stiffening=electrode_stiffening,
    )  # fmt: skip


@checked
def fit_hyperelastic_tests(
    tests: Sequence[TensileTest],
    model: str = "auto",
    *,
    electrode_natural: float | None = None,
    electrode_stiffening: bool = False,
) -> HyperelasticFit:
    r"""Least squares of nominal stress over all tests of one material.

    $\min \sum_t \sum_i (P_{ti} - P(\lambda_{ti}) - k\,e_{ti} - q\,e_{ti}^3)^2$ with
    $e = \lambda - \lambda_e$

    The moduli are solved for; the shape parameters are searched from many starts. The last terms
    are those of optional electrodes, stress-free at $\lambda_e$. Laws that soften within the
    data, and laws with a parameter that is not identifiable, are ranked behind the others.

    Args:
        tests: one or more, each with its own deformation.
        model: name of a law, or "auto" for all of them and the lowest AICc.
        electrode_natural: stretch of the length at which electrodes are free of force, or None.
        electrode_stiffening: fit their cubic term $q$ too.
    Returns:
        The chosen law and all candidates.
    Raises:
        InputError: no test, or an unknown law.
    Source: Ogden, Saccomandi and Sgura, Comput. Mech. 34 (2004), 484, for the joint fit; Hurvich
        and Tsai, Biometrika 76 (1989), 297, for the criterion.
    Example:
        >>> from haselab.models import Gent
        >>> x, law, rng = np.linspace(1.1, 3.0, 30), Gent(15e3, 40.0), np.random.default_rng(4)
        >>> tests = []
        >>> for kind in (Deformation("uniaxial"), Deformation("equibiaxial")):
        ...     stress_pa = law.nominal_stress_pa(*kind.stretches(x)) + 50.0 * rng.normal(size=30)
        ...     tests.append(TensileTest(x, stress_pa, kind))
        >>> low, high = fit_hyperelastic_tests(tests, "gent").best.parameters["jm"].ci95
        >>> low < 40.0 < high
        True
    """
    if not tests:
        raise InputError("No test was given. Pass at least one TensileTest.")
    if model != "auto" and model not in LAWS:
        raise InputError(f"model = {model}; it must be one of auto, {', '.join(LAWS)}.")
    if electrode_stiffening and electrode_natural is None:
        raise InputError(
            "electrode_stiffening needs electrode_natural, the stretch at which the electrodes are "
            "free of force. Give it."
        )
    electrodes = None
    if electrode_natural is not None:
        electrodes = Electrodes(electrode_natural, electrode_stiffening)
    samples = [test.sample for test in tests]
    names = list(LAWS) if model == "auto" else [model]
    fitted = [_judged(fit_law(name, samples, electrodes), tests) for name in names]
    fitted.sort(key=_rank)
    best = fitted[0]
    status = "ok"
    if not best.settled:
        status = f"no result: {best.model} reached its search limit; use a wider stretch range"
    elif not best.r_squared > 0.0:
        status = "no result: no law explains the data better than their mean; check the columns"
    notes = _notes(best, tests, electrodes) if status == "ok" else ()
    return HyperelasticFit(
        status=status,
        parameters=best.parameters,
        covariance=best.covariance,
        residuals=tuple(
            test.nominal_stress_pa - modelled_pa
            for test, modelled_pa in zip(tests, best.modelled_pa, strict=True)
        ),
        notes=notes,
        best=best,
        candidates=tuple(fitted),
        tests=tuple(tests),
    )


def _rank(candidate: Candidate) -> tuple[bool, bool, bool, float]:
    unknown = any(math.isnan(e.value) for e in candidate.parameters.values())
    return not candidate.settled, candidate.softens_at is not None, unknown, candidate.aicc


def _law(candidate: Candidate) -> HyperelasticLaw:
    numbers = {name: v for name, v in candidate.numbers.items() if name not in ELECTRODE_NAMES}
    return law_from_parameters(candidate.model, numbers)


def _judged(candidate: Candidate, tests: Sequence[TensileTest]) -> Candidate:
    """The candidate with the stretch from which it softens within the data."""
    if not candidate.settled:
        return candidate
    law = _law(candidate)
    places = [_softening(law, test.deformation, *test.stretch_range) for test in tests]
    found = [place for place in places if place is not None]
    return replace(candidate, softens_at=min(found, default=None))


def _softening(law: HyperelasticLaw, kind: Deformation, low: float, high: float) -> float | None:
    """Lowest stretch at which the stress stops rising, up to the full length of the chains."""
    x = np.linspace(low, high, _GRID)
    length, width = kind.stretches(x)
    stress, beyond = np.zeros(0), _GRID + 1
    # Bisection for the last stretch of the grid before the full length of the chains.
    while beyond - stress.size > 1:
        count = _GRID if beyond > _GRID else (stress.size + beyond) // 2
        try:
            stress = law.nominal_stress_pa(length[:count], width[:count])
        except LimitError:
            beyond = count
    falls = np.flatnonzero(np.diff(stress) <= 0.0)
    return float(x[falls[0]]) if falls.size else None


def _spread(candidate: Candidate, length: Floats, width: Floats) -> Floats:
    """Standard deviation of the law's stress from the covariance of its parameters."""
    names = [name for name in candidate.numbers if name not in ELECTRODE_NAMES]
    place = [list(candidate.numbers).index(name) for name in names]
    covariance = candidate.covariance[np.ix_(place, place)]
    known = np.isfinite(np.diag(covariance))
    slopes = np.zeros((length.size, len(names)))
    for k, name in enumerate(names):
        step = 1e-6 * max(abs(candidate.numbers[name]), 1e-6)
        sides = []
        for way in (1.0, -1.0):
            numbers = {n: candidate.numbers[n] + (way * step if n == name else 0.0) for n in names}
            sides.append(
                law_from_parameters(candidate.model, numbers).nominal_stress_pa(length, width)
            )
        slopes[:, k] = (sides[0] - sides[1]) / (2.0 * step)
    part = slopes[:, known]
    variance = np.einsum("ni,ij,nj->n", part, covariance[np.ix_(known, known)], part)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _notes(
    best: Candidate, tests: Sequence[TensileTest], electrodes: Electrodes | None
) -> tuple[str, ...]:
    return (
        *_identifiability_note(best),
        *_softening_notes(best, tests),
        *_range_notes(best, tests, electrodes),
        *_unit_notes(tests),
    )


def _identifiability_note(best: Candidate) -> list[str]:
    unknown = [name for name, e in best.parameters.items() if math.isnan(e.value)]
    if not unknown:
        return []
    reason = (
        "the chains are far from their full length" if {"lambda_m", "jm"} & set(unknown)
        else "fewer terms fit as well"
    )  # fmt: skip
    return [f"Not identifiable from these data: {', '.join(unknown)} ({reason})."]


def _softening_notes(best: Candidate, tests: Sequence[TensileTest]) -> list[str]:
    if best.softens_at is not None:
        return [
            f"{best.model} softens from stretch {best.softens_at:.3g} on, within the data, which "
            "no stable rubber does; choose another law."
        ]
    law, tested = _law(best), {test.deformation.kind for test in tests}
    high = max(test.stretch_range[1] for test in tests)
    notes = []
    for kind in _STANDARD:
        if kind in tested or high <= 1.0:
            continue
        place = _softening(law, Deformation(kind), 1.0, high)
        if place is not None:
            notes.append(
                f"{best.model} softens from stretch {place:.3g} on in {kind.replace('_', ' ')}, "
                "which was not tested; do not use it there."
            )
    return notes


def _range_notes(
    best: Candidate, tests: Sequence[TensileTest], electrodes: Electrodes | None
) -> list[str]:
    """A note where the parameters of the lower half of the range differ."""
    halves = []
    for test in tests:
        sample = test.sample
        rows = sample.stretch <= 0.5 * sum(test.stretch_range)
        if rows.sum() < max(_LEAST_SAMPLES, 2 * len(best.numbers)):
            return []
        halves.append(sample.taken(rows))
    half = fit_law(best.model, halves, electrodes)
    if not half.settled:
        return []
    moved = []
    for name, whole in best.parameters.items():
        part = half.parameters[name]
        if name != "chain_segments" and abs(part.value - whole.value) > _MOVED * part.std:
            moved.append(f"{name} to {part.value:.4g} {part.unit}".rstrip())
    if not moved:
        return []
    return [
        f"On the lower half of the stretches the parameters differ ({', '.join(moved)}): they "
        "are valid for this range only."
    ]


def _unit_notes(tests: Sequence[TensileTest]) -> list[str]:
    samples = [test.sample for test in tests]
    pull = np.concatenate([s.length - 1.0 / (s.length**3 * s.width**2) for s in samples])
    stress = np.concatenate([s.stress_pa for s in samples])
    modulus_pa = abs(float(pull @ stress) / float(pull @ pull))
    if _SOFT_PA <= modulus_pa <= _STIFF_PA:
        return []
    other = "kPa or MPa" if modulus_pa < _SOFT_PA else "a unit below Pa"
    return [
        f"A shear modulus of {modulus_pa:.3g} Pa is implausible for rubber. Is nominal_stress_pa "
        f"in in {other}?"
    ]
