"""One rule makes views of what users write, whichever command, environment API or file it comes from."""

import math

import numpy as np
import pytest

from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import FullView, LocalView
from marl_sched.envs.murse.views import LocalView as MapView
from marl_sched.errors import InvalidOptionError, UnknownNameError

AIRME, MURSE = get_domain("airme"), get_domain("murse")


def test_a_view_is_made_of_nothing_its_kind_its_options_or_itself():
    view = LocalView(reach=2)
    assert AIRME.make_view(None) == AIRME.make_view("full") == FullView()
    assert AIRME.make_view({"kind": "local", "reach": 2}) == AIRME.view("local", reach=2) == view
    assert AIRME.make_view(view) is view


def test_numbers_take_the_type_of_the_option():
    view = AIRME.view("local", reach=np.int64(2), comm=3.0)
    assert (type(view.reach), type(view.comm)) == (int, int)
    assert MURSE.view("local", sensing=3) == MapView(sensing=3.0)


@pytest.mark.parametrize(
    ("domain", "options", "message"),
    [
        (AIRME, {"radius": 1}, "view local: radius: expected an option of this view of airme: reach, comm, staleness"),
        (AIRME, {"reach": 1.5}, "view local: reach: expected an integer, got 1.5"),
        (AIRME, {"reach": "2"}, "view local: reach: expected an integer, got '2'"),
        (AIRME, {"reach": True}, "view local: reach: expected an integer, got True"),
        (AIRME, {"comm": math.inf}, "view local: comm: expected an integer, got inf"),
        (MURSE, {"comm": math.nan}, "view local: comm: expected a finite number, got nan"),
        (MURSE, {"sensing": math.inf}, "view local: sensing: expected a finite number, got inf"),
        (MURSE, {"sensing": None}, "view local: sensing: expected a finite number, got None"),
    ],
)
def test_an_option_that_does_not_fit_is_named_with_what_was_expected(domain, options, message):
    with pytest.raises(InvalidOptionError) as caught:
        domain.view("local", **options)
    assert str(caught.value) == message


def test_an_unknown_kind_names_the_known_ones():
    with pytest.raises(
        UnknownNameError, match=r"unknown view of airme 'lokal'; did you mean 'local'\? Known: full, local"
    ):
        AIRME.view("lokal")


@pytest.mark.parametrize("given", [3, ["full"], {"reach": 1}, MapView()])
def test_what_describes_no_view_is_refused(given):
    with pytest.raises(InvalidOptionError, match="view: expected one of full, local, random or a view object"):
        AIRME.make_view(given)
