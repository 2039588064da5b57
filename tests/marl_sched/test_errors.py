import copy
import pickle  # noqa: TID251 (what is tested is that pools may)

import pytest

from marl_sched import errors
from marl_sched.errors import InvalidFileError, MarlSchedError, UnknownNameError, require


def test_misspelt_name_gets_a_suggestion_and_the_known_names():
    error = UnknownNameError("scheduler", "corective", ["random", "corrective"])
    assert str(error) == "unknown scheduler 'corective'; did you mean 'corrective'? Known: corrective, random"


def test_name_like_no_other_gets_the_known_names_only():
    assert str(UnknownNameError("view", "zzz", ["local", "full"])) == "unknown view 'zzz'. Known: full, local"


def test_name_among_none_says_so():
    assert str(UnknownNameError("policy", "x", [])) == "unknown policy 'x'. Known: none"


def test_known_name_is_passed_on():
    assert require("view", "full", {"full": 1, "local": 2}) == "full"


def test_unknown_name_is_refused_even_when_the_known_come_once():
    with pytest.raises(UnknownNameError, match="Known: full, local"):
        require("view", "ful", iter(["local", "full"]))


def test_invalid_file_names_file_field_expectation_and_value():
    error = InvalidFileError("fleet.json", "planes[12].income", "a number > 0 (per flying hour)", -3.0)
    assert str(error) == "fleet.json: planes[12].income: expected a number > 0 (per flying hour), got -3.0"


def test_invalid_file_without_field_or_value_leaves_them_out():
    assert str(InvalidFileError("fleet.json", "", "a list of planes")) == "fleet.json: expected a list of planes"


def test_long_value_is_shortened_to_one_line():
    message = str(InvalidFileError("a.json", "b", "a number", "x" * 10_000))
    assert len(message) < 120
    assert message.endswith("...")


def test_every_error_of_a_user_is_a_marl_sched_error_and_a_value_error():
    for error in (UnknownNameError("view", "x", []), InvalidFileError("a", "b", "c")):
        assert isinstance(error, MarlSchedError)
        assert isinstance(error, ValueError)


def every_kind():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, MarlSchedError)]
    special = {
        UnknownNameError: UnknownNameError("view", "ful", ["full", "local"]),
        InvalidFileError: InvalidFileError("a.json", "planes", "a list", lambda: "no pickle takes this"),
        errors.InvalidSheetError: errors.InvalidSheetError("a.csv", ["a.csv: row 2", "a.csv: row 3"]),
    }
    return [special.get(kind) or kind("what, where, expected, got") for kind in kinds]


@pytest.mark.parametrize("error", every_kind(), ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("send", [copy.deepcopy, lambda error: pickle.loads(pickle.dumps(error))])  # noqa: S301
def test_every_error_arrives_from_another_process_as_it_was(error, send):
    arrived = send(error)
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    assert vars(arrived) == vars(error)
