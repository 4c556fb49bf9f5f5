"""Problem of a joint calibration, its solution, and solutions from some of the images.

An estimate contains the derivatives of all residuals. Near it, the estimate from fewer images follows from the normal
equations of these images, without another iteration.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.joint.earlier import read_earlier
from uwlts.calibration.joint.estimate import Estimate, Evidence, Noise, estimate, outliers, prior_observations
from uwlts.calibration.joint.gathering import Gathered, build_priors, usual_distortion
from uwlts.calibration.joint.initial import (
    build_all_scan_evidence,
    build_step_evidence,
    estimate_line_start,
    estimate_series_start,
)
from uwlts.calibration.joint.parameters import SHEET, EarlierEstimate, Parameters, Prior
from uwlts.calibration.joint.residuals import TARGET, Residuals, StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import SurfaceScanEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import invert_block, normal_equations
from uwlts.model.calibration import WindowModel
from uwlts.model.parameter_keys import LensParameter, ParameterKey, TargetParameter
from uwlts.model.sensor import Sensor, Uncertainty

_TRIAL_LINES = slice(None, None, 4)  # stripe pixels for the comparison of lenses: neighbours are correlated
_FOLDS = 5  # as for the lens alone
_CLIPPED = 5.0  # standard deviations; a larger error of prediction counts as this
_SINGULAR = 1e-12  # eigenvalue of scaled normal equations below which the images do not determine a parameter
_LEAST_SHARE = 1e-6  # of a parameter's variance: the least of a difference, for parameters without evidence
_FEWEST_IMAGES = 4  # images of a target in two halves: two in each

ImageId = tuple[int, int]
"""Number of the piece of evidence, and of the image in it."""


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
        parts = [e.residuals(free, result.values, local) for e, local in zip(self.evidence, result.local, strict=True)]
        full = replace(result, residuals=[each or [] for each in parts])
        covariance = self.linearise(full).covariance_with(self.parameters.tied)
        return replace(result, covariance=covariance, formal_covariance=result.covariance)

    def linearise(self, result: Estimate) -> "LinearisedEstimate":
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

    def with_images(self, wanted: Collection[ImageId], near: Estimate) -> Self:
        """Return the problem with the wanted images of targets and steps, and all scans, near an estimate."""
        kept: list[tuple[Evidence, np.ndarray]] = []
        for number, (piece, start) in enumerate(zip(self.evidence, near.local, strict=True)):
            if isinstance(piece, TargetEvidence):
                images = [image for image in np.unique(piece.placement.image).tolist() if (number, image) in wanted]
                if not images:
                    continue
                piece = piece.with_images(images)
                if piece.staged:
                    start = np.append(start[:8], np.zeros(len(piece.images())))
            elif isinstance(piece, StepProfileEvidence) and (number, piece.image) not in wanted:
                continue
            kept.append((piece, start))
        evidence, local = [piece for piece, _ in kept], [start for _, start in kept]
        return replace(self, evidence=evidence, local=local, global_values=near.values)


def joint_problem(gathered: Gathered, *, options: CalibrationOptions) -> JointProblem:
    """Build the problem from the captures, with start values; errors as `calibrate_jointly`."""
    sensor = gathered.sensor
    views = [part.view for part in (*gathered.series, *gathered.scans)] + [view for _, view in gathered.steps]
    earlier = None if options.earlier is None else read_earlier(options.earlier, gathered)
    if not gathered.series and earlier is None:
        raise CalibrationError("no capture shows a target; joint calibration needs one in air or in water")
    bare = next((v.medium for v in views if v.medium is not None and not v.window and set(views) != {v}), None)
    if bare is not None:
        raise CalibrationError(
            f"some captures in {list(gathered.media)[bare]} were taken without a window, others were not: a lens in "
            "contact with the medium has other parameters; calibrate it separately, or set window.mounted"
        )
    window = None
    if earlier is not None:
        window = earlier.calibration.window
    elif any(view.window for view in views):
        window = WindowModel.from_description(sensor.camera.window, sensor.laser.wavelength_nm)
    indices = gathered.indices(options)
    start = estimate_series_start(gathered.series, sensor, window, indices, options=options, earlier=earlier)
    if earlier is not None:
        first, sheet = earlier.calibration, earlier.parameters.sheet
        turns = np.array([earlier.parameters.value(earlier.values, key) for key in SHEET[:3]])
    elif (found := start.sheet()) is not None:
        sheet, turns = found
        first = start.calibration(sheet.model(np.append(turns, (0.0, 0.0))))
    else:
        reasons = [each.found.no_stripe for each in gathered.series if each.found.no_stripe]
        raise CalibrationError(
            "; ".join(reasons) or "no stripe was found on the target: check its description and the stage positions"
        )
    steps, heights, left_out = build_step_evidence(gathered, first, window)
    scans, missed = build_all_scan_evidence(gathered.scans, first, sensor, indices, sizes_known=options.sizes_known)
    if not (start.evidence or steps or scans):
        raise CalibrationError("; ".join([*gathered.warnings, *left_out, *missed]))
    priors, known = build_priors(gathered, window, turns, heights, options), None
    if earlier is not None:
        known = EarlierEstimate(earlier.values, earlier.covariance)
        priors = earlier.parameters.priors | {k: p for k, p in priors.items() if k not in earlier.parameters.priors}
    parameters = Parameters(start.intrinsics, sheet, window, tuple(gathered.media), priors, known)
    global_values = parameters.start(start.lens)
    lines = [estimate_line_start(step, parameters, global_values) for step in steps]
    circles = [series.found.target.circle_diameter_mm for series in gathered.series]
    return JointProblem(
        parameters,
        evidence=[*start.evidence, *steps, *(evidence for evidence, _ in scans)],
        global_values=global_values,
        local=[*start.local, *lines, *(local for _, local in scans)],
        sensor=sensor,
        diameter_mm=circles[0] if circles and options.correct_circles else None,
        warnings=[*gathered.warnings, *left_out, *missed],
    )


HeldOut = Sequence[tuple[np.ndarray, np.ndarray]]
"""Predicted residuals of each held-out image, px, and their kinds."""


def mean_squares(held: HeldOut, noise: dict[str, Noise]) -> np.ndarray:
    """Return the mean square (F,) of each held-out image's errors relative to a noise, with clipped outliers.

    An image whose points are all outliers of the estimate counts as clipped.
    """
    found = []
    for values, kinds in held:
        if not len(values):
            found.append(_CLIPPED**2)
            continue
        sigma = np.array([noise[kind].sigma_px for kind in kinds])
        weight = np.array([noise[kind].sigma_px / noise[kind].effective_px() for kind in kinds]) ** 2
        squares = np.minimum(np.square(values / sigma), _CLIPPED**2)
        found.append(float(np.sum(weight * squares) / np.sum(weight)))
    return np.array(found)


@dataclass(frozen=True)
class HalfDifference:
    """Estimates of a parameter from two halves of the images, and the standard uncertainty of their difference."""

    key: ParameterKey
    one: float
    other: float
    std: float

    def sigmas(self) -> float:
        """Return the difference in its standard uncertainties."""
        return abs(self.one - self.other) / self.std

    def words(self) -> str:
        """Describe the disagreement."""
        quantity = self.key.quantity
        one, other = (quantity.format_with_std(value, self.std / np.sqrt(2.0)) for value in (self.one, self.other))
        return f"two halves of the images disagree: {quantity.words} is {one} and {other}"


class LinearisedEstimate:
    """Normal equations of an estimate, for each image of targets and steps; scans belong to all subsets."""

    def __init__(self, result: Estimate, evidence: Sequence[Evidence], uncertainty: Uncertainty):
        self._result, self._count, self._halves = result, len(result.values), split_in_halves(evidence)
        self._prior_of = [
            normal_equations([piece.known_before(local, uncertainty)], self._count, len(local))[0]
            for piece, local in zip(evidence, result.local, strict=True)
        ]
        self._parts: dict[ImageId, list[tuple[Residuals, np.ndarray]]] = {}
        for number, parts in enumerate(result.residuals):
            for part in parts:
                used = ~outliers(part, result.noise[part.kind])
                self._parts.setdefault((number, part.image), []).append((part, used))
        self._normal = {image: self._sum_products(image) for image in self._parts}
        self._targets = [image for image in self._parts if isinstance(evidence[image[0]], TargetEvidence)]
        self._shared = [image for image in self._parts if isinstance(evidence[image[0]], SurfaceScanEvidence)]
        self._prior = normal_equations(prior_observations(result.parameters, result.values), self._count, 0)[0]

    def _sum_products(self, image: ImageId) -> np.ndarray:
        noise, size = self._result.noise, len(self._prior_of[image[0]]) - self._count - 1
        rows = [part.weighted(noise[part.kind].effective_px(), used) for part, used in self._parts[image]]
        return normal_equations(rows, self._count, size)[0]

    def _reduce(self, chosen: Collection[ImageId]) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Return the normal equations (P + 1, P + 1) of chosen images and prior knowledge, the gradient last.

        Local parameters are eliminated. The second result gives their step, -B @ (step, 1), by a matrix B (b, P + 1).
        """
        p, total, backwards = self._count, self._prior.copy(), {}
        keep, sums = np.r_[:p, -1], dict[int, np.ndarray]()
        for number, image in sorted(chosen):
            sums[number] = sums.get(number, self._prior_of[number]) + self._normal[number, image]
        for number, product in sums.items():
            border, inverse = product[p:-1, keep], _invert(product[p:-1, p:-1])
            if inverse is None:
                continue  # too few points of an image for its pose: it says nothing
            backwards[number] = inverse @ border
            total += product[np.ix_(keep, keep)] - border.T @ backwards[number]
        return total, backwards

    def predict(self) -> HeldOut:
        """Predict each fifth of the target images, with the stripes on them, from all other images.

        The pose of a held-out image is that of its placement, or fitted to its target points if it was held by hand.

        Raises
        ------
        CalibrationError
            The other images do not determine the parameters, or too few images show a target.
        """
        folds, found = min(_FOLDS, len(self._targets)), []
        if folds < 2:
            raise CalibrationError("too few images of a target to predict one from the others")
        for fold in range(folds):
            held = self._targets[fold::folds]
            total, backwards = self._reduce(set(self._parts) - set(held))
            inverse = _invert(total[:-1, :-1])
            if inverse is None:
                raise CalibrationError("without some of the images, the others do not determine the calibration")
            step = -inverse @ total[:-1, -1]
            for image in held:
                columns: list[tuple[np.ndarray, ...]] = []
                for part, used in self._parts[image]:
                    by_local = np.zeros((len(used), len(self._result.local[image[0]])))
                    by_local[:, part.local_columns] = part.by_local
                    kind = np.full(len(used), part.kind)
                    columns.append(tuple(c[used] for c in (part.values + part.by_global @ step, by_local, kind)))
                moved, by_local, kind = (np.concatenate(column) for column in zip(*columns, strict=True))
                if image[0] in backwards:
                    local = -backwards[image[0]] @ np.append(step, 1.0)
                else:
                    points = kind == TARGET
                    local = -np.linalg.lstsq(by_local[points], moved[points], rcond=None)[0]
                found.append((moved + by_local @ local, kind))
        return found

    def compare_halves(self) -> list[HalfDifference]:
        """Compare the parameters estimated from every second image and from the others; empty if not determined.

        Prior knowledge and scans belong to both halves.
        """
        if len(self._targets) < _FEWEST_IMAGES:
            return []
        rest, values, covariances = self._reduce(self._shared)[0][:-1, :-1], [], []
        for half in self._halves:
            total, _ = self._reduce([*half, *self._shared])
            if (inverse := _invert(total[:-1, :-1])) is None:
                return []
            values.append(self._result.values - inverse @ total[:-1, -1])
            covariances.append(inverse)
        return compare_estimates(self._result.parameters.keys, values, covariances, rest)

    def covariance_with(self, tied: Collection[ParameterKey]) -> np.ndarray:
        """Return the covariance (P, P) if ``tied`` parameters keep their prior value and uncertainty.

        Their uncertainty is propagated to all others ("consider parameters": Schmidt, NASA TN D-1234, 1962).
        """
        keys = self._result.parameters.keys
        held = np.array([key in tied for key in keys])
        total = self._reduce(self._parts)[0][:-1, :-1]
        inverse = _invert(total[np.ix_(~held, ~held)])
        if inverse is None:
            raise CalibrationError("the evidence does not determine the calibration")
        variance = np.diag(np.square(self._result.parameters.prior_std()[held]))
        by_held = np.eye(len(held))[:, held]
        by_held[~held] = -inverse @ total[np.ix_(~held, held)]
        covariance = by_held @ variance @ by_held.T
        covariance[np.ix_(~held, ~held)] += inverse
        return covariance


def compare_estimates(
    keys: Sequence[ParameterKey], values: Sequence[np.ndarray], covariances: Sequence[np.ndarray], shared: np.ndarray
) -> list[HalfDifference]:
    """Compare two estimates (P,) with covariances (P, P), both with the same prior knowledge ``shared`` (P, P).

    With the normal matrices N of a half and S of the shared knowledge, an estimate is C (N a + S b), C = (N + S)^-1.
    The difference of two has the covariance `C1 N1 C1 + C2 N2 C2 + D S D` with `D = C1 - C2`. Here `C N C = C - C S C`.
    """
    one, other = values
    first, second = covariances
    difference = first - second
    covariance = first - first @ shared @ first + second - second @ shared @ second + difference @ shared @ difference
    variance = np.maximum(np.diag(covariance), (_LEAST_SHARE * np.minimum(np.diag(first), np.diag(second))))
    columns = zip(keys, one.tolist(), other.tolist(), np.sqrt(variance).tolist(), strict=True)
    return [HalfDifference(*each) for each in columns]


def _invert(matrix: np.ndarray) -> np.ndarray | None:
    """Return the inverse of normal equations; None if they are singular."""
    scale = np.sqrt(np.diag(matrix))
    if not (scale > 0).all():
        return None
    try:
        return invert_block(matrix / np.outer(scale, scale), least=_SINGULAR) / np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return None


def split_in_halves(evidence: Sequence[Evidence]) -> tuple[set[ImageId], set[ImageId]]:
    """Return every second image, and the others; targets and steps apart."""
    targets = [
        (number, image)
        for number, piece in enumerate(evidence)
        if isinstance(piece, TargetEvidence)
        for image in np.unique(piece.placement.image).tolist()
    ]
    steps = [(n, piece.image) for n, piece in enumerate(evidence) if isinstance(piece, StepProfileEvidence)]
    return {*targets[::2], *steps[::2]}, {*targets[1::2], *steps[1::2]}
