"""Page of a camera calibration from photographs: lens models, images used, and pictures of rejected images."""

from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup

from uwlts.calibration.camera.camera_parameters import DISTORTION
from uwlts.calibration.camera.photographs import CameraCalibration, Photograph
from uwlts.errors import Error
from uwlts.pages.toolkit import (
    BLUE,
    MISSING,
    RED,
    figure_svg,
    new_figure,
    plain_text,
    png_data_uri,
    render_page,
    write_page as write_text,
)
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
        [each.name, str(each.parameters()), f"{each.rms_px:.4f}", "taken" if each.options == lens.options else ""]
        for each in lens.candidates
    ]
    text = render_page(
        "uwlts.report",
        "camera.html.j2",
        name=camera.folder.resolve().name,
        summary=_summary(camera),
        models=models,
        rows=rows,
        misses=_misses(camera),
        pictures=[
            (each.name, each.reason or "used", _thumbnail(camera, each)) for each in (left_out + used)[:_MOST_PICTURES]
        ],
    )
    write_text(path, text, overwrite=overwrite)


def camera_lines(camera: CameraCalibration) -> list[str]:
    """Return the result as lines of text."""
    taken = camera.lens.options
    models = [
        f"  {each.name:32} {each.rms_px:8.4f} px" + ("   taken" if each.options == taken else "")
        for each in camera.lens.candidates
    ]
    return _summary(camera) + (
        ["models, misses of images that each was not calibrated from:", *models] if models else []
    )


def _summary(camera: CameraCalibration) -> list[str]:
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


def _misses(camera: CameraCalibration) -> Markup:
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


def _thumbnail(camera: CameraCalibration, photograph: Photograph) -> str | None:
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
