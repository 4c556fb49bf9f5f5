"""Pages of a camera calibration from photographs, and of a recalibration by passes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup

from uwlts.calibration.camera.camera_parameters import DISTORTION
from uwlts.calibration.camera.photographs import CameraCalibration, Photograph
from uwlts.errors import Error
from uwlts.files.json_files import json_text
from uwlts.pages.toolkit import (
    BLUE,
    MISSING,
    RED,
    Tile,
    figure_svg,
    new_figure,
    plain_text,
    png_data_uri,
    render_page,
    write_page,
)
from uwlts.recalibration.recalibrate import ParameterChange, Recalibrated, SurfaceParts
from uwlts.report.change_page import draw_views
from uwlts.report.plot import surface_limit_mm
from uwlts.storage.image_file import read_image

_THUMBNAIL_PX = 420  # width of pictures on the page
_MOST_PICTURES = 12  # those left out come first
_ARROWS_PX = 0.02  # length of the rms arrow, relative to the image width


def write_camera(path: str | Path, camera: CameraCalibration, *, overwrite: bool = False) -> None:
    """Write the page of a camera calibration.

    Parameters
    ----------
    path : str or Path
        Page to write.
    camera : CameraCalibration
        Result of `uwlts.calibrate_camera`.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    lens = camera.lens
    left_out = [each for each in camera.photographs if each.reason is not None]
    used = sorted(_select_used(camera), key=Photograph.rms_px, reverse=True)
    rows = [
        [each.name, "used", str(len(each.pixels)), f"{each.rms_px():.3f}", f"{each.moved:.1f}"]
        if each.reason is None
        else [each.name, each.reason, str(len(each.pixels)), MISSING, MISSING]
        for each in camera.photographs
    ]
    models = [
        [
            each.options.name,
            str(each.parameters()),
            f"{each.rms_px:.4f}",
            "taken" if each.options == lens.options else "",
        ]
        for each in lens.candidates
    ]
    text = render_page(
        "uwlts.report",
        "camera.html.j2",
        name=camera.folder.resolve().name,
        summary=_summarise(camera),
        models=models,
        rows=rows,
        misses=_plot_residuals(camera),
        pictures=[
            (each.name, each.reason or "used", _brighten(camera, each)) for each in (left_out + used)[:_MOST_PICTURES]
        ],
    )
    write_page(path, text, overwrite=overwrite)


def camera_lines(camera: CameraCalibration) -> list[str]:
    """Return the result as lines of text."""
    taken = camera.lens.options
    models = [
        f"  {each.options.name:32} {each.rms_px:8.4f} px" + ("   taken" if each.options == taken else "")
        for each in camera.lens.candidates
    ]
    return _summarise(camera) + (
        ["models, misses of images that each was not calibrated from:", *models] if models else []
    )


def _summarise(camera: CameraCalibration) -> list[str]:
    """Return images used, residuals, and the parameters with their standard uncertainties, as lines of text."""
    lens = camera.lens
    lines = [
        f"{len(lens.used)} of {len(camera.photographs)} images used, {lens.solution.rms_px():.3f} px rms",
        f"{100 * lens.rejected_share:.1f} % of their points left out as outliers",
    ]
    std, halves = lens.std(), lens.half_values()
    for name, value in lens.values().items():
        digits, unit = (6, "") if name in DISTORTION else (3, " px")
        by_half = " and ".join(f"{half[name]:.{digits}f}" for half in halves)
        lines.append(
            f"{name} = {value:.{digits}f} +- {std[name]:.{digits}f}{unit}"
            + (f" (by every second image and by the others {by_half})" if halves else "")
        )
    return lines


def _select_used(camera: CameraCalibration) -> list[Photograph]:
    return [each for each in camera.photographs if each.reason is None]


def _plot_residuals(camera: CameraCalibration) -> Markup:
    """Plot the residuals of all points over the image, magnified, and the rms of each image."""
    model = camera.lens.solution.model
    used = _select_used(camera)
    places = np.vstack([each.pixels for each in used])
    misses = np.vstack([each.misses_px for each in used])
    usual = float(np.sqrt(np.mean(np.sum(misses**2, axis=1))))
    figure, (over, each_image) = new_figure(10.5, 4.4, columns=2)
    scale = usual / (_ARROWS_PX * model.width_px)
    arrows = over.quiver(*places.T, *misses.T, angles="xy", scale_units="xy", scale=scale, width=0.002, color=BLUE)
    over.quiverkey(arrows, 0.88, 1.04, usual, f"{usual:.2g} px", labelpos="E")
    over.set(xlim=(0, model.width_px), ylim=(model.height_px, 0), aspect="equal", xlabel="u / px", ylabel="v / px")
    over.set_title("found minus calculated")
    each_image.barh(range(len(used)), [each.rms_px() for each in used], color=BLUE)
    each_image.set_yticks(range(len(used)), [plain_text(Path(each.name).stem) for each in used], fontsize=7)
    each_image.invert_yaxis()
    each_image.set(xlabel="rms distance / px", title="by image")
    return figure_svg(figure)


def _brighten(camera: CameraCalibration, photograph: Photograph) -> str | None:
    """Return the image, brightened, with the points found; None if it cannot be read."""
    try:
        image = read_image(camera.folder / photograph.name)
    except Error:
        return None
    grey = image if image.ndim == 2 else image.max(axis=2)
    factor = min(1.0, _THUMBNAIL_PX / grey.shape[1])
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA).astype(np.float32)
    low, high = np.percentile(small, [1, 98])
    bright = np.clip((small - low) / max(high - low, 1.0), 0, 1) ** 0.6 * 255
    drawn = cv2.cvtColor(bright.astype(np.uint8), cv2.COLOR_GRAY2BGR)
    colour = tuple(int(RED[place : place + 2], 16) for place in (5, 3, 1))
    for u, v in (photograph.pixels + 0.5) * factor - 0.5:
        cv2.circle(drawn, (round(float(u)), round(float(v))), 3, colour, 1, cv2.LINE_AA)
    return png_data_uri(cv2.imencode(".png", drawn)[1].tobytes())


RECALIBRATION = "recalibration"
"""Kind of the page, in the name of its JSON file."""


def write_recalibration(path: str | Path, found: Recalibrated, *, overwrite: bool = False) -> None:
    """Write the page of a recalibration, and its figures, advice and doubts as JSON beside it.

    Parameters
    ----------
    path : str or Path
        Page to write; for pipe.html, the figures go into pipe.recalibration.json.
    found : Recalibrated
        Result of `uwlts.recalibrate`.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    count, most = len(found.passes), surface_limit_mm(found.parts_before.apart_mm)
    text = render_page(
        "uwlts.report",
        "recalibration.html.j2",
        title="Recalibration by passes",
        passes=", ".join(found.passes),
        lengths=[
            Tile(f"100 mm along {each.axis}", f"+-{each.after_mm:.3f} mm", f"before: +-{each.before_mm:.3f} mm")
            for each in found.lengths
        ],
        doubts=found.doubts,
        warnings=found.warnings,
        parameters=list(map(_show_parameter, sorted(found.parameters, key=lambda each: each.std / each.std_before))),
        mount=found.mount.lines() if found.mount else [],
        next_passes=[
            (each.candidate.words, f"{each.before:.3f}", f"{each.after:.3f}")
            for each in found.next_passes[:6]
            if each.after < each.before
        ],
        overlap=_draw_parts(found.parts, found.parts.passes, "passes", most=count, ticks=range(1, count + 1)),
        before=_draw_parts(found.parts_before, found.parts_before.apart_mm, "distance / mm", most=most),
        after=_draw_parts(found.parts, found.parts.apart_mm, "distance / mm", most=most),
        spread=f"{found.spread:.2f}",
    )
    write_page(path, text, beside=json_text(found.record()), kind=RECALIBRATION, overwrite=overwrite)


def _show_parameter(change: ParameterChange) -> tuple[str, ...]:
    label = change.key.quantity
    after = label.format_with_std(change.after, change.std) if change.determined else "not determined"
    left = f"{100 * change.std / change.std_before:.0f} %"
    return label.words, label.format_with_std(change.before, change.std_before), after, left


def _draw_parts(
    parts: SurfaceParts, values: np.ndarray, label: str, *, most: float, ticks: Sequence[int] | None = None
) -> str:
    """Draw values (C,) of the parts in three views, with colours up to ``most``."""
    known: dict[str, Any] = {"c": values, "cmap": "viridis", "vmin": 0.0, "vmax": most, "linewidths": 0}

    def draw(axes: Any, first: int, second: int) -> Any:
        return axes.scatter(parts.middle_mm[:, first], parts.middle_mm[:, second], s=14, **known)

    return draw_views(draw, label=label, ticks=ticks)
