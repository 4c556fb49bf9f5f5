"""Problem of a joint calibration: all evidence with start values, and the parameters to estimate from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.joint.estimate import Estimate, Evidence, estimate
from uwlts.calibration.joint.gathering import Gathered, build_priors, usual_distortion
from uwlts.calibration.joint.initial import (
    build_all_scan_evidence,
    build_step_evidence,
    estimate_line_start,
    estimate_series_start,
)
from uwlts.calibration.joint.linearised_estimate import LinearisedEstimate
from uwlts.calibration.joint.parameters import Parameters, Prior
from uwlts.calibration.joint.residuals import TargetEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.calibration import WindowModel
from uwlts.model.parameter_keys import LensParameter, TargetParameter
from uwlts.model.sensor import Sensor

_TRIAL_LINES = slice(None, None, 4)  # stripe pixels for the comparison of lenses: neighbours are correlated


@dataclass(frozen=True, eq=False)
class JointProblem:
    """All evidence, the parameters to estimate from it, and their start values.

    The start values are ``global_values`` (P,) and ``local`` (b,) of every piece of evidence. ``diameter_mm`` is that
    of the target's circles for the correction of their images; None for no correction. ``misfits`` is as for
    `estimate`.
    """

    parameters: Parameters
    evidence: Sequence[Evidence]
    global_values: np.ndarray
    local: list[np.ndarray]
    sensor: Sensor
    diameter_mm: float | None
    warnings: list[str]
    misfits: frozenset[str] = frozenset()

    def solve(self) -> Estimate:
        """Return the estimate without consistency checks; errors as `estimate`.

        Parameters that are tied to their prior contribute its uncertainty to all others.
        """
        result = estimate(
            self.parameters,
            self.evidence,
            self.global_values,
            self.local,
            uncertainty=self.sensor.uncertainty,
            diameter_mm=self.diameter_mm,
            misfits=self.misfits,
        )
        if not self.parameters.tied:
            return result
        free = replace(self.parameters, tied=frozenset())
        parts = [e.residuals(free, result.values, own) for e, own in zip(self.evidence, result.local, strict=True)]
        full = replace(result, residuals=[each or [] for each in parts])
        covariance = self.linearise(full).covariance_with(self.parameters.tied)
        return replace(result, covariance=covariance, formal_covariance=result.covariance)

    def linearise(self, result: Estimate) -> LinearisedEstimate:
        """Return the normal equations of an estimate of this problem."""
        return LinearisedEstimate(result, self.evidence, self.sensor.uncertainty)

    def with_lens(self, camera: CameraOptions, near: Estimate) -> Self:
        """Return the problem with another lens and fewer stripe pixels, near an estimate: for its prediction only.

        The target is as described, and all other distortion is zero: else both would replace the lens.
        """
        known, fixed = self.parameters, Prior(0.0, 0.0)
        intrinsics = replace(known.intrinsics, options=camera)
        priors = {
            key: fixed if isinstance(key, TargetParameter) else prior
            for key, prior in known.priors.items()
            if not isinstance(key, LensParameter)
        } | usual_distortion(camera)
        parameters = replace(known, intrinsics=intrinsics, priors=priors)
        start = dict(zip(known.keys, near.values, strict=True))
        focal = start.get(LensParameter.F, start.get(LensParameter.FX))
        start |= {LensParameter.F: focal, LensParameter.FX: focal, LensParameter.FY: start.get(LensParameter.FY, focal)}
        evidence = [e.with_stripes(_TRIAL_LINES) if isinstance(e, TargetEvidence) else e for e in self.evidence]
        values = np.array([start.get(key, 0.0) for key in parameters.keys])
        return replace(self, parameters=parameters, evidence=evidence, global_values=values, local=near.local)


def joint_problem(gathered: Gathered, *, options: CalibrationOptions) -> JointProblem:
    """Build the problem from the captures, with start values; errors as `calibrate_jointly`."""
    sensor = gathered.sensor
    views = [part.view for part in (*gathered.series, *gathered.scans)] + [view for _, view in gathered.steps]
    if not gathered.series:
        raise CalibrationError("no capture shows a target; joint calibration needs one in air or in water")
    bare = next((v.medium for v in views if v.medium is not None and not v.window and set(views) != {v}), None)
    if bare is not None:
        raise CalibrationError(
            f"some captures in {list(gathered.media)[bare]} were taken without a window, others were not: a lens in "
            "contact with the medium has other parameters; calibrate it separately, or set window.mounted"
        )
    window = None
    if any(view.window for view in views):
        window = WindowModel.from_description(sensor.camera.window, sensor.laser.wavelength_nm)
    indices = gathered.indices(options)
    start = estimate_series_start(gathered.series, sensor, window, indices, options=options)
    found = start.sheet()
    if found is None:
        reasons = [each.found.no_stripe for each in gathered.series if each.found.no_stripe]
        raise CalibrationError(
            "; ".join(reasons) or "no stripe was found on the target: check its description and the stage positions"
        )
    sheet, turns = found
    first = start.calibration(sheet.model(np.append(turns, (0.0, 0.0))))
    steps, heights, left_out = build_step_evidence(gathered, first, window)
    scans, missed = build_all_scan_evidence(gathered.scans, first, sensor, indices, sizes_known=options.sizes_known)
    priors = build_priors(gathered, window, turns, heights, options)
    parameters = Parameters(start.intrinsics, sheet, window, tuple(gathered.media), priors)
    global_values = parameters.start(start.lens)
    lines = [estimate_line_start(step, parameters, global_values) for step in steps]
    return JointProblem(
        parameters,
        evidence=[*start.evidence, *steps, *(evidence for evidence, _ in scans)],
        global_values=global_values,
        local=[*start.local, *lines, *(local for _, local in scans)],
        sensor=sensor,
        diameter_mm=gathered.series[0].found.target.circle_diameter_mm if options.correct_circles else None,
        warnings=[*gathered.warnings, *left_out, *missed],
    )
