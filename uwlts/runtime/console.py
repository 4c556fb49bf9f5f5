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

from uwlts.errors import Error
from uwlts.files.inputs import inputs_kept, refuse_named_inputs
from uwlts.runtime.interrupts import interrupts_kept
from uwlts.runtime.progress import ProgressListener, unheard

USER_ERROR, INTERRUPTED = 2, 130


@contextmanager
def progress_bar(title: str) -> Iterator[ProgressListener]:
    """A bar on standard error, moved by calling ``progress(done, total)``; silent where that is no terminal.

    A bar that is full stands still, so that other programs may print below it; the next stage begins another.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        # A disabled bar of rich before 14.3 prints an empty line.
        yield unheard
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
    # Matrices are small here: threads for their products gain nothing, and wait for each other where other work runs.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A shell starts what a script puts in the background with SIGINT ignored, and a laser could not be stopped by it.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command: object = None
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
        names = inspect.signature(command).parameters if callable(command) else ()
        print(f"error: {as_options(str(error), names)}", file=sys.stderr)
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


def as_options(text: str, names: Collection[str]) -> str:
    """A function's text with the command's options in place of parameters with these names, which are in backticks."""
    return re.sub(
        r"(`+)(\w+)\1", lambda found: f"--{found[2].replace('_', '-')}" if found[2] in names else found[0], text
    )
