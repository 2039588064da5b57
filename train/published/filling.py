"""Making the cells that are not there yet, in worker processes, cheapest first.

A cell is written when it is finished, so whatever stops the work costs no more than the cells in the making.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec

from marl_sched.errors import MarlSchedError
from marl_sched.train.malloc import keep_freed_memory
from marl_sched.train.published.cells import Cell, Job, describe, make
from marl_sched.train.published.store import Cells


def missing(jobs: Iterable[Job], cells: Cells) -> list[Job]:
    """What is left of the jobs, in their order: cells that are there are not made again."""
    return [left for job in jobs if (left := _left(job, cells)) is not None]


def _left(job: Job, cells: Cells) -> Job | None:
    """A job without the cells that are there, None if all are."""
    besides = tuple(inputs for inputs in job.besides if cells.read(inputs) is None)
    if cells.read(job.inputs) is None:
        return replace(job, besides=besides)
    return replace(job, inputs=besides[0], besides=besides[1:]) if besides else None


def fill(jobs: Iterable[Job], cells: Cells, pool: Executor) -> Iterator[tuple[Job, Cell]]:
    """Make each job's cells and keep them; yields the jobs with their own cell as they are finished.

    Raises MarlSchedError, with the job's name, for a job that cannot be done, and for a worker that was killed: the
    pool does not tell at which job it was.
    """
    futures = {pool.submit(_attempt, job): job for job in jobs}
    left = len(futures)
    for future in as_completed(futures):
        try:
            made = future.result()
        except BrokenExecutor as error:
            raise MarlSchedError(
                f"a worker process was killed, perhaps for want of memory; {left} cells are left to make, those that "
                f"were finished are kept"
            ) from error
        left -= 1
        cells.write(*made)
        yield futures[future], made[0]


def _attempt(job: Job) -> list[Cell]:
    try:
        return make(job)
    except MarlSchedError as error:  # errors with arguments of their own do not survive the way between processes
        raise MarlSchedError(f"{describe(job.inputs)}: {error}") from None


@contextmanager
def worker_processes(workers: int) -> Iterator[Executor]:
    """A pool of single-threaded processes, which are gone when the block is left, also by Ctrl-C or an error."""
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")  # PyTorch and Numba do not survive a fork with threads
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_work)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    pool.shutdown()


def _begin_work() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the parent ends the workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()
    if find_spec("torch") is not None:
        import torch

        torch.set_num_threads(1)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, however it went."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
