"""Inspections of the drawn pipes of `tests.oracles`, and what is asserted on their findings.

Gates on depths are 4.5 standard uncertainties, exceeded by a normal error 7 times in a million.
"""

import numpy as np

import uwlts
from tests.oracles.damaged_pipes import Part
from tests.oracles.pipes import ScannedPipe
from uwlts.inspection.features import FeatureKind, Inspection
from uwlts.storage.cloud import PointCloud

GATE = 4.5
HOLLOWS = FeatureKind.PIT, FeatureKind.DENT
BLEMISHES = *HOLLOWS, FeatureKind.PROTRUSION


def cloud_of(pipe: ScannedPipe | Part) -> PointCloud:
    """Return the scan as a cloud without stated uncertainties."""
    return PointCloud(pipe.points_mm, np.ones(len(pipe.points_mm)), pipe.frame, pipe.line)


def inspect(pipe: ScannedPipe, **options: float) -> Inspection:
    """Inspect the scan as a pipe."""
    return uwlts.inspect_pipe(cloud_of(pipe), **options)
