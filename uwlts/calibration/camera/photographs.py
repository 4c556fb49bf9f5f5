"""Camera calibration from a folder of photographs of a target, without a laser."""

from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from uwlts.argument_types import check_arguments
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.camera.lens import (
    WIDE_DEG,
    Distortion,
    LensCalibration,
    LensChoice,
    Pixels,
    calibrate_lens,
    require_coefficients,
)
from uwlts.errors import CalibrationError, DescriptionError, ImageError, TargetError
from uwlts.files.reading import is_regular_file
from uwlts.files.writing import write_file
from uwlts.model.library import read_table
from uwlts.model.short_text import Brief
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.folder_description import NAME as DESCRIPTION_NAME
from uwlts.storage.import_.grey_values import check_channel, extract_channel
from uwlts.storage.import_.matching import image_files
from uwlts.targets import Target, parse_target

TARGET_NAME = "target.toml"
"""Name of the target's description in the folder of photographs."""
_FEWEST_IMAGES = 4  # three determine a lens, the fourth checks it


@dataclass(frozen=True, eq=False)
class Photograph:
    """Image file with the detected target points (N, 2), or the reason why it was rejected.

    For used images, ``misses_px`` (N, 2) are detected minus calculated pixels. ``moved`` is the largest change of a
    parameter without this image, in standard uncertainties.
    """

    name: str
    pixels: np.ndarray
    reason: str | None
    misses_px: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    moved: float = np.nan

    def rms_px(self) -> float:
        """Return the root mean square distance between detected and calculated pixels."""
        return float(np.sqrt(np.mean(np.sum(self.misses_px**2, axis=1))))


@dataclass(frozen=True, eq=False, repr=False)
class CameraCalibration(Brief):
    """Camera calibrated from photographs.

    Attributes
    ----------
    folder : folder of the photographs
    lens : calibrated lens
    photographs : all image files in natural order
    warnings : possible problems
    """

    folder: Path
    target: Target
    lens: LensCalibration
    photographs: list[Photograph]
    warnings: list[str]

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the camera as YAML in the form of ROS CameraInfo, which `uwlts import` reads as ``intrinsics``.

        Raises
        ------
        OutputError
            The file exists and ``overwrite`` is not given, or it cannot be written.
        """
        lens, model = self.lens, self.lens.solution.model

        def matrix(rows: list[list[float]]) -> dict[str, object]:
            return {"rows": len(rows), "cols": len(rows[0]), "data": [float(value) for row in rows for value in row]}

        known = model.distortion
        projection = np.column_stack([model.matrix(), np.zeros(3)]).tolist()
        content = {
            "image_width": model.width_px,
            "image_height": model.height_px,
            "camera_name": self.folder.resolve().name,
            "camera_matrix": matrix(model.matrix().tolist()),
            "distortion_model": "rational_polynomial" if known.is_rational() else "plumb_bob",
            "distortion_coefficients": matrix([list(known.used_coefficients().values())]),
            "rectification_matrix": matrix(np.eye(3).tolist()),
            "projection_matrix": matrix(projection),
            "estimated": {
                "parameters": list(lens.solution.parameters),
                "standard_uncertainties": [float(value) for value in lens.std().values()],
                "covariance": lens.covariance.tolist(),
                "rms_px": lens.solution.rms_px(),
                "images": [each.name for each in self.photographs if each.reason is None],
                "left_out": {each.name: each.reason for each in self.photographs if each.reason is not None},
            },
        }
        text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        write_file(path, text, overwrite=overwrite)


def calibrate_camera(
    folder: str | Path,
    *,
    target: str | Path | None = None,
    channel: str | None = None,
    distortion: Distortion = "auto",
    pixels: Pixels = "auto",
    progress: ProgressListener = ignore_progress,
) -> CameraCalibration:
    """Calibrate a camera from photographs of a target in different poses.

    Parameters
    ----------
    folder : str or Path
        Folder of PNG, TIFF, BMP or JPEG images, directly or in subfolders. Images without the target are reported with
        the reason.
    target : str or Path, optional
        Description of the target (TOML), optionally in a table [target]. Default: target.toml or import.toml in the
        folder.
    channel : str, optional
        Channel of colour images, or a formula of channels. Default: luminance.
    distortion : "auto" or tuple of str
        Distortion coefficients to estimate. auto: those that best predict held-out images.
    pixels : {"auto", "square", "free"}
        Whether pixels are square or have a free shape. auto: the choice that best predicts held-out images.
    progress : callable, optional
        Called with the number of images or models done, the total, and the name of the stage.

    Returns
    -------
    CameraCalibration
        Its uncertainties take the correlation of errors within an image into account.

    Raises
    ------
    DescriptionError
        The target's description is missing or wrong, or ``channel`` is invalid.
    ImageError
        The folder contains no images.
    CalibrationError
        The target is found in fewer than four images, or these do not determine a camera.
    """
    require_coefficients(distortion)
    folder = Path(folder)
    described = _read_target(folder, target)
    names = image_files(folder)
    try:
        wanted = check_channel(channel or "grey")
    except ValueError as error:
        raise DescriptionError(f"channel is {channel!r}: {error}") from error
    seen: dict[int, tuple[tuple[int, int], TargetImage]] = {}
    reasons = dict.fromkeys(names, "")
    for number, name in enumerate(names):
        try:
            raw = read_image(folder / name)
            view = described.detect(np.clip(extract_channel(raw, wanted, name=name), 0, None).astype(raw.dtype))
            seen[number] = (raw.shape[1], raw.shape[0]), TargetImage(view.points_mm, view.pixels)
        except (ImageError, TargetError, CalibrationError) as error:
            reasons[name] = str(error).replace(f"{folder / name}", "it").removeprefix(f"{name} ")
        progress(number + 1, len(names), "target")
    # Images of another size are from another camera.
    size = Counter(shape for shape, _ in seen.values()).most_common(1)[0][0] if seen else (0, 0)
    for number, ((width, height), _) in list(seen.items()):
        if (width, height) != size:
            reasons[names[number]] = f"it has {width} x {height} pixels; most images have {size[0]} x {size[1]}"
            del seen[number]
    found, places = [image for _, image in seen.values()], list(seen)
    photographs = [Photograph(name, np.empty((0, 2)), reason) for name, reason in reasons.items()]
    if len(found) < _FEWEST_IMAGES:
        listed = "; ".join(f"{name}: {reason}" for name, reason in reasons.items() if reason)
        raise CalibrationError(
            f"the target was found in {len(found)} of {len(names)} images, at least {_FEWEST_IMAGES} are needed"
            + (f": {listed[:600]}" if listed else "")
        )
    lens = calibrate_lens(
        found,
        width_px=size[0],
        height_px=size[1],
        choice=LensChoice(distortion, pixels),
        circle_diameter_mm=described.circle_diameter_mm,
        progress=partial(progress, stage="lens"),
    )
    for place, image, misses, moved in zip(lens.used, lens.images, lens.solution.residuals_px, lens.moved, strict=True):
        number = places[place]
        photographs[number] = Photograph(names[number], image.pixels, None, misses, float(moved))
    warnings = []
    for place, reason in lens.left_out.items():
        name = names[places[place]]
        photographs[places[place]] = Photograph(name, found[place].pixels, reason)
        warnings.append(f"{name}: left out, {reason}")
    warnings += [f"{each.name}: {each.reason}" for each in photographs if not len(each.pixels)]
    return CameraCalibration(folder, described, lens, photographs, warnings + _doubt_wide(lens) + lens.half_doubts())


def _doubt_wide(lens: LensCalibration) -> list[str]:
    """Return a warning if the lens bends the image as a wide-angle lens and the model cannot follow."""
    if not lens.widest_deg() > WIDE_DEG or lens.solution.model.distortion.is_rational():
        return []
    named = " ".join(lens.options.distortion) or "no distortion"
    return [
        f"the target is seen up to {lens.widest_deg():.0f} deg from the camera's axis: this is a wide-angle lens, "
        f"which bends straight lines more than {named} can follow beyond {WIDE_DEG:.0f} deg; residuals are "
        f"{lens.solution.rms_px():.2g} px: use the distortion auto, or k1 k2 k4 k5"
    ]


def _read_target(folder: Path, path: str | Path | None) -> Target:
    """Read the target from a file, or from one in the folder."""
    if not folder.is_dir():
        raise ImageError(f"no folder at {folder}")
    known = [folder / TARGET_NAME, folder / DESCRIPTION_NAME] if path is None else [Path(path)]
    there = next((each for each in known if is_regular_file(each)), None)
    if there is None:
        raise DescriptionError(
            f"no description of the target at {' or '.join(map(str, known))}: write one, such as "
            'kind = "chessboard", columns = 9, rows = 6 (inner corners), square_mm = 15.0, each on a line'
        )
    table = read_table(there)
    inner = table.get("target", table)
    if not isinstance(inner, dict):
        raise DescriptionError(f"{there}: target is {inner!r}; expected a table")
    return parse_target(inner)
