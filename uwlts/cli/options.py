"""The ``uwlts`` command line itself, and what its commands share."""

import pkgutil
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from uwlts._version import __version__

app = App(
    name="uwlts",
    help="Software of an underwater laser triangulation sensor.",
    version=__version__,
    help_format="markdown",
)

Flag = Annotated[bool, Parameter(negative="")]
Files = Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="")]
# Not a union of "auto" and tuples: cyclopts takes one value, or refuses the type, where kinds differ in their number.
Coefficients = Annotated[
    tuple[Literal["auto", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"], ...],
    Parameter(consume_multiple=True, negative="", show_default=" ".join),
]
JSON = (".json",)
"""Ending of calibrations, mounts, evaluations, findings and studies."""
AUTO: Coefficients = ("auto",)
if TYPE_CHECKING:
    MethodName = str
else:
    # The names of the modules in uwlts.stripe.methods, which are not imported for a command's help.
    _METHODS = Path(__file__).parents[1] / "stripe" / "methods"
    _NAMES = sorted(m.name.replace("_", "-") for m in pkgutil.iter_modules([str(_METHODS)]))
    MethodName = Literal[(*_NAMES, "learned")]
Method = Annotated[
    MethodName | None,
    Parameter(help="How the stripe's centre is found; learned needs --stripe model=FILE.onnx (docs: learned_stripe)."),
]
Index = Annotated[
    float | None, Parameter(help="Refractive index of the medium, in place of the one that follows from the captures.")
]
Workers = Annotated[
    int | None, Parameter(help="Processes that work at the same time; one for each processor unless given.")
]
Overwrite = Annotated[bool, Parameter(negative="", help="Replace existing files.")]
CalibrationOut = Annotated[Path, Parameter(help="Calibration file to write.")]


Stripe = Annotated[
    tuple[str, ...],
    Parameter(
        consume_multiple=True,
        negative="",
        show_default=False,
        help="Settings of how the stripe is found, such as half_window_px=32 threshold_sigmas=4, in place of those in "
        "the sensor's table [stripe] (docs: StripeOptions).",
    ),
]


def stripe_settings(stripe: Stripe, method: Method, peak: str | None = None) -> dict[str, object]:
    """Settings of finding stripes that were given on the command line."""
    from uwlts.errors import DescriptionError
    from uwlts.files.reading import parsed_json

    settings: dict[str, object] = {}
    for setting in stripe:
        name, equals, value = setting.partition("=")
        if not (name and equals and value):
            raise DescriptionError(f"--stripe {setting}: expected NAME=VALUE, such as half_window_px=32")
        try:
            settings[name] = parsed_json(value)
        except ValueError:
            settings[name] = value
    given: dict[str, object] = {"method": method, "peak": peak}
    return settings | {name: value for name, value in given.items() if value is not None}


def chosen_distortion(given: Coefficients) -> tuple[str, ...] | Literal["auto"]:
    """Coefficients to estimate that were given on the command line."""
    from uwlts.errors import DescriptionError

    if given == AUTO:
        return "auto"
    if "auto" in given or len(set(given)) < len(given):
        raise DescriptionError(f"--distortion {' '.join(given)}: expected auto alone, or each coefficient once")
    return given


def any_stage(progress: Callable[[int, int], None]) -> Callable[[str, int, int], None]:
    """The progress of all stages of a calculation, shown by one bar."""
    return lambda stage, done, total: progress(done, total)


def say(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)


def show(lines: Iterable[str]) -> None:
    """Print lines."""
    print("\n".join(lines))


def warn(*texts: str) -> None:
    """Print warnings on standard error."""
    for text in texts:
        print(f"warning: {text}", file=sys.stderr, flush=True)


def refuse_unsuitable_cloud(path: Path, *, overwrite: bool, coloured: bool = False) -> None:
    """Refuse a cloud that cannot be written; imported when it is needed, as the commands' help needs no NumPy."""
    from uwlts.storage import cloud_files

    cloud_files.refuse_unsuitable_cloud(path, overwrite=overwrite, coloured=coloured)
