"""The ``uwlts`` command line itself, and what its commands share."""

import pkgutil
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

import uwlts

app = App(
    name="uwlts",
    help="Software of an underwater laser triangulation sensor.",
    version=uwlts.__version__,
    help_format="plaintext",
)

Flag = Annotated[bool, Parameter(negative="")]
Files = Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="")]
Coefficients = Annotated[
    tuple[Literal["k1", "k2", "p1", "p2", "k3"], ...], Parameter(consume_multiple=True, negative="")
]
if TYPE_CHECKING:
    MethodName = str
else:
    # The names of the modules in uwlts.stripe.methods, which are not imported for a command's help.
    _METHODS = Path(uwlts.__file__).parent / "stripe" / "methods"
    MethodName = Literal[tuple(sorted(m.name.replace("_", "-") for m in pkgutil.iter_modules([str(_METHODS)])))]
Method = Annotated[MethodName | None, Parameter(help="How the stripe's centre is found.")]
Index = Annotated[
    float | None, Parameter(help="Refractive index of the medium, in place of the one that follows from the captures.")
]
Workers = Annotated[
    int | None, Parameter(help="Processes that work at the same time; one for each processor unless given.")
]
Overwrite = Annotated[bool, Parameter(negative="", help="Replace existing files.")]
CalibrationOut = Annotated[Path, Parameter(help="Calibration file to write.")]


def stripe_options(method: Method, peak: Literal["strongest", "first", "last"] = "strongest") -> "uwlts.StripeOptions":
    """Options of finding stripes, with the default method unless one is given."""
    from uwlts.stripe import PeakRule

    options = uwlts.StripeOptions
    return options(method=method or options.method, peak=PeakRule(peak))


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
