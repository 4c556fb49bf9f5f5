"""Run readers on mutated files in a separate process, and monitor its time, memory and exceptions.

A case is a reader's name and a number: the same number makes the same file. A case passes if the file is read, or
rejected by one of the project's errors, within `MOST_S` and `MOST_MIB`.
"""

import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random

MOST_S, MOST_MIB = 5.0, 200.0
_SPACE = 2**30
"""Address space in bytes beyond that of the libraries: far above the limit, and below the memory of the machine."""
_READY = b"ready\n"
ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Outcome:
    """Result of a case: reader, number or path, failure or "", the error that rejected it, and time and memory used."""

    reader: str
    case: str
    fault: str
    refusal: str
    seconds: float
    mib: float


def watched(folder: Path, work: Iterable[tuple[str, str]], *, seed: int = 0) -> list[Outcome]:
    """Run cases, pairs of a reader's name and a case's number or the path of a file, and return their outcomes.

    If a reader crashes or hangs, the process ends, and a new one continues with the next case. ``folder`` contains the
    last file of each reader.
    """
    waiting, outcomes = list(work), []
    while waiting:
        done = 0
        for outcome in _by_child(folder, waiting, seed):
            outcomes.append(outcome)
            if outcome.fault:
                print(f"{outcome.reader} {outcome.case}: {outcome.fault[-700:]}", file=sys.stderr, flush=True)
            done += 1
        waiting = waiting[done:]
    return outcomes


def _by_child(folder: Path, waiting: list[tuple[str, str]], seed: int) -> Iterator[Outcome]:
    """Yield outcomes until all cases are done or a case ends the process."""
    command = [sys.executable, "-m", "tests.fuzz.running", str(folder), str(seed)]
    known = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "BLOSC_NTHREADS"), "1")
    environment = os.environ | known | {"PYTHONPATH": str(ROOT)}
    with (
        tempfile.TemporaryFile("w+") as list_, tempfile.TemporaryFile() as said,
        subprocess.Popen(command, stdin=list_, stdout=subprocess.PIPE, stderr=said, env=environment, cwd=ROOT) as child,
    ):  # fmt: skip
        json.dump(waiting, list_)
        list_.seek(0)
        # The file's place is shared with the child, which reads it once it has been written.
        assert child.stdout is not None
        if child.stdout.readline() != _READY:
            said.seek(0)
            raise RuntimeError(f"the readers' valid files cannot be read: {said.read().decode()}")
        for reader, case in waiting:
            ready = select.select([child.stdout], [], [], 4 * MOST_S)[0]
            line = child.stdout.readline() if ready else b""
            if not line:
                hung = child.poll() is None and not ready
                child.kill()
                child.wait()
                _keep(folder, reader, case)
                said.seek(0)
                words = "no end" if hung else f"the process ended with {child.returncode}: {said.read()[-600:]!r}"
                yield Outcome(reader, case, words, "", 4 * MOST_S, 0.0)
                return
            yield Outcome(**json.loads(line))


def kept_file(folder: Path, reader: str, case: str) -> Path:
    """Return the path of the stored file of a failed case."""
    return folder / f"{reader}--{case}"


def _keep(folder: Path, reader: str, case: str) -> None:
    """Store the file of a numbered case."""
    found = next((folder / reader).glob("case.*"), None)
    if case.isdecimal() and found is not None:
        shutil.copyfile(found, kept_file(folder, reader, case))


def _peak_mib() -> tuple[float, float]:
    """Return the memory in use and its peak since the last reset, MiB."""
    known = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    now, peak = (int(known[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))
    return now, peak


def _too_slow(*_: object) -> None:
    raise TimeoutError(f"it took more than {MOST_S} s")


def _child(folder: Path, seed: int) -> None:
    from tests.fuzz.mutation import changed
    from tests.fuzz.readers import READERS, seed_of
    from uwlts.errors import Error

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    work = json.load(sys.stdin)
    seeds = {}
    for name in dict.fromkeys(name for name, _ in work):
        place = folder / name
        place.mkdir(exist_ok=True)
        if any(case.isdecimal() for each, case in work if each == name):
            seeds[name] = seed_of(READERS[name], place)
            READERS[name].read(place / f"seed{READERS[name].suffix}")
    answers.write(_READY.decode())
    answers.flush()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + _SPACE, used + _SPACE))
    # Processor time, so that other programs on the machine do not count.
    signal.signal(signal.SIGPROF, _too_slow)
    for name, case in work:
        reader, path = READERS[name], Path(case)
        if case.isdecimal():
            path = folder / name / f"case{reader.suffix}"
            content = changed(seeds[name], reader.form, Random(f"{name} {case} {seed}"), folder / name)
            path.unlink(missing_ok=True)
            path.write_bytes(content)
        Path("/proc/self/clear_refs").write_text("5")
        before, began = _peak_mib()[0], time.process_time()
        fault = refusal = ""
        signal.setitimer(signal.ITIMER_PROF, MOST_S)
        try:
            reader.read(path)
        except Error as error:
            refusal = f"{type(error).__name__}: {error}"
            if len(refusal) > 6000:
                fault = f"the message has {len(refusal)} characters"
        except BaseException:
            fault = traceback.format_exc()[-1500:]
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        seconds, mib = time.process_time() - began, _peak_mib()[1] - before
        if not fault and mib > MOST_MIB:
            fault = f"it took {mib:.0f} MiB"
        if not fault and seconds > MOST_S:
            fault = f"it took {seconds:.1f} s"
        if fault:
            _keep(folder, name, case)
        outcome = Outcome(name, case, fault, refusal[:300], round(seconds, 4), round(mib, 1))
        answers.write(json.dumps(asdict(outcome)) + "\n")
        answers.flush()


if __name__ == "__main__":
    _child(Path(sys.argv[1]), int(sys.argv[2]))
