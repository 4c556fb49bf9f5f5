"""What each piece of evidence says of the parameters: residuals in pixels, and their derivatives.

A residual is the distance in the image between what was found and what the parameters predict. It is calculated on the
object, where the ray of the found pixel should meet a known point or plane, and brought back to the image by the
derivative by the pixel: exact to the second order in the residual, and without a search for the predicted pixel.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.calibration.joint.rays import COLUMNS
from uwlts.calibration.target_placement import Placement

TARGET, STRIPE, STEP = "target", "stripe on the target", "stripe on the step"


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals (n,) in px with their derivatives by shared (n, P) and own (n, b) parameters, and which kind they are.

    ``image`` (n,) tells from which image of its evidence each comes.
    """

    kind: str
    values: np.ndarray
    by_shared: np.ndarray
    by_own: np.ndarray
    image: np.ndarray


@dataclass(frozen=True, eq=False)
class TargetEvidence:
    """Images of one placement of the target with the stripes on it; own parameters are its pose, and the stage's.

    The own parameters are rotation vector and shift ``T_camera_target`` at the first image, and where the stage moved:
    the tilt of its direction against the target's normal (2,) and an error of every position but the first, in mm.

    Attributes
    ----------
    view : View
    placement : Placement
        The target's points as found.
    stripe_pixels : (M, 2)
    stripe_image : (M,)
        Number of each stripe pixel's image.
    stripe_shifts_mm : (M,)
        Stage position of each, from that of the first image.
    across : {0, 1}
        The coordinate of the pixel that runs across the stripe.
    staged : bool
        Whether the images are joined by the stage's motion.
    radius_mm : float
        Largest distance of a point of the target from its middle; there the target's bow is given.
    middle_mm : (2,)
    """

    view: View
    placement: Placement
    stripe_pixels: np.ndarray
    stripe_image: np.ndarray
    stripe_shifts_mm: np.ndarray
    across: int
    staged: bool
    radius_mm: float
    middle_mm: np.ndarray

    def images(self) -> np.ndarray:
        """Numbers of the images whose stage positions have errors of their own."""
        return np.unique(self.placement.image)[1:] if self.staged else np.empty(0, dtype=int)

    def pose(self, parameters: Parameters, shared: np.ndarray, own: np.ndarray, image: int) -> np.ndarray:
        """``T_camera_target`` (4, 4) of one of the images."""
        shift = self.placement.shifts_mm[self.placement.image == image][:1]
        pose = _Pose.of(self, parameters, shared, own, shift, np.array([image]))
        result = np.eye(4)
        result[:3, :3] = pose.rotation
        result[:3, 3] = pose.shift - pose.rotation @ (pose.direction * pose.travel[0])
        return result

    def own_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Standard uncertainty (b,) of the own parameters before; infinite for the pose."""
        if not self.staged:
            return np.full(6, np.inf)
        return np.concatenate([np.full(6, np.inf), [alignment] * 2, np.full(len(self.images()), position_mm)])

    def residuals(self, parameters: Parameters, shared: np.ndarray, own: np.ndarray) -> list[Residuals] | None:
        """Those of the target's points and of the stripe; None where a ray meets nothing."""
        circles = self._of_points(parameters, shared, own)
        if circles is None or not len(self.stripe_pixels):
            return None if circles is None else [circles]
        stripes = self._of_stripes(parameters, shared, own)
        return None if stripes is None else [circles, stripes]

    def _of_points(self, parameters: Parameters, shared: np.ndarray, own: np.ndarray) -> Residuals | None:
        placement = self.placement
        rays = parameters.rays(shared, self.view, placement.pixels)
        if rays is None:
            return None
        pose = _Pose.of(self, parameters, shared, own, placement.shifts_mm, placement.image)
        start, along = pose.into_target(rays.origins), pose.rotation.T @ rays.directions
        bow = parameters.value(shared, "target_bow")
        known = placement.points_mm
        height = bow * self._bulge(known)
        reach = (height - start[2]) / along[2]
        if not (reach > 0).all():
            return None
        here = rays.origins + reach * rays.directions
        by_rays = np.einsum("ij,cjn->cin", pose.rotation.T, rays.origins_by + reach * rays.directions_by)
        slope = along[:2] / along[2]

        def flat(moved: np.ndarray) -> np.ndarray:
            """From a change (..., 3, N) of the point to that (..., 2, N) of where the ray meets the target."""
            return moved[..., :2, :] - slope * moved[..., 2:, :]

        scale = flat(by_rays[:2])  # (2 pixel, 2 target, N)
        found = (start + reach * along)[:2] - known[:, :2].T
        into = np.linalg.inv(np.moveaxis(scale, 2, 0).transpose(0, 2, 1))  # target mm to px

        def to_pixels(moved: np.ndarray) -> np.ndarray:
            """From (C, 2, N) to rows (2 N, C)."""
            return np.einsum("npt,ctn->npc", into, moved).reshape(2 * len(known), -1)

        by_scale = flat(pose.by_scale())
        by_shared = np.empty((2, len(known), len(parameters.names)))
        for axis, moved in enumerate(np.moveaxis(flat(by_rays), 1, 0)):
            by_shared[axis] = parameters.by_shared(moved, self.view)
            parameters.add(by_shared[axis], "target_bow", slope[axis] * self._bulge(known))
            parameters.add(by_shared[axis], "stage_scale", by_scale[axis])
        return Residuals(
            kind=TARGET,
            values=np.einsum("npt,tn->np", into, found).ravel(),
            by_shared=np.einsum("npt,tnc->npc", into, by_shared).reshape(2 * len(known), -1),
            by_own=to_pixels(flat(pose.by_own(here))),
            image=np.repeat(placement.image, 2),
        )

    def _of_stripes(self, parameters: Parameters, shared: np.ndarray, own: np.ndarray) -> Residuals | None:
        points = parameters.on_sheet(shared, self.view, self.stripe_pixels)
        if points is None:
            return None
        pose = _Pose.of(self, parameters, shared, own, self.stripe_shifts_mm, self.stripe_image)
        at = pose.into_target(points.points)
        bow = parameters.value(shared, "target_bow")
        offset = at[:2] - self.middle_mm[:, None]
        # Height above the bent target: its gradient by the point in the target's frame.
        gradient = np.stack([*(-2.0 * bow / self.radius_mm**2 * offset), np.ones(at.shape[1])])
        in_camera = pose.rotation @ gradient
        by_rays = np.einsum("in,cin->cn", in_camera, points.by_rays)
        by_sheet = np.einsum("in,cin->cn", in_camera, points.by_sheet)
        bulge = self._bulge(at.T)
        by_shared = parameters.by_shared(by_rays, self.view, by_sheet)
        parameters.add(by_shared, "target_bow", -bulge)
        parameters.add(by_shared, "stage_scale", np.einsum("in,in->n", gradient, pose.by_scale()))
        by_own = np.einsum("in,cin->nc", gradient, pose.by_own(points.points))
        per_px = by_rays[COLUMNS.index("uv"[self.across])]
        return Residuals(
            kind=STRIPE,
            values=(at[2] - bow * bulge) / per_px,
            by_shared=by_shared / per_px[:, None],
            by_own=by_own / per_px[:, None],
            image=self.stripe_image,
        )

    def _bulge(self, points: np.ndarray) -> np.ndarray:
        """How far (N,) the target's points (N, 2 or 3) rise for a bow of one."""
        return np.sum((points[:, :2] - self.middle_mm) ** 2, axis=1) / self.radius_mm**2


@dataclass(frozen=True, eq=False)
class _Pose:
    """How points of the camera frame lie to the target, for each of them; and the derivatives of that."""

    rotation: np.ndarray
    rotation_by: np.ndarray
    shift: np.ndarray
    direction: np.ndarray
    direction_by: np.ndarray
    travel: np.ndarray
    nominal: np.ndarray
    column: np.ndarray
    own: int

    @classmethod
    def of(cls, evidence: TargetEvidence, parameters: Parameters, shared: np.ndarray, own: np.ndarray,
           shifts_mm: np.ndarray, image: np.ndarray) -> "_Pose":  # fmt: skip
        rotation, by = cv2.Rodrigues(own[:3])
        direction = evidence.placement.direction(own[6:8])
        by_tilt = np.zeros((0, 3))
        nominal, travel = np.zeros(len(image)), np.zeros(len(image))
        column = np.full(len(image), -1)
        if evidence.staged:
            length = abs(direction[2])
            by_tilt = ((np.eye(3) - np.outer(direction, direction))[:, :2] * length).T
            nominal = shifts_mm
            numbers = evidence.images()
            column = np.searchsorted(numbers, image)
            first = ~np.isin(image, numbers)
            errors = np.append(own[8:], 0.0)
            column[first] = len(numbers)
            travel = shifts_mm * (1.0 + parameters.value(shared, "stage_scale")) + errors[column]
            column = np.where(first, -1, column)
        return cls(
            rotation=rotation, rotation_by=by.reshape(3, 3, 3), shift=own[3:6], direction=direction,
            direction_by=by_tilt, travel=travel, nominal=nominal, column=column, own=len(own),
        )  # fmt: skip

    def into_target(self, points: np.ndarray) -> np.ndarray:
        """Points (3, N) of the camera frame in the target's frame at the first image."""
        return self.rotation.T @ (points - self.shift[:, None]) + self.direction[:, None] * self.travel

    def by_scale(self) -> np.ndarray:
        """Derivative (3, N) of `into_target` by the stage's scale."""
        return self.direction[:, None] * self.nominal

    def by_own(self, points: np.ndarray) -> np.ndarray:
        """Derivatives (b, 3, N) of `into_target` by the own parameters."""
        away = points - self.shift[:, None]
        result = np.zeros((self.own, 3, points.shape[1]))
        result[:3] = np.einsum("kji,jn->kin", self.rotation_by, away)
        result[3:6] = -self.rotation[:, :, None]
        if self.own > 6:
            result[6:8] = self.direction_by[:, :, None] * self.travel
            moved = np.flatnonzero(self.column >= 0)
            result[8 + self.column[moved], :, moved] = self.direction
        return result


@dataclass(frozen=True, eq=False)
class StepProfileEvidence:
    """Stripe pixels on both treads of a step standard in one image; own parameters are the lower tread's line.

    The treads are planes square to ``upward + slope * along``; the lower one lies at a distance of the own parameters
    (slope, distance in mm), the upper one higher by the standard's height, which is the shared parameter ``height``.

    Attributes
    ----------
    view : View
    pixels : (N, 2)
    upper : (N,) bool
        Which of them lie on the upper tread.
    upward, along : (3,)
        Unit vectors of the camera frame: away from the sensor turned round, that is from the lower tread to the upper
        one, and along the stripe.
    across : {0, 1}
    height : str
        Name of the shared parameter.
    image : int
        Number of the image among all of steps.
    """

    view: View
    pixels: np.ndarray
    upper: np.ndarray
    upward: np.ndarray
    along: np.ndarray
    across: int
    height: str
    image: int

    def own_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Nothing is known of the line before."""
        return np.full(2, np.inf)

    def residuals(self, parameters: Parameters, shared: np.ndarray, own: np.ndarray) -> list[Residuals] | None:
        """One for every pixel; None where a ray misses the sheet."""
        points = parameters.on_sheet(shared, self.view, self.pixels)
        if points is None:
            return None
        raw = self.upward + own[0] * self.along
        length = np.linalg.norm(raw)
        normal = raw / length
        by_slope = (self.along - normal * (normal @ self.along)) / length
        by_rays = np.einsum("i,cin->cn", normal, points.by_rays)
        by_shared = parameters.by_shared(by_rays, self.view, np.einsum("i,cin->cn", normal, points.by_sheet))
        parameters.add(by_shared, self.height, -self.upper.astype(np.float64))
        per_px = by_rays[COLUMNS.index("uv"[self.across])]
        off = normal @ points.points - own[1] - self.upper * parameters.value(shared, self.height)
        by_own = np.stack([by_slope @ points.points, np.full(len(off), -1.0)], axis=1)
        return [
            Residuals(
                kind=STEP,
                values=off / per_px,
                by_shared=by_shared / per_px[:, None],
                by_own=by_own / per_px[:, None],
                image=np.full(len(off), self.image),
            )
        ]
