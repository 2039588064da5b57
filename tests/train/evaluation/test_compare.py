"""Pictures: what they are drawn from, and that it is what they show."""

import numpy as np
import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError
from marl_sched.privileged import PrivilegedInfo
from marl_sched.problem import Problem
from marl_sched.statistics import PairedDifference, Summary
from marl_sched.train.evaluation import plots
from marl_sched.train.evaluation.compare import draw_learning_curves, play_episode, read_learning_curve
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from marl_sched.train.evaluation.results import Baseline, Results, SchedulerResults

AIRME = get_domain("airme")


def row(mean, low, high):
    such = Summary(mean=mean, std=0.0, iqm=mean, ci95_these_instances=None, ci95_such_instances=(low, high))
    difference = PairedDifference(mean=0.0, std=0.0, ci95_these_instances=None, ci95_such_instances=None, p=None)
    known = PrivilegedInfo.NONE
    return lambda share: SchedulerResults(
        M1=such, scores=[], measures={}, difference=difference, visible_share=share, privileged_info=known, seconds=1.0
    )


def table(share, **rows):
    return Results(
        problem=Problem(AIRME, count=2, episodes=3, view="local"),
        baseline=Baseline(scheduler=next(iter(rows)), view={"kind": "local"}),
        schedulers={name: make(share) for name, make in rows.items()},
        by_instance=[],
    )


def test_bars_stand_in_the_order_of_their_means_best_on_top():
    results = table(0.4, good=row(0.7, 0.69, 0.71), bad=row(0.5, 0.48, 0.52), middling=row(0.6, 0.6, 0.6))
    axes = plots.score_bars(results).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["bad", "middling", "good"]
    assert [bar.get_width() for bar in axes.patches] == [0.5, 0.6, 0.7]
    assert [text.get_text() for text in axes.texts] == ["0.500", "0.600", "0.700"]


def test_bars_of_two_tables_differ_in_colour_and_the_legend_tells_their_views():
    figure = plots.score_bars(table(0.4, one=row(0.7, 0.7, 0.7)), table(1.0, one=row(0.6, 0.6, 0.6)))
    colours = [bar.get_facecolor() for bar in figure.axes[0].patches]
    assert colours[0] != colours[1]
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:2] == ["local view, 40 % seen", "local view, 100 % seen"]


def test_a_score_below_zero_has_room():
    axes = plots.score_bars(table(1.0, sad=row(-0.2, -0.25, -0.15), glad=row(0.1, 0.1, 0.1))).axes[0]
    assert axes.get_xlim()[0] < -0.25


def test_a_timeline_is_labelled_in_hours_and_planes():
    image = np.zeros((4 * 25, 2 * 48, 3), np.uint8)
    figure = plots.timelines({"calm": image}, length=48, unit="hours", legend={"flying": (1, 2, 3)}, band=("plane", 4))
    axes = figure.axes[0]
    assert axes.get_title(loc="left") == "calm"
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 48), (25.5, 0.5))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["flying"]


def test_the_episode_that_is_drawn_is_the_first_one_that_was_scored():
    instances = AIRME.instances("small", 2, 4)
    problem = Problem(AIRME, instances=instances, pad="small", episodes=2, seed=9, horizon=48)
    scores = evaluate_scheduler(problem, RULES["random"]())
    drawn = play_episode(problem, RULES["random"]())
    assert drawn.objectives()["profit"][0] == scores.measures["profit"][0, 0]
    assert AIRME.render["rgb_array"](drawn, 0).shape == (540, 960, 3)


def test_a_learning_curve_has_the_validated_rows_in_minutes(tmp_path):
    log = tmp_path / "progress.csv"
    log.write_text("update,seconds,validation\n1,30,0.5\n2,60,\n3,90,0.625\n")
    minutes, scores = read_learning_curve(log)
    assert minutes.tolist() == [0.5, 1.5]
    assert scores.tolist() == [0.5, 0.625]


@pytest.mark.parametrize(("better", "best"), [("higher", "0.610"), ("lower", "0.500")])
def test_the_best_validation_is_marked(better, best):
    figure = plots.learning_curves({"run": (np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.61, 0.6]))}, better=better)
    assert [text.get_text() for text in figure.axes[0].texts] == [best]


def test_a_log_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(InvalidFileError, match="nothing"):
        read_learning_curve(tmp_path / "nothing.csv")


def test_a_picture_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    figure = plots.learning_curves({"run": (np.array([1.0]), np.array([0.5]))}, better="higher")
    monkeypatch.setattr(figure, "savefig", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        plots.save(figure, tmp_path / "curve.png")
    assert list(tmp_path.iterdir()) == []


def test_logs_of_folders_with_the_same_name_are_drawn_side_by_side(tmp_path, monkeypatch):
    logs = [tmp_path / place / "seed0" / "progress.csv" for place in "ab"] + [tmp_path / "c" / "progress.csv"]
    for log in logs:
        log.parent.mkdir(parents=True)
        log.write_text("seconds,validation\n60,0.5\n")
    drawn = {}
    monkeypatch.setattr(plots, "learning_curves", lambda curves, better: drawn.update(curves))
    monkeypatch.setattr(plots, "save", lambda figure, path: path)
    draw_learning_curves(tmp_path / "out.png", logs, better="higher")
    assert list(drawn) == [str(logs[0]), str(logs[1]), "c"]
