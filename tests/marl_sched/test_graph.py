"""Features are written and read in their own units, by name."""

import numpy as np
import pytest

from marl_sched.errors import UnknownNameError
from marl_sched.graph import Feature, Features

FEATURES = Features(Feature("hours", 10, whole=True), Feature("income", 10), Feature("broken"))


def test_labels_carry_the_scale_as_cards_of_policies_know_them():
    assert FEATURES.labels == ("hours/10", "income/10", "broken")
    assert (len(FEATURES), FEATURES.index("income"), FEATURES.scale("hours")) == (3, 1, 10)
    assert FEATURES.factor("hours") == np.float32(0.1)


@pytest.mark.parametrize("scale", [1, 3, 7, 10, 100, 8760])
def test_a_whole_number_comes_back_whatever_its_scale(scale):
    """Float32 has 24 bits, so x / scale times scale is off by less than 2**-22 x: below one half for x < 2**21."""
    features = Features(Feature("hours", scale, whole=True))
    hours = np.arange(0, 2**21, 997)
    array = np.zeros((len(hours), 1), np.float32)
    features.write(array, slice(None), hours=hours)
    np.testing.assert_array_equal(features.read(array, "hours"), hours)


def test_a_fraction_comes_back_as_float32_holds_it():
    array = np.zeros((1, 3), np.float32)
    FEATURES.write(array, 0, income=12.5, broken=True)
    assert FEATURES.read(array, "income")[0] == np.float64(np.float32(1.25)) * 10
    assert array[0].tolist() == [0.0, 1.25, 1.0]


def test_an_unknown_feature_gets_a_suggestion_and_names_differ():
    with pytest.raises(UnknownNameError, match="unknown feature 'hour'; did you mean 'hours'"):
        FEATURES.index("hour")
    with pytest.raises(ValueError, match="names that differ"):
        Features(Feature("a"), Feature("a", 2))
