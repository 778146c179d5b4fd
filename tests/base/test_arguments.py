"""Arguments are checked against the annotations of the function that takes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import ClassVar, Literal

import numpy as np
import pytest
from numpy.typing import ArrayLike

from haselab.base import InputError, check_fields, checked, generator, real_array


@dataclass(frozen=True)
class Bench:
    gap_m: float = 1.0
    made_by: ClassVar[str] = "Make one with open_bench()."

    def __post_init__(self) -> None:
        check_fields(self)


@checked
def call(
    number: float = 1.0,
    count: int = 1,
    flag: bool = True,
    kind: Literal["pi", "pid"] = "pi",
    values: ArrayLike = (),
    more: ArrayLike | None = None,
    bench: Bench | Sequence[Bench] | None = None,
    limits: tuple[float, float] = (0.0, 1.0),
    demands: Mapping[str, float | bool] | None = None,
) -> str:
    """Take one of each."""
    return "taken"


@pytest.mark.parametrize(
    "right",
    [
        {"number": 1}, {"number": np.float32(1.5)}, {"number": np.inf}, {"count": np.int8(3)},
        {"flag": np.True_}, {"values": 3.0}, {"values": [np.nan, 1]}, {"values": [True]},
        {"more": None}, {"bench": None}, {"bench": Bench()}, {"bench": (Bench(),)},
        {"limits": [0, 1]}, {"limits": np.ones(2)}, {"demands": {"a": 1.0, "b": False}},
        {"values": np.array([1, 2.5], dtype=object)},
    ],
    ids=str,
)  # fmt: skip
def test_what_suits_the_annotation_is_taken(right):
    assert call(**right) == "taken"


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"number": "1"}, r"number is '1'; it must be a number\."),
        ({"number": np.nan}, r"number is nan; it must be a number\."),
        ({"number": True}, r"number is True; it must be a number\."),
        ({"number": 10**400}, r"number is 1000+\.\.\.; it must be a number\."),
        ({"count": 1.0}, r"count is 1\.0; it must be a whole number\."),
        ({"flag": 1}, r"flag is 1; it must be True or False\."),
        ({"kind": "p"}, r"kind is 'p'; it must be pi or pid\."),
        ({"kind": ["pi"]}, r"kind is \['pi'\]; it must be pi or pid\."),
        ({"values": None}, r"values is None; it must be an array of real numbers\."),
        ({"values": b"ab"}, r"values is b'ab'; it must be an array of real numbers\."),
        ({"values": ["a"]}, r"values holds a; it must hold real numbers\."),
        ({"values": [1.0, None]}, r"values holds None; it must hold real numbers\."),
        ({"values": [1j]}, r"values holds 1j; it must hold real numbers\."),
        (
            {"values": [datetime(2026, 1, 1)]},
            r"values holds an object of type datetime; it must hold",
        ),
        ({"values": [[1], [1, 2]]}, r"values has rows of unequal lengths; it must be an array"),
        ({"more": "words"}, r"more is 'words'; it must be an array of real numbers\."),
        ({"bench": 3}, r"bench is 3; it must be a Bench or a sequence of Benchs\. Make one with"),
        ({"bench": [3]}, r"bench is \[3\]; it must be a Bench"),
        ({"limits": [1]}, r"limits is \[1\]; it must be 2 numbers\."),
        ({"limits": [1, 2, 3]}, r"limits is \[1, 2, 3\]; it must be 2 numbers\."),
        (
            {"demands": {"a": "b"}},
            r"demands is \{'a': 'b'\}; it must be a dictionary of numbers or True or False\.",
        ),
    ],
    ids=str,
)
def test_what_does_not_is_refused_with_the_value_found(wrong, match):
    with pytest.raises(InputError, match=match):
        call(**wrong)


def test_an_unknown_argument_is_reported_with_the_function_and_its_arguments():
    @checked
    def halved(length_m: float) -> float:
        return 0.5 * length_m

    said = r"halved\(\) got an unexpected keyword argument 'mass_kg'\. Its arguments are length_m\."
    with pytest.raises(TypeError, match=said):
        halved(1.0, mass_kg=1.0)


def test_fields_of_a_dataclass_are_checked_too():
    with pytest.raises(InputError, match=r"gap_m is '1'; it must be a number\."):
        Bench("1")


def test_complex_numbers_do_not_lose_their_imaginary_part():
    with pytest.raises(InputError, match=r"u holds \(1\+1j\); it must hold real numbers\."):
        real_array("u", np.full(3, 1 + 1j))


@pytest.mark.parametrize("seed", [-1, 1.0, None, "1", True, np.float64(1), [1]], ids=str)
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(InputError, match=r"seed is .*; it must be a whole number of 0 or more\."):
        generator(seed)


def test_a_seed_gives_the_generator_of_numpy():
    assert generator(np.int64(7)).random() == np.random.default_rng(7).random()
