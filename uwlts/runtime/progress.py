"""How long calculations of both packages tell their progress."""

from typing import Protocol


class ProgressListener(Protocol):
    """Function that is told the progress of a calculation, to draw a bar or to write a line."""

    def __call__(self, done: int, total: int, stage: str = "") -> None:
        """Take the number of parts done, the number in all, and the name of the stage where there are several."""
        ...


def unheard(done: int, total: int, stage: str = "") -> None:
    """Progress that nobody follows."""
