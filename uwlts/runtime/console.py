"""Progress bars and error messages of both commands on the terminal."""

import inspect
import os
import re
import signal
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from cyclopts import App, CycloptsError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uwlts.errors import Error, make_printable
from uwlts.files.inputs import protect_inputs, refuse_named_inputs
from uwlts.runtime.interrupts import preserve_interrupts
from uwlts.runtime.progress import ProgressListener, ignore_progress

USER_ERROR, INTERRUPTED = 2, 130


@contextmanager
def progress_bar(title: str) -> Iterator[ProgressListener]:
    """Return a context with a progress bar on standard error, updated by ``progress(done, total)``.

    Without a terminal it prints nothing. A full bar stops, so that other output can follow below it; the next stage
    begins another bar.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        # In rich before 14.3 a disabled bar prints an empty line.
        yield ignore_progress
        return
    times = TimeElapsedColumn(), TimeRemainingColumn()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *times
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=None)

        def listen(done: int, total: int, stage: str = "") -> None:
            bar.update(task, completed=done, total=total, description=f"{title} {stage}".rstrip())
            if done < total:
                bar.start()
            else:
                bar.stop()

        yield listen


def run(app: App) -> int:
    """Run a command line and return its exit code: 2 with a message for the user's errors, 130 for Ctrl-C.

    A wrong command line is explained by cyclopts, on standard error like all errors.
    """
    # Matrices are small here: threads for their products gain nothing, and delay each other when other programs run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Scripts start background commands with SIGINT ignored, so that it could not stop a laser.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command: object = None
    try:
        with preserve_interrupts():
            command, bound, _ = app.parse_args(sys.argv[1:], exit_on_error=False, print_error=True)
            with protect_inputs():
                refuse_named_inputs(bound.arguments)
                command(*bound.args, **bound.kwargs)
        sys.stdout.flush()
    except CycloptsError:
        return USER_ERROR
    except Error as error:
        names = inspect.signature(command).parameters if callable(command) else ()
        print(f"error: {replace_by_options(str(error), names)}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("interrupted; what is complete is kept: run it again, recordings with --resume", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has closed the pipe; Python must not try to write the rest when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(make_printable(f"error: {error.strerror or error}: {error.filename}"), file=sys.stderr)
        return USER_ERROR
    return 0


def replace_by_options(text: str, names: Collection[str]) -> str:
    """Replace parameters in backticks by the command's options, for parameters with these names."""
    return re.sub(
        r"(`+)(\w+)\1", lambda found: f"--{found[2].replace('_', '-')}" if found[2] in names else found[0], text
    )
