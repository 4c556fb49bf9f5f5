"""Progress bars and error messages of both commands on the terminal."""

import inspect
import os
import re
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout

from cyclopts import App, CycloptsError, CycloptsPanel, MissingArgumentError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uwlts.argument_types import protect_inputs
from uwlts.errors import DescriptionWarning, Error, make_printable
from uwlts.runtime.progress import ProgressListener, ignore_progress, preserve_interrupts

USER_ERROR, INTERRUPTED = 2, 130
SWITCHES = {
    "verbose": (("--verbose", "-v"), "With any command: also print the traceback of an error."),
    "quiet": (("--quiet", "-q"), "With any command: print only warnings and errors, without results and progress."),
}
"""Options of all commands, with their words and their help."""
_TABLE_WIDTH = 110  # characters, without a terminal
_LINE_EVERY_S = 10.0  # interval between lines of progress without a terminal: a log of an hour stays readable
_quiet = False
_parameters: Collection[str] = ()  # names of the parameters of the command that runs
_python_show_warning = warnings.showwarning


def table_console() -> Console:
    """Return the terminal, or a console of fixed width for tables that are not shown in one."""
    usual = Console()
    return usual if usual.is_terminal and not usual.is_dumb_terminal else Console(width=_TABLE_WIDTH)


@contextmanager
def progress_bar(title: str) -> Iterator[ProgressListener]:
    """Return a context with a progress bar on standard error, updated by ``progress(done, total)``.

    A full bar stops, so that other output can follow below it; the next stage begins another bar. Without a terminal
    it prints a line every ten seconds instead, and nothing for shorter work.
    """
    console = Console(stderr=True)
    if _quiet:
        yield ignore_progress
        return
    if not console.is_terminal:
        # In rich before 14.3 a disabled bar prints an empty line.
        yield _print_progress(title)
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


def _print_progress(title: str) -> ProgressListener:
    """Return a listener that prints the progress as lines."""
    begun = shown_s = time.monotonic()

    def listen(done: int, total: int, stage: str = "") -> None:
        nonlocal shown_s
        now = time.monotonic()
        if now - shown_s >= _LINE_EVERY_S:
            shown_s = now
            what = make_printable(f"{title} {stage}".rstrip())
            print(f"{what}: {done} of {total} after {now - begun:.0f} s", file=sys.stderr, flush=True)

    return listen


def _show_warning(message: Warning | str, category: type[Warning], *place: object, **more: object) -> None:
    """Print a warning on standard error as the commands do; without the line of code for those about descriptions."""
    if issubclass(category, DescriptionWarning):
        warn(str(message))
    else:
        _python_show_warning(message, category, *place, **more)  # pyright: ignore[reportArgumentType]


def run(app: App) -> int:
    """Run a command line and return its exit code: 2 with a message for the user's errors, 130 for Ctrl-C.

    A wrong command line is explained on standard error like all errors.
    """
    global _quiet, _parameters
    # Matrices are small here: threads for their products gain nothing, and delay each other when other programs run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Scripts start background commands with SIGINT ignored, so that it could not stop a laser.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    arguments = sys.argv[1:]
    on = {name: not {*choices}.isdisjoint(arguments) for name, (choices, _) in SWITCHES.items()}
    switches = {word for choices, _ in SWITCHES.values() for word in choices}
    _quiet, _parameters, arguments = on["quiet"], (), [word for word in arguments if word not in switches]
    try:
        with preserve_interrupts(), warnings.catch_warnings(), ExitStack() as output:
            warnings.showwarning = _show_warning
            command, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False)
            _parameters = inspect.signature(command).parameters
            if _quiet:
                output.enter_context(redirect_stdout(output.enter_context(open(os.devnull, "w", encoding="utf-8"))))
            with protect_inputs(bound.arguments):
                command(*bound.args, **bound.kwargs)
        sys.stdout.flush()
    except CycloptsError as error:
        _explain(error, app.name[0])
        return USER_ERROR
    except Error as error:
        if on["verbose"]:
            traceback.print_exc()
        print(f"error: {replace_by_options(str(error))}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("interrupted; what is complete is kept: run it again, recordings with --resume", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has closed the pipe; Python must not try to write the rest when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ImportError, MemoryError) as error:
        if on["verbose"]:
            traceback.print_exc()
        text = f"{error}: too little memory? See also `uwlts doctor`"
        if isinstance(error, OSError) and error.strerror:
            text = f"{error.strerror}: {error.filename}"
        print(make_printable(f"error: {text}"), file=sys.stderr)
        return USER_ERROR
    return 0


def _explain(error: CycloptsError, program: str) -> None:
    """Print what is wrong with a command line; an argument that was not given is called missing."""
    message: object = error
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        argument = error.argument
        part = getattr(error, "keyword", None)  # a part of an argument, in newer versions of cyclopts
        if part is None and not argument.tokens and not error.tokens_so_far:
            chain = " ".join([program, *(error.command_chain or ())])
            kind = "option" if argument.name.startswith("-") else "argument"
            message = f"{chain}: the required {kind} {argument.name} is missing; {chain} --help explains it."
    (error.console or Console(stderr=True)).print(CycloptsPanel(message))


def warn(*texts: str) -> None:
    """Print warnings on standard error, with the command's options in place of parameters in backticks."""
    for text in texts:
        print(make_printable(f"warning: {replace_by_options(text)}"), file=sys.stderr, flush=True)


def replace_by_options(text: str, names: Collection[str] | None = None) -> str:
    """Replace parameters in backticks by options; with ``names`` those of another command than the one that runs."""
    names = _parameters if names is None else names
    return re.sub(
        r"(`+)(\w+)\1", lambda found: f"--{found[2].replace('_', '-')}" if found[2] in names else found[0], text
    )
