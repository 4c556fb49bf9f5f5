"""Which further shot would make a joint calibration measure lengths best, by the information that it would add.

A shot adds to the inverse of the covariance J^T W J less what its own unknowns, such as the target's pose, take away
(Schur complement): the estimate's own derivatives, at the places where target, step and spheres would be seen, weighted
by the noise that the evidence shows.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.noise import Noise, with_slope_bias
from uwlts.calibration.joint.observations import TARGET
from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.shots import SPHERE_MM, SPHERES, Shot, sphere_shot, step_shot, target_shot
from uwlts.calibration.joint.stored import StoredEstimate, require_joint
from uwlts.calibration.joint.surfaces import Spheres
from uwlts.calibration.joint.volume import Lengths, Region, estimate_in, lengths_over, regions
from uwlts.calibration.model import Calibration
from uwlts.targets import Target, parse_target

_TILT_DEG = 20.0
_PLACES = {"near": 0.05, "in the middle": 0.5, "far": 0.95}
_TILTS = {
    "square": (0.0, 0.0), "left edge nearer": (0.0, -1.0), "right edge nearer": (0.0, 1.0),
    "upper edge nearer": (1.0, 0.0), "lower edge nearer": (-1.0, 0.0),
}  # fmt: skip
"""Turns about the camera's x and y axes."""
_WORTH = 0.95


@dataclass(frozen=True, eq=False)
class Outlook:
    """A shot and what it would do.

    Attributes
    ----------
    words : str
    before_mm, after_mm : float
        Standard uncertainty of lengths over the volume (root mean square), without and with it.
    covariance : (P, P)
        Of the parameters with it.
    view : View
    pose : (4, 4), optional
        ``T_camera_target`` of a target.
    """

    words: str
    before_mm: float
    after_mm: float
    covariance: np.ndarray
    view: View
    pose: np.ndarray | None = None

    def advice(self) -> str:
        """The shot as advice, without a full stop."""
        if self.after_mm > _WORTH * self.before_mm:
            return "no further shot alone would lower the uncertainty of lengths by a twentieth"
        return (
            f"{self.words} would lower the standard uncertainty of lengths over the volume from {self.before_mm:.4f} "
            f"to {self.after_mm:.4f} mm"
        )


@dataclass(frozen=True, eq=False)
class _Candidate:
    words: str
    shot: Shot | None
    pose: np.ndarray | None = None


def next_shots(calibration: Calibration) -> list[Outlook]:
    """Further shots, the most helpful one first; none where the evidence covers no area.

    Raises
    ------
    CalibrationError
        The calibration holds no joint estimate, or a damaged one.
    """
    region = next(iter(regions(calibration)), None)
    if region is None or not region.has_area():
        return []
    known = estimate_in(calibration, region)
    lengths = lengths_over(calibration, known, region)
    found = [
        _outlook(calibration, candidate, candidate.shot, lengths, known)
        for candidate in _candidates(calibration, known, region)
        if candidate.shot is not None
    ]
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


def _outlook(
    calibration: Calibration, candidate: _Candidate, shot: Shot, lengths: Lengths, known: StoredEstimate
) -> Outlook:
    count = len(known.values)
    covariance = _with(shot.known.covariance, information(calibration, shot))[:count, :count]
    return Outlook(
        candidate.words, _rms(lengths.std_mm(known.covariance)), _rms(lengths.std_mm(covariance)), covariance,
        shot.known.view, candidate.pose,
    )  # fmt: skip


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
        # One image in air is of use beside others taken so, whose series tells the camera.
        in_air = [other.view for other in regions(calibration) if other.view.medium is None]
        if region.view.medium is not None and in_air:
            yield from _targets(calibration, replace(known, view=in_air[0]), "air", target, depths)
    for words, depth in depths.items():
        place = f"in {region.name}, {words} (Z {depth:+.0f} mm),"
        yield _Candidate(f"an image of a step {place}", step_shot(calibration, known, depth, uncertainty))
        yield _Candidate(
            f"a scan of two spheres of {SPHERE_MM:g} mm {place}", sphere_shot(calibration, known, depth, uncertainty)
        )


def _targets(
    calibration: Calibration, known: StoredEstimate, medium: str, target: Target, depths: dict[str, float]
) -> Iterator[_Candidate]:
    through = " without the window" if calibration.window is not None and not known.view.window else ""
    for where, depth in depths.items():
        for tilt, turns in _TILTS.items():
            pose = _pose(calibration, target, depth, turns)
            words = f"an image of the target in {medium}{through}, {where} (Z {depth:+.0f} mm), {tilt}"
            words += "," if tilt == "square" else f" by {_TILT_DEG:g}°,"
            yield _Candidate(words, target_shot(calibration, known, target, pose), pose)


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
