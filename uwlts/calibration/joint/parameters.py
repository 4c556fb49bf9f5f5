"""Global parameters of the joint calibration: prior knowledge, and rays and points with derivatives."""

from dataclasses import dataclass, field

import numpy as np

from uwlts.calibration.camera.camera_parameters import Intrinsics
from uwlts.errors import CalibrationError
from uwlts.model.calibration import CameraModel, FanModel, SheetModel, WindowModel
from uwlts.model.joint_estimate import NominalSheet
from uwlts.model.parameter_keys import LensParameter, MediumIndex, ParameterKey, SheetParameter, WindowParameter
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Sensor, Uncertainty
from uwlts.optics.camera import directions, image_derivatives, project_through_window
from uwlts.optics.triangulation import behind_window_mm, fan_distances, sheet_surface
from uwlts.optics.window import RayDerivatives, tilt_direction, trace_derivatives

LENS = tuple(key for key in LensParameter if key is not LensParameter.F)
WINDOW = tuple(WindowParameter)
COLUMNS = ("u", "v", *LENS, *WINDOW, "medium_index")
"""Variables of the derivatives of rays."""
SHEET = tuple(SheetParameter)
"""Rotations of the normal towards the axis and the fan's direction, rad; shift, mm; parameters of `FanModel`."""


@dataclass(frozen=True)
class ViewMedium:
    """Window state and medium of a camera's view: window or none, and the number of a medium; None is air."""

    window: bool
    medium: int | None


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a parameter: ``mean`` and standard uncertainty ``std``.

    With an infinite ``std``, the mean is only a start value. With zero, the parameter is fixed.
    """

    mean: float
    std: float


def window_values(window: WindowModel) -> dict[ParameterKey, float]:
    """Return the parameters of a window in their order."""
    slope_x, slope_y, _ = (np.array(window.normal) / window.normal[2]).tolist()
    values = (window.distance_mm, slope_x, slope_y, window.thickness_mm, window.glass_index)
    return dict(zip(WINDOW, values, strict=True))


def window_priors(window: WindowModel, known: Uncertainty) -> dict[ParameterKey, Prior]:
    """Return prior knowledge of the camera's window as described, in the order of its parameters."""
    tilt = float(np.tan(np.radians(known.window_tilt_deg)))
    std = (known.window_distance_mm, tilt, tilt, known.glass_thickness_mm, known.glass_index)
    return {key: Prior(value, each) for (key, value), each in zip(window_values(window).items(), std, strict=True)}


def fan_priors(sensor: Sensor, *, wet: bool) -> dict[ParameterKey, Prior]:
    """Return prior knowledge of the fan's bow and, if it is seen in a medium, of the turn of the laser's window."""
    bow, turn = np.radians([sensor.uncertainty.bow_deg, sensor.uncertainty.laser_window_tilt_deg]).tolist()
    priors: dict[ParameterKey, Prior] = {SheetParameter.BOW: Prior(float(np.radians(sensor.laser.bow_deg)), bow)}
    if wet and sensor.laser.window.mounted:
        priors[SheetParameter.WINDOW_TURN] = Prior(float(np.arcsin(sensor.laser.window.normal()[0])), turn)
    return priors


@dataclass(frozen=True, eq=False)
class EarlierEstimate:
    """Earlier estimate of the first K parameters of a vector: ``values`` (K,), ``covariance`` (K, K).

    ``whitening`` (K, K) is W with W^T W the inverse of the covariance: W (x - values) are K independent residuals with
    unit variance. CalibrationError if the covariance is not positive definite.
    """

    values: np.ndarray
    covariance: np.ndarray
    whitening: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        variance = np.diag(self.covariance)
        try:
            if not variance.min() > 0:
                raise np.linalg.LinAlgError("a variance is not positive")
            # Pixels, millimetres and radians differ in scale: factorise correlations for numerical accuracy.
            std = np.sqrt(variance)
            root = np.linalg.cholesky(self.covariance / np.outer(std, std))
        except np.linalg.LinAlgError as error:
            raise CalibrationError(
                f"the covariance of the earlier calibration is damaged or singular ({error}): calibrate again"
            ) from error
        object.__setattr__(self, "whitening", np.linalg.inv(root) / std)

    def std(self) -> np.ndarray:
        """Return the standard uncertainty (K,) of each parameter."""
        return np.sqrt(np.diag(self.covariance))

    def residuals(self, global_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals (K,) of a vector (P,) that begins with these parameters, and derivatives (K, P)."""
        count = len(self.values)
        by_global = np.zeros((count, len(global_values)))
        by_global[:, :count] = self.whitening
        return self.whitening @ (global_values[:count] - self.values), by_global


@dataclass(frozen=True, eq=False)
class DescribedSheet:
    """Described sheet, camera frame, mm: vectors (3,) as in `NominalSheet`; all its parameters are zero."""

    normal: np.ndarray
    axis: np.ndarray
    middle_mm: np.ndarray
    apex_mm: np.ndarray
    pivot_mm: np.ndarray

    @classmethod
    def from_sensor(cls, sensor: Sensor) -> "DescribedSheet":
        """Return the sheet of a sensor's description; it turns about the intersection of the camera's axis with it."""
        pose, glass = laser_pose(sensor), sensor.laser.window
        outer = glass.distance_mm + glass.thickness_mm if glass.mounted else 0.0
        middle = camera_from_object(sensor)[:3, 3]
        return cls(pose.normal, pose.axis, middle, pose.origin_mm, pose.origin_mm + outer * pose.axis)

    @classmethod
    def from_description(cls, nominal: NominalSheet) -> "DescribedSheet":
        """Read the sheet from a file's description."""
        return cls(*(np.array(getattr(nominal, name)) for name in NominalSheet.model_fields))

    def nominal(self) -> NominalSheet:
        """Return the sheet as a file describes it."""
        return NominalSheet.model_validate({name: vector.tolist() for name, vector in vars(self).items()})

    def fan(self, values: np.ndarray) -> FanModel:
        """Return the fan for parameters (5,)."""
        apex, axis, pivot = (tuple(vector.tolist()) for vector in (self.apex_mm, self.axis, self.pivot_mm))
        return FanModel(
            apex_mm=apex, axis=axis, pivot_mm=pivot, bow_rad=float(values[3]), window_turn_rad=float(values[4])
        )

    def model(self, values: np.ndarray) -> SheetModel:
        """Return the sheet for parameters (5,)."""
        normal, _ = self._compute_normal(values)
        offset = float(normal @ self.middle_mm + values[2])
        return SheetModel(normal=tuple(normal.tolist()), offset_mm=offset, fan=self.fan(values))

    def _compute_normal(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normal (3,) and its derivatives (2, 3) by the two rotations."""
        return tilt_direction(self.normal, np.stack([self.axis, np.cross(self.axis, self.normal)]), values[:2])

    def miss_by(self, values: np.ndarray, points: np.ndarray, index: float) -> np.ndarray:
        """Return derivatives (6, N) of `SheetSurface.miss_mm` at points (3, N) by the parameters and the index."""
        normal, normal_by = self._compute_normal(values)
        turn, bow = values[4], values[3]
        angle = turn * (1.0 - 1.0 / index)
        cosine, sine = np.cos(angle), np.sin(angle)

        def across(n: np.ndarray, m: np.ndarray) -> np.ndarray:
            """Return the vector (axis x n) x m."""
            return n * (self.axis @ m) - self.axis * (n @ m)

        from_middle, from_pivot = points - self.middle_mm[:, None], points - self.pivot_mm[:, None]
        by = np.empty((6, points.shape[1]))
        for row, n in enumerate(normal_by):
            turned = (cosine - 1.0) * n + sine * (across(n, normal) + across(normal, n))
            by[row] = n @ from_middle + turned @ from_pivot
        fan = self.fan(values)
        at, behind = fan_distances(points, fan, medium_index=index), behind_window_mm(fan)
        of_bow, of_turn = at.bulges()
        # The fan's apparent apex moves away as the index grows.
        air_by = (index * (at.along**2 - at.distance**2) + at.along * behind) / at.in_air
        of_bow_by = behind * at.along / at.distance - air_by
        of_turn_by = at.wet * (behind - air_by) - behind / at.along * at.wet * (at.along - at.in_air)
        by_angle = (cosine * across(normal, normal) - sine * normal) @ from_pivot
        by[2] = -1.0
        by[3] = -of_bow / index
        by[4] = by_angle * (1.0 - 1.0 / index) - of_turn / index
        by[5] = by_angle * turn / index**2
        by[5] += (bow * of_bow + turn * of_turn) / index**2 - (bow * of_bow_by + turn * of_turn_by) / index
        return by


@dataclass(frozen=True, eq=False)
class SheetPoints:
    """Points (3, N) of the sheet in mm, camera frame, and derivatives (N, 3, 1 + P).

    The first derivative is by the pixel across the stripe, the others are by the global parameters.
    """

    points: np.ndarray
    by: np.ndarray


@dataclass(frozen=True, eq=False)
class Parameters:
    """Keys and indices of the global parameters in a vector (P,).

    ``sheet`` and ``window`` are as described (None: no view through the window). ``media`` are the names of media other
    than air. ``priors`` contains all parameters in the order of the vector, except lens parameters without prior
    knowledge. Fixed parameters are not part of the vector. ``earlier`` is additional knowledge of the vector's first
    parameters from an earlier calibration. ``tied`` parameters of the target keep their prior means: the evidence does
    not change them.
    """

    intrinsics: Intrinsics
    sheet: DescribedSheet
    window: WindowModel | None
    media: tuple[str, ...]
    priors: dict[ParameterKey, Prior]
    earlier: EarlierEstimate | None = None
    tied: frozenset[ParameterKey] = frozenset()
    keys: tuple[ParameterKey, ...] = field(init=False)
    places: dict[ParameterKey, int] = field(init=False)

    def __post_init__(self) -> None:
        known = (key for key, prior in self.priors.items() if prior.std > 0 and not isinstance(key, LensParameter))
        object.__setattr__(self, "keys", (*self.intrinsics.keys, *known))
        object.__setattr__(self, "places", {key: place for place, key in enumerate(self.keys)})

    def start(self, lens: np.ndarray) -> np.ndarray:
        """Return a vector (P,) with the given lens parameters and the prior means of the others."""
        return np.concatenate([lens, self.prior_mean()[len(lens) :]])

    def prior_std(self) -> np.ndarray:
        """Return the prior standard uncertainty (P,) of each parameter; infinite without prior knowledge."""
        return np.array([self.priors[key].std if key in self.priors else np.inf for key in self.keys])

    def prior_mean(self) -> np.ndarray:
        """Return the prior mean or start value of each parameter (P,); zero for lens parameters without one."""
        return np.array([self.priors[key].mean if key in self.priors else 0.0 for key in self.keys])

    def camera(self, values: np.ndarray) -> CameraModel:
        """Return the camera of a vector."""
        return self.intrinsics.model(values[: len(self.intrinsics.names)])

    def window_model(self, values: np.ndarray) -> WindowModel | None:
        """Return the window of a vector."""
        if self.window is None:
            return None
        distance, slope_x, slope_y, thickness, index = (self.value(values, key) for key in WINDOW)
        normal = np.array([slope_x, slope_y, 1.0])
        found = {"distance_mm": distance, "thickness_mm": thickness, "glass_index": index}
        return self.window.model_copy(update=found | {"normal": tuple((normal / np.linalg.norm(normal)).tolist())})

    def sheet_model(self, values: np.ndarray) -> SheetModel:
        """Return the sheet of a vector."""
        return self.sheet.model(self._select_sheet_values(values))

    def medium_index(self, values: np.ndarray, view: ViewMedium) -> float:
        """Return the refractive index of a view's medium relative to air."""
        return 1.0 if view.medium is None else self.value(values, self.index_key(view.medium))

    def rays(self, values: np.ndarray, view: ViewMedium, pixels: np.ndarray) -> RayDerivatives | None:
        """Return rays of pixels (N, 2) in the medium of a view."""
        window = self.window_model(values) if view.window else None
        return ray_derivatives(self.camera(values), window, pixels, medium_index=self.medium_index(values, view))

    def stripe_points(
        self, values: np.ndarray, view: ViewMedium, pixels: np.ndarray, *, across: int
    ) -> SheetPoints | None:
        """Intersect rays of pixels (N, 2) with the sheet; None if a ray does not meet it.

        The pixel coordinate ``across``, 0 or 1, is the one across the stripe.
        """
        rays, index = self.rays(values, view, pixels), self.medium_index(values, view)
        if rays is None:
            return None
        surface = sheet_surface(self.sheet_model(values), medium_index=index)
        reach, slope = surface.crossings(rays.origins, rays.directions)
        if not (reach > 0).all():
            return None
        points = rays.origins + reach * rays.directions
        moved = rays.origins_by + reach * rays.directions_by
        along = -np.einsum("in,cin->cn", surface.gradient(points), moved) / slope
        by_rays = moved + along[:, None] * rays.directions
        by_sheet = -self.sheet.miss_by(self._select_sheet_values(values), points, index) / slope
        by = np.empty((len(pixels), 3, 1 + len(self.keys)))
        by[:, :, 0] = by_rays[across].T
        for axis in range(3):
            by[:, axis, 1:] = self.by_global(by_rays[:, axis], view, by_sheet * rays.directions[axis])
        return SheetPoints(points, by)

    def project(self, values: np.ndarray, view: ViewMedium, points: np.ndarray) -> np.ndarray:
        """Project points (N, 3) of the camera frame through a view; return pixels (N, 2), else NaN."""
        window = self.window_model(values) if view.window else None
        return project_through_window(self.camera(values), window, points, medium_index=self.medium_index(values, view))

    def by_global(self, by_rays: np.ndarray, view: ViewMedium, by_sheet: np.ndarray | None = None) -> np.ndarray:
        """Return derivatives (N, P) by all parameters from those by rays (C, N), and by sheet and index (6, N)."""
        result = np.zeros((by_rays.shape[1], len(self.keys)))
        result[:, : len(self.intrinsics.names)] = by_rays[2 : 2 + len(LENS)].T @ self.intrinsics.map
        index = () if view.medium is None else (self.index_key(view.medium),)
        columns: list[tuple[ParameterKey, np.ndarray]] = []
        if view.window:
            columns += zip((*WINDOW, *index), by_rays[COLUMNS.index(WINDOW[0]) :], strict=False)
        if by_sheet is not None:
            columns += zip((*SHEET, *index), by_sheet, strict=False)
        for key, column in columns:
            self.add(result, key, column)
        return result

    def value(self, values: np.ndarray, key: ParameterKey) -> float:
        """Return a parameter other than the lens's; zero if it does not exist."""
        if (place := self.places.get(key)) is not None:
            return float(values[place])
        return self.priors[key].mean if key in self.priors else 0.0

    def add(self, by_global: np.ndarray, key: ParameterKey, column: np.ndarray) -> None:
        """Add derivatives (N,) by a parameter to those by all parameters (N, P), if it is estimated."""
        if (place := self.places.get(key)) is not None and key not in self.tied:
            by_global[:, place] += column

    def index_key(self, medium: int) -> MediumIndex:
        """Return the key of the index of a medium."""
        return MediumIndex(self.media[medium])

    def _select_sheet_values(self, values: np.ndarray) -> np.ndarray:
        return np.array([self.value(values, key) for key in SHEET])


def ray_derivatives(
    camera: CameraModel, window: WindowModel | None, pixels: np.ndarray, *, medium_index: float
) -> RayDerivatives | None:
    """Return rays of pixels (N, 2) with their derivatives by `COLUMNS`; None if a pixel has no ray in the medium."""
    seen = directions(camera, pixels).T
    if not np.isfinite(seen).all():
        return None
    ideal = seen[:2] / seen[2]
    # Derivatives of the unit vector (x, y, 1) / length by x and y; those by pixel and lens follow after the window.
    by_ideal = -seen * (seen[:2] * seen[2])[:, None]
    by_ideal[[0, 1], [0, 1]] += seen[2]
    if window is None:
        nothing = np.zeros((len(WINDOW) + 1, *seen.shape))
        by = np.concatenate([by_ideal, nothing])
        rays = RayDerivatives(np.zeros_like(seen), seen, np.zeros_like(by), by)
    elif (rays := trace_derivatives(seen, by_ideal, window, medium_index=medium_index)) is None:
        return None
    by_lens = image_derivatives(camera, pixels, ideal)[:, :, None]

    def by_columns(by: np.ndarray) -> np.ndarray:
        return np.concatenate([by[0] * by_lens[:, 0] + by[1] * by_lens[:, 1], by[2:]])

    return RayDerivatives(rays.origins, rays.directions, by_columns(rays.origins_by), by_columns(rays.directions_by))
