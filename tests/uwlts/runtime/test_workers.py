"""Worker processes: results in order, errors that reach the command, and no process left when the command ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from uwlts.errors import CaptureError, SetupError
from uwlts.files.writing import write_atomically
from uwlts.runtime import workers
from uwlts.runtime.workers import map_in_threads, run_jobs

ROOT = Path(__file__).resolve().parents[3]


def square(number, send):
    send((number, os.getpid()))
    time.sleep(0.02 * (number % 3))
    return number * number


def fail(error, job, send):
    if job == 1:
        raise error
    time.sleep(60)


def end(how, job, send):
    os._exit(how) if how >= 0 else os.kill(os.getpid(), -how)


def linger(folder, job, send):
    """Send a message and wait; leave a mark when stopped."""
    try:
        (folder / f"{job}.begun").touch()
        send(job)
        time.sleep(60)
    finally:
        (folder / f"{job}.stopped").touch()


def hold_on(job, send):
    """Wait, also after a request to stop."""
    with suppress(KeyboardInterrupt):
        send(job)
        time.sleep(60)
    time.sleep(60)


@pytest.fixture(autouse=True)
def no_process_is_left():
    yield
    assert multiprocessing.active_children() == []


def test_results_come_in_the_order_of_the_jobs():
    heard = []
    assert run_jobs(square, range(20), workers=3, on_message=heard.append) == [n * n for n in range(20)]
    assert sorted(number for number, _ in heard) == list(range(20))
    processes = {process for _, process in heard}
    assert len(processes) == 3
    assert os.getpid() not in processes


def test_fewer_jobs_than_processes():
    assert run_jobs(square, [], workers=4) == []
    heard = []
    assert run_jobs(square, [3], workers=4, on_message=heard.append) == [9]
    assert len(heard) == 1


@pytest.mark.parametrize("error", [CaptureError("no capture at a.h5"), FileNotFoundError(2, "No such file", "a.h5")])
def test_a_job_that_fails_stops_the_others(error):
    start = time.monotonic()
    with pytest.raises(type(error)) as raised:
        run_jobs(partial(fail, error), range(5), workers=2)
    assert str(raised.value) == str(error)
    assert time.monotonic() - start < 30


@pytest.mark.parametrize(("how", "says"), [(-signal.SIGKILL, "signal SIGKILL"), (7, "exit code 7")])
def test_a_process_that_vanishes_is_no_mystery(how: int, says: str):
    with pytest.raises(SetupError, match=rf"ended unexpectedly \({says}\).*fewer workers"):
        run_jobs(partial(end, how), range(3), workers=2)


def test_a_bug_shows_its_traceback(capfd):
    with pytest.raises(SetupError, match="exit code 1.*error printed above; .*`if __name__"):
        run_jobs(partial(fail, ZeroDivisionError("a bug")), range(3), workers=2)
    assert "ZeroDivisionError: a bug" in capfd.readouterr().err


def test_an_interrupt_stops_running_jobs_and_starts_no_other(tmp_path: Path, capfd):
    seen = set()

    def interrupted(job: int) -> None:
        seen.add(job)
        if len(seen) == 2:
            raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_jobs(partial(linger, tmp_path), range(9), workers=2, on_message=interrupted)
    assert time.monotonic() - start < 30
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.begun", "0.stopped", "1.begun", "1.stopped"]
    assert capfd.readouterr() == ("", "")


def test_a_process_that_does_not_end_is_killed(monkeypatch):
    monkeypatch.setattr(workers, "_GRACE_S", 0.3)

    def interrupted(job: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_jobs(hold_on, [0], on_message=interrupted)


def write_and_hold_on(folder, job, send):
    """Begin a file, then wait regardless of requests to stop."""
    with write_atomically(folder / f"{job}.txt"):
        hold_on(job, send)


def test_a_killed_process_leaves_no_unfinished_files(tmp_path: Path):
    seen = []

    def interrupted(job: int) -> None:
        seen.append(sorted(path.suffix for path in tmp_path.iterdir()))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_jobs(partial(write_and_hold_on, tmp_path), range(2), workers=2, on_message=interrupted)
    assert ".txt" in seen[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("how", ["interrupt of all", "interrupt of the command", "kill"])
def test_processes_end_with_their_command(tmp_path: Path, how: str):
    # A shell that runs the tests in the background makes all its children ignore Ctrl-C; the program must not.
    program = (
        "import signal, sys, pathlib, functools\n"
        "from tests.uwlts.runtime.test_workers import linger, run_jobs\n"
        "signal.signal(signal.SIGINT, lambda *_: sys.exit(130))\n"
        "print('ready', flush=True)\n"
        "run_jobs(functools.partial(linger, pathlib.Path(sys.argv[1])), range(9), workers=2)\n"
    )
    command = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)],
        start_new_session=True,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert command.stdout.readline() == "ready\n"
    if how == "interrupt of all":
        # While the processes are starting, when they know least about their work.
        time.sleep(0.05)
        os.killpg(command.pid, signal.SIGINT)
    else:
        while len(list(tmp_path.glob("*.begun"))) < 2 and command.poll() is None:
            time.sleep(0.01)
        command.send_signal(signal.SIGKILL if how == "kill" else signal.SIGINT)
    # The output ends when the last process that holds it does.
    output, errors = command.communicate(timeout=30)
    assert (command.returncode, output, errors) == (-signal.SIGKILL if how == "kill" else 130, "", "")
    assert len(list(tmp_path.glob("*.begun"))) == len(list(tmp_path.glob("*.stopped")))


def threads(job, send):
    return os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS")


def test_workers_do_linear_algebra_in_one_thread_unless_set_otherwise(monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert run_jobs(threads, [0, 1], workers=2) == [("1", "3")] * 2
    assert "OPENBLAS_NUM_THREADS" not in os.environ
    assert os.environ["OMP_NUM_THREADS"] == "3"


@pytest.mark.parametrize("processors", [1, 3])
def test_threads_take_few_items_ahead_and_end_at_an_interrupt(monkeypatch, processors: int):
    """A capture of any length must not be read into memory while its first images are processed."""
    monkeypatch.setattr(workers, "count_processors", lambda: processors)
    taken, begun = [], []

    def items():
        for number in range(1000):
            taken.append(number)
            yield number

    def work(number):
        begun.append(number)
        if number == 20:
            raise CaptureError("20")
        return number * number

    for number, result in (results := map_in_threads(work, items())):
        assert result == number * number
        assert len(taken) <= number + 2 + processors
        if number == 10:
            break
    with pytest.raises(KeyboardInterrupt):
        results.throw(KeyboardInterrupt)
    assert set(begun) <= set(taken) and len(taken) <= 12 + processors
    with pytest.raises(CaptureError, match="20"):
        list(map_in_threads(work, range(1000)))
    assert 30 not in begun
