"""Interface for reports of progress by long calculations of both packages."""

from typing import Protocol


class ProgressListener(Protocol):
    """Function that receives the progress of a calculation, to draw a bar or to write a line."""

    def __call__(self, done: int, total: int, stage: str = "") -> None:
        """Receive the number of finished parts, the total, and the name of the stage if there are several."""
        ...


def ignore_progress(done: int, total: int, stage: str = "") -> None:
    """Ignore the progress."""
