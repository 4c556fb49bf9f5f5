"""Images that may be added to a joint calibration, with the reduction of the uncertainty of lengths by each."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.camera.camera_parameters import Placement, pose_values
from uwlts.calibration.joint.estimate import Evidence, Noise, add_common_error
from uwlts.calibration.joint.observability import (
    SheetRegion,
    compute_mesh_lengths,
    find_weaknesses,
    format_weaknesses,
    list_regions,
    project_sheet_points,
    read_region_estimate,
)
from uwlts.calibration.joint.parameters import Prior
from uwlts.calibration.joint.residuals import TARGET, StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import SLOPES, ScannedSpheres, SurfaceScanEvidence
from uwlts.calibration.joint.stored_estimate import StoredEstimate, require_joint
from uwlts.fitting.next_observation import Candidate, CovarianceRoot, Forecast, eliminate_others, rank_candidates
from uwlts.fitting.schur_least_squares import normal_equations
from uwlts.model.calibration import Calibration, rigid_transform
from uwlts.model.parameter_keys import ParameterKey, StageParameter, StepHeight
from uwlts.optics.triangulation import sheet_surface
from uwlts.stripe.capture_stripes import FEWEST_LINES
from uwlts.targets import Target, parse_target

WHOLE_VOLUME = "lengths over the volume"
_FEWEST_POINTS = 20  # target points in view: fewer determine the pose of an image poorly
_SAMPLES = 400  # points of a curve, enough to interpolate a point on each profile line of its image
_STEP_MM = 20.0
"""Height of the step standard, as in the thesis."""
_STEP_HALF_MM = 30.0  # half the length of its upper face along the stripe
_STEP_REACH_MM = 70.0  # extent of its lower faces from the middle
_SPHERES = 2  # of the standard that an image of a sphere pair shows
_SPHERE_MM = 30.0
"""Diameter of the spheres, as in the thesis."""
_SPHERES_APART_MM = 60.0  # spacing of their centres, twice the diameter
_SPHERE_IMAGES = 29  # images of their scan, some 1 mm apart; more are redundant
_ON_SPHERES_PX = 0.01
"""Standard uncertainty of stripe centres on matt spheres by blur, for a stripe with a full width of 4 px."""

_SEEN = np.radians(60)
"""Visible angle of a sphere from the side that faces the sensor."""

_TILT_DEG = 20.0  # easily reached by hand, and printed circles remain detectable
_PLACES = {"near": 0.05, "in the middle": 0.5, "far": 0.95}
_TILTS = {
    "square": (0.0, 0.0),
    "left edge nearer": (0.0, -1.0),
    "right edge nearer": (0.0, 1.0),
    "upper edge nearer": (1.0, 0.0),
    "lower edge nearer": (-1.0, 0.0),
}
"""Rotations about the camera's x and y axes."""


_Simulated = tuple[StoredEstimate, Evidence, np.ndarray]
"""The estimate (with parameters that the image adds), the image's evidence, and its local parameters."""


def rank_next_shots(calibration: Calibration) -> list[Forecast]:
    """Return possible further images, the most helpful one first; empty if the evidence covers no area.

    They are compared by the standard uncertainty of lengths over the volume (root mean square), mm. Their poses are
    ``T_camera_object``.

    Raises CalibrationError if the calibration contains no joint estimate, or a damaged one.
    """
    region = next(iter(list_regions(calibration)), None)
    if region is None or not region.has_area():
        return []
    known = read_region_estimate(calibration, region)
    lengths = compute_mesh_lengths(known, region).by_parameters
    return rank_candidates(CovarianceRoot.from_covariance(known.covariance), lengths, _generate_shots(known, region))


def advice_lines(calibration: Calibration) -> list[str]:
    """Describe weak directions and the most helpful image.

    Raises CalibrationError if the calibration contains no joint estimate, or a damaged one.
    """
    region = next(iter(list_regions(calibration)), None)
    if region is None or not region.has_area():
        return ["the stripes of the evidence cover no area: the uncertainty of measured lengths is not known"]
    known = read_region_estimate(calibration, region)
    weak = find_weaknesses(compute_mesh_lengths(known, region), known.parameters.keys, known.covariance)
    best = rank_next_shots(calibration)[:1]
    return [*format_weaknesses(weak), *(f"next: {forecast.advice(WHOLE_VOLUME)}" for forecast in best)]


def _generate_shots(known: StoredEstimate, region: SheetRegion) -> Iterator[Candidate]:
    """Generate images of the target, if the calibration used one, and of a step, and scans of two spheres."""
    low, high = region.outline_mm[:, 1].min(), region.outline_mm[:, 1].max()
    depths = {text: float(low + share * (high - low)) for text, share in _PLACES.items()}
    shots = [*_simulate_targets(known, region.name, depths)]
    for text, depth in depths.items():
        place, pose = f"in {region.name}, {text} (Z {depth:+.0f} mm),", _pose(known.calibration, np.zeros(3), depth)
        spheres = f"a scan of two spheres of {_SPHERE_MM:g} mm {place}"
        shots += [(f"an image of a step {place}", pose, _simulate_step(known, depth))]
        shots += [(spheres, pose, _simulate_spheres(known, depth))]
    for text, pose, shot in shots:
        if shot is not None and (added := _compute_information(shot, len(known.values))) is not None:
            yield Candidate(words=text, information=added, pose=pose)


def _simulate_targets(
    known: StoredEstimate, medium: str, depths: Mapping[str, float]
) -> Iterator[tuple[str, np.ndarray, _Simulated | None]]:
    """Generate descriptions, poses and simulated images (None if impossible) of the target."""
    described = known.calibration.origin().target
    if described is None:
        return
    target, views = parse_target(described), {medium: known.view}
    # An image in air helps only beside others in air, whose series determines the camera.
    in_air = [other.view for other in list_regions(known.calibration) if other.view.medium is None]
    if known.view.medium is not None and in_air:
        views["air"] = in_air[0]
    middle = np.append(target.extent_mm.mean(axis=0), 0.0)
    for (name, view), (where, depth), (tilt, turns) in product(views.items(), depths.items(), _TILTS.items()):
        through = " without the window" if known.calibration.window is not None and not view.window else ""
        pose = _pose(known.calibration, middle, depth, turns)
        by = "" if tilt == "square" else f" by {_TILT_DEG:g}°"
        text = f"an image of the target in {name}{through}, {where} (Z {depth:+.0f} mm), {tilt}{by},"
        yield text, pose, _simulate_target(replace(known, view=view), target, pose)


def _pose(
    calibration: Calibration, middle: np.ndarray, depth_mm: float, turns: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Return ``T_camera_object`` (4, 4) with the object's middle (3,) on the OCS's axis, tilted by ``turns``."""
    frame = calibration.object_transform()
    turn = Rotation.from_euler("XY", _TILT_DEG * np.array(turns), degrees=True).as_matrix() @ frame[:3, :3]
    return rigid_transform(turn, frame[:3, 3] + depth_mm * frame[:3, 2] - turn @ middle)


def _simulate_target(known: StoredEstimate, target: Target, pose: np.ndarray) -> _Simulated | None:
    """Simulate an image of the target with the stripe at ``T_camera_target`` (4, 4); None if too little is in view."""
    points = target.points_mm
    pixels = _mask_outside(known, known.project(points @ pose[:3, :3].T + pose[:3, 3]))
    inside = np.isfinite(pixels).all(axis=1)
    count, lit = int(inside.sum()), _simulate_stripe(known, target, pose)
    if count < _FEWEST_POINTS or len(lit) < FEWEST_LINES:
        return None
    evidence = TargetEvidence(
        view=known.view,
        placement=Placement(points[inside], np.zeros(count), pixels[inside], np.zeros(count, dtype=int), 1.0),
        pixels=lit,
        image=np.zeros(len(lit), dtype=int),
        shifts_mm=np.zeros(len(lit)),
        across=known.across(),
        staged=False,
        extent_mm=target.extent_mm,
    )
    return known, evidence, pose_values(pose)


def _simulate_step(known: StoredEstimate, depth_mm: float) -> _Simulated | None:
    """Simulate an image of a step standard with the lower face at a depth Z; None if too little is in view.

    The standard of the evidence is used if it contains one.
    """
    height = next((key for key in known.parameters.keys if isinstance(key, StepHeight)), None)
    if height is None:
        height = StepHeight(_STEP_MM)
        std = known.calibration.origin().known_before.step_height_mm
        known = _append_parameters(known, {height: Prior(_STEP_MM, std)})
    y = np.linspace(-_STEP_REACH_MM, _STEP_REACH_MM, _SAMPLES)
    upper = np.abs(y) < _STEP_HALF_MM
    raised = depth_mm - known.parameters.value(known.values, height)
    faces = ((~upper & (y < 0), depth_mm), (upper, raised), (~upper & (y > 0), depth_mm))
    kept = [_sample_curve(known, np.column_stack([y[face], np.full(face.sum(), z)])) for face, z in faces]
    if min(map(len, kept)) < FEWEST_LINES:
        return None
    frame = known.calibration.object_transform()
    evidence = StepProfileEvidence(
        view=known.view,
        pixels=np.vstack(kept),
        across=known.across(),
        upper=np.repeat([z != depth_mm for _, z in faces], [len(pixels) for pixels in kept]),
        upward=-frame[:3, 2],
        along=frame[:3, 1],
        height=height,
        image=0,
    )
    return known, evidence, np.array([0.0, -frame[:3, 2] @ (frame[:3, 3] + frame[:3, 2] * depth_mm)])


def _simulate_spheres(known: StoredEstimate, depth_mm: float) -> _Simulated | None:
    """Simulate a scan along X of two spheres of unknown size at a depth Z; None if they are not in view."""
    uncertainty = known.calibration.origin().known_before
    stage: dict[ParameterKey, Prior] = {key: Prior(0.0, uncertainty.stage_lean()) for key in SLOPES}
    known = _append_parameters(known, stage | {StageParameter.SCALE: Prior(0.0, uncertainty.stage_scale)})
    frame, radius = known.calibration.object_transform(), _SPHERE_MM / 2
    positions = np.linspace(-0.9, 0.9, _SPHERE_IMAGES) * radius
    centres = np.array([(0.0, side * _SPHERES_APART_MM / 2, depth_mm) for side in (-1, 1)])
    turn = np.linspace(-_SEEN, _SEEN, _SAMPLES)
    arc = np.column_stack([np.sin(turn), -np.cos(turn)])
    chords = np.sqrt(radius**2 - positions**2)
    pixels = [_sample_curve(known, centre[1:] + chord * arc) for chord in chords for centre in centres]
    counts = [len(found) for found in pixels]
    if min(counts) < FEWEST_LINES:
        return None
    unknown = np.full(_SPHERES, np.inf)
    sphere = np.repeat(np.tile(np.arange(_SPHERES), _SPHERE_IMAGES), counts)
    spacings = np.full(_SPHERES - 1, _SPHERES_APART_MM)
    evidence = SurfaceScanEvidence(
        view=known.view,
        pixels=np.vstack(pixels),
        across=known.across(),
        beside_mm=np.zeros((3, sum(counts))),
        common_px=np.full(sum(counts), _ON_SPHERES_PX),
        surface=ScannedSpheres(np.full(_SPHERES, _SPHERE_MM), unknown, spacings, unknown[1:], sphere),
        frame=np.repeat(np.repeat(np.arange(_SPHERE_IMAGES), _SPHERES), counts),
        stage_mm=positions,
        direction=frame[:3, 0],
        across_stage=frame[:3, 1:3].T,
        image=0,
    )
    return known, evidence, np.append(centres @ frame[:3, :3].T + frame[:3, 3], np.zeros(_SPHERES + len(positions)))


def _append_parameters(known: StoredEstimate, priors: Mapping[ParameterKey, Prior]) -> StoredEstimate:
    """Append those of these parameters to an estimate that it does not contain and that are not known exactly."""
    added = {key: prior for key, prior in priors.items() if key not in known.parameters.keys and prior.std > 0}
    parameters = replace(known.parameters, priors=known.parameters.priors | added)
    return replace(known, parameters=parameters, values=np.append(known.values, [p.mean for p in added.values()]))


def _simulate_stripe(known: StoredEstimate, target: Target, pose: np.ndarray) -> np.ndarray:
    """Return stripe pixels on the target, one for each profile line, from the plane that approximates the sheet."""
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
    reach = float(np.ptp(target.plate_mm, axis=0).sum())
    points = start + np.linspace(-reach, reach, _SAMPLES)[:, None] * along
    at = (points - pose[:3, 3]) @ pose[:3, :3]
    return _interpolate_lines(known, known.project(points[target.is_on_plate(at[:, :2])]))


def _sample_curve(known: StoredEstimate, at_mm: np.ndarray) -> np.ndarray:
    """Return pixels (N, 2) of a curve Y and Z (K, 2) on the sheet, one for each profile line in the image."""
    return _interpolate_lines(known, project_sheet_points(known, at_mm))


def _interpolate_lines(known: StoredEstimate, pixels: np.ndarray) -> np.ndarray:
    across, pixels = known.across(), _mask_outside(known, pixels)
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    if len(seen) < 2:
        return np.empty((0, 2))
    seen = seen[np.argsort(seen[:, 1 - across])]
    lines = np.arange(np.ceil(seen[0, 1 - across]), np.floor(seen[-1, 1 - across]) + 1)
    centres = np.interp(lines, seen[:, 1 - across], seen[:, across])
    return np.column_stack([lines, centres] if across else [centres, lines])


def _mask_outside(known: StoredEstimate, pixels: np.ndarray) -> np.ndarray:
    """Replace pixels (N, 2) outside the image by NaN."""
    camera = known.parameters.camera(known.values)
    inside = np.all((pixels >= 0) & (pixels <= [camera.width_px - 1, camera.height_px - 1]), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _compute_information(shot: _Simulated, known: int) -> np.ndarray | None:
    """Return the information on the first ``known`` parameters that an image adds; None if a ray meets nothing.

    The noise is that of the same kind of residual, or of the noisiest stripe for a new kind.
    """
    estimate, evidence, local_values = shot
    parts = evidence.residuals(estimate.parameters, estimate.values, local_values)
    if parts is None:
        return None
    joint = require_joint(estimate.calibration)
    noise = {name: Noise(sigma, joint.shared_variance[name]) for name, sigma in joint.scatter_px.items()}
    stripe = max((each for name, each in noise.items() if name != TARGET), key=Noise.effective_px)
    noise = {part.kind: noise.get(part.kind, stripe) for part in parts}
    if isinstance(evidence, SurfaceScanEvidence):
        kind, surface = evidence.surface.kind, evidence.surface
        noise[kind] = add_common_error(noise[kind], evidence.common_px, bodies=surface.count)
    rows = [part.weighted(noise[part.kind].effective_px()) for part in parts]
    before = evidence.known_before(local_values, estimate.calibration.origin().known_before)
    total = normal_equations([*rows, before], len(estimate.values), len(local_values))[0][:-1, :-1]
    added = np.arange(known, len(estimate.values))
    total[added, added] += estimate.parameters.prior_std()[added] ** -2.0
    return eliminate_others(total, known)
