"""The ``uwlts`` command line itself, and what its commands share."""

import pkgutil
import sys
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
    Method = str
else:
    # The names of the modules in uwlts.stripe.methods, which are not imported for a command's help.
    _METHODS = Path(uwlts.__file__).parent / "stripe" / "methods"
    Method = Literal[tuple(sorted(m.name.replace("_", "-") for m in pkgutil.iter_modules([str(_METHODS)])))]


def warn(text: str) -> None:
    """Print a warning on standard error."""
    print(f"warning: {text}", file=sys.stderr, flush=True)
