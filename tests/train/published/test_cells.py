"""Cells: named by all that decides their scores, made once, kept whole."""

import json
import multiprocessing
import os
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import msgspec
import numpy as np
import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.agents.policies.cards import read_card, write_card
from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import LocalView
from marl_sched.errors import InvalidFileError, MarlSchedError
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from marl_sched.train.published import filling
from marl_sched.train.published.cells import Bound, Cell, Job, Play, describe, digest, make
from marl_sched.train.published.entries import Entries
from marl_sched.train.published.filling import fill, missing, worker_processes
from marl_sched.train.published.store import Cells, confirm

AIRME = get_domain("airme")
PLAY = Play(
    env="airme",
    scale="small",
    objective="profit",
    scheduler="condition",
    weights_sha256=None,
    mode=None,
    view={"kind": "local", "reach": 1, "comm": 1, "staleness": 2},
    options={},
    instances=2,
    episodes=3,
    seed=5,
    horizon=8,
)
BOUND = Bound(
    env="airme", scale="small", objective="profit", instances=2, seed=5, horizon=8, price_vectors=1, evaluations=1
)
OTHERWISE = {
    "env": "murse",
    "scale": "medium",
    "objective": "revenue",
    "scheduler": "random",
    "weights_sha256": "00",
    "mode": "sample",
    "view": {"kind": "local", "reach": 1, "comm": 1, "staleness": 3},
    "options": {"scheme": "skip"},
    "instances": 3,
    "episodes": 4,
    "seed": 6,
    "horizon": 9,
    "schema": 2,
    "price_vectors": 2,
    "evaluations": 2,
}


@pytest.mark.parametrize("field", Play.__struct_fields__)
def test_the_name_of_a_played_cell_depends_on_every_input(field):
    assert digest(msgspec.structs.replace(PLAY, **{field: OTHERWISE[field]})) != digest(PLAY)


@pytest.mark.parametrize("field", Bound.__struct_fields__)
def test_the_name_of_a_bound_depends_on_every_input(field):
    assert digest(msgspec.structs.replace(BOUND, **{field: OTHERWISE[field]})) != digest(BOUND)


def test_the_name_does_not_depend_on_the_order_of_a_views_options():
    view = dict(reversed(PLAY.view.items()))
    assert list(view) != list(PLAY.view)
    assert digest(msgspec.structs.replace(PLAY, view=view)) == digest(PLAY)


def test_a_cell_holds_what_the_evaluation_of_its_inputs_gives():
    (cell,) = make(Job(PLAY))
    problem = Problem(AIRME, count=2, episodes=3, seed=5, view=LocalView(staleness=2), horizon=8)
    scores = evaluate_scheduler(problem, RULES["condition"]())
    profit = scores.measures["profit"]
    np.testing.assert_allclose(cell.M1, profit.mean(axis=1), rtol=0, atol=5e-7)
    between = [np.mean([(x - row.mean()) ** 2 for x in row]) for row in profit]
    assert cell.episode_std == pytest.approx(np.sqrt(np.mean(between)), abs=5e-7)
    assert cell.visible_share == pytest.approx(scores.visible_share, abs=5e-7)
    assert (cell.inputs, cell.privileged_info, cell.training) == (PLAY, [], None)


def test_a_scheme_is_played_as_the_inputs_say():
    single = msgspec.structs.replace(PLAY, view={"kind": "full"}, options={"scheme": "single"}, horizon=24)
    full = msgspec.structs.replace(single, options={})
    assert make(Job(single))[0].M1 != make(Job(full))[0].M1


def test_a_proved_cell_is_not_below_the_bound():
    from marl_sched.agents.airme.bound.relaxation import Relaxation, upper_bounds

    found = upper_bounds(Relaxation(AIRME.instances("small", 2, 5), horizon=8), price_vectors=1, evaluations=1)
    (cell,) = make(Job(BOUND))
    assert all(kept >= value for kept, value in zip(cell.M1, found.value, strict=True))
    np.testing.assert_allclose(cell.M1, found.value, rtol=0, atol=1.1e-6)
    assert str(cell.knows) == "failure model and clock"


def test_what_is_written_is_read_and_says_its_inputs_in_clear(cells):
    cell = Cell(inputs=PLAY, M1=[0.25, 0.5], episode_std=0.1, visible_share=0.4, seconds=1.0, revision="abc")
    cells.write(cell)
    assert Cells(cells.path).read(PLAY) == cell
    assert json.loads(cells.path.read_text())["inputs"]["scheduler"] == "condition"
    assert cells.read(BOUND) is None


def test_a_cell_that_said_in_words_what_its_scheduler_needs_is_still_read(cells):
    """As version 0.1.0 wrote them; words that nobody used are refused with the line."""
    written = msgspec.structs.replace(make(Job(PLAY))[0], privileged_info=["failure_model", "time_left"])
    cells.write(written)
    text = cells.path.read_text()
    old = text.replace('"privileged_info":["failure_model","time_left"]', '"needs":"failure model and clock"')
    assert old != text
    cells.path.write_text(old)
    assert Cells(cells.path).read(PLAY) == written
    cells.path.write_text(old.replace("failure model and clock", "luck"))
    with pytest.raises(InvalidFileError, match=r"line 1: expected a cell of schema 1 .*unknown privileged information"):
        Cells(cells.path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"M1": [0.5]}, "M1: expected 2 numbers"),
        ({"M1": ["high", 0.5]}, "a cell of schema 1"),
        ({"surplus": 1}, "a cell of schema 1"),
    ],
)
def test_a_damaged_cell_is_refused_by_name(cells, change, message):
    cells.write(Cell(inputs=PLAY, M1=[0.25, 0.5], seconds=1.0, revision=""))
    cells.path.write_text(json.dumps({**json.loads(cells.path.read_text()), **change}))
    with pytest.raises(InvalidFileError, match=message) as refused:
        Cells(cells.path)
    assert f"{cells.path}: line 1" in str(refused.value)


def test_a_cell_that_stands_twice_is_refused(cells):
    cells.write(Cell(inputs=PLAY, M1=[0.25, 0.5], seconds=1.0, revision=""))
    cells.path.write_bytes(2 * cells.path.read_bytes())
    with pytest.raises(InvalidFileError, match="line 2"):
        Cells(cells.path)


def test_cells_that_two_processes_write_are_both_kept(cells):
    other = Cells(cells.path)
    cells.write(Cell(inputs=PLAY, M1=[0.25, 0.5], seconds=1.0, revision=""))
    other.write(Cell(inputs=BOUND, M1=[0.5, 0.75], seconds=1.0, revision=""))
    assert len(Cells(cells.path)) == 2


def test_lines_are_sorted_so_that_a_new_cell_is_one_line_of_a_difference(cells):
    inputs = [msgspec.structs.replace(PLAY, seed=seed) for seed in range(20)]
    for one in inputs:
        cells.write(Cell(inputs=one, M1=[0.25, 0.5], seconds=1.0, revision=""))
    names = [digest(msgspec.json.decode(line, type=Cell).inputs) for line in cells.path.read_bytes().splitlines()]
    assert names == sorted(digest(one) for one in inputs)


def test_cells_of_other_kernels_are_taken_over_where_a_sample_agrees(cells):
    (made,) = make(Job(PLAY))
    cells.write(msgspec.structs.replace(made, kernels="earlier"))
    cells.write(Cell(inputs=BOUND, M1=[0.5, 0.75], seconds=1.0, revision="", kernels=None))
    assert len(cells.stale()) == 2
    assert confirm(cells, [Job(PLAY), Job(BOUND)], 10) == []
    assert cells.stale() == []
    assert cells.read(PLAY) == made


def test_cells_of_kernels_that_score_otherwise_are_made_again(cells):
    (made,) = make(Job(PLAY))
    cells.write(msgspec.structs.replace(made, kernels="earlier", M1=[made.M1[0] + 1e-6, made.M1[1]]))
    cells.write(Cell(inputs=BOUND, M1=[0.5, 0.75], seconds=1.0, revision="", kernels=None))
    assert confirm(cells, [Job(PLAY), Job(BOUND)], 10) == [describe(PLAY)]
    assert len(cells) == 0


def test_weights_that_change_make_another_cell(entries, plan, trained, tmp_path):
    row = plan.rows[-1]
    before = entries.row(row, "profit", "small")
    trained.write_bytes(b"other weights")
    after = Entries(plan, plan.full, tmp_path).row(row, "profit", "small")
    assert digest(before.inputs) != digest(after.inputs)
    with pytest.raises(InvalidFileError, match="the weights that were there when the cells were listed"):
        make(before)


def test_another_mode_on_the_card_makes_another_cell(entries, plan, trained, tmp_path):
    row, card = plan.rows[-1], trained.with_suffix(".json")
    before = entries.row(row, "profit", "small")
    write_card(card, msgspec.structs.replace(read_card(card), mode="sample"))
    assert digest(Entries(plan, plan.full, tmp_path).row(row, "profit", "small").inputs) != digest(before.inputs)


def test_a_rule_is_played_once_for_all_objectives_and_for_all_that_ask_for_a_view(entries, trained):
    jobs, _ = entries.all()
    names = [digest(inputs) for job in jobs for inputs in (job.inputs, *job.besides)]
    assert len(set(names)) == len(names)
    played = [job for job in jobs if getattr(job.inputs, "scheduler", "") == "condition"]
    # two scales in the tables; of the three views, the full one is in the table of small already
    assert len(played) == 2 + 2
    full = [job for job in played if job.inputs.view["kind"] == "full"]
    assert [(job.inputs.objective, [b.objective for b in job.besides]) for job in full] == [("profit", ["revenue"])] * 2


@pytest.mark.parametrize("rule", [name for name, rule in RULES.items() if not rule().heeds_objective])
def test_rules_that_do_not_heed_the_objective_score_alike_played_for_any(rule):
    play = msgspec.structs.replace(PLAY, scheduler=rule, horizon=48)
    other = msgspec.structs.replace(play, objective="availability")
    _, besides = make(Job(play, besides=(other,)))
    (alone,) = make(Job(other))
    assert (besides.inputs, besides.M1, besides.episode_std) == (other, alone.M1, alone.episode_std)


def test_the_index_heeds_the_objective():
    assert {name for name, rule in RULES.items() if rule().heeds_objective} == {"index", "index-without-clock"}


def test_jobs_come_cheapest_first(entries, trained):
    jobs, _ = entries.all()
    assert [job.cost for job in jobs] == sorted(job.cost for job in jobs)
    kinds = ["policy" if job.weights else type(job.inputs).__name__ for job in jobs]
    assert kinds.index("Play") < kinds.index("policy")


def test_a_policy_that_is_not_there_is_told_with_its_command(entries, trained):
    _, untrained = entries.all()
    (told,) = untrained  # the one for revenue; that for profit is there
    assert told.policy == "policies/net-revenue.safetensors"
    assert told.label == "net"
    assert told.command == "marl-sched train env.objective=revenue"


def test_a_run_that_was_stopped_goes_on_where_it_was(entries, cells, monkeypatch):
    jobs = [job for job in entries.all()[0] if isinstance(job.inputs, Play)]
    made = []

    def stop_at_the_fourth(job):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(digest(job.inputs))
        return make(job)

    monkeypatch.setattr(filling, "make", stop_at_the_fourth)
    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
        list(fill(jobs[:4], cells, pool))
    kept = {digest(cell.inputs) for cell in Cells(cells.path)}
    assert kept >= set(made)
    assert len(made) == 3
    assert missing(jobs, cells) == [job for job in jobs if digest(job.inputs) not in made]

    monkeypatch.setattr(filling, "make", make)
    with ThreadPoolExecutor(1) as pool:
        done = [digest(cell.inputs) for _, cell in fill(missing(jobs, cells), cells, pool)]
    assert not kept & set(done)
    assert set(done) | set(made) == {digest(job.inputs) for job in jobs}
    assert missing(jobs, cells) == []


def test_an_objective_that_comes_later_does_not_touch_the_cells_of_the_others(entries, cells, write):
    write(entries, cells)
    (job,) = [
        job
        for job in entries.all()[0]
        if isinstance(job.inputs, Play) and job.inputs.scheduler == "condition" and job.inputs.scale == "medium"
    ]
    (revenue,) = job.besides
    cells.remove(revenue)
    assert missing(entries.all()[0], cells) == [Job(revenue)]
    cells.remove(job.inputs)
    assert missing(entries.all()[0], cells) == [job]


@pytest.mark.slow
def test_what_cannot_be_made_is_told_by_the_workers_in_full(entries, cells, plan, trained):
    job = entries.row(plan.rows[-1], "profit", "small")
    trained.write_bytes(b"other weights")
    told = r"net-profit.*, small, .*: .*net-profit\.safetensors: expected the weights that were there"
    with worker_processes(1) as pool, pytest.raises(MarlSchedError, match=told):
        list(fill([job], cells, pool))
    assert not cells.path.exists()


def gone(pid: int) -> bool:
    """Whether a process ends within half a minute; its exit code may have been read by the pool's own thread."""
    for _ in range(300):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


class Killed(Executor):
    """A pool whose worker is killed at once."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_exception(BrokenProcessPool("a child process terminated abruptly"))
        return future


def test_a_killed_worker_is_told_with_the_number_of_cells_left(cells):
    with pytest.raises(MarlSchedError, match=r"killed.* 2 cells are left"):
        list(fill([Job(PLAY), Job(msgspec.structs.replace(PLAY, seed=8))], cells, Killed()))


@pytest.mark.slow
def test_workers_are_gone_after_an_error():
    before = set(multiprocessing.active_children())

    def stopped_at_work():
        with worker_processes(2) as pool:
            assert pool.submit(make, Job(PLAY)).result()[0].M1 == make(Job(PLAY))[0].M1
            pool.submit(make, Job(msgspec.structs.replace(PLAY, horizon=100_000)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped_at_work()
    for process in set(multiprocessing.active_children()) - before:
        assert gone(process.pid)


ORPHANS = """
import os, sys, time
from marl_sched.train.published.filling import worker_processes

if __name__ == "__main__":
    with worker_processes(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 600)
        os.kill(os.getpid(), 9)
"""


@pytest.mark.slow
def test_workers_are_gone_when_their_parent_was_killed(tmp_path):
    script = tmp_path / "orphans.py"
    script.write_text(ORPHANS)
    # the worker, with ten minutes to sleep, holds the other end of this pipe: to read it to its end is to outlive it
    done = subprocess.run([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, timeout=200, check=False)
    assert done.returncode == -9
    assert int(done.stdout) > 0
