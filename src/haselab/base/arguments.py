"""Checks of what a caller passes to a public function, against the function's annotations."""

from __future__ import annotations

import functools
import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeGuard, TypeVar, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base.errors import InputError

__all__ = ["check_fields", "check_length", "checked", "generator", "is_real", "real_array", "shown"]

Given = ParamSpec("Given")
Answer = TypeVar("Answer")
_LONGEST = 50  # characters of a value that an error shows
_WORDS = {float: "a number", int: "a whole number", bool: "True or False", str: "a text",
          np.ndarray: "an array of real numbers"}  # fmt: skip
_ARRAYS = set(get_args(ArrayLike))


def checked(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Make a function refuse arguments that its annotations exclude.

    Numbers must be real and not NaN, arrays must hold real numbers, and anything else must be of
    the annotated classes. A class may say in `made_by` how to make its objects. Type variables,
    protocols and texts (aliases with optional libraries) are not checked.

    Args:
        function: with annotations that exist at run time.
    Returns:
        The function, which raises `InputError` instead of whatever such a value led to.
    Raises:
        TypeError: by the function, for an unknown argument or a missing one.
    Example:
        >>> @checked
        ... def halved(length_m: float) -> float:
        ...     return 0.5 * length_m
        >>> halved("3")
        Traceback (most recent call last):
        haselab.base.errors.InputError: length_m is '3'; it must be a number.
    """
    signature = inspect.signature(function)
    owner: Any = function

    @functools.wraps(function)
    def call(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        kinds = _kinds(owner)
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            # Perhaps arrays where a record is needed, which is the better reason.
            _check_all(dict(zip(signature.parameters, args, strict=False)), kinds)
            known = ", ".join(name for name in signature.parameters if name != "self")
            raise TypeError(
                f"{function.__qualname__}() {error}. Its arguments are {known}."
            ) from None
        _check_all(given, kinds)
        return function(*args, **kwargs)

    return call


def _check_all(given: Mapping[str, object], kinds: Mapping[str, Any]) -> None:
    for name, value in given.items():
        if name in kinds:
            _check(name, value, kinds[name])


def check_fields(instance: object) -> None:
    """Refuse fields of a dataclass that its annotations exclude; for `__post_init__`.

    Args:
        instance: with all fields set.
    Raises:
        InputError: a field of another kind.
    """
    owner: Any = type(instance)
    for name, kind in _kinds(owner).items():
        _check(name, getattr(instance, name), kind)


def real_array(name: str, values: object) -> NDArray[np.float64]:
    """Values as an array of real numbers.

    Args:
        name: of the argument, for the error.
        values: numbers, in any nesting of one shape.
    Returns:
        The array, not copied where it is one already.
    Raises:
        InputError: a text, nothing, complex numbers, times, rows of unequal lengths.
    Example:
        >>> real_array("u", [1, 2])
        array([1., 2.])
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind == "O" and array.ndim and all(map(is_real, array.flat)):
            array = array.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(
            f"{name} has rows of unequal lengths; it must be an array of real numbers."
        ) from error
    if array.dtype.kind in "biuf":
        return np.asarray(array, dtype=np.float64)
    if array.ndim == 0:
        raise InputError(f"{name} is {shown(values)}; it must be an array of real numbers.")
    strange = next((each for each in array.flat if not is_real(each)), array.dtype)
    raise InputError(f"{name} holds {shown(strange)}; it must hold real numbers.")


def generator(seed: object, name: str = "seed") -> np.random.Generator:
    """Random generator of a seed that a caller states.

    Args:
        seed: a whole number of 0 or more.
        name: of the argument, for the error.
    Returns:
        The generator.
    Raises:
        InputError: anything else; a seed of None would give other numbers each time.
    """
    if not isinstance(seed, Integral) or isinstance(seed, bool) or seed < 0:
        raise InputError(f"{name} is {shown(seed)}; it must be a whole number of 0 or more.")
    return np.random.default_rng(int(seed))


@functools.cache
def _kinds(owner: Any) -> dict[str, Any]:
    """Annotations of the parameters of a function, or of the fields of a class."""
    owners = reversed(owner.__mro__) if isinstance(owner, type) else (owner,)
    kinds: dict[str, Any] = {}
    for each in owners:
        kinds |= inspect.get_annotations(each, eval_str=True)
    return {name: kind for name, kind in kinds.items() if name != "return"}


def _check(name: str, value: object, kind: Any) -> None:
    options = _options(kind)
    if any(_suits(value, option) for option in options):
        return
    if np.ndarray in options:
        real_array(name, value)
        return
    kinds = [option for option in options if option is not NoneType]
    words = " or ".join(dict.fromkeys(_described(option) for option in kinds))
    made_by = next(filter(None, (getattr(option, "made_by", "") for option in options)), "")
    advice = f" {made_by}" if made_by else ""
    raise InputError(f"{name} is {shown(value)}; it must be {words}.{advice}")


def _options(kind: Any) -> list[Any]:
    """The members of a union, with `np.ndarray` in place of those of `ArrayLike`."""
    parts = list(get_args(kind)) if get_origin(kind) in (Union, UnionType) else [kind]
    if set(parts) >= _ARRAYS:
        parts = [np.ndarray, *(part for part in parts if part not in _ARRAYS)]
    return [np.ndarray if get_origin(part) is np.ndarray else part for part in parts]


def _suits(value: object, kind: Any) -> bool:
    """Whether a value is of a kind; what cannot be checked is."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any:
        return True
    if kind is np.ndarray:
        try:
            real_array("", value)
        except InputError:
            return False
        return True
    if kind is float:
        return is_real(value) and value == value
    if kind is int:
        return isinstance(value, Integral) and is_real(value)
    if kind is bool:
        return isinstance(value, (bool, np.bool_))
    if kind is str:
        return isinstance(value, str) and "\0" not in value
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is tuple and parts[-1] is not Ellipsis:
        items = _items(value)
        fits = items is not None and len(items) == len(parts)
        return fits and all(map(_suits, items or (), parts))
    if origin in (tuple, Sequence):
        items = _items(value)
        return items is not None and all(_is_one_of(each, parts[0]) for each in items)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            _is_one_of(key, parts[0]) and _is_one_of(each, parts[1]) for key, each in value.items()
        )
    checked_class = origin if isinstance(origin, type) else kind
    if not isinstance(checked_class, type) or getattr(checked_class, "_is_protocol", False):
        return True
    return isinstance(value, checked_class)


def _items(value: object) -> list[object] | None:
    """The items of a sequence, such as a list or an array; None if it is none."""
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        return None
    return list(value) if not isinstance(value, np.ndarray) or value.ndim else None


def _is_one_of(value: object, kind: Any) -> bool:
    return any(_suits(value, option) for option in _options(kind))


def is_real(value: object) -> TypeGuard[float]:
    """Whether a value is one real number that a double can hold; booleans and texts are not.

    Args:
        value: anything.
    Returns:
        True for numbers of Python and of numpy.
    Example:
        >>> is_real(np.float32(0.1)), is_real(True), is_real("0.1"), is_real(np.ones(1))
        (True, False, False, False)
    """
    if not isinstance(value, Real) or isinstance(value, (bool, np.bool_)):
        return False
    return not isinstance(value, int) or abs(value) <= sys.float_info.max


def check_length(name: str, value: object) -> None:
    """Refuse a value that is neither None nor a finite length above 0.

    Args:
        name: of the argument.
        value: in m.
    Raises:
        InputError: it is not a finite number above 0.
    """
    if value is not None and not (is_real(value) and 0.0 < value < math.inf):
        raise InputError(f"{name} is {shown(value)}; it must be a number above 0 m and finite.")


def _described(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if kind in _WORDS:
        return _WORDS[kind]
    if origin is Literal:
        return " or ".join(parts)
    if origin is tuple and parts[-1] is not Ellipsis:
        return f"{len(parts)} {_plural(parts[0])}"
    if origin in (tuple, Sequence):
        return f"a sequence of {_plural(parts[0])}"
    if origin is Mapping:
        return f"a dictionary of {' or '.join(map(_plural, _options(parts[1])))}"
    name = str(getattr(kind, "__name__", kind))
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _plural(kind: Any) -> str:
    one = _described(kind).removeprefix("a ").removeprefix("an ")
    return one if kind is bool else f"{one}s"


def shown(value: object) -> str:
    """A value as an error message shows it: short, and in one line.

    Args:
        value: anything.
    Returns:
        Its text, or what it is where that is long.
    """
    if isinstance(value, np.ndarray) and value.ndim:
        return f"an array of shape {value.shape} and type {value.dtype}"
    plain = value is None or isinstance(value, (Real, complex, str, bytes, list, tuple, dict))
    text = repr(value) if plain else f"an object of type {type(value).__name__}"
    if isinstance(value, np.generic):
        text = str(value)
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
