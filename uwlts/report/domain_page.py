"""Page of a domain gap: tables, distributions of all statistics, and pieces of the images."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwlts.files.json_files import json_text
from uwlts.pages.toolkit import (
    BLUE,
    RED,
    figure_svg,
    new_figure,
    plain_text,
    png_data_uri,
    refuse_unsuitable_page,
    render_page,
    write_page,
)
from uwlts.radiometry.domain_gap import DomainGap, measure_domain_gap
from uwlts.radiometry.stripe_windows import STATISTICS
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.stripe import StripeSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 8  # pictures of each set
_GAMMA = 0.5  # exponent of the displayed brightness, which makes a halo visible


def write_domain_gap(
    generated: Sequence[str | Path] = (),
    *,
    real: Sequence[str | Path] = (),
    out: str | Path,
    most_images: int = 200,
    title: str = "Generated and real stripes",
    stripe: StripeSettings = None,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> DomainGap:
    """Compare the stripe in generated and real images by its statistics, and measure the domain gap.

    Sets of images are folders of data sets, captures (.h5), folders of image files, image files, or quoted patterns
    such as "bust/laser_*.png". Statistics are of windows of 64 profile lines of a stripe without a jump. The gap is the
    energy coefficient of inhomogeneity of their distributions: 0 if they are equal, at most 1. The page also has the
    gaps between random halves of each real set, as the least value that means anything, and between the real sets.

    Parameters
    ----------
    generated : sequence of paths
        Sets of rendered images.
    real : sequence of paths
        Sets of real images.
    out : str or Path
        Page to write; all figures go into a JSON file of the same name.
    most_images : int
        Largest number of images of each set, evenly chosen.
    title : str
        Title of the page.
    stripe : StripeOptions or dict, optional
        Options for finding the stripe, all or some: see `uwlts.StripeOptions`.
    overwrite : bool
        Replace existing files.
    progress : callable, optional
        Called after each set with the number of sets done and the total number.

    Returns
    -------
    DomainGap
        Statistics of all windows, gaps, and the fractions of real windows that generated ones cover.

    Raises
    ------
    CaptureError, ImageError
        A set cannot be read, shows no stripe, or too little of it.
    DescriptionError, RangeError
        No set is given, a setting of the stripe is unknown, or a number is out of range.
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    refuse_unsuitable_page(Path(out), overwrite=overwrite)
    found = measure_domain_gap(generated, real=real, most_images=most_images, stripe=stripe, progress=progress)
    text = render_page(
        "uwlts.report",
        "domain.html.j2",
        title=title,
        gaps=found.gap_table() if found.real else None,
        covered=found.covered_table() if found.real and found.generated else None,
        statistics=found.statistics_table(),
        definitions=[(each.name, each.unit or "1", each.meaning) for each in STATISTICS],
        distributions=figure_svg(_draw_distributions(found)),
        pictures=_draw_pictures(found),
    )
    write_page(out, text, beside=json_text(found.record()), overwrite=overwrite)
    return found


def _draw_distributions(found: DomainGap) -> "Figure":
    """Draw 5 %, quartiles and 95 % of all statistics: generated sets in blue, real ones in red."""
    sets, rows = found.sets(), -(-len(STATISTICS) // 3)
    figure, axes = new_figure(11.0, rows * (0.8 + 0.2 * len(sets)), rows=rows, columns=3)
    for k, (axis, each) in enumerate(zip(axes, STATISTICS, strict=False)):
        boxes = axis.boxplot(
            [own.values[:, k] for own in sets], whis=(5, 95), showfliers=False, orientation="horizontal", widths=0.6
        )
        for number, own in enumerate(sets):
            colour = RED if own in found.real else BLUE
            parts = [boxes["boxes"][number], boxes["medians"][number]]
            parts += boxes["whiskers"][2 * number : 2 * number + 2] + boxes["caps"][2 * number : 2 * number + 2]
            for part in parts:
                part.set_color(colour)
        labels = [plain_text(own.name) for own in sets] if k % 3 == 0 else [""] * len(sets)
        axis.set_yticks(range(1, len(sets) + 1), labels)
        axis.invert_yaxis()
        axis.set_xlabel(f"{each.name} / {each.unit}" if each.unit else each.name)
    for axis in axes[len(STATISTICS) :]:
        axis.set_axis_off()
    return figure


def _draw_pictures(found: DomainGap) -> str:
    """Draw windows of all sets, one row for each set."""
    sets = found.sets()
    figure, axes = new_figure(11.0, 2.3 * len(sets), rows=len(sets), columns=_SHOWN)
    for row, own in enumerate(sets):
        chosen = np.unique(np.linspace(0, len(own.pictures) - 1, _SHOWN).astype(int))
        cells = axes[row * _SHOWN : (row + 1) * _SHOWN]
        for cell in cells:
            cell.set_axis_off()
        for cell, number in zip(cells, chosen.tolist(), strict=False):
            cell.imshow(np.clip(own.pictures[number], 0, 1) ** _GAMMA, cmap="gray", vmin=0, vmax=1)
        cells[0].set_title(plain_text(own.name), loc="left")
    return png_data_uri(figure, dpi=110)
