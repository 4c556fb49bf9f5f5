"""Residuals in pixels of target points, stripes on the target and stripes on steps, with their derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from uwlts.calibration.joint.derivatives import COLUMNS
from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.calibration.target_images import Placement
from uwlts.model.parameter_keys import StageParameter, StepHeight, TargetParameter

TARGET, STRIPE, STEP = "target", "stripe on the target", "stripe on the step"


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals (n,) in px of one kind from one image, with their derivatives by global and local parameters.

    Attributes
    ----------
    values : (n,); of the target's points both coordinates in turn
    by_global : (n, P)
    by_local : (n, c); by those of the evidence's local parameters that matter in this image
    local_columns : (c,); which of them these are
    image : number of the image
    """

    kind: str
    values: np.ndarray
    by_global: np.ndarray
    by_local: np.ndarray
    local_columns: np.ndarray
    image: int


@dataclass(frozen=True, eq=False)
class TargetEvidence:
    """Images of one placement of the target with the stripes on it; local parameters are its pose, and the stage's.

    The local parameters are rotation vector and shift ``T_camera_target`` at the first image, and where the stage
    moved: the tilt of its direction against the target's normal (2,) and an error in mm of all positions but the first.

    Attributes
    ----------
    placement : the target's points as found
    stripe_pixels : (M, 2)
    stripe_image : (M,); number of each stripe pixel's image
    stripe_shifts_mm : (M,); stage position of each, from that of the first image
    across : {0, 1}; the coordinate of the pixel that runs across the stripe
    staged : whether the images are joined by the stage's motion
    radius_mm : largest distance of a point of the target from its middle; there the target's bow is given
    middle_mm : (2,)
    predicted : (N, 2), optional; pixels near those predicted of the target's points, where rays are taken; as found
        unless given
    stripe_predicted : (M, 2), optional; the same of the stripe
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
    predicted: np.ndarray | None = None
    stripe_predicted: np.ndarray | None = None

    def images(self) -> np.ndarray:
        """Numbers of the images whose stage positions have errors of their own."""
        return np.unique(self.placement.image)[1:] if self.staged else np.empty(0, dtype=int)

    def with_stripes(self, chosen: np.ndarray | slice) -> "TargetEvidence":
        """The same with some of the stripe pixels only."""
        return replace(
            self,
            stripe_pixels=self.stripe_pixels[chosen],
            stripe_image=self.stripe_image[chosen],
            stripe_shifts_mm=self.stripe_shifts_mm[chosen],
        )

    def pose(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray, image: int) -> np.ndarray:
        """``T_camera_target`` (4, 4) of one of the images."""
        pose = _Pose.of(self, parameters, global_values, local, image)
        result = np.eye(4)
        result[:3, :3] = pose.rotation
        result[:3, 3] = pose.shift - pose.rotation @ (pose.direction * pose.travel)
        return result

    def local_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Standard uncertainty (b,) of the local parameters before; infinite for the pose."""
        if not self.staged:
            return np.full(6, np.inf)
        return np.concatenate([np.full(6, np.inf), [alignment] * 2, np.full(len(self.images()), position_mm)])

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        """Those of the target's points and of the stripe, image by image; None where a ray meets nothing."""
        found = []
        for image in np.unique(self.placement.image):
            pose = _Pose.of(self, parameters, global_values, local, image)
            here, lit = self.placement.image == image, self.stripe_image == image
            parts = [self._of_points(parameters, global_values, pose, here)]
            if lit.any():
                parts.append(self._of_stripe(parameters, global_values, pose, lit))
            if any(part is None for part in parts):
                return None
            found += parts
        return found

    def linearised(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> "TargetEvidence":
        """The same with rays taken at the pixels that these residuals predict, but as found where not ``used`` (n,)."""
        predicted, stripe_predicted = self.placement.pixels.copy(), self.stripe_pixels.copy()
        for part, kept in zip(residuals, used, strict=True):
            moved = np.where(kept, part.values, 0.0)
            if part.kind == TARGET:
                predicted[self.placement.image == part.image] -= moved.reshape(-1, 2)
            else:
                stripe_predicted[self.stripe_image == part.image, self.across] -= moved
        return replace(self, predicted=predicted, stripe_predicted=stripe_predicted)

    def _of_points(
        self, parameters: Parameters, global_values: np.ndarray, pose: "_Pose", here: np.ndarray
    ) -> Residuals | None:
        found_px = self.placement.pixels[here]
        at_px = found_px if self.predicted is None else self.predicted[here]
        rays = parameters.rays(global_values, self.view, at_px)
        if rays is None:
            return None
        start, along = pose.into_target(rays.origins), pose.rotation.T @ rays.directions
        bow = parameters.value(global_values, TargetParameter.BOW)
        known = self.placement.points_mm[here]
        bulge = self._bulge(known)
        reach = (bow * bulge - start[2]) / along[2]
        if not (reach > 0).all():
            return None
        at = rays.origins + reach * rays.directions
        by_rays = pose.rotation.T @ (rays.origins_by + reach * rays.directions_by)
        slope = along[:2] / along[2]

        def flat(moved: np.ndarray) -> np.ndarray:
            """From a change (..., 3, N) of the point to that (..., 2, N) of where the ray meets the target."""
            return moved[..., :2, :] - slope * moved[..., 2:, :]

        by_rays = flat(by_rays)
        found = (start + reach * along)[:2] - known[:, :2].T
        into = np.linalg.inv(by_rays[:2].transpose(2, 1, 0))  # (N, 2 pixel, 2 target), target mm to px

        def to_pixels(moved: np.ndarray) -> np.ndarray:
            """From (2, N, c) to rows (2 N, c)."""
            return (into @ moved.transpose(1, 0, 2)).reshape(2 * len(known), -1)

        by_scale = flat(pose.by_scale()[:, None])
        by_global = np.empty((2, len(known), len(parameters.keys)))
        for axis in (0, 1):
            by_global[axis] = parameters.by_global(by_rays[:, axis], self.view)
            parameters.add(by_global[axis], TargetParameter.BOW, slope[axis] * bulge)
            parameters.add(by_global[axis], StageParameter.SCALE, by_scale[axis])
        return Residuals(
            kind=TARGET,
            values=(found_px - at_px).ravel() + to_pixels(found[:, :, None]).ravel(),
            by_global=to_pixels(by_global),
            by_local=to_pixels(flat(pose.by_local(at)).transpose(1, 2, 0)),
            local_columns=pose.local_columns,
            image=pose.image,
        )

    def _of_stripe(
        self, parameters: Parameters, global_values: np.ndarray, pose: "_Pose", here: np.ndarray
    ) -> Residuals | None:
        found_px = self.stripe_pixels[here]
        at_px = found_px if self.stripe_predicted is None else self.stripe_predicted[here]
        points = parameters.on_sheet(global_values, self.view, at_px)
        if points is None:
            return None
        at = pose.into_target(points.points)
        bow = parameters.value(global_values, TargetParameter.BOW)
        offset = at[:2] - self.middle_mm[:, None]
        # Height above the bent target: its gradient by the point in the target's frame.
        gradient = np.stack([*(-2.0 * bow / self.radius_mm**2 * offset), np.ones(at.shape[1])])
        in_camera = pose.rotation @ gradient
        by_rays = np.einsum("in,cin->cn", in_camera, points.by_rays)
        by_sheet = np.einsum("in,cin->cn", in_camera, points.by_sheet)
        bulge = self._bulge(at.T)
        by_global = parameters.by_global(by_rays, self.view, by_sheet)
        parameters.add(by_global, TargetParameter.BOW, -bulge)
        parameters.add(by_global, StageParameter.SCALE, pose.by_scale() @ gradient)
        by_local = np.einsum("in,cin->nc", gradient, pose.by_local(points.points))
        per_px = by_rays[COLUMNS.index("uv"[self.across])]
        return Residuals(
            kind=STRIPE,
            values=(found_px - at_px)[:, self.across] + (at[2] - bow * bulge) / per_px,
            by_global=by_global / per_px[:, None],
            by_local=by_local / per_px[:, None],
            local_columns=pose.local_columns,
            image=pose.image,
        )

    def _bulge(self, points: np.ndarray) -> np.ndarray:
        """How far (N,) the target's points (N, 2 or 3) rise for a bow of one."""
        return np.sum((points[:, :2] - self.middle_mm) ** 2, axis=1) / self.radius_mm**2


@dataclass(frozen=True, eq=False)
class _Pose:
    """How the target stands to the camera in one image, and its derivatives by the parameters ``local_columns`` (c,).

    The stage has moved by ``travel`` mm along ``direction``, ``nominal`` without its errors; where it has one of its
    own, that is the last of the parameters.
    """

    rotation: np.ndarray
    rotation_by: np.ndarray
    shift: np.ndarray
    direction: np.ndarray
    direction_by: np.ndarray
    travel: float
    nominal: float
    local_columns: np.ndarray
    image: int

    @classmethod
    def of(
        cls, evidence: TargetEvidence, parameters: Parameters, global_values: np.ndarray, local: np.ndarray, image: int
    ) -> "_Pose":
        rotation, by = cv2.Rodrigues(local[:3])
        direction = evidence.placement.direction(local[6:8])
        by_tilt, nominal, travel, columns = np.zeros((0, 3)), 0.0, 0.0, np.arange(6)
        if evidence.staged:
            by_tilt = ((np.eye(3) - np.outer(direction, direction))[:, :2] * abs(direction[2])).T
            columns = np.append(np.arange(8), 8 + np.flatnonzero(evidence.images() == image))
            nominal = float(evidence.placement.shifts_mm[evidence.placement.image == image][0])
            travel = nominal * (1.0 + parameters.value(global_values, StageParameter.SCALE)) + float(
                local[columns[8:]].sum()
            )
        return cls(
            rotation=rotation,
            rotation_by=by.reshape(3, 3, 3),
            shift=local[3:6],
            direction=direction,
            direction_by=by_tilt,
            travel=travel,
            nominal=nominal,
            local_columns=columns,
            image=int(image),
        )

    def into_target(self, points: np.ndarray) -> np.ndarray:
        """Points (3, N) of the camera frame in the target's frame at the first image."""
        return self.rotation.T @ (points - self.shift[:, None]) + (self.direction * self.travel)[:, None]

    def by_scale(self) -> np.ndarray:
        """Derivative (3,) of `into_target` by the stage's scale."""
        return self.direction * self.nominal

    def by_local(self, points: np.ndarray) -> np.ndarray:
        """Derivatives (c, 3, N) of `into_target` by the local parameters."""
        result = np.empty((len(self.local_columns), 3, points.shape[1]))
        result[:3] = self.rotation_by.transpose(0, 2, 1) @ (points - self.shift[:, None])
        result[3:6] = -self.rotation[:, :, None]
        if len(self.local_columns) > 6:
            result[6:8] = self.direction_by[:, :, None] * self.travel
            result[8:] = self.direction[:, None]
        return result


@dataclass(frozen=True, eq=False)
class StepProfileEvidence:
    """Stripe pixels on both treads of a step standard in one image; local parameters are the lower tread's line.

    The treads are planes square to ``upward + slope * along``; the lower one lies at a distance of the local parameters
    (slope, distance in mm), the upper one higher by the standard's height, which is the global parameter ``height``.

    Attributes
    ----------
    pixels : (N, 2)
    upper : (N,) bool; which of them lie on the upper tread
    upward, along : (3,); unit vectors of the camera frame: away from the sensor turned round, that is from the lower
        tread to the upper one, and along the stripe
    across : {0, 1}
    height : the global parameter
    image : number of the image among all of steps
    predicted : (N, 2), optional; pixels near those predicted, where rays are taken; as found unless given
    """

    view: View
    pixels: np.ndarray
    upper: np.ndarray
    upward: np.ndarray
    along: np.ndarray
    across: int
    height: StepHeight
    image: int
    predicted: np.ndarray | None = None

    def local_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Nothing is known of the line before."""
        return np.full(2, np.inf)

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        """One for every pixel; None where a ray misses the sheet."""
        at_px = self.pixels if self.predicted is None else self.predicted
        points = parameters.on_sheet(global_values, self.view, at_px)
        if points is None:
            return None
        raw = self.upward + local[0] * self.along
        length = np.linalg.norm(raw)
        normal = raw / length
        by_slope = (self.along - normal * (normal @ self.along)) / length
        by_rays = np.einsum("i,cin->cn", normal, points.by_rays)
        by_global = parameters.by_global(by_rays, self.view, np.einsum("i,cin->cn", normal, points.by_sheet))
        parameters.add(by_global, self.height, -self.upper.astype(np.float64))
        per_px = by_rays[COLUMNS.index("uv"[self.across])]
        off = normal @ points.points - local[1] - self.upper * parameters.value(global_values, self.height)
        by_local = np.stack([by_slope @ points.points, np.full(len(off), -1.0)], axis=1)
        return [
            Residuals(
                kind=STEP,
                values=(self.pixels - at_px)[:, self.across] + off / per_px,
                by_global=by_global / per_px[:, None],
                by_local=by_local / per_px[:, None],
                local_columns=np.arange(2),
                image=self.image,
            )
        ]

    def linearised(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> "StepProfileEvidence":
        """The same with rays taken at the pixels that these residuals predict, but as found where not ``used`` (n,)."""
        predicted = self.pixels.copy()
        predicted[:, self.across] -= np.where(used[0], residuals[0].values, 0.0)
        return replace(self, predicted=predicted)
