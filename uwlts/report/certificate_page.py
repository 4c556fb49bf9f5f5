"""Certificate page for reading and printing, with its charts, and the certificate's files."""

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from uwlts.calibration.joint.calibrated_volume import (
    LengthUncertainty,
    compare_calibrations,
    prepare_use,
    require_same_sensor,
    uncertainty_maps,
)
from uwlts.calibration.joint.observability import list_regions
from uwlts.calibration.joint.stored_estimate import require_joint
from uwlts.model.calibration import Calibration
from uwlts.model.joint_estimate import ImageFit, Origin
from uwlts.model.parameter_keys import ParameterKey
from uwlts.pages.toolkit import (
    COLOURS,
    INK,
    MISSING,
    figure_svg,
    format_fixed,
    format_to_scale,
    legend_below,
    new_figure,
    refuse_unsuitable_page,
    render_page,
    write_page,
)
from uwlts.report.certificate import Certificate, ParameterRow, make_certificate, parameter_rows
from uwlts.report.plot import DEVIATIONS
from uwlts.storage.calibration_file import read_calibration

_WORST_IMAGES = 5  # listed


def write_certificate(
    calibration: str | Path, *, out: str | Path | None = None, before: str | Path | None = None, overwrite: bool = False
) -> tuple[Path, Certificate]:
    """Write the certificate of a calibration: a page to read and print, and its content as sealed JSON.

    Parameters
    ----------
    calibration : str or Path
        File of a joint calibration.
    out : str or Path, optional
        Page to write (default: CALIBRATION.certificate.html). The JSON is written beside it.
    before : str or Path, optional
        Another calibration of the same sensor to compare with.
    overwrite : bool
        Replace existing files.

    Returns
    -------
    (Path, Certificate)
        The page and the content of both files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, cannot be written, or is one of the calibrations.
    CaptureError
        A calibration cannot be read.
    CalibrationError
        The calibration is not a joint one, its estimate is damaged, or the other calibration is of another sensor.
    """
    source = Path(calibration)
    page = Path(out or source.with_name(f"{source.stem}.certificate.html"))
    refuse_unsuitable_page(page, overwrite=overwrite)
    known = read_calibration(source)
    content = make_certificate(known, source, issued=datetime.now(UTC).isoformat(timespec="seconds"))
    earlier = None if before is None else (Path(before).name, read_calibration(before))
    text = certificate_page(content, known, before=earlier)
    sealed = json.dumps(content.in_file(), indent=2, ensure_ascii=False) + "\n"
    write_page(page, text, beside=sealed, overwrite=overwrite)
    return page, content


def certificate_page(
    content: Certificate, calibration: Calibration, *, before: tuple[str, Calibration] | None = None
) -> str:
    """Return the page as text; ``before`` is the name and content of another calibration of the sensor to compare with.

    CalibrationError if the joint estimate is damaged, or the other calibration is of another sensor.
    """
    if before is not None:
        require_same_sensor(calibration, before[1])
    return render_page(
        "uwlts.report",
        "certificate.html.j2",
        c=content,
        captures=[source.in_file() for source in Origin.model_validate(content.made_from).captures()],
        warnings=content.made_from.get("warnings", []),
        known_before=content.made_from.get("known_before", {}),
        parameters=_list_parameters(content.parameters, before),
        before=None if before is None else before[0],
        lengths=_list_lengths(content.lengths),
        drawn=_draw(content, calibration, before),
    )


def _draw(content: Certificate, calibration: Calibration, before: tuple[str, Calibration] | None) -> dict[str, Any]:
    """Return the charts of the page by name.

    ``worst`` are the images with the largest residuals relative to their kind.
    """
    joint = require_joint(calibration)
    fits = [image for image in content.images if image.rms_px is not None]
    fits.sort(key=lambda image: -(image.rms_px or 0.0) / content.scatter_px[image.kind])
    drawn: dict[str, Any] = {
        "correlation": correlation_picture(joint.parameters, joint.covariance_matrix()),
        "residuals": image_residuals(content.images) if content.images else None,
        "worst": fits[:_WORST_IMAGES],
    }
    if not content.lengths:
        return drawn
    region = list_regions(calibration)[0]
    mesh, maps = uncertainty_maps(prepare_use(calibration, region))
    drawn["lengths"] = length_chart(content.lengths)
    drawn["maps"] = [heat_map(title, mesh, 1e3 * values) for title, values in maps.items()]
    if before is not None:
        change = compare_calibrations(calibration, before[1], region)
        drawn["largest_change_um"] = 1e3 * change.largest_mm
        drawn["changes"] = [
            heat_map(f"change in {axis}", change.at_mm, 1e3 * change.moved_mm[..., "XYZ".index(axis)], signed=True)
            for axis in "YZX"
        ]
    return drawn


def _list_parameters(rows: Sequence[ParameterRow], before: tuple[str, Calibration] | None) -> list[tuple[str, ...]]:
    """Return words, unit, value, standard and prior uncertainty, then both values of the other calibration."""
    other = {} if before is None else {row.name: row for row in parameter_rows(before[1])}
    shown = []
    for row in rows:
        known = MISSING if row.std_before is None else format_to_scale(row.std_before, row.std_before)
        theirs = other.pop(row.name, None)
        shown.append((row.words, row.unit, *row.texts(), known, *(theirs.texts() if theirs else (MISSING, MISSING))))
    return shown + [(row.words, row.unit, MISSING, MISSING, MISSING, *row.texts()) for row in other.values()]


def _list_lengths(lengths: Sequence[LengthUncertainty]) -> list[tuple[float, list[tuple[str, str]]]]:
    """Return lengths with expanded uncertainties in µm along X, Y and Z; a dash if the length does not fit."""
    table = {
        (r.length_mm, r.axis): (format_fixed(1e3 * r.calibration_mm, 1), format_fixed(1e3 * r.point_mm, 1))
        for r in lengths
    }
    return [
        (length, [table.get((length, axis), (MISSING, MISSING)) for axis in "XYZ"])
        for length in sorted({row.length_mm for row in lengths})
    ]


def heat_map(title: str, at_mm: np.ndarray, values: np.ndarray, *, signed: bool = False) -> Markup:
    """Draw values (R, C) in µm over a mesh (R, C, 2) of Y and Z, with the sensor on top.

    Signed values are drawn from blue to red.
    """
    size = np.ptp(at_mm.reshape(-1, 2), axis=0)
    figure, (ax,) = new_figure(3.7, float(np.clip(2.4 * size[1] / size[0], 1.5, 4.0)) + 0.8)
    limit = max(float(np.abs(values).max()), 1e-9)
    colours: dict[str, Any] = {"cmap": DEVIATIONS, "vmin": -limit} if signed else {"cmap": "Blues", "vmin": 0}
    y, z = np.moveaxis(at_mm, -1, 0)
    drawn = ax.pcolormesh(y, z, values, shading="gouraud", rasterized=True, vmax=limit, **colours)
    ax.set(title=title, xlabel="Y / mm", ylabel="Z / mm, away from the sensor", aspect="equal")
    ax.invert_yaxis()
    ax.grid(visible=False)
    figure.colorbar(drawn, label="µm")
    return figure_svg(figure)


def correlation_picture(keys: Sequence[ParameterKey], covariance: np.ndarray) -> Markup:
    """Draw the correlation matrix of parameters, with names on the left and numbers on top."""
    std = np.sqrt(np.diag(covariance))
    std = np.where(std > 0, std, 1.0)
    correlation = covariance / np.outer(std, std)
    count = len(keys)
    # A row of 0.24 inches holds an 8-point name; names need about 3 inches on the left.
    figure, (ax,) = new_figure(3.0 + 0.24 * count, 0.5 + 0.24 * count)
    ax.imshow(correlation, cmap=DEVIATIONS, vmin=-1, vmax=1)
    for row, column in np.argwhere(np.abs(correlation) >= 0.5):
        size = abs(correlation[row, column])
        if row != column:
            text = f"{size:.2f}"[1:] if size < 0.995 else "1"
            ax.text(column, row, text, ha="center", va="center", fontsize=6.5, color="white" if size > 0.7 else INK)
    ax.set_yticks(range(count), [f"{key.quantity.words}  {number}" for number, key in enumerate(keys, 1)], fontsize=8)
    ax.set_xticks(range(count), [str(number + 1) for number in range(count)], fontsize=8)
    ax.tick_params(length=0, labeltop=True, labelbottom=False)
    ax.set_xticks(np.arange(count + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(count + 1) - 0.5, minor=True)
    ax.grid(visible=False, which="major")
    ax.grid(color="white", which="minor")
    ax.tick_params(which="minor", length=0)
    ax.spines[:].set_visible(False)
    return figure_svg(figure)


def image_residuals(images: Sequence[ImageFit]) -> Markup:
    """Draw the rms residual of every image, one panel per kind and two panels per row."""
    kinds = list(dict.fromkeys(image.kind for image in images))
    rows = math.ceil(len(kinds) / 2)
    figure, panels = new_figure(9.0, 2.7 * rows, rows=rows, columns=min(2, len(kinds)))
    for colour, ax, kind in zip(cycle(COLOURS), panels, kinds, strict=False):
        rms = [image.rms_px for image in images if image.kind == kind]
        values = [np.nan if value is None else value for value in rms]
        ax.plot(range(1, len(values) + 1), values, "o", color=colour, markersize=4)
        ax.set(title=kind, xlabel="image", ylabel="residual (rms) / px")
        ax.set_ylim(bottom=0)
    for ax in panels[len(kinds) :]:
        ax.set_axis_off()
    return figure_svg(figure)


def length_chart(lengths: Sequence[LengthUncertainty]) -> Markup:
    """Draw the expanded uncertainty over length, for each axis."""
    figure, panels = new_figure(9.0, 3.2, columns=2)
    shown = {"surfaces: the calibration alone": "calibration_mm", "single points": "point_mm"}
    for ax, (title, name) in zip(panels, shown.items(), strict=True):
        for colour, axis in zip(COLOURS, "XYZ", strict=False):
            along = {each.length_mm: 1e3 * getattr(each, name) for each in lengths if each.axis == axis}
            if along:
                ax.plot(list(along), list(along.values()), "o-", color=colour, label=f"along {axis}")
        ax.set(title=title, xlabel="length / mm", ylabel="expanded uncertainty (k = 2) / µm")
        ax.set_ylim(bottom=0)
    legend_below(figure)
    return figure_svg(figure)
