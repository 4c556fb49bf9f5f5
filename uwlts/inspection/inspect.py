"""Inspection of a cloud: what of a pipe, weld, step, flange or gap is found in it, with uncertainty."""

from __future__ import annotations

import os
from typing import Literal, assert_never

from uwlts.errors import EvaluationError
from uwlts.inspection.features import Inspection
from uwlts.inspection.flat import inspect_flange, inspect_gap, inspect_step
from uwlts.inspection.pipe import inspect_pipe
from uwlts.inspection.pipe_form import LARGEST_OVALITY
from uwlts.inspection.weld import inspect_weld
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import read_cloud

InspectionKind = Literal["pipe", "weld", "step", "flange", "gap"]


def inspect(
    cloud: PointCloud | str | os.PathLike[str],
    kind: InspectionKind = "pipe",
    *,
    section_mm: float | None = None,
    wall_mm: float | None = None,
    false_alarm: float = 0.05,
    largest_ovality: float = LARGEST_OVALITY,
    datum: PointCloud | str | os.PathLike[str] | None = None,
) -> Inspection:
    """Find the features of an object in a cloud and measure them, with uncertainty.

    A pipe's axis, diameter, ovality and straightness, section by section, and its pits, dents and protrusions; a weld
    bead's height, width, undercut, toe angles and misalignment; the step between two faces; a flange's flatness, holes,
    bolt circle and parallelism; the gap between two plates. `DEFINITIONS` (`uwlts.inspection.features`) says what each
    value is, and whose definition that is. Uncertainties are of the points' covariance, with what all share by
    calibration, and at least what the points' own scatter shows; without covariance of the scatter alone.

    Parameters
    ----------
    cloud
        What was measured; a cloud or its file.
    kind
        What the cloud shows.
    section_mm
        Length of a section along a pipe (up to twelve unless given) or a weld (as short as its points allow).
    wall_mm
        Thickness of a pipe's undamaged wall, for the wall that remains.
    false_alarm
        Probability that anything is found on the whole of a pipe's surface where nothing is.
    largest_ovality
        Ovality over the diameter that a pipe may have where less than half of its circumference was seen: the tolerance
        of its specification, where it still holds.
    datum
        Cloud of another face in the same frame, to which a flange's face is to be parallel.

    Raises
    ------
    CaptureError
        A file cannot be read.
    EvaluationError
        The cloud does not show such an object, or a parameter is out of its range or is none of this kind.

    Examples
    --------
    >>> found = uwlts.inspect("pipe.ply", wall_mm=9.5)
    >>> for pit in found.of(FeatureKind.PIT):
    ...     print(pit.name, pit["depth"].value, pit["depth"].low, pit["depth"].high)
    """
    of_pipe = {"wall_mm": wall_mm is not None, "false_alarm": false_alarm != 0.05}
    of_pipe["largest_ovality"] = largest_ovality != LARGEST_OVALITY
    foreign = {"section_mm": section_mm is not None and kind not in ("pipe", "weld")}
    foreign |= {name: given and kind != "pipe" for name, given in of_pipe.items()}
    foreign |= {"datum": datum is not None and kind != "flange"}
    if wrong := [name for name, given in foreign.items() if given]:
        raise EvaluationError(f"a {kind} has no {', '.join(wrong)}: leave it out")
    measured = cloud if isinstance(cloud, PointCloud) else read_cloud(cloud)
    match kind:
        case "pipe":
            return inspect_pipe(
                measured,
                section_mm=section_mm,
                wall_mm=wall_mm,
                false_alarm=false_alarm,
                largest_ovality=largest_ovality,
            )
        case "weld":
            return inspect_weld(measured, section_mm=section_mm)
        case "step":
            return inspect_step(measured)
        case "flange":
            other = datum if isinstance(datum, PointCloud) or datum is None else read_cloud(datum)
            return inspect_flange(measured, datum=other)
        case "gap":
            return inspect_gap(measured)
        case _:
            assert_never(kind)
