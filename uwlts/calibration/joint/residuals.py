"""Residuals in pixels of target points, stripes on the target and stripes on steps, with their derivatives."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Self

import cv2
import numpy as np
from scipy import sparse

from uwlts.calibration.camera.camera_parameters import Placement
from uwlts.calibration.camera.target_poses import centre_offsets
from uwlts.calibration.joint.parameters import Parameters, SheetPoints, ViewMedium
from uwlts.fitting.local_surface import group_rows
from uwlts.fitting.schur_least_squares import LocalPrior, Observation
from uwlts.model.calibration import rigid_transform
from uwlts.model.parameter_keys import ParameterKey, StageParameter, StepHeight, TargetParameter
from uwlts.model.sensor import Uncertainty
from uwlts.optics.line_table import LineTable, sum_series
from uwlts.optics.window import tilt_direction

TARGET, STRIPE, STEP = "target", "stripe on the target", "stripe on the step"
BENDS = (TargetParameter.BOW, TargetParameter.SADDLE, TargetParameter.TWIST)
STRETCH = (TargetParameter.STRETCH_X, TargetParameter.STRETCH_Y)
SHIFT = TargetParameter.STRIPE
_TABLE_MM, _TABLE_SHARE = 1e-7, 1e-7
"""Error of tabulated points of the sheet, and relative error of their derivatives."""

_TOGETHER = 2000
"""Pixels per batch: smaller batches have more overhead, larger ones exceed the cache."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals ``values`` (n,) in px of one kind from one image; for target points, x and y alternate.

    ``by_global`` (n, P) are the derivatives by the global parameters. ``by_local`` (n, c) are those by the local
    parameters ``local_columns`` (c,), which affect this image.
    """

    kind: str
    values: np.ndarray
    by_global: np.ndarray
    by_local: np.ndarray
    local_columns: np.ndarray
    image: int

    def weighted(self, sigma_px: float, used: np.ndarray | slice = slice(None)) -> Observation:
        """Return the ``used`` residuals in standard deviations, with their derivatives."""
        columns = (self.values[:, None], self.by_global, self.by_local)
        values, by_global, by_local = (column[used] / sigma_px for column in columns)
        return Observation(values, by_global, by_local, self.local_columns)


@dataclass(frozen=True, eq=False)
class Distances:
    """Signed distances ``values_mm`` (N,) of points from a surface, positive on the side of its normals.

    ``outward`` (3, N) are the derivatives by the points (unit normals), ``by_local`` (N, k) those by local parameters.
    ``by_global`` (N,) are those by global parameters other than the camera's rays and the sheet.
    """

    values_mm: np.ndarray
    outward: np.ndarray
    by_local: np.ndarray
    by_global: Mapping[ParameterKey, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class StripeEvidence(ABC):
    """Stripe ``pixels`` (N, 2) on an object, with local parameters.

    ``across``, 0 or 1, is the pixel coordinate across the stripe. ``sources`` maps image numbers to capture and frame.
    Rays are computed at the pixels, or at ``predicted`` pixels (N, 2) near them.
    """

    view: ViewMedium
    pixels: np.ndarray
    across: int
    sources: Mapping[int, str] = field(default_factory=dict)
    predicted: np.ndarray | None = None

    @abstractmethod
    def local_std(self, uncertainty: Uncertainty) -> np.ndarray:
        """Return the prior standard uncertainty (b,) of the local parameters; infinite without prior knowledge."""

    def known_before(self, local: np.ndarray, uncertainty: Uncertainty) -> LocalPrior:
        """Return prior knowledge of the local parameters, in standard uncertainties."""
        std = self.local_std(uncertainty)
        known = np.flatnonzero(np.isfinite(std))
        places = np.arange(len(known)), known
        by_local = sparse.csr_array((1.0 / std[known], places), shape=(len(known), len(std)))
        return LocalPrior((local[known] / std[known])[:, None], by_local)

    def stripe_pixels(self, image: int) -> np.ndarray | slice:
        """Return the numbers of an image's stripe pixels."""
        return slice(None)

    def linearise(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> Self:
        """Compute rays at the pixels that residuals predict; those that are not ``used`` (n,) stay as detected."""
        predicted = self.pixels.copy()
        for part, kept in zip(residuals, used, strict=True):
            if part.kind != TARGET:
                predicted[self.stripe_pixels(part.image), self.across] -= np.where(kept, part.values, 0.0)
        return replace(self, predicted=predicted)

    def on_sheet(self, parameters: Parameters, global_values: np.ndarray, *, shifted_px: float = 0.0) -> "SeenSheet":
        """Compute the sheet points of the pixels, with the stripe shifted across itself."""
        at_px = self.pixels if self.predicted is None else self.predicted
        at_px = at_px - shifted_px * np.eye(2)[self.across]
        return SeenSheet.from_parameters(parameters, global_values, self.view, at_px, across=self.across)

    def stripe_residuals(
        self,
        parameters: Parameters,
        points: SheetPoints,
        off: Distances,
        *,
        kind: str,
        local_columns: np.ndarray,
        image: int,
        here: np.ndarray | slice = slice(None),
        least_share: float = 0.0,
    ) -> Residuals:
        """Convert distances of sheet points from a surface to pixels across the stripe.

        ``least_share`` is the minimum ratio of the distance change to the point's shift per pixel.
        """
        by = np.einsum("in,nic->nc", off.outward, points.by)
        by_px, by_global = by[:, 0], by[:, 1:]
        for key, column in off.by_global.items():
            parameters.add(by_global, key, column)
        per_px, found_px = by_px, self.pixels[here, self.across]
        at_px = found_px if self.predicted is None else self.predicted[here, self.across]
        if least_share:
            least = least_share * np.linalg.norm(points.by[:, :, 0], axis=1)
            per_px = np.copysign(np.maximum(np.abs(per_px), least), per_px)
        return Residuals(
            kind,
            (found_px - at_px) * (by_px / per_px) + off.values_mm / per_px,
            by_global / per_px[:, None],
            off.by_local / per_px[:, None],
            local_columns,
            image,
        )


@dataclass(frozen=True, eq=False)
class SeenSheet:
    """Sheet points of stripe pixels (N, 2), computed one by one, or from a table for many pixels.

    ``table`` contains the series of lines, and the row and argument (N,) of each pixel (see `LineTable.series`).
    """

    exact: Callable[[np.ndarray], SheetPoints | None]
    pixels: np.ndarray
    table: tuple[np.ndarray, np.ndarray, np.ndarray] | None

    @classmethod
    def from_parameters(
        cls, parameters: Parameters, global_values: np.ndarray, view: ViewMedium, pixels: np.ndarray, *, across: int
    ) -> "SeenSheet":
        """Build the sheet for a vector of the global parameters."""
        exact = partial(parameters.stripe_points, global_values, view, across=across)
        line, place = pixels[:, 1 - across].astype(np.intp), pixels[:, across]
        if not (line == pixels[:, 1 - across]).all():
            return cls(exact, pixels, None)

        def values(line: np.ndarray, place: np.ndarray) -> np.ndarray:
            found = exact(np.stack([line, place] if across else [place, line], axis=1))
            if found is None:
                return np.full((len(line), 1), np.nan)
            return np.hstack([found.points.T, found.by.reshape(len(line), -1)])

        table = LineTable.over_range(values, line, place, tolerance=_TABLE_MM, share=_TABLE_SHARE)
        return cls(exact, pixels, None if table is None else table.series(line, place))

    def places_mm(self) -> np.ndarray | None:
        """Return the points (3, N) only; None if a ray does not meet the sheet."""
        if self.table is None:
            found = self.exact(self.pixels)
            return None if found is None else found.points
        series, row, at = self.table
        values = np.empty((len(row), 3))
        sum_series(np.ascontiguousarray(series[:, :, :3]), row, at, values)
        return values.T

    def points(self, here: np.ndarray | slice = slice(None)) -> SheetPoints | None:
        """Return the sheet points of some pixels (n,); None if a ray does not meet the sheet."""
        if self.table is None:
            return self.exact(self.pixels[here])
        series, row, at = self.table
        values = np.empty((len(row[here]), series.shape[2]))
        sum_series(series, row[here], at[here], values)
        return SheetPoints(np.ascontiguousarray(values[:, :3].T), values[:, 3:].reshape(len(values), 3, -1))


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetEvidence(StripeEvidence):
    """Images of one placement of the target with the stripes on it.

    The local parameters are the rotation vector and shift ``T_camera_target`` at the first image. If the stage moved,
    the tilt of its direction against the target's normal (2,) and a position error in mm of all images except the first
    follow.
    """

    placement: Placement  # detected target points
    image: np.ndarray  # (N,); image number of each stripe pixel
    shifts_mm: np.ndarray  # (N,); stage position of each stripe pixel, relative to the first image
    staged: bool  # whether the stage's motion connects the images
    extent_mm: np.ndarray  # (K, 2); corners of the target; its bow is given at the corner farthest from the middle
    predicted_points: np.ndarray | None = None  # (M, 2); predicted pixels, like ``predicted`` for the stripe
    middle_mm: np.ndarray = field(init=False)
    radius_mm: float = field(init=False)

    def __post_init__(self) -> None:
        middle = self.extent_mm.mean(axis=0)
        object.__setattr__(self, "middle_mm", middle)
        object.__setattr__(self, "radius_mm", float(np.linalg.norm(self.extent_mm - middle, axis=1).max()))

    @cached_property
    def every_image(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of all images (F,), ascending, and the stage position of each."""
        images, first = np.unique(self.placement.image, return_index=True)
        return images, self.placement.shifts_mm[first]

    def images(self) -> np.ndarray:
        """Return the numbers of the images with a position error."""
        return self.every_image[0][1:] if self.staged else np.empty(0, dtype=int)

    @cached_property
    def _stripe_of_image(self) -> dict[int, np.ndarray]:
        return group_rows(self.image)

    def stripe_pixels(self, image: int) -> np.ndarray | slice:
        return self._stripe_of_image[image]

    def with_stripes(self, chosen: np.ndarray | slice) -> Self:
        """Return the evidence with some of the stripe pixels only."""
        return replace(self, pixels=self.pixels[chosen], image=self.image[chosen], shifts_mm=self.shifts_mm[chosen])

    def with_images(self, wanted: Sequence[int]) -> Self:
        """Return the evidence of some images; stage positions still refer to the first image of all."""
        here = np.isin(self.placement.image, wanted)
        kept = {name: getattr(self.placement, name)[here] for name in ("points_mm", "shifts_mm", "pixels", "image")}
        return replace(self, placement=replace(self.placement, **kept)).with_stripes(np.isin(self.image, wanted))

    def with_centres(
        self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray, diameter_mm: float
    ) -> Self:
        """Correct the detected centres of circle images to the images of the circles' centres."""
        placement, seen_by = self.placement, partial(parameters.project, global_values, self.view)
        pixels = placement.pixels.copy()
        for image, here in group_rows(placement.image).items():
            pose = self.pose(parameters, global_values, local, image)
            pixels[here] -= centre_offsets(seen_by, pose, placement.points_mm[here], diameter_mm=diameter_mm)
        return replace(self, placement=replace(placement, pixels=pixels))

    def pose(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray, image: int) -> np.ndarray:
        """Return ``T_camera_target`` (4, 4) of an image."""
        pose = _Poses(self, parameters, global_values, local, np.array([image]))
        return rigid_transform(pose.rotation, pose.shift - pose.rotation @ (pose.direction * pose.travel))

    def local_std(self, uncertainty: Uncertainty) -> np.ndarray:
        if not self.staged:
            return np.full(6, np.inf)
        tilt, position = uncertainty.stage_lean(), uncertainty.stage_position_mm
        return np.array([*[np.inf] * 6, tilt, tilt, *[position] * len(self.images())])

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        """Return the residuals of target points and stripe for each image; None if a ray misses the target."""
        found: list[Residuals] = []
        sheet = self.on_sheet(parameters, global_values, shifted_px=parameters.value(global_values, SHIFT))
        of_stripe = partial(self._take_stripe, sheet)
        for of_kind, image in ((self._take_points, self.placement.image), (of_stripe, self.image)):
            for here in _split_batches(image):
                pose = _Poses(self, parameters, global_values, local, image[here])
                if (parts := of_kind(parameters, global_values, pose, here)) is None:
                    return None
                found += parts
        return sorted(found, key=lambda part: part.image)

    def linearise(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> Self:
        points, of_image = self.placement.pixels.copy(), group_rows(self.placement.image)
        for part, kept in zip(residuals, used, strict=True):
            if part.kind == TARGET:
                points[of_image[part.image]] -= np.where(kept, part.values, 0.0).reshape(-1, 2)
        return replace(super().linearise(residuals, used), predicted_points=points)

    def _take_points(
        self, parameters: Parameters, global_values: np.ndarray, pose: "_Poses", here: np.ndarray
    ) -> list[Residuals] | None:
        """Return the residuals of some target points (n,), image after image."""
        found_px = self.placement.pixels[here]
        at_px = found_px if self.predicted_points is None else self.predicted_points[here]
        rays = parameters.rays(global_values, self.view, at_px)
        if rays is None:
            return None
        start, along = pose.to_target_frame(rays.origins), pose.rotation.T @ rays.directions
        known = self.placement.points_mm[here]
        bends = self._compute_bends(known)
        reach = (_list_values(parameters, global_values, BENDS) @ bends - start[2]) / along[2]
        if not (reach > 0).all():
            return None
        at = rays.origins + reach * rays.directions
        slope = along[:2] / along[2]

        def flat(moved: np.ndarray) -> np.ndarray:
            """Convert a shift (..., 3, N) of a point to the shift (..., 2, N) of the ray's target point."""
            return moved[..., :2, :] - slope * moved[..., 2:, :]

        by_rays = flat(pose.rotation.T @ (rays.origins_by + reach * rays.directions_by))
        stretch = 1.0 + _list_values(parameters, global_values, STRETCH)
        found = (start + reach * along)[:2] - stretch[:, None] * known[:, :2].T
        into = np.linalg.inv(by_rays[:2].transpose(2, 1, 0))  # (N, 2 pixel, 2 target), maps target mm to px

        def to_pixels(moved: np.ndarray) -> np.ndarray:
            """Convert (2, N, c) to rows (2 N, c)."""
            return (into @ moved.transpose(1, 0, 2)).reshape(2 * len(known), -1)

        by_scale = flat(pose.by_scale())
        by_global = np.empty((2, len(known), len(parameters.keys)))
        for axis in (0, 1):
            by_global[axis] = parameters.by_global(by_rays[:, axis], self.view)
            for key, bend in zip(BENDS, bends, strict=True):
                parameters.add(by_global[axis], key, slope[axis] * bend)
            parameters.add(by_global[axis], STRETCH[axis], -known[:, axis])
            parameters.add(by_global[axis], StageParameter.SCALE, by_scale[axis])
        values = (found_px - at_px).ravel() + to_pixels(found[:, :, None]).ravel()
        by_local = to_pixels(flat(pose.by_local(at)).transpose(1, 2, 0))
        return pose.split_by_image(TARGET, values, to_pixels(by_global), by_local)

    def _take_stripe(
        self, sheet: SeenSheet, parameters: Parameters, global_values: np.ndarray, pose: "_Poses", here: np.ndarray
    ) -> list[Residuals] | None:
        """Return the residuals of some stripe pixels (n,), image after image."""
        points = sheet.points(here)
        if points is None:
            return None
        at = pose.to_target_frame(points.points)
        bends, sizes = self._compute_bends(at.T), _list_values(parameters, global_values, BENDS)
        bow, saddle, twist = sizes
        # Gradient of the height above the bent target, in the target's frame.
        steep = -2.0 / self.radius_mm**2 * np.array([[bow + saddle, twist], [twist, bow - saddle]])
        gradient = np.stack([*(steep @ (at[:2] - self.middle_mm[:, None])), np.ones(at.shape[1])])
        outward = pose.rotation @ gradient
        by_stripe = -np.einsum("in,ni->n", outward, points.by[:, :, 0])
        by_global = {SHIFT: by_stripe, StageParameter.SCALE: np.sum(pose.by_scale() * gradient, axis=0)}
        off = Distances(
            at[2] - sizes @ bends,
            outward,
            np.einsum("in,cin->nc", gradient, pose.by_local(points.points)),
            dict(zip(BENDS, -bends, strict=True)) | by_global,
        )
        all_columns = np.empty(0, int)
        every = self.stripe_residuals(
            parameters, points, off, kind=STRIPE, local_columns=all_columns, image=-1, here=here
        )
        return pose.split_by_image(STRIPE, every.values, every.by_global, every.by_local)

    def _compute_bends(self, points: np.ndarray) -> np.ndarray:
        """Return heights (3, N) of target points (N, 2 or 3) for a unit bow, a unit saddle, and a unit twist."""
        x, y = ((points[:, :2] - self.middle_mm) / self.radius_mm).T
        return np.stack([x**2 + y**2, x**2 - y**2, 2 * x * y])


def _list_values(parameters: Parameters, global_values: np.ndarray, keys: tuple[ParameterKey, ...]) -> np.ndarray:
    return np.array([parameters.value(global_values, key) for key in keys])


def _split_batches(image: np.ndarray) -> list[np.ndarray]:
    """Split pixel numbers into batches of whole images that fit into the processor's cache."""
    order = np.argsort(image, kind="stable")
    starts = np.flatnonzero(np.diff(image[order], prepend=-1))
    return np.split(order, starts[1:][np.diff(starts // _TOGETHER) > 0]) if len(order) else []


class _Poses:
    """Target poses for pixels (n,) of several images, and derivatives by local parameters.

    ``image`` (n,) is each pixel's image, ``travel`` (n,) the motion of the stage along ``direction``, mm.
    """

    def __init__(
        self,
        evidence: TargetEvidence,
        parameters: Parameters,
        global_values: np.ndarray,
        local: np.ndarray,
        image: np.ndarray,
    ):
        placement = evidence.placement
        self.rotation, rotation_by = cv2.Rodrigues(local[:3])
        self._rotation_by = rotation_by.reshape(3, 3, 3)
        self.shift, self.image, self._staged = local[3:6], image, evidence.staged
        tilt = local[6:8] if evidence.staged else np.zeros(2)
        self.direction, self._direction_by = tilt_direction(
            np.array([0.0, 0.0, placement.along_z]), np.eye(3)[:2], tilt
        )
        self._nominal = self.travel = np.zeros(len(image))
        if evidence.staged:
            images, shifts_mm = evidence.every_image
            # The first image lacks a position error.
            self._place = np.searchsorted(images, image)
            self._nominal = shifts_mm[self._place]
            scale = 1.0 + parameters.value(global_values, StageParameter.SCALE)
            self.travel = self._nominal * scale + np.append(0.0, local[8:])[self._place]

    def to_target_frame(self, points: np.ndarray) -> np.ndarray:
        """Transform points (3, n) of the camera frame to the target's frame at the first image."""
        return self.rotation.T @ (points - self.shift[:, None]) + self.direction[:, None] * self.travel

    def by_scale(self) -> np.ndarray:
        """Return derivatives (3, n) of `into_target` by the stage's scale."""
        return self.direction[:, None] * self._nominal

    def by_local(self, points: np.ndarray) -> np.ndarray:
        """Return derivatives (c, 3, n) of `into_target` by the local parameters; the last one is the pixel's image."""
        result = np.empty((9 if self._staged else 6, 3, points.shape[1]))
        result[:3] = self._rotation_by.transpose(0, 2, 1) @ (points - self.shift[:, None])
        result[3:6] = -self.rotation[:, :, None]
        if self._staged:
            result[6:8] = self._direction_by[:, :, None] * self.travel
            result[8] = self.direction[:, None]
        return result

    def split_by_image(
        self, kind: str, values: np.ndarray, by_global: np.ndarray, by_local: np.ndarray
    ) -> list[Residuals]:
        """Split residuals of pixels with one or two coordinates each by image."""
        images, first = np.unique(self.image, return_index=True)
        rows, found = len(values) // len(self.image), []
        for image, start, end in zip(images, first, np.append(first[1:], len(self.image)), strict=True):
            here = slice(rows * start, rows * end)
            place = self._place[start] if self._staged else 0
            columns = np.append(np.arange(8), 7 + place) if place else np.arange(min(8, by_local.shape[1]))
            by_pose = by_local[here, : len(columns)]
            found.append(Residuals(kind, values[here], by_global[here], by_pose, columns, int(image)))
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class StepProfileEvidence(StripeEvidence):
    """Stripe pixels on both faces of a step standard in one image; local parameters are the lower face's line.

    The faces are planes perpendicular to ``upward + slope * along``. The local parameters (slope, distance in mm) give
    the lower face. The upper face is higher by the global parameter ``height`` times ``lengthened``: the sheet cuts the
    step at an angle to its normal. ``upward`` (from the lower face to the upper one) and ``along`` the stripe are unit
    vectors (3,), camera frame. ``upper`` (N,) marks the pixels on the upper face. ``image`` counts all step images.
    """

    upper: np.ndarray
    upward: np.ndarray
    along: np.ndarray
    height: StepHeight
    image: int
    lengthened: float = 1.0

    def upper_mm(self, parameters: Parameters, global_values: np.ndarray) -> np.ndarray:
        """Return the height (N,) of each pixel's face above the lower one, within the sheet."""
        return self.upper * (self.lengthened * parameters.value(global_values, self.height))

    def local_std(self, uncertainty: Uncertainty) -> np.ndarray:
        return np.full(2, np.inf)

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        """Return the residuals of the image; None if a ray does not meet the sheet."""
        points = self.on_sheet(parameters, global_values).points()
        if points is None:
            return None
        normal, by_slope = tilt_direction(self.upward, self.along[None], local[:1])
        off = Distances(
            normal @ points.points - local[1] - self.upper_mm(parameters, global_values),
            np.broadcast_to(normal[:, None], points.points.shape),
            np.column_stack([by_slope[0] @ points.points, np.full(len(self.pixels), -1.0)]),
            {self.height: -self.lengthened * self.upper},
        )
        columns = np.arange(2)
        return [self.stripe_residuals(parameters, points, off, kind=STEP, local_columns=columns, image=self.image)]
