"""Measures every scan of a campaign by every method, with the thesis's image processing and with ours."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwlts.calibration.any_calibration import AnyCalibration
from uwlts.capture import Capture
from uwlts.cloud import PointCloud, write_cloud
from uwlts.errors import CalibrationError, CaptureError, EvaluationError
from uwlts.evaluate import Judgement, judge
from uwlts.metrology.artefact_descriptions import parse_artefact
from uwlts.metrology.robust_fit import VDI_OUTLIER_SHARE
from uwlts.scan import reconstruct_stripes
from uwlts.stripe import find_stripes
from uwlts.thesis.folder import ScanFile
from uwlts.thesis.image_processing import thesis_stripes
from uwlts.thesis.methods import METHODS, PROPOSED
from uwlts.truth import read_truth, truth_path

THESIS, OURS = "thesis", "ours"
"""Image processing: the thesis's, and this program's default."""
VARIANTS = {
    "thesis, mean of 5x5": {"tolerance": 0.0}, "thesis, fit over 3 px": {"fitted_px": 3},
    "thesis, fit over 7 px": {"fitted_px": 7},
}  # fmt: skip
"""Other readings of the thesis's text, tried on the spheres by the proposed method."""
_SHOWN = ("pipe", "head", "weld")
"""Things whose coloured clouds are kept for the report."""


@dataclass(frozen=True)
class Measurement:
    """Figures of one scan by one method and image processing, by name, in mm. ``failure`` says why there are none."""

    thing: str
    placement: str
    medium: str
    method: str
    processing: str
    figures_mm: dict[str, float]
    points: int = 0
    failure: str | None = None


def measure_scan(
    scan: ScanFile, calibrations: Mapping[tuple[str, str], AnyCalibration], *, clouds: Path
) -> list[Measurement]:
    """Measure a scan by every method of its medium and either image processing; ``clouds`` is a folder for clouds."""
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
                    cloud = reconstruct_stripes(capture, stripes, calibrations[method, scan.medium]).cloud
                    judgement = judge(cloud, artefact=artefact, truth=truth, source=scan.path.name)
                except (CalibrationError, CaptureError, EvaluationError) as error:
                    found.append(Measurement(*about, figures_mm={}, failure=str(error)))
                    continue
                figures = _figures(judgement) | {"line length": _line_length(cloud)}
                found.append(Measurement(*about, figures_mm=figures, points=len(cloud)))
                if scan.thing in _SHOWN and processing == OURS:
                    name = f"{scan.path.stem}-{method.replace(' ', '-')}.ply"
                    write_cloud(clouds / name, judgement.cloud, overwrite=True)
    return found


def _figures(judgement: Judgement) -> dict[str, float]:
    """The artefact's figures; of a free form the spread about the true surface after a best fit is the STD.

    PE and RE leave out the 0.3 % of the points that lie farthest off, as VDI/VDE 2634 allows: the published ranges of
    4 to 6 standard deviations of more than ten thousand points cannot be had without. The full ranges stand beside.
    """
    content = judgement.content
    figures = dict(content["evaluation"]["figures_mm"]) if content["evaluation"] else {}
    for name in ("PE", "RE"):
        if name in figures:
            figures[f"{name} of all points"] = figures[name]
            figures[name] = _range_within(judgement.cloud.deviation_mm)
    if content["truth"]:
        spread = content["truth"]["after_best_fit"]["std_mm"]
        figures |= {"std to the true surface": spread} | ({} if content["evaluation"] else {"STD": spread})
    return figures


def _range_within(deviation_mm: np.ndarray) -> float:
    """Range of deviations (N,), NaN where not evaluated, without the largest 0.3 %."""
    used = deviation_mm[np.isfinite(deviation_mm)]
    kept = used[np.argsort(np.abs(used))[: len(used) - int(VDI_OUTLIER_SHARE * len(used))]]
    return float(np.ptp(kept))


def _line_length(cloud: PointCloud) -> float:
    """Median over the profiles of how far the points reach along Y, mm."""
    return float(np.median([np.ptp(cloud.points_mm[cloud.frame == n, 1]) for n in np.unique(cloud.frame)]))
