"""Profile of a single laser image: its points for the cloud, and its section for measurements."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uwlts.inspection.section import Section, order_profile
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import Calibration
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import CaptureHeader, Frame, FrameTable
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import CaptureStripes, Stripe


@dataclass(frozen=True, eq=False)
class FrameProfile:
    """Stripe of a laser image, and the calibration that gives its points; errors are those of `reconstruct_stripes`.

    Uncertainties take several times as long as the points: displays that show every image use ``points``.
    """

    frame: Frame
    stripe: Stripe
    header: CaptureHeader
    calibration: AnyCalibration

    @cached_property
    def points(self) -> PointCloud:
        """Points (N,) of the stripe, without uncertainty."""
        return self._reconstruct(with_uncertainty=False)

    @cached_property
    def section(self) -> Section:
        """Points in their order along the stripe, with uncertainty if the calibration states it."""
        return order_profile(self.measured())

    def measured(self) -> PointCloud:
        """Return the points (N,) of the stripe, with uncertainty if the calibration states it."""
        known = isinstance(self.calibration, Calibration) and self.calibration.joint is not None
        return self._reconstruct(with_uncertainty=known)

    def _reconstruct(self, *, with_uncertainty: bool) -> PointCloud:
        stripe, line = self.stripe, self.stripe.lines
        own, centre = np.zeros(len(line), dtype=int), stripe.centre_px[line]
        stripes = CaptureStripes(own, line, centre, stripe.amplitude[line], stripe.width_px[line], {})
        table = FrameTable.from_frames(self.header, [self.frame])
        return reconstruct_stripes(table, stripes, self.calibration, with_uncertainty=with_uncertainty)
