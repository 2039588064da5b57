"""Scores: against a loop that plays one episode after the other, by hand, and against the published figures."""

import json

import numpy as np
import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import LocalView
from marl_sched.errors import InvalidOptionError, UnknownNameError
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import Scores, Table, evaluate, evaluate_scheduler

AIRME = get_domain("airme")
DAYS = 3 * 24


def fleets(count=3, seed=11):
    return AIRME.instances("small", count, seed)


def problem(instances=None, **changes):
    """The fleets, or instances, under the settings of most tests."""
    given = {"instances": instances or fleets(), "episodes": 2, "seed": 7, "horizon": DAYS, "pad": "small"}
    return Problem(AIRME, **{**given, **changes})


def one_after_the_other(scheduler, instances, view, episodes, seed):
    """M1 of profit by summing rewards, and the shares seen, one row and one turn at a time."""
    m1, shares = np.zeros((len(instances), episodes)), []
    for i, instance in enumerate(instances):
        for episode in range(episodes):
            simulator = AIRME.simulator([instance], view=view, horizon=DAYS, objective="profit")
            simulator.reset(seed=seed, episodes=[episode])
            while simulator.acting[0] >= 0:
                observation = simulator.observe(simulator.acting)
                shares.append(float(observation["visible_share"][0]))
                simulator.step(scheduler.choose(observation, simulator.policy_noise(simulator.acting)))
                m1[i, episode] += simulator.reward[0] / DAYS
    return m1, np.mean(shares)


@pytest.mark.parametrize("name", ["random", "preventive-first"])
@pytest.mark.parametrize("view", [None, LocalView(reach=1, comm=2, staleness=5)])
def test_scores_are_those_of_episodes_played_one_after_the_other(name, view):
    instances = fleets()
    expected, share = one_after_the_other(RULES[name](), instances, view, episodes=2, seed=7)
    scores = evaluate_scheduler(problem(instances, view=view), RULES[name]())
    np.testing.assert_allclose(scores.measures["profit"], expected, rtol=0, atol=1e-12)
    # read at every eighth turn only
    assert scores.visible_share == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("max_rows", [1, 4, 5])
def test_the_size_of_chunks_changes_nothing(max_rows):
    view = LocalView(reach=1, comm=1, staleness=3)
    whole = evaluate_scheduler(problem(view=view), RULES["random"]())
    chunked = evaluate_scheduler(problem(view=view), RULES["random"](), max_rows=max_rows)
    assert chunked.visible_share == whole.visible_share
    for name, values in whole.measures.items():
        np.testing.assert_array_equal(chunked.measures[name], values)


def test_the_order_of_instances_changes_nothing_but_the_order_of_scores():
    order = [2, 0, 1]
    instances = fleets()
    straight = evaluate_scheduler(problem(instances), RULES["condition"]())
    permuted = evaluate_scheduler(problem([instances[i] for i in order]), RULES["condition"]())
    for name, values in straight.measures.items():
        np.testing.assert_array_equal(permuted.measures[name], values[order])


def test_more_episodes_leave_the_first_ones_as_they_were():
    few = evaluate_scheduler(problem(episodes=2), RULES["condition"]())
    many = evaluate_scheduler(problem(episodes=3), RULES["condition"]())
    np.testing.assert_array_equal(many.measures["profit"][:, :2], few.measures["profit"])
    assert len(np.unique(many.measures["profit"])) == 9


def test_another_seed_brings_other_noise():
    one = evaluate_scheduler(problem(seed=7), RULES["condition"]())
    other = evaluate_scheduler(problem(seed=8), RULES["condition"]())
    assert (one.measures["profit"] != other.measures["profit"]).all()


def test_progress_only_grows_and_never_passes_the_whole():
    told = []
    evaluate_scheduler(problem(), RULES["condition"](), max_rows=4, progress=told.append)
    assert told == sorted(told)
    assert 0 <= told[0] < 0.1
    assert 0.9 < told[-1] <= 1


def scores_of(profit, share=1.0):
    return Scores(measures={"profit": np.array(profit)}, visible_share=share, seconds=1.5)


def test_a_table_worked_out_by_hand():
    better = scores_of([[0.5, 0.7], [0.6, 0.6]], share=0.25)
    reference = scores_of([[0.4, 0.4], [0.5, 0.7]])
    table = Table(
        problem=problem(fleets(2), view=LocalView(reach=2), objective="profit"),
        scores={"better": better},
        reference=("plain", reference),
        baseline=("plain", None, reference),
    ).as_json()
    row = table["schedulers"]["better"]
    assert row["M1"]["mean"] == pytest.approx(0.6)
    assert row["M1"]["std"] == pytest.approx(0.0)
    assert row["M1"]["iqm"] == pytest.approx(0.6)  # of 0.5 0.6 0.6 0.7 the middle half
    assert row["M2"]["mean"] == pytest.approx(25.0)  # 50 percent on the first instance, none on the second
    assert row["M2"]["std"] == pytest.approx(25.0)
    assert row["difference"]["to"] == "plain"
    assert row["difference"]["mean"] == pytest.approx(0.1)
    assert row["difference"]["std"] == pytest.approx(0.1)
    assert table["reference"]["M1"]["mean"] == pytest.approx(0.5)
    assert table["view"] == {
        "kind": "local",
        "reach": 2,
        "comm": 1,
        "staleness": 0,
        "visible_share": 0.25,
        "local": True,
    }


def test_the_table_has_the_keys_that_other_tools_read():
    schedulers = {"corrective": RULES["corrective"](), "mine": RULES["model-based"]()}
    table = evaluate(problem(), schedulers, reference=RULES["corrective-published"]()).as_json()
    assert json.loads(json.dumps(table, allow_nan=False)) == table
    assert table["schema"] == 2
    head = ("env", "scale", "objective", "view", "instances", "episodes", "horizon", "unit", "seed")
    assert [table[key] for key in head] == [
        "airme",
        "small",
        "profit",
        {"kind": "full", "visible_share": 1.0, "local": False},
        3,
        2,
        DAYS,
        "hours",
        7,
    ]
    assert list(table["schedulers"]) == ["corrective", "mine"]
    for row in table["schedulers"].values():
        for measure in ("M1", "M2", "profit", "revenue", "availability"):
            assert set(row[measure]) == {"mean", "std", "iqm", "ci95_these_instances", "ci95_such_instances"}
            for kind in ("these", "such"):
                low, high = row[measure][f"ci95_{kind}_instances"]
                assert low <= row[measure]["iqm"] <= high
        assert np.shape(row["scores"]) == (3, 2)
        assert np.mean(row["scores"]) == pytest.approx(row["M1"]["mean"], abs=1e-12)
        assert row["M1"] == row["profit"]
        assert row["seconds"] > 0
    assert table["schedulers"]["mine"]["privileged_info"] == ["failure_model"]
    assert table["schedulers"]["corrective"]["privileged_info"] == []


def test_m1_is_the_objective_that_was_asked_for():
    rules = {"condition": RULES["condition"]()}
    table = evaluate(problem(objective="availability"), rules).as_json()
    row = table["schedulers"]["condition"]
    assert table["objective"] == "availability"
    assert row["M1"] == row["availability"]
    assert row["M1"] != row["profit"]
    assert "M2" not in row  # no reference was given


def test_the_gain_is_taken_to_the_reference_under_the_full_view_whatever_the_view_of_the_table():
    published = RULES["corrective-published"]()
    blind = problem(view=LocalView(reach=0, comm=0))
    local = evaluate(blind, {"corrective-published": published}, reference=published).as_json()
    full = evaluate(problem(), {"corrective-published": published}, reference=published).as_json()
    assert local["reference"] == full["reference"]
    assert full["schedulers"]["corrective-published"]["M2"]["mean"] == 0.0
    assert local["schedulers"]["corrective-published"]["M2"]["mean"] != 0.0


def test_the_default_baseline_is_the_full_view_reference_whatever_else_is_in_the_table():
    published, blind = RULES["corrective-published"](), problem(view=LocalView(reach=0, comm=0))
    alone = {"condition": RULES["condition"]()}
    tables = [
        evaluate(blind, rules, reference=published).as_json()
        for rules in (alone, {**alone, "corrective-published": published})
    ]
    for table in tables:
        assert table["baseline"] == {"scheduler": "corrective-published", "view": {"kind": "full"}}
    assert tables[0]["schedulers"]["condition"]["difference"] == tables[1]["schedulers"]["condition"]["difference"]
    assert tables[1]["schedulers"]["corrective-published"]["difference"]["mean"] != 0.0


def test_a_named_baseline_plays_under_the_view_of_the_table():
    published, blind = RULES["corrective-published"](), problem(view=LocalView(reach=0, comm=0))
    rules = {"condition": RULES["condition"](), "corrective-published": published}
    table = evaluate(blind, rules, reference=published, baseline="corrective-published").as_json()
    assert table["baseline"]["view"] == {"kind": "local", "reach": 0, "comm": 0, "staleness": 0}
    row = table["schedulers"]["corrective-published"]
    assert row["difference"]["mean"] == 0.0
    assert row["M2"]["mean"] != 0.0


def test_a_reference_outside_the_table_is_no_baseline_by_name():
    rules, published = {"condition": RULES["condition"]()}, RULES["corrective-published"]()
    with pytest.raises(UnknownNameError, match="Known: condition"):
        evaluate(problem(), rules, reference=published, baseline=published.name)


def test_a_baseline_that_does_not_play_is_refused():
    with pytest.raises(UnknownNameError, match="did you mean 'condition'"):
        evaluate(problem(), {"condition": RULES["condition"]()}, baseline="conditon")


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"horizon": 0}, {"horizon": -1}])
def test_a_problem_without_anything_to_play_are_refused(wrong):
    with pytest.raises(InvalidOptionError, match=next(iter(wrong))):
        evaluate_scheduler(problem(**wrong), RULES["condition"]())


PUBLISHED = {  # M1 for profit, its tolerance, and revenue and availability
    "corrective-published": (0.5375, 0.004, 0.648, 0.721),
    "corrective": (0.545, 0.004, 0.655, 0.718),
    "condition": (0.656, 0.008, 0.724, 0.810),
    "model-based": (0.667, 0.008, 0.729, 0.815),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_rules_reach_the_published_scores(name):
    profit, tolerance, revenue, availability = PUBLISHED[name]
    scores = evaluate_scheduler(
        Problem(AIRME, instances=fleets(1000, seed=5), pad="small", episodes=2, seed=1), RULES[name]()
    )
    means = {measure: values.mean() for measure, values in scores.measures.items()}
    assert means["profit"] == pytest.approx(profit, abs=tolerance)
    assert means["revenue"] == pytest.approx(revenue, abs=0.012)
    assert means["availability"] == pytest.approx(availability, abs=0.012)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "count"), [("small", 100), ("medium", 50), ("large", 25)])
def test_serving_worn_planes_first_keeps_its_score_on_every_scale(scale, count):
    instances = AIRME.instances(scale, count, 5)
    chosen = Problem(AIRME, instances=instances, pad=scale, episodes=2, seed=1)
    scores = evaluate_scheduler(chosen, RULES["preventive-first"]())
    assert scores.measures["profit"].mean() >= 0.700


def test_rounds_are_told_one_by_one_and_failures_count():
    table = evaluate(Problem("murse", count=3, episodes=2, seed=1, horizon=3), {"random": RULES["random"]()}).as_json()
    row = table["schedulers"]["random"]
    assert (table["horizon"], table["unit"], table["better"]) == (3, "rounds", "lower")
    for name in ("feasible", "makespan"):
        assert len(row[name]["per_round"]) == 3
        assert np.mean(row[name]["per_round"]) == pytest.approx(row[name]["mean"])
    assert row["M1"]["mean"] == row["makespan"]["mean"]
    assert 0 <= row["feasible"]["mean"] < 1
    if row["feasible"]["mean"] == 0:
        assert row["makespan_feasible"] == {"mean": None, "per_round": [None, None, None]}
    else:
        assert row["makespan_feasible"]["mean"] < row["makespan"]["mean"]


def test_the_gap_to_the_exact_solver_is_in_percent_of_its_score():
    scores = {
        "exact": Scores(measures={"makespan": np.array([[50.0], [80.0]])}, visible_share=1.0, seconds=1.0),
        "quick": Scores(measures={"makespan": np.array([[60.0], [80.0]])}, visible_share=1.0, seconds=1.0),
    }
    table = Table(
        problem=Problem("murse", count=2),
        scores=scores,
        reference=None,
        baseline=("exact", None, scores["exact"]),
    ).as_json()
    assert table["schedulers"]["quick"]["gap_to_exact"]["mean"] == pytest.approx(10.0)
    assert table["schedulers"]["exact"]["gap_to_exact"]["mean"] == 0.0


class Talkative(type(RULES["random"]())):
    """Says one word in every round of every row."""

    def start(self, simulator, rows):
        self._said = np.ones((simulator.batch, simulator.horizon))

    def per_round(self):
        return {"messages": self._said}


def test_what_a_scheduler_counts_of_itself_is_told_by_round():
    few = Problem("murse", count=2, episodes=2, seed=1, horizon=3)
    table = evaluate(few, {"talkative": Talkative()}).as_json()
    assert table["schedulers"]["talkative"]["messages"] == {"mean": 1.0, "per_round": [1.0, 1.0, 1.0]}
