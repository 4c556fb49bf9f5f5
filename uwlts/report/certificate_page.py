"""The certificate as a page to read and to print, its pictures, and its files."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from markupsafe import Markup

from uwlts.calibration.joint.observability import regions
from uwlts.calibration.joint.stored_estimate import require_joint
from uwlts.model.calibration import Calibration
from uwlts.model.errors import OutputError
from uwlts.model.joint_estimate import ImageFit
from uwlts.model.parameter_keys import ParameterKey
from uwlts.report.certificate import AnyCertificate, JointCertificate, ParameterRow, certificate_of, parameter_rows
from uwlts.report.certificate_volume import LengthUncertainty, change_from, form_of, in_use, require_same_sensor
from uwlts.report.numbers import fixed
from uwlts.report.page_toolkit import (
    COLOURS,
    INK,
    MISSING,
    json_beside,
    legend_below,
    new_figure,
    refuse_unsuitable_page,
    render_page,
    svg_of,
    write_page,
)
from uwlts.report.plot import DEVIATIONS
from uwlts.storage.calibration_file import read_calibration
from uwlts.storage.capture_sources import captures_in

_WORST_IMAGES = 5


def write_certificate(
    calibration: str | Path, *, out: str | Path | None = None, before: str | Path | None = None, overwrite: bool = False
) -> tuple[Path, AnyCertificate]:
    """Write the certificate of a calibration: a page to read and print, and the same beside it as sealed JSON.

    Parameters
    ----------
    calibration : str or Path
        Calibration file; only a joint calibration has uncertainties.
    out : str or Path, optional
        Page to write; CALIBRATION.certificate.html unless given. The JSON goes beside it.
    before : str or Path, optional
        Another calibration of the same sensor to set beside it.
    overwrite : bool
        Replace existing files.

    Returns
    -------
    (Path, JointCertificate or SequentialCertificate)
        The page and the content of both files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, cannot be written, or is the calibration itself.
    CaptureError
        A calibration cannot be read.
    CalibrationError
        The joint estimate is damaged, or the other calibration is of another sensor.
    """
    source = Path(calibration)
    page = Path(out or source.with_name(f"{source.stem}.certificate.html"))
    if source.resolve() in (json_beside(page).resolve(), page.resolve()):
        raise OutputError(f"the certificate's JSON beside {page} would replace the calibration; give another name")
    refuse_unsuitable_page(page, example="cert.html", overwrite=overwrite)
    known = read_calibration(source)
    content = certificate_of(known, source, issued=datetime.now(UTC).isoformat(timespec="seconds"))
    earlier = None if before is None else (Path(before).name, read_calibration(before))
    text = certificate_page(content, known, before=earlier)
    sealed = json.dumps(content.in_file(), indent=2, ensure_ascii=False) + "\n"
    write_page(page, text, beside=sealed, overwrite=overwrite)
    return page, content


def certificate_page(
    content: AnyCertificate, calibration: Calibration, *, before: tuple[str, Calibration] | None = None
) -> str:
    """The page as text; ``before`` is another calibration of the sensor with its name, set beside this one.

    Raises
    ------
    CalibrationError
        The joint estimate is damaged, or the other calibration is of another sensor.
    """
    if before is not None:
        require_same_sensor(calibration, before[1])
    return render_page(
        "uwlts.report",
        "certificate.html.j2",
        c=content,
        captures=captures_in(content.made_from),
        warnings=content.made_from.get("warnings", []),
        known_before=content.made_from.get("known_before", {}),
        parameters=_parameters(content.parameters, before),
        before=None if before is None else before[0],
        lengths=_length_rows(content.lengths) if isinstance(content, JointCertificate) else [],
        drawn=_pictures(content, calibration, before) if isinstance(content, JointCertificate) else _Pictures(),
    )


@dataclass(frozen=True)
class _Pictures:
    """Pictures of the page; ``worst`` are the images whose residuals lie farthest above their kind."""

    correlation: Markup | None = None
    residuals: Markup | None = None
    worst: tuple[ImageFit, ...] = ()
    lengths: Markup | None = None
    maps: tuple[Markup, ...] = ()
    changes: tuple[Markup, ...] = ()
    largest_change_um: float | None = None


def _pictures(content: JointCertificate, calibration: Calibration, before: tuple[str, Calibration] | None) -> _Pictures:
    joint = require_joint(calibration)
    fits = [image for image in content.images if image.rms_px is not None]
    fits.sort(key=lambda image: -(image.rms_px or 0.0) / content.scatter_px[image.kind])
    drawn = _Pictures(
        correlation=correlation_picture(joint.parameters, joint.covariance_matrix()),
        residuals=image_residuals(content.images) if content.images else None,
        worst=tuple(fits[:_WORST_IMAGES]),
    )
    if not content.lengths:
        return drawn
    region = regions(calibration)[0]
    form = form_of(in_use(calibration, region))
    maps = [
        heat_map(f"u({axis}), {what}", form.at_mm, 1e3 * values[..., place])
        for what, values in (("calibration", form.calibration_mm), ("single point", form.point_mm))
        for place, axis in ((1, "Y"), (2, "Z"), (0, "X"))
    ] + [
        heat_map(f"u of {form.short_mm:g} mm along {axis}", form.at_mm, 1e3 * values)
        for axis, values in (("Y", form.along_y_mm), ("Z", form.along_z_mm))
    ]
    drawn = replace(drawn, lengths=length_chart(content.lengths), maps=tuple(maps))
    if before is None:
        return drawn
    change = change_from(calibration, before[1], region)
    changes = [
        heat_map(f"change in {axis}", change.at_mm, 1e3 * change.moved_mm[..., place], signed=True)
        for place, axis in ((1, "Y"), (2, "Z"), (0, "X"))
    ]
    return replace(drawn, changes=tuple(changes), largest_change_um=1e3 * change.largest_mm)


def _parameters(
    rows: Sequence[ParameterRow], before: tuple[str, Calibration] | None
) -> list[tuple[str, str, str, str, str, str, str]]:
    """Words, unit, value, standard uncertainty, that before; value and uncertainty by the other calibration."""
    other = {} if before is None else {row.name: row for row in parameter_rows(before[1])}
    shown = [
        (row.words, row.unit, *_with_std(row), _number(row.std_before), *_with_std(other.get(row.name))) for row in rows
    ]
    mine = {row.name for row in rows}
    shown += [
        (row.words, row.unit, MISSING, MISSING, MISSING, *_with_std(row))
        for name, row in other.items()
        if name not in mine
    ]
    return shown


def _with_std(row: ParameterRow | None) -> tuple[str, str]:
    """A value with as many decimals as two digits of its uncertainty have, and that."""
    if row is None:
        return MISSING, MISSING
    if row.std is None or not row.std > 0:
        return f"{row.value:.6g}", MISSING
    decimals = max(0, 1 - math.floor(math.log10(row.std)))
    return fixed(row.value, decimals), fixed(row.std, decimals)


def _number(value: float | None) -> str:
    return MISSING if value is None else fixed(value, max(0, 1 - math.floor(math.log10(value))))


def _length_rows(lengths: Sequence[LengthUncertainty]) -> list[tuple[float, list[tuple[str, str]]]]:
    """Length, and for X, Y and Z its expanded uncertainties in µm; a dash where it does not fit."""
    table = {(row.length_mm, row.axis): row for row in lengths}
    rows = []
    for length in dict.fromkeys(sorted(row.length_mm for row in lengths)):
        found = [table.get((length, axis)) for axis in "XYZ"]
        rows.append(
            (
                length,
                [
                    (MISSING, MISSING)
                    if row is None
                    else (fixed(1e3 * row.calibration_mm, 1), fixed(1e3 * row.point_mm, 1))
                    for row in found
                ],
            )
        )
    return rows


def heat_map(title: str, at_mm: np.ndarray, values: np.ndarray, *, signed: bool = False) -> Markup:
    """Values (R, C) in µm over a mesh (R, C, 2) of Y and Z, the sensor being above; signed ones from blue to red."""
    size = np.ptp(at_mm.reshape(-1, 2), axis=0)
    figure, (ax,) = new_figure(3.7, float(np.clip(2.4 * size[1] / size[0], 1.5, 4.0)) + 0.8)
    limit = max(float(np.abs(values).max()), 1e-9)
    drawn = ax.pcolormesh(
        *np.moveaxis(at_mm, -1, 0),
        values,
        shading="gouraud",
        rasterized=True,
        cmap=DEVIATIONS if signed else "Blues",
        vmin=-limit if signed else 0,
        vmax=limit,
    )
    ax.set(title=title, xlabel="Y / mm", ylabel="Z / mm, away from the sensor", aspect="equal")
    ax.invert_yaxis()
    ax.grid(visible=False)
    figure.colorbar(drawn, label="µm")
    return svg_of(figure)


def correlation_picture(keys: Sequence[ParameterKey], covariance: np.ndarray) -> Markup:
    """The correlation matrix of parameters, coloured, with their names at the left and numbers above."""
    std = np.sqrt(np.diag(covariance))
    std = np.where(std > 0, std, 1.0)
    correlation = covariance / np.outer(std, std)
    count = len(keys)
    # A row of 0.24 inches holds its name in 8 points; names need some 3 inches at the left.
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
    return svg_of(figure)


def image_residuals(images: Sequence[ImageFit]) -> Markup:
    """Root mean square residual of every image, a panel for each kind and two of them in a row."""
    kinds = list(dict.fromkeys(image.kind for image in images))
    rows = math.ceil(len(kinds) / 2)
    figure, panels = new_figure(9.0, 2.7 * rows, rows=rows, columns=min(2, len(kinds)))
    for number, (ax, kind) in enumerate(zip(panels, kinds, strict=False)):
        rms = [image.rms_px for image in images if image.kind == kind]
        values = [np.nan if value is None else value for value in rms]
        ax.plot(range(1, len(values) + 1), values, "o", color=COLOURS[number % len(COLOURS)], markersize=4)
        ax.set(title=kind, xlabel="image", ylabel="residual (rms) / px")
        ax.set_ylim(bottom=0)
    for ax in panels[len(kinds) :]:
        ax.set_axis_off()
    return svg_of(figure)


def length_chart(lengths: Sequence[LengthUncertainty]) -> Markup:
    """Expanded uncertainty over length, for each axis."""
    figure, panels = new_figure(9.0, 3.2, columns=2)
    for ax, title, name in zip(
        panels, ("surfaces: the calibration alone", "single points"), ("calibration_mm", "point_mm"), strict=True
    ):
        for number, axis in enumerate("XYZ"):
            known = [each for each in lengths if each.axis == axis]
            y = [1e3 * getattr(each, name) for each in known]
            if known:
                ax.plot([each.length_mm for each in known], y, "o-", color=COLOURS[number], label=f"along {axis}")
        ax.set(title=title, xlabel="length / mm", ylabel="expanded uncertainty (k = 2) / µm")
        ax.set_ylim(bottom=0)
    legend_below(figure)
    return svg_of(figure)
