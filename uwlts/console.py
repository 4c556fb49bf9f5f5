"""What both commands share on the terminal: progress bars, and errors that speak instead of tracebacks."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cyclopts import App
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uwlts.errors import UwltsError

USER_ERROR, INTERRUPTED = 2, 130


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error, moved by calling ``progress(done, total)``; silent where nobody watches."""
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def run(app: App) -> int:
    """Run a command line; errors of the user's making end with a message and exit code 2, Ctrl-C with 130."""
    try:
        app(sys.argv[1:], exit_on_error=True, print_error=True)
    except UwltsError as error:
        print(f"error: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("interrupted; complete frames are kept, give --resume to go on", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        return 0
    return 0
