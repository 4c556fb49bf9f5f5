"""Progress bars and error messages of both commands on the terminal."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cyclopts import App, CycloptsError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uwlts.errors import Error
from uwlts.files.inputs import inputs_kept, refuse_named_inputs
from uwlts.runtime.interrupts import interrupts_kept

USER_ERROR, INTERRUPTED = 2, 130


@contextmanager
def progress_bar(title: str, *, shown: bool = True) -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error, moved by calling ``progress(done, total)``; silent unless shown on a terminal."""
    console = Console(stderr=True)
    if not (shown and console.is_terminal):
        # A disabled bar of rich before 14.3 prints an empty line.
        yield lambda done, total: None
        return
    times = TimeElapsedColumn(), TimeRemainingColumn()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *times
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def run(app: App) -> int:
    """Run a command line and return its exit code: 2 with a message for the user's errors, 130 for Ctrl-C.

    A wrong command line is explained by cyclopts, on standard error like all errors.
    """
    # Matrices are small here: threads for their products gain nothing, and wait for each other where other work runs.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A shell starts what a script puts in the background with SIGINT ignored, and a laser could not be stopped by it.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with interrupts_kept():
            command, bound, _ = app.parse_args(sys.argv[1:], exit_on_error=False, print_error=True)
            with inputs_kept():
                refuse_named_inputs(bound.arguments)
                command(*bound.args, **bound.kwargs)
        sys.stdout.flush()
    except CycloptsError:
        return USER_ERROR
    except Error as error:
        print(f"error: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("interrupted; what is complete is kept: run it again, recordings with --resume", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has seen enough; what is left unwritten must not be tried again when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(f"error: {error.strerror or error}: {error.filename}", file=sys.stderr)
        return USER_ERROR
    return 0
