"""Everything a user can get wrong has an error of its own here; a program bug is any other exception.

Messages say what was found, what was expected and what to do. The commands print them without a traceback and exit
with code 2.
"""


class UwltsError(Exception):
    """Base of all errors caused by input, files or the machine rather than by a bug."""


class DescriptionError(UwltsError):
    """A sensor, scene or target description cannot be read: unknown key, wrong type, unknown name."""


class DesignError(UwltsError):
    """A description is readable but the sensor it describes cannot work."""


class RangeError(UwltsError):
    """A value lies outside the range for which a formula or table holds."""


class CaptureError(UwltsError):
    """A capture, cloud or calibration file is foreign, truncated, of a newer version, or inconsistent."""


class OutputError(UwltsError):
    """An output cannot be written: it exists already, the folder is missing, the disk is full."""


class ImageError(UwltsError):
    """An image has the wrong size, type or content for what is asked of it."""


class TargetError(UwltsError):
    """A calibration target is not found, or not found completely enough, in an image."""


class CalibrationError(UwltsError):
    """The evidence does not determine the calibration, or contradicts it."""


class EvaluationError(UwltsError):
    """A cloud does not hold what the evaluation needs."""


class SetupError(UwltsError):
    """The machine lacks something: libLLVM, a library, a permission."""


class HardwareError(UwltsError):
    """A camera, stage or laser does not answer, answers wrongly, or reports a fault."""
