"""Workers for several rounds of jobs: if a process dies, only the job that killed it is lost."""

import os
import signal
import time
from pathlib import Path

import pytest

from uwlts.errors import SetupError
from uwlts.runtime import workers
from uwlts.runtime.workers import Lost, open_workers

GUILTY = 7


def squared(job: tuple[int, Path]) -> int:
    number, folder = job
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(0.01)
    return number * number


def deadly(job: tuple[int, Path]) -> int:
    if job[0] == GUILTY:
        os.kill(os.getpid(), signal.SIGKILL)
    return squared(job)


def unlucky(job: tuple[int, Path]) -> int:
    """Dies the first time only."""
    mark = job[1] / "died"
    if job[0] == GUILTY and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return squared(job)


def test_all_jobs_are_done_once_by_all_workers(tmp_path):
    with open_workers(workers=2) as pool:
        done = dict(pool.map_unordered(squared, ((k, tmp_path) for k in range(30))))
    assert {job[0]: result for job, result in done.items()} == {k: k * k for k in range(30)}
    marks = [path.name.split("-") for path in tmp_path.iterdir()]
    assert sorted(int(number) for number, _ in marks) == list(range(30))
    assert 1 <= len({process for _, process in marks}) <= 2


def test_only_the_job_that_kills_its_process_is_lost(tmp_path):
    with open_workers(workers=2) as pool:
        done = {job[0]: result for job, result in pool.map_unordered(deadly, ((k, tmp_path) for k in range(20)))}
        assert {k for k, result in done.items() if isinstance(result, Lost)} == {GUILTY}
        assert "ended unexpectedly" in done[GUILTY].reason
        assert {k: r for k, r in done.items() if k != GUILTY} == {k: k * k for k in range(20) if k != GUILTY}
        # The workers continue afterwards.
        assert next(iter(pool.map_unordered(squared, [(3, tmp_path)])))[1] == 9


def test_a_job_whose_process_was_killed_by_chance_is_done_again(tmp_path):
    with open_workers(workers=2) as pool:
        done = {job[0]: result for job, result in pool.map_unordered(unlucky, ((k, tmp_path) for k in range(20)))}
    assert done == {k: k * k for k in range(20)}


def test_jobs_are_taken_only_shortly_before_they_are_done(tmp_path):
    taken = []

    def jobs():
        for k in range(50):
            taken.append(k)
            yield k, tmp_path

    with open_workers(workers=2) as pool:
        work = pool.map_unordered(squared, jobs())
        next(work)
        assert len(taken) <= 8
        assert sum(1 for _ in work) == 49


def test_workers_share_the_threads_of_the_machine(tmp_path):
    processors = len(os.sched_getaffinity(0))
    with open_workers(workers=processors) as pool:
        ((_, threads),) = pool.map_unordered(os.getenv, ["OMP_NUM_THREADS"])
    assert threads == "1"
    assert pool.processes_for(processors) == 1 and pool.processes_for(1) == processors


def test_no_scheduler_at_an_address(monkeypatch):
    nobody = "tcp://127.0.0.1:9"
    monkeypatch.setattr(workers, "_PATIENCE_S", 1.0)
    with pytest.raises(SetupError, match="no Dask scheduler"), open_workers(scheduler=nobody):
        pass
