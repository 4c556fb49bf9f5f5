"""How well the form of the volume is known: each point's standard uncertainty with a rigid motion of all taken out."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.volume import points_at
from uwlts.certificate.lengths import InUse, lengths_of

_ROWS, _COLUMNS = 17, 21
_SHORT_SHARE = 0.25
"""Of the volume's depth and width: a length whose uncertainty is shown where it is measured."""


@dataclass(frozen=True, eq=False)
class Form:
    """Standard uncertainties over a mesh (R, C) of the sheet, mm.

    Attributes
    ----------
    at_mm : (R, C, 2)
        Y and Z.
    calibration_mm, point_mm : (R, C, 3)
        Of X, Y and Z of a point: by the calibration alone, and with the stripe's noise.
    short_mm : float
        A length that fits well into the volume.
    along_y_mm, along_z_mm : (R, C)
        Of that length by the calibration, about each point as far as the volume reaches.
    """

    at_mm: np.ndarray
    calibration_mm: np.ndarray
    point_mm: np.ndarray
    short_mm: float
    along_y_mm: np.ndarray
    along_z_mm: np.ndarray


def form_of(use: InUse) -> Form:
    """The form's uncertainty in a calibration's region."""
    mesh = use.region.mesh(_ROWS, _COLUMNS)
    at = mesh.reshape(-1, 2)
    points = points_at(use.calibration, use.known, at)
    std = np.sqrt(np.diag(use.covariance))
    scale = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(use.covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    moved = without_rigid_motion(at, (points.by_parameters @ root).transpose(2, 0, 1))
    calibration = np.sqrt(np.sum(moved**2, axis=0))
    noise = points.by_px * use.noise_px
    short = _round_length(_SHORT_SHARE * float(np.ptp(use.region.outline_mm, axis=0).min()))
    return Form(
        at_mm=mesh,
        calibration_mm=calibration.reshape(*mesh.shape[:2], 3),
        point_mm=np.hypot(calibration, noise).reshape(*mesh.shape[:2], 3),
        short_mm=short,
        along_y_mm=_of_short(use, mesh, np.array([short, 0.0])),
        along_z_mm=_of_short(use, mesh, np.array([0.0, short])),
    )


def without_rigid_motion(at_mm: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Displacements (R, N, 3) of points at Y and Z (N, 2) less the rigid motions that fit them best."""
    points = np.column_stack([np.zeros(len(at_mm)), at_mm - at_mm.mean(axis=0)])
    turns = np.cross(np.eye(3)[:, None], points[None])
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    basis, _ = np.linalg.qr(np.concatenate([shifts, turns]).reshape(6, -1).T)
    flat = moved.reshape(len(moved), -1)
    return (flat - (flat @ basis) @ basis.T).reshape(moved.shape)


def _of_short(use: InUse, mesh: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Standard uncertainty (R, C) of a length (2,) whose middle is at each point of the mesh, or as near as it fits."""
    middle = mesh.reshape(-1, 2).copy()
    low, high = use.region.outline_mm[:, 1].min(), use.region.outline_mm[:, 1].max()
    half = length / 2
    middle[:, 1] = np.clip(middle[:, 1], low + half[1], high - half[1])
    for at in middle:
        ranges = [use.region.width_at(z) for z in {at[1] - half[1], at[1] + half[1]}]
        left, right = max(a for a, _ in ranges) + half[0], min(b for _, b in ranges) - half[0]
        at[0] = np.clip(at[0], left, right) if left < right else (left + right) / 2
    ends = np.stack([middle - half, middle + half], axis=1)
    return lengths_of(use, ends).std_mm(use.covariance).reshape(mesh.shape[:2])


def _round_length(length_mm: float) -> float:
    """The largest of 1, 2, 5 times a power of ten within a length."""
    power = 10.0 ** np.floor(np.log10(length_mm))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length_mm))
