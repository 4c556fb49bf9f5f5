"""Everything a user can get wrong has an error of its own here; a program bug is any other exception.

Messages say what was found, what was expected and what to do. The commands print them without a traceback and exit
with code 2.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

_MOST_PROBLEMS = 5
"""Problems named in a message; a damaged table would be reported number by number."""

_MOST_LISTED = 1000
"""Problems that are looked at: a list of a million would take a gigabyte."""

_LONGEST_PROBLEM = 300
_LONGEST = 5000


class Error(Exception):
    """Base of all errors caused by input, files or the machine rather than by a bug; long messages are cut."""

    def __str__(self) -> str:
        """The message, of at most about 5000 characters: some quote what was found in a file."""
        text = super().__str__()
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1000]} ... {text[-1000:]}"


class DescriptionError(Error):
    """A sensor, scene or target description cannot be read: unknown key, wrong type, unknown name."""


class DesignError(Error):
    """A description is readable but the sensor it describes cannot work."""


class RangeError(Error):
    """A value lies outside the range for which a formula or table holds."""


class CaptureError(Error):
    """A capture, cloud or calibration file is foreign, truncated, of a newer version, or inconsistent."""


class OutputError(Error):
    """An output cannot be written: it exists already, the folder is missing, the disk is full."""


class ImageError(Error):
    """An image has the wrong size, type or content for what is asked of it."""


class TargetError(Error):
    """A calibration target is not found, or not found completely enough, in an image."""


class CalibrationError(Error):
    """The evidence does not determine the calibration, or contradicts it."""


class EvaluationError(Error):
    """A cloud does not hold what the evaluation needs."""


class SetupError(Error):
    """The machine lacks something: libLLVM, a library, a permission."""


class HardwareError(Error):
    """A camera, stage or laser does not answer, answers wrongly, or reports a fault."""


class CommandFailed(Error):
    """A command that a function ran has failed, and has printed why; ``returncode`` is its exit code."""

    def __init__(self, line: str, returncode: int):
        super().__init__(f"{line} ended with exit code {returncode}")
        self.returncode = returncode


def first_problems(error: "ValidationError", most: int) -> "list[ErrorDetails]":
    """The first problems that a validation found; none where there are too many to list them."""
    return error.errors(include_url=False)[:most] if error.error_count() <= _MOST_LISTED else []


def problems_of(error: "ValidationError") -> str:
    """The first problems that a validation found, each with the place where it is."""
    problems = (
        f"{'.'.join(map(str, p['loc']))}: {p['msg']}"[:_LONGEST_PROBLEM] for p in first_problems(error, _MOST_PROBLEMS)
    )
    return "; ".join(problems) or f"{error.error_count():,} values are wrong"
