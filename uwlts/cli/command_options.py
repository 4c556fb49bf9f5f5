"""The ``uwlts`` command line, and options that several commands have in addition to their functions'."""

import pkgutil
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from uwlts.files.writing import refuse_unsuitable
from uwlts.runtime.command_line import Before, Shortcuts, make_program, say, show, warn

if TYPE_CHECKING:
    from uwlts.storage.cloud import PointCloud

app = make_program("uwlts", "Software of an underwater laser triangulation sensor.")

if TYPE_CHECKING:
    MethodName = str
else:
    # Names of the modules in uwlts.stripe.methods, which are not imported for a command's help.
    _METHODS = Path(__file__).parents[1] / "stripe" / "methods"
    _NAMES = sorted(m.name.replace("_", "-") for m in pkgutil.iter_modules([str(_METHODS)]))
    MethodName = Literal[*_NAMES]

STRIPE = Shortcuts(
    "stripe",
    {
        "method": Annotated[MethodName | None, Parameter(help="Method for the stripe's centre.")],
        "peak": Annotated[
            Literal["direct", "strongest", "first", "last"] | None,
            Parameter(
                help="Which of several stripes on a line counts; by default that of the sensor's table, or direct."
            ),
        ],
    },
)
"""Options for single entries of ``--stripe``."""


def a_cloud(path: Path, *, overwrite: bool, coloured: bool = False) -> None:
    """Refuse a cloud that cannot be written; imports its module on use, because the help needs no NumPy."""
    from uwlts.storage import cloud_files

    cloud_files.refuse_unsuitable_cloud(path, overwrite=overwrite, coloured=coloured)


def a_page(kind: str = "") -> Before:
    """Return the check of a page, and of the JSON beside it."""

    def check(path: Path, *, overwrite: bool) -> None:
        from uwlts.pages.toolkit import refuse_unsuitable_page

        refuse_unsuitable_page(path, kind=kind, overwrite=overwrite)

    return Before(check)


def a_file(*endings: str, beside: str = "") -> Before:
    """Return the check of a file with one of some endings, and of the file with another ending beside it."""

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
        help="Also write the cloud coloured by the deviation of every point from the surface, with deviations in mm, "
        "to this PLY, LAZ, LAS, E57 or HDF5 file."
    ),
]


def write_coloured(path: Path, cloud: "PointCloud", limit_mm: Callable[..., float], *, overwrite: bool) -> None:
    """Write a cloud with its deviations in the colours of the pages, limited to a range."""
    import numpy as np

    from uwlts.report.plot import deviation_colours
    from uwlts.storage.cloud_files import write_cloud

    deviation = np.full(len(cloud), np.nan) if cloud.deviation_mm is None else cloud.deviation_mm
    limit = limit_mm(deviation) if np.isfinite(deviation).any() else 1.0
    write_cloud(path, cloud, overwrite=overwrite, colours=deviation_colours(deviation, limit))


def wrote(lines: Iterable[str], warnings: Iterable[str], *paths: Path | None) -> None:
    """Print a result, its warnings, and the files written."""
    show(lines)
    warn(*warnings)
    wrote_files(*paths)


def wrote_files(*paths: Path | None) -> None:
    """Print the files written for a result, if any."""
    if written := ", ".join(str(path) for path in paths if path is not None):
        say(f"wrote {written}")


def cloud_written(path: Path, points: int) -> str:
    """Return the line on a written cloud, with its unit."""
    from uwlts.storage.cloud_files import unit_of

    return f"wrote {path} with {points} points in {unit_of(path)}"


def note_lean(path: Path, cloud: "PointCloud") -> None:
    """Say so if the file holds less of the uncertainty than the cloud."""
    from uwlts.storage.cloud_files import FULL, is_lean

    if cloud.uncertainty is not None and is_lean(path):
        say(
            f"{path.name} has the standard deviation along the normal, for other programs; NAME.h5 or NAME{FULL} have "
            "the whole uncertainty, which measuring needs"
        )


def wrote_page(page: Path) -> None:
    """Print the page written for a result, and the JSON beside it."""
    say(f"wrote {page} and {page.with_suffix('.json').name}")
