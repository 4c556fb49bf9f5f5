"""The further shot that would improve measured lengths most, by the information that it would add."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.estimate import Evidence
from uwlts.calibration.joint.evidence import TARGET, Residuals, StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.noise import Noise, with_slope_bias
from uwlts.calibration.joint.observability import (
    Region,
    estimate_in,
    format_weaknesses,
    lengths_over,
    pixels_at,
    regions,
    weaknesses,
)
from uwlts.calibration.joint.parameters import Prior, View
from uwlts.calibration.joint.scanned_surfaces import Spheres, SurfaceScanEvidence
from uwlts.calibration.joint.stored_estimate import StoredEstimate, require_joint
from uwlts.calibration.target_images import Placement, pose_values
from uwlts.model.calibration import Calibration
from uwlts.model.parameter_keys import ParameterKey, StageParameter, StepHeight
from uwlts.model.sensor import Uncertainty
from uwlts.optics.camera import project_through_window
from uwlts.optics.sheet import sheet_surface
from uwlts.targets import Target, parse_target

_FEWEST_POINTS, _FEWEST_LINES = 20, 20  # an image with less determines its own pose poorly
_SAMPLES = 400  # of a curve; more than the image of one needs for a point on each of its lines to be interpolated
# A step standard and spheres as the thesis used them, in size; more images of a sphere say nothing new.
STEP_MM, _STEP_HALF_MM, _STEP_REACH_MM = 20.0, 30.0, 70.0
SPHERES, SPHERE_MM, _SPHERES_APART_MM, _SPHERE_IMAGES = 2, 30.0, 60.0, 29
_SEEN = np.radians(60)
"""A sphere is seen this far round from the side that faces the sensor."""


@dataclass(frozen=True, eq=False)
class Shot:
    """What a shot would say: the estimate, perhaps with parameters that it adds, residuals, and priors of its own.

    ``local_std`` (b,) is what is known before of the shot's local parameters, infinite for those that it has to find.
    """

    known: StoredEstimate
    residuals: list[Residuals]
    local_std: np.ndarray


def target_shot(calibration: Calibration, known: StoredEstimate, target: Target, pose: np.ndarray) -> Shot | None:
    """An image of the target with the stripe on it, at ``T_camera_target`` (4, 4); None where too little is in view."""
    points = target.points_mm
    pixels = _seen(known, points @ pose[:3, :3].T + pose[:3, 3])
    inside = np.isfinite(pixels).all(axis=1)
    lit = _lit(calibration, known, target, pose)
    if inside.sum() < _FEWEST_POINTS or len(lit) < _FEWEST_LINES:
        return None
    extent = target.extent_mm
    middle = extent.mean(axis=0)
    count = int(inside.sum())
    evidence = TargetEvidence(
        view=known.view,
        placement=Placement(points[inside], np.zeros(count), pixels[inside], np.zeros(count, dtype=int), 1.0),
        stripe_pixels=lit,
        stripe_image=np.zeros(len(lit), dtype=int),
        stripe_shifts_mm=np.zeros(len(lit)),
        across=_across(calibration),
        staged=False,
        radius_mm=float(np.linalg.norm(extent - middle, axis=1).max()),
        middle_mm=middle,
    )
    local = pose_values(pose)
    return _shot(known, evidence, local, Uncertainty())


def step_shot(
    calibration: Calibration, known: StoredEstimate, depth_mm: float, uncertainty: Uncertainty
) -> Shot | None:
    """An image of a step standard whose lower tread lies at a depth Z, the evidence's own where it has one.

    None where too little of it is in view.
    """
    height = next((key for key in known.parameters.keys if isinstance(key, StepHeight)), None)
    if height is None:
        height = StepHeight(STEP_MM)
        known = extended(known, {height: Prior(STEP_MM, uncertainty.step_height_mm)})
    y = np.linspace(-_STEP_REACH_MM, _STEP_REACH_MM, _SAMPLES)
    upper = np.abs(y) < _STEP_HALF_MM
    raised = known.parameters.value(known.values, height)
    kept, labels = [], []
    for tread, z in ((~upper & (y < 0), depth_mm), (upper, depth_mm - raised), (~upper & (y > 0), depth_mm)):
        pixels = _on_lines(calibration, known, np.column_stack([y[tread], np.full(tread.sum(), z)]))
        kept.append(pixels)
        labels.append(np.full(len(pixels), z != depth_mm))
    if min(map(len, kept)) < _FEWEST_LINES:
        return None
    frame = calibration.object_transform()
    evidence = StepProfileEvidence(
        view=known.view,
        pixels=np.vstack(kept),
        upper=np.concatenate(labels),
        upward=-frame[:3, 2],
        along=frame[:3, 1],
        across=_across(calibration),
        height=height,
        image=0,
    )
    local = np.array([0.0, -frame[:3, 2] @ (frame[:3, 3] + frame[:3, 2] * depth_mm)])
    return _shot(known, evidence, local, uncertainty)


def sphere_shot(
    calibration: Calibration, known: StoredEstimate, depth_mm: float, uncertainty: Uncertainty
) -> Shot | None:
    """A scan along X of two spheres of unknown size, their centres at a depth Z; None where they are not in view."""
    lean = float(np.tan(np.radians(uncertainty.stage_alignment_deg)))
    stage: dict[ParameterKey, Prior] = {
        StageParameter.SLOPE_1: Prior(0.0, lean),
        StageParameter.SLOPE_2: Prior(0.0, lean),
        StageParameter.SCALE: Prior(0.0, uncertainty.stage_scale),
    }
    known = extended(known, stage)
    frame, radius = calibration.object_transform(), SPHERE_MM / 2
    positions = np.linspace(-0.9, 0.9, _SPHERE_IMAGES) * radius
    centres = np.array([(0.0, side * _SPHERES_APART_MM / 2, depth_mm) for side in (-1, 1)])
    turn = np.linspace(-_SEEN, _SEEN, _SAMPLES)
    pixels, sphere, image = [], [], []
    for number, at in enumerate(positions):
        chord = np.sqrt(radius**2 - at**2)
        for which, centre in enumerate(centres):
            found = _on_lines(calibration, known, centre[1:] + chord * np.column_stack([np.sin(turn), -np.cos(turn)]))
            pixels.append(found)
            sphere.append(np.full(len(found), which))
            image.append(np.full(len(found), number))
    if min(map(len, pixels)) < _FEWEST_LINES:
        return None
    unknown = np.full(SPHERES, np.inf)
    surface = Spheres(
        np.full(SPHERES, SPHERE_MM),
        unknown,
        np.full(SPHERES - 1, _SPHERES_APART_MM),
        unknown[1:],
        np.concatenate(sphere),
    )
    stripes = np.vstack(pixels)
    evidence = SurfaceScanEvidence(
        view=known.view,
        pixels=stripes,
        beside_mm=np.zeros((3, len(stripes))),
        surface=surface,
        frame=np.concatenate(image),
        stage_mm=positions,
        direction=frame[:3, 0],
        across_stage=frame[:3, 1:3].T,
        across=_across(calibration),
        image=0,
        source="",
    )
    local = np.concatenate([(centres @ frame[:3, :3].T + frame[:3, 3]).ravel(), np.zeros(SPHERES + len(positions))])
    return _shot(known, evidence, local, uncertainty)


def _shot(known: StoredEstimate, evidence: Evidence, local: np.ndarray, uncertainty: Uncertainty) -> Shot | None:
    """The shot of some evidence; None where a ray meets nothing."""
    parts = evidence.residuals(known.parameters, known.values, local)
    lean = float(np.tan(np.radians(uncertainty.stage_alignment_deg)))
    std = evidence.local_std(alignment=lean, position_mm=uncertainty.stage_position_mm)
    return None if parts is None else Shot(known, parts, std)


def extended(known: StoredEstimate, priors: Mapping[ParameterKey, Prior]) -> StoredEstimate:
    """The estimate with those of these parameters that it lacks and that are not known exactly, behind its own."""
    added = {key: prior for key, prior in priors.items() if key not in known.parameters.keys and prior.std > 0}
    count = len(known.values)
    covariance = np.zeros((count + len(added),) * 2)
    covariance[:count, :count] = known.covariance
    covariance[range(count, len(covariance)), range(count, len(covariance))] = [p.std**2 for p in added.values()]
    return replace(
        known,
        parameters=replace(known.parameters, priors=known.parameters.priors | added),
        values=np.append(known.values, [prior.mean for prior in added.values()]),
        covariance=covariance,
    )


def _lit(calibration: Calibration, known: StoredEstimate, target: Target, pose: np.ndarray) -> np.ndarray:
    """Stripe pixels on the target, one for each profile line, by the plane that is nearest to the sheet."""
    index = known.parameters.medium_index(known.values, known.view)
    sheet = sheet_surface(known.parameters.sheet_model(known.values), medium_index=index)
    facing, along = pose[:3, 2], np.cross(sheet.normal, pose[:3, 2])
    if np.linalg.norm(along) < 1e-3:
        return np.empty((0, 2))
    along /= np.linalg.norm(along)
    middle = np.append(target.extent_mm.mean(axis=0), 0.0)
    rows = np.stack([sheet.normal, facing, along])
    centre = pose[:3, :3] @ middle + pose[:3, 3]
    start = np.linalg.solve(rows, np.array([sheet.offset_mm, facing @ centre, along @ centre]))
    extent, margin = target.extent_mm, target.spacing_mm / 2
    reach = float(np.ptp(extent, axis=0).sum())
    points = start + np.linspace(-reach, reach, _SAMPLES)[:, None] * along
    at = (points - pose[:3, 3]) @ pose[:3, :3]
    on_plate = ((at[:, :2] >= extent.min(axis=0) - margin) & (at[:, :2] <= extent.max(axis=0) + margin)).all(axis=1)
    return _lines_through(calibration, _seen(known, points[on_plate]))


def _on_lines(calibration: Calibration, known: StoredEstimate, at_mm: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of a curve Y and Z (K, 2) on the sheet, one for each profile line in the image."""
    pixels = pixels_at(calibration, known, at_mm)
    return _lines_through(calibration, np.where(_in_image(known, pixels)[:, None], pixels, np.nan))


def _lines_through(calibration: Calibration, pixels: np.ndarray) -> np.ndarray:
    across = _across(calibration)
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    if len(seen) < 2:
        return np.empty((0, 2))
    seen = seen[np.argsort(seen[:, 1 - across])]
    lines = np.arange(np.ceil(seen[0, 1 - across]), np.floor(seen[-1, 1 - across]) + 1)
    centres = np.interp(lines, seen[:, 1 - across], seen[:, across])
    return np.column_stack([lines, centres] if across else [centres, lines])


def _seen(known: StoredEstimate, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in the camera frame; NaN outside the image."""
    parameters = known.parameters
    window = parameters.window_model(known.values) if known.view.window else None
    index = parameters.medium_index(known.values, known.view)
    pixels = project_through_window(parameters.camera(known.values), window, points, medium_index=index)
    return np.where(_in_image(known, pixels)[:, None], pixels, np.nan)


def _in_image(known: StoredEstimate, pixels: np.ndarray) -> np.ndarray:
    camera = known.parameters.camera(known.values)
    return np.all((pixels >= 0) & (pixels <= [camera.width_px - 1, camera.height_px - 1]), axis=1)


def _across(calibration: Calibration) -> int:
    """The coordinate of the pixel that runs across the stripe."""
    return 1 if calibration.stripe_along == "width" else 0


_TILT_DEG = 20.0  # easily reached by hand, and printed circles stay detectable
_PLACES = {"near": 0.05, "in the middle": 0.5, "far": 0.95}
_TILTS = {
    "square": (0.0, 0.0),
    "left edge nearer": (0.0, -1.0),
    "right edge nearer": (0.0, 1.0),
    "upper edge nearer": (1.0, 0.0),
    "lower edge nearer": (-1.0, 0.0),
}
"""Turns about the camera's x and y axes."""
_HELPFUL = 0.95  # of the uncertainty before: less than a twentieth is not an improvement


@dataclass(frozen=True, eq=False)
class Outlook:
    """A shot and what it would do.

    Attributes
    ----------
    before_mm, after_mm : standard uncertainty of lengths over the volume (root mean square), without and with it
    covariance : (P, P); of the parameters with it
    pose : (4, 4), optional; ``T_camera_target`` of a target
    """

    words: str
    before_mm: float
    after_mm: float
    covariance: np.ndarray
    view: View
    pose: np.ndarray | None = None

    def advice(self) -> str:
        """The shot as advice, without a full stop."""
        if self.after_mm > _HELPFUL * self.before_mm:
            return "no further shot alone would lower the uncertainty of lengths by a twentieth"
        return (
            f"{self.words} would lower the standard uncertainty of lengths over the volume from {self.before_mm:.4f} "
            f"to {self.after_mm:.4f} mm"
        )


_Candidate = tuple[str, Shot | None, np.ndarray | None]
"""A shot in words, what it would say if it is possible, and the pose of a target."""


def next_shots(calibration: Calibration) -> list[Outlook]:
    """Further shots, the most helpful one first; none where the evidence covers no area.

    Raises CalibrationError: the calibration holds no joint estimate, or a damaged one.
    """
    region = next(iter(regions(calibration)), None)
    if region is None or not region.has_area():
        return []
    known = estimate_in(calibration, region)
    lengths = lengths_over(calibration, known, region)
    count, before_mm, found = len(known.values), _rms(lengths.std_mm(known.covariance)), []
    for words, shot, pose in _candidates(calibration, known, region):
        if shot is not None:
            covariance = _with(shot.known.covariance, information(calibration, shot))[:count, :count]
            after_mm = _rms(lengths.std_mm(covariance))
            found.append(Outlook(words, before_mm, after_mm, covariance, shot.known.view, pose))
    return sorted(found, key=lambda outlook: outlook.after_mm)


def information(calibration: Calibration, shot: Shot) -> np.ndarray:
    """What a shot adds (P, P) to the inverse of the covariance."""
    count, local, noise = len(shot.known.values), len(shot.local_std), _noise_of(calibration, shot)
    total = np.zeros((count + local,) * 2)
    for part in shot.residuals:
        weight = noise[part.kind].effective_px() ** -2
        rows = np.hstack([part.by_global, part.by_local])
        at = np.r_[0:count, count + part.local_columns]
        total[np.ix_(at, at)] += weight * np.einsum("ni,nj->ij", rows, rows)
    border, block = total[:count, count:], total[count:, count:] + np.diag(shot.local_std**-2.0)
    scale = 1.0 / np.sqrt(np.diag(block))
    border, block = border * scale, block * np.outer(scale, scale)
    return total[:count, :count] - border @ np.linalg.solve(block, border.T)


def _noise_of(calibration: Calibration, shot: Shot) -> dict[str, Noise]:
    """Noise of every kind of a shot's residuals; that of the noisiest other stripe for a kind new to the evidence."""
    joint = require_joint(calibration)
    known = {name: Noise(sigma, joint.shared_variance[name]) for name, sigma in joint.scatter_px.items()}
    stripe = max((noise for name, noise in known.items() if name != TARGET), key=Noise.effective_px)
    found = {kind: known.get(kind, stripe) for kind in {part.kind for part in shot.residuals}}
    if Spheres.kind in found:
        each = sum(len(part.values) for part in shot.residuals) / SPHERES
        found[Spheres.kind] = with_slope_bias(found[Spheres.kind], points_per_body=each)
    return found


def _with(covariance: np.ndarray, added: np.ndarray) -> np.ndarray:
    """The covariance with further information, by a root of it, as its inverse may be out of reach of rounding."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    root = std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root @ np.linalg.solve(np.eye(len(std)) + root.T @ added @ root, root.T)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _candidates(calibration: Calibration, known: StoredEstimate, region: Region) -> Iterator[_Candidate]:
    origin = calibration.origin()
    uncertainty = origin.known_before
    low, high = region.outline_mm[:, 1].min(), region.outline_mm[:, 1].max()
    depths = {words: float(low + share * (high - low)) for words, share in _PLACES.items()}
    target = None if origin.target is None else parse_target(origin.target)
    if target is not None:
        yield from _targets(calibration, known, region.name, target, depths)
        # One image in air is of use beside others taken so, whose series determines the camera.
        in_air = [other.view for other in regions(calibration) if other.view.medium is None]
        if region.view.medium is not None and in_air:
            yield from _targets(calibration, replace(known, view=in_air[0]), "air", target, depths)
    for words, depth in depths.items():
        place = f"in {region.name}, {words} (Z {depth:+.0f} mm),"
        yield f"an image of a step {place}", step_shot(calibration, known, depth, uncertainty), None
        spheres = f"a scan of two spheres of {SPHERE_MM:g} mm {place}"
        yield spheres, sphere_shot(calibration, known, depth, uncertainty), None


def _targets(
    calibration: Calibration, known: StoredEstimate, medium: str, target: Target, depths: dict[str, float]
) -> Iterator[_Candidate]:
    through = " without the window" if calibration.window is not None and not known.view.window else ""
    for where, depth in depths.items():
        for tilt, turns in _TILTS.items():
            pose = _pose(calibration, target, depth, turns)
            words = f"an image of the target in {medium}{through}, {where} (Z {depth:+.0f} mm), {tilt}"
            words += "," if tilt == "square" else f" by {_TILT_DEG:g}°,"
            yield words, target_shot(calibration, known, target, pose), pose


def _pose(calibration: Calibration, target: Target, depth_mm: float, turns: tuple[float, float]) -> np.ndarray:
    """``T_camera_target`` (4, 4) with the target's middle on the OCS's axis, turned from being square to that axis."""
    frame, angles = calibration.object_transform(), np.radians(_TILT_DEG) * np.array(turns)
    (cx, cy), (sx, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    pose = np.eye(4)
    pose[:3, :3] = about_x @ about_y @ frame[:3, :3]
    middle = np.append(target.extent_mm.mean(axis=0), 0.0)
    pose[:3, 3] = frame[:3, 3] + depth_mm * frame[:3, 2] - pose[:3, :3] @ middle
    return pose


def advice_lines(calibration: Calibration) -> list[str]:
    """Weak directions and the shot that would help most; CalibrationError where the estimate is missing or damaged."""
    region = next(iter(regions(calibration)), None)
    if region is None or not region.has_area():
        return ["the stripes of the evidence cover no area: the uncertainty of lengths measured by it is not known"]
    known = estimate_in(calibration, region)
    lengths = lengths_over(calibration, known, region)
    lines = format_weaknesses(weaknesses(lengths, known.parameters.keys, known.covariance))
    return [*lines, *(f"next: {outlook.advice()}" for outlook in next_shots(calibration)[:1])]
