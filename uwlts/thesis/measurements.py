"""Calibrations of a campaign by every method, and measurements of its scans with them.

The thesis's image processing (section 4.5) is a 5x5 low-pass filter, then a quadratic through the peak, in LabVIEW. The
filter IMAQ LowPass replaces a pixel by the mean of its neighbours only if it differs from them by more than a tolerance
(default: 40 %); it is not a plain mean. "Every few columns" of the quadratic fit is interpreted as five pixels, the
size of the filter. Lines with a stripe are selected as for all methods.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from uwlts.calibration.polynomial.polynomial_calibration_fit import calibrate_polynomials
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.errors import CalibrationError, CaptureError, EvaluationError
from uwlts.evaluation.evaluate import Evaluation, evaluate
from uwlts.fitting.least_squares import VDI_OUTLIER_SHARE
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.artefacts import parse_artefact
from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import write_cloud
from uwlts.storage.truth import read_truth, truth_path
from uwlts.stripe import CaptureStripes, find_stripes
from uwlts.thesis.campaign_folder import CampaignFolder, ScanFile
from uwlts.thesis.results import Measurement

PROPOSED, TWO, POLYNOMIALS, SINGLE = "proposed", "two refractions", "polynomials", "single viewpoint"
FORGOTTEN = "window forgotten"
METHODS = {"air": (PROPOSED, POLYNOMIALS, FORGOTTEN), "water": (PROPOSED, TWO, POLYNOMIALS, SINGLE)}


def calibrations(
    folder: CampaignFolder, *, progress: ProgressListener = ignore_progress
) -> dict[tuple[str, str], AnyCalibration]:
    """Return calibrations by method and medium; up-to-date ones are read from the folder ``calibrations``.

    Raises CaptureError if a recording is missing or damaged; CalibrationError if the recordings do not determine a
    calibration.
    """
    made = {
        (PROPOSED, "water"): lambda: _calibrate_rays(folder.target("air"), folder.steps(), refractions=1),
        (TWO, "water"): lambda: _calibrate_rays(folder.target("bare"), folder.steps(), refractions=2),
        (SINGLE, "water"): lambda: _calibrate_rays(folder.target("water"), [], refractions=1),
        (POLYNOMIALS, "air"): lambda: _calibrate_polynomials(folder.target("air")),
        (POLYNOMIALS, "water"): lambda: _calibrate_polynomials(folder.target("water")),
    }
    place = folder.path / "calibrations"
    place.mkdir(exist_ok=True)
    found: dict[tuple[str, str], AnyCalibration] = {}
    evidence = [*folder.steps(), *(folder.target(kind) for kind in ("air", "bare", "water"))]
    newest = max(path.stat().st_mtime_ns for path in evidence)
    for number, ((method, medium), make) in enumerate(made.items()):
        progress(number, len(made))
        path = place / f"{method.replace(' ', '-')}-{medium}.json"
        if not path.is_file() or path.stat().st_mtime_ns < newest:
            make().save(path, overwrite=True)
        found[method, medium] = load_calibration(path)
    progress(len(made), len(made))
    # In air, only camera and sheet of a calibration are used.
    for method, source in ((PROPOSED, PROPOSED), (FORGOTTEN, TWO)):
        found[method, "air"] = found[source, "water"].model_copy(update={"window": None})
    return found


def _calibrate_rays(target: Path, steps: list[Path], *, refractions: Literal[1, 2]) -> Calibration:
    with ExitStack() as stack:
        air = [stack.enter_context(Capture(target))]
        opened = [stack.enter_context(Capture(path)) for path in steps]
        return calibrate_sequentially(air, opened, options=CalibrationOptions(refractions=refractions)).calibration


def _calibrate_polynomials(target: Path) -> PolynomialCalibration:
    with Capture(target) as capture:
        return calibrate_polynomials([capture]).calibration


_SIZE_PX = 5  # of the window of the thesis's filter
_SEARCHED_PX = 8
"""Half width of the window around the stripe in which its peak is searched."""


def thesis_stripes(
    capture: Capture, found: CaptureStripes, *, tolerance: float = 0.4, fitted_px: int = 5
) -> CaptureStripes:
    """Recompute the stripe centres on the same lines with the thesis's processing.

    ``tolerance`` is that of the low-pass filter; 0 makes it a mean of the neighbours. ``fitted_px`` is an odd number.
    """
    along_width = capture.header.sensor.camera.stripe_along == "width"
    centre = np.empty(len(found.line))
    for number in np.unique(found.frame):
        own = found.frame == number
        image = capture.image(int(number))
        smooth = apply_low_pass(image if along_width else image.T, tolerance=tolerance)
        centre[own] = _peaks(smooth, found.line[own], found.centre_px[own], half=fitted_px // 2)
    return replace(found, centre_px=centre)


def apply_low_pass(image: np.ndarray, *, tolerance: float) -> np.ndarray:
    """Filter an image (H, W) with IMAQ LowPass of 5x5 pixels; return float32."""
    grey = image.astype(np.float32)
    count = _SIZE_PX**2
    neighbours = (cv2.blur(grey, (_SIZE_PX, _SIZE_PX)) * count - grey) / (count - 1)
    return np.where(np.abs(grey - neighbours) > tolerance * neighbours, neighbours, grey)


def _peaks(smooth: np.ndarray, line: np.ndarray, near_px: np.ndarray, *, half: int) -> np.ndarray:
    """Return vertices (N,) of parabolas through pixels around the maximum of columns (N,) near rows (N,)."""
    # On a plateau, the maximum nearest to the stripe's position is used.
    around = np.array(sorted(range(-_SEARCHED_PX, _SEARCHED_PX + 1), key=abs))
    rows = np.clip(np.rint(near_px).astype(int)[:, None] + around, 0, len(smooth) - 1)
    top = rows[np.arange(len(line)), smooth[rows, line[:, None]].argmax(axis=1)]
    offset = np.arange(-half, half + 1)
    rows = np.clip(top[:, None] + offset, 0, len(smooth) - 1)
    # Relative to the maximum, so that a plateau is exactly zero. It has no vertex; its position is used instead.
    below = smooth[rows, line[:, None]] - smooth[top, line][:, None]
    second, first, _ = np.linalg.pinv(np.vander(offset, 3)) @ below.T
    vertex = np.where(second < 0, -first / np.where(second < 0, 2 * second, 1.0), 0.0)
    return top + np.clip(vertex, -half, half)


THESIS, OURS = "thesis", "ours"
"""Image processing: the thesis's, and this program's default."""
VARIANTS = {
    "thesis, mean of 5x5": {"tolerance": 0.0},
    "thesis, fit over 3 px": {"fitted_px": 3},
    "thesis, fit over 7 px": {"fitted_px": 7},
}
"""Other interpretations of the thesis's text, tested on the spheres with the proposed method."""
_SHOWN = ("pipe", "head", "weld")
"""Objects with coloured clouds in the report."""


def measure_scan(
    scan: ScanFile, calibrations: Mapping[tuple[str, str], AnyCalibration], *, clouds: Path
) -> list[Measurement]:
    """Measure a scan by every method of its medium and both image processings; ``clouds`` is a folder for clouds."""
    truth_file = truth_path(scan.path)
    truth = read_truth(truth_file)[1] if truth_file.is_file() else None
    found = []
    with Capture(scan.path) as capture:
        artefact = parse_artefact(capture.header.artefact) if capture.header.artefact else None
        ours = find_stripes(capture)
        cases = [(OURS, ours, METHODS[scan.medium]), (THESIS, thesis_stripes(capture, ours), METHODS[scan.medium])]
        if scan.thing == "spheres":
            cases += [(name, thesis_stripes(capture, ours, **how), (PROPOSED,)) for name, how in VARIANTS.items()]
        for processing, stripes, methods in cases:
            for method in methods:
                about = scan.thing, scan.placement, scan.medium, method, processing
                try:
                    cloud = reconstruct_stripes(capture, stripes, calibrations[method, scan.medium])
                    evaluation = evaluate(cloud, artefact, truth)
                except (CalibrationError, CaptureError, EvaluationError) as error:
                    found.append(Measurement(*about, figures_mm={}, failure=str(error)))
                    continue
                figures = _figures(evaluation) | {"line length": _line_length(cloud)}
                found.append(Measurement(*about, figures_mm=figures, points=len(cloud)))
                if evaluation.cloud is not None and scan.thing in _SHOWN and processing == OURS:
                    name = f"{scan.path.stem}-{method.replace(' ', '-')}.ply"
                    write_cloud(clouds / name, evaluation.cloud, overwrite=True)
    return found


def _figures(evaluation: Evaluation) -> dict[str, float]:
    """Return the artefact's figures; for a free form, STD is the spread about the true surface after a best fit.

    PE and RE exclude the 0.3 % of the points with the largest deviations, as VDI/VDE 2634 allows: the published ranges
    of 4 to 6 standard deviations of more than ten thousand points are otherwise impossible. The full ranges are added.
    """
    figures = {figure.key.name: figure.value_mm for figure in evaluation.figures}
    deviation_mm = None if evaluation.cloud is None else evaluation.cloud.deviation_mm
    for name in ("PE", "RE"):
        if name in figures and deviation_mm is not None:
            figures[f"{name} of all points"] = figures[name]
            figures[name] = _range_within(deviation_mm)
    if (truth := evaluation.truth) is not None and truth.after_best_fit is not None:
        spread = truth.after_best_fit.std_mm
        figures |= {"std to the true surface": spread} | ({} if evaluation.artefact else {"STD": spread})
    return figures


def _range_within(deviation_mm: np.ndarray) -> float:
    """Return the range of deviations (N,), NaN if not evaluated, without the largest 0.3 %."""
    used = deviation_mm[np.isfinite(deviation_mm)]
    kept = used[np.argsort(np.abs(used))[: len(used) - int(VDI_OUTLIER_SHARE * len(used))]]
    return float(np.ptp(kept))


def _line_length(cloud: PointCloud) -> float:
    """Return the median length of the profiles along Y, mm."""
    return float(np.median([np.ptp(cloud.points_mm[cloud.frame == n, 1]) for n in np.unique(cloud.frame)]))
