"""Plain data into structs: an error names the field, what it expects in its own words, and what was found."""

from typing import Annotated

import pytest
from msgspec import Meta, Struct

from marl_sched.errors import InvalidFileError
from marl_sched.structs import convert


class Part(Struct, forbid_unknown_fields=True):
    weight: Annotated[float, Meta(gt=0, description="a number > 0 (kg)")]
    tags: list[str] = []
    size: Annotated[int, Meta(ge=1, description="an integer >= 1")] | None = None


class Whole(Struct, forbid_unknown_fields=True):
    parts: Annotated[list[Part], Meta(min_length=1, description="at least one part")]
    window: tuple[int, int] = (0, 1)


def test_good_data_is_converted():
    assert convert({"parts": [{"weight": 2}]}, Whole, "f") == Whole(parts=[Part(weight=2.0)])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "f: expected an object, got []"),
        (None, "f: expected an object, got None"),
        ({}, "f: parts: expected at least one part; the field is missing"),
        ({"parts": []}, "f: parts: expected at least one part, got []"),
        ({"parts": [3]}, "f: parts[0]: expected an object, got 3"),
        ({"parts": [{}]}, "f: parts[0].weight: expected a number > 0 (kg); the field is missing"),
        ({"parts": [{"weight": -1}]}, "f: parts[0].weight: expected a number > 0 (kg), got -1"),
        ({"parts": [{"weight": None}]}, "f: parts[0].weight: expected a number > 0 (kg), got None"),
        ({"parts": [{"weight": True}]}, "f: parts[0].weight: expected a number > 0 (kg), got True"),
        ({"parts": [{"weight": 1, "size": 0}]}, "f: parts[0].size: expected an integer >= 1, got 0"),
        ({"parts": [{"weight": 1, "tags": ["a", 2]}]}, "f: parts[0].tags[1]: expected str, got 2"),
        ({"parts": [{"weight": 1, "wait": 2}]}, "f: parts[0].wait: expected one of weight, tags, size, got 'wait'"),
        ({"parts": [{"weight": 1}], "window": [1, "x"]}, "f: window[1]: expected int, got 'x'"),
    ],
)
def test_bad_data_is_named_with_field_expectation_and_value(data, message):
    with pytest.raises(InvalidFileError) as caught:
        convert(data, Whole, "f")
    assert str(caught.value) == message
