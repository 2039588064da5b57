"""MuRSE's own environment APIs: pictures, the centralised schedule, and equal traces through every environment API."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched import murse_v0
from marl_sched.domain import get_domain
from marl_sched.envs.api.gymnasium_env import SchedulingEnv
from marl_sched.envs.murse import render
from marl_sched.envs.murse.gantt import gantt_figure
from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import IllegalActionError, UnknownNameError
from tests.murse.problems import play_randomly, played, problem, three_tasks


def joint(*pairs: tuple[int, int], size: int = 3) -> np.ndarray:
    """A joint action: pairs of task slot and agent, filled up with nothing."""
    return np.array([*pairs, *[(0, 0)] * (size - len(pairs))])


@pytest.mark.parametrize("mode", ["plan", "online"])
def test_a_whole_schedule_plays_like_its_turns(mode):
    env = SchedulingEnv("murse", scale=None, instance=three_tasks(n_rounds=2), mode=mode)
    env.reset(seed=3)
    _, reward, terminated, truncated, info = env.step(joint((1, 0), (2, 1), (3, 0)))
    assert (reward, terminated, truncated) == (-11.0, False, False)
    assert info == {"illegal": [], "feasible": True, "makespan": 11, "stuck": False, "time": 11}
    _, reward, terminated, _, info = env.step(joint((1, 0), (1, 1), (2, 1)))
    assert (reward, terminated, info["illegal"], info["stuck"]) == (-18.0, True, [1], True)


def test_a_plan_may_name_a_task_before_the_one_that_it_waits_for():
    env = SchedulingEnv("murse", scale=None, instance=three_tasks())
    env.reset(seed=3)
    assert env.step(joint((3, 1), (1, 0), (2, 0)))[1] == -11.0
    env.reset(seed=3)
    # One robot cannot do task 3 before task 1, for which it waits.
    assert not env.step(joint((3, 0), (1, 0), (2, 1)))[4]["feasible"]


def test_ineligible_and_foreign_pairs_are_left_out():
    env = SchedulingEnv("murse", scale="small", instance=problem([[3, 0], [0, 2]]))
    env.reset(seed=0)
    action = joint((1, 1), (2, 1), (9, 0), (1, 4), (1, 0), size=11)
    info = env.step(action)[4]
    assert info["illegal"] == [0, 2, 3]
    assert info["feasible"]


def test_given_schedules_are_checked():
    simulator = MurseSimulator([three_tasks()])
    with pytest.raises(IllegalActionError, match="dispatched twice"):
        simulator.play_round(0, np.array([0, 0]), np.array([0, 1]))
    with pytest.raises(IllegalActionError, match="eligible pairs"):
        simulator.play_round(0, np.array([0, 7]), np.array([0, 1]))
    with pytest.raises(IllegalActionError, match="only be given in plan mode"):
        MurseSimulator([three_tasks()], mode="online").play_round(0, np.array([0]), np.array([0]))


@pytest.mark.parametrize("durations", ["deterministic", "stochastic"])
def test_turns_and_whole_schedules_give_the_same_rounds_to_the_last_bit(durations):
    for instance in get_domain("murse").instances("small", 4, seed=5):
        env = murse_v0.raw_env(instance=instance, durations=durations)
        env.reset(seed=7)
        rng = np.random.default_rng(1)
        for _ in env.agent_iter():
            observation, _, over, _, _ = env.last()
            env.step(None if over else rng.choice(np.flatnonzero(observation["action_mask"])))
        whole = SchedulingEnv("murse", instance=instance, durations=durations)
        whole.reset(seed=7)
        for index in range(10):
            pairs = [(job["task"], job["agent"]) for job in schedule(env.simulator, 0, index)["dispatch"]]
            whole.step(joint(*pairs, size=11))
        for name in ("makespan", "weighted", "feasible", "worst"):
            ours, theirs = env.simulator.round_results(0)[name], whole.simulator.round_results(0)[name]
            assert ours.tobytes() == theirs.tobytes()
        filters = [s.snapshot(0)["filters"]["mean"].tobytes() for s in (env.simulator, whole.simulator)]
        assert filters[0] == filters[1]


def test_the_same_seed_gives_the_same_rounds_alone_and_in_a_batch():
    instances = get_domain("murse").instances("small", 6, seed=2)
    batch = MurseSimulator(instances, mode="online", durations="stochastic", pad="medium", seed=9)
    play_greedily(batch)
    for b in (0, 5):
        alone = MurseSimulator([instances[b]], mode="online", durations="stochastic", seed=9)
        play_greedily(alone)
        assert alone.round_results(0).tolist() == batch.round_results(b).tolist()
        assert schedule(alone, 0) == schedule(batch, b)


def play_greedily(simulator: MurseSimulator) -> None:
    """Every agent takes the first task that it may."""
    while not simulator.over.all():
        simulator.step(simulator.legal()[:, 1:].argmax(axis=1) + simulator.legal()[:, 1:].any(axis=1))


def test_an_episode_repeats_itself_and_the_next_one_differs():
    instances = get_domain("murse").instances("small", 2, seed=3)
    simulator = MurseSimulator(instances, durations="stochastic")
    play_randomly(simulator, 1)
    first = simulator.round_results(0).tolist()
    simulator.reset(seed=0)
    play_randomly(simulator, 1)
    assert simulator.round_results(0).tolist() == first
    simulator.reset()
    play_randomly(simulator, 1)
    assert simulator.round_results(0).tolist() != first


def test_board_names_who_has_what():
    text = render.board(played(MurseSimulator([three_tasks()]), [1, 2]))
    assert "*robot 0: 1[0,4)" in text
    assert "robot 1: 2[4,7)" in text
    assert text.endswith("unscheduled: 3")


def test_pictures_are_images_and_the_gantt_chart_marks_violations(tmp_path):
    pytest.importorskip("matplotlib")
    simulator = MurseSimulator([three_tasks(deadlines=[-1, 6, 11])])
    start = render.gantt(simulator)
    assert start.dtype == np.uint8
    assert start.shape[2] == 3
    played(simulator, [1, 2, 3])
    assert render.gantt(simulator).shape == start.shape == (540, 960, 3)  # videos take frames of one size alone
    figure = gantt_figure({"": schedule(simulator)})
    axes = figure.axes[0]
    assert "task 2: finishes at 7 after its deadline 6" in axes.get_title(loc="left")
    assert [label.get_text() for label in axes.get_yticklabels()] == ["robot 0", "robot 1"]
    inside = [text for text in axes.texts if text.get_va() == "center"]
    bars = {int(text.get_text()): bar for text, bar in zip(inside, axes.patches, strict=False)}
    assert [(bars[i].get_x(), bars[i].get_width()) for i in (1, 2, 3)] == [(0, 4), (4, 3), (9, 2)]
    late = [tuple(bar.get_edgecolor()) for bar in bars.values()]
    assert late[0] == late[2] != late[1]
    render.save_figure(figure, tmp_path / "round.png")
    assert (tmp_path / "round.png").read_bytes().startswith(b"\x89PNG")


def test_public_face_refuses_unknown_options():
    with pytest.raises(TypeError):
        murse_v0.env(colour="red")
    with pytest.raises(UnknownNameError, match="scale of murse"):
        murse_v0.env(scale="tiny")
