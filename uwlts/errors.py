"""Errors that a user can cause or fix; any other exception is a bug of the program.

Messages state what was found, what was expected and what to do. The commands print them without a traceback and exit
with code 2.
"""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

_MOST_PROBLEMS = 5  # largest number of problems in a message; a damaged table would have one for each number

_MOST_LISTED = 1000  # largest number of problems that are examined: a list of a million would take a gigabyte

_LONGEST_PROBLEM = 300  # characters; foreign files are quoted in messages
_LONGEST = 5000  # characters of a message


_UNPRINTABLE = re.compile(r"[^\n\t\x20-\x7e\xa0-\u200d\u2010-\u2029\u202f-\u2065\u206a-\ud7ff\ue000-\U0010ffff]")


def make_printable(text: str) -> str:
    """Return text with control characters, marks of the writing direction, and parts of characters as escapes.

    Names and texts from files could otherwise move the cursor, change colours or hide text on a terminal.
    """
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class Error(Exception):
    """Base of all errors caused by input, files or the machine rather than by a bug; long messages are shortened."""

    def __str__(self) -> str:
        """Return the message, printable and shortened to about 5000 characters: some quote the content of a file."""
        text = make_printable(super().__str__())
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1000]} ... {text[-1000:]}"


class ArgumentError(Error, TypeError):
    """An argument of a public function has a wrong type."""


class DescriptionError(Error):
    """A description of a sensor, scene or target cannot be read: unknown key, wrong type, unknown name."""


class DescriptionWarning(UserWarning):
    """A description keeps a value of its base that does not fit the values that it changes; commands print it."""


class DesignError(Error):
    """A description is readable but its sensor cannot work."""


class RangeError(Error):
    """A value is outside the range of validity of a formula or table."""


class CaptureError(Error):
    """A capture, cloud or calibration file is foreign, truncated, of a newer version, or inconsistent."""


class OutputError(Error):
    """An output cannot be written: it exists already, the folder is missing, the disk is full."""


class ImageError(Error):
    """An image has the wrong size, type or content for its purpose."""


class TargetError(Error):
    """A calibration target is not found, or not found completely enough, in an image."""


class CalibrationError(Error):
    """The evidence does not determine the calibration, or contradicts it."""


class EvaluationError(Error):
    """A cloud lacks what the evaluation needs."""


class SetupError(Error):
    """The machine lacks something: libLLVM, a library, a permission."""


class HardwareError(Error):
    """A camera, stage or laser does not answer, answers wrongly, or reports a fault."""


def list_problems(error: "ValidationError", most: int) -> "list[ErrorDetails]":
    """Return the first problems found by a validation; empty if there are too many to list them."""
    return error.errors(include_url=False)[:most] if error.error_count() <= _MOST_LISTED else []


def describe_problems(error: "ValidationError") -> str:
    """Describe the first problems found by a validation, each with its location."""
    problems = (
        f"{'.'.join(map(str, p['loc']))}: {p['msg']}"[:_LONGEST_PROBLEM] for p in list_problems(error, _MOST_PROBLEMS)
    )
    return "; ".join(problems) or f"{error.error_count():,} values are wrong"
