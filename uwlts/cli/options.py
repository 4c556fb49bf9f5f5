"""The ``uwlts`` command line itself, and the options that several commands have beside their functions' own."""

import pkgutil
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from uwlts._version import __version__
from uwlts.files.writing import refuse_unsuitable
from uwlts.runtime.command_line import Before, Shortcuts, show, warn

if TYPE_CHECKING:
    from uwlts.storage.cloud import PointCloud

app = App(
    name="uwlts",
    help="Software of an underwater laser triangulation sensor.",
    version=__version__,
    help_format="markdown",
)

if TYPE_CHECKING:
    MethodName = str
else:
    # The names of the modules in uwlts.stripe.methods, which are not imported for a command's help.
    _METHODS = Path(__file__).parents[1] / "stripe" / "methods"
    _NAMES = sorted(m.name.replace("_", "-") for m in pkgutil.iter_modules([str(_METHODS)]))
    MethodName = Literal[(*_NAMES, "learned")]

STRIPE = Shortcuts(
    "stripe",
    {
        "method": Annotated[
            MethodName | None,
            Parameter(
                help="How the stripe's centre is found; learned needs --stripe model=FILE.onnx (docs: learned_stripe)."
            ),
        ],
        "peak": Annotated[
            Literal["direct", "strongest", "first", "last"] | None,
            Parameter(help="Which of several stripes on a line counts; the direct one, or as the sensor's table says."),
        ],
    },
)
"""Options for single entries of ``--stripe``."""


def a_cloud(path: Path, *, overwrite: bool, coloured: bool = False) -> None:
    """Refuse a cloud that cannot be written; imported when it is needed, as the commands' help needs no NumPy."""
    from uwlts.storage import cloud_files

    cloud_files.refuse_unsuitable_cloud(path, overwrite=overwrite, coloured=coloured)


def a_page(kind: str = "") -> Before:
    """Check of a page, and of the JSON beside it."""

    def check(path: Path, *, overwrite: bool) -> None:
        from uwlts.pages.toolkit import refuse_unsuitable_page

        refuse_unsuitable_page(path, kind=kind, overwrite=overwrite)

    return Before(check)


def a_file(*endings: str, beside: str = "") -> Before:
    """Check of a file whose name has one of some endings, and of one that gets another ending beside it."""

    def check(path: Path, *, overwrite: bool) -> None:
        refuse_unsuitable(path, overwrite=overwrite, endings=endings)
        if beside:
            refuse_unsuitable(path.with_suffix(beside), overwrite=overwrite)

    return Before(check)


Overwrite = Annotated[bool, Parameter(negative="", help="Replace existing files.")]
CalibrationOut = Annotated[Path, a_file(".json"), Parameter(help="Calibration to write (JSON).")]
ColouredOut = Annotated[
    Path | None,
    Before(partial(a_cloud, coloured=True)),
    Parameter(
        help="Also write the cloud coloured by the deviation of every point from the surface, with these in mm, to "
        "this PLY, LAZ, LAS, E57 or HDF5 file."
    ),
]


def write_coloured(path: Path, cloud: "PointCloud", limit_mm: Callable[..., float], *, overwrite: bool) -> None:
    """Write a cloud with its deviations in the colours of the pages, which end at a limit."""
    import numpy as np

    from uwlts.report.plot import deviation_colours
    from uwlts.storage.cloud_files import write_cloud

    deviation = np.full(len(cloud), np.nan) if cloud.deviation_mm is None else cloud.deviation_mm
    limit = limit_mm(deviation) if np.isfinite(deviation).any() else 1.0
    write_cloud(path, cloud, overwrite=overwrite, colours=deviation_colours(deviation, limit))


def wrote(lines: Iterable[str], warnings: Iterable[str], *paths: Path | None) -> None:
    """Print a result, warnings about it, and the files it was written to."""
    show(lines)
    warn(*warnings)
    wrote_files(*paths)


def wrote_files(*paths: Path | None) -> None:
    """Print the files that a result was written to."""
    print(f"wrote {', '.join(str(path) for path in paths if path is not None)}")


def wrote_page(page: Path) -> None:
    """Print a page and the JSON beside it that a result was written to."""
    print(f"wrote {page} and {page.with_suffix('.json').name}")
