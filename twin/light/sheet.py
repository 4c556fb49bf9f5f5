"""The laser sheet in the medium: fan rays traced through the laser window, then a smooth ruled surface.

All coordinates are in the sensor's object coordinate system (OCS). The nominal sheet is X = 0, Y is along the stripe
and Z along the laser's axis. A fan ray is the straight line Y = y0(m) + m Z, X = x0(m) + k(m) Z; its slope m = dY/dZ is
the parameter of the surface. A tilted window or a bow curve the surface. Across it, along its normal, the irradiance is
Gaussian, with side lobes if they are described.

The fan's own frame has x along the sheet's normal, y along the fan and z along the laser's axis. A fan ray is
identified by the angle in rad between the axis and its projection along x.

For the light after its spread in translucent bodies (`twin.scene.surfaces`), the surface is its tangent plane within
the spread, with the irradiance of the sheet's centre. Shadows and edges are those of the point where the light leaves,
so light does not pass around an edge inside the body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.polynomial import Chebyshev

from twin.backend.arrays import Float, Point3f, SurfaceInteraction3f, UInt32, Vector3f, opaque, opaque_point, to_jit
from twin.light.camera import WindowFaces, build_frame
from twin.light.image_sampling import LIT_SIGMAS
from twin.light.pose import Rays
from twin.scene.objects import Objects
from uwlts.errors import DesignError
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Laser, Medium, Sensor

_RAYS = 1025  # number of fan rays traced through the window, many more than the terms of the series
_NODES = 4097  # number of nodes of the power along the fan, more than the traced rays
_NEWTON_STEPS = 2  # enough for single precision: the start is the ray of a fan with one vertex behind the window
_LARGEST_DEGREE = 27  # degree of the series before truncation, sufficient for fans that fill their window
_LARGEST_MISS_MM = 1e-3  # largest distance between the series and a traced ray 1 m behind the window
_SERIES_MM = 5e-5  # largest sum of the truncated terms of a series in mm, about the rounding errors of the traced rays
_SERIES_SLOPE = 1e-7  # largest sum of the truncated terms of a series of slopes
_FAINT_PEAK = 0.01  # peak irradiance of a faint side lobe divided by that of the main part
_SMALLEST_SPREAD_MM = 1e-3  # smallest distance from the fan's vertex; rays closer to it are treated as at this distance


Part = tuple[Float, Float, Float]
"""Gaussian across a sheet: share of the power; place and standard deviation in standard deviations of the main one."""


@dataclass(frozen=True)
class SheetLight:
    """Light of the sheet at points: distance, width, irradiance in W/mm2 perpendicular to the ray, direction.

    The signed ``distance_mm`` and ``sigma_mm`` are measured along ``normal``, the unit normal of the lit surface
    towards positive X. ``in_middle`` is the irradiance at the nearest point of the sheet's centre if all power were in
    the main Gaussian; scattered light is computed with it. ``exit_mm`` is the path length from the laser's window.
    """

    distance_mm: Float
    sigma_mm: Float
    irradiance: Float
    in_middle: Float
    direction: Vector3f
    normal: Vector3f
    exit_mm: Float


class Sheet:
    """The lit surface of a laser in a medium: of the sensor's main laser, or of ``laser``, another laser of the sensor.

    ``power_w`` is the power behind the window, before absorption. ``begins_at_z_mm`` is the smallest Z of the window's
    outer face in the OCS, before which there is no light. ``parts`` are the Gaussians across the sheet, the main one
    first. Side lobes make the lit surface ``reach`` times as wide, those that are not faint ``bright_reach`` times. The
    sheet of another laser has its own OCS; ``sheet_from_object`` (4, 4) transforms from the sensor's OCS to it.
    DesignError if part of the fan does not pass the window, or the window bends the fan too unevenly.
    """

    def __init__(self, sensor: Sensor, medium: Medium, laser: Laser | None = None):
        described = sensor if laser is None else sensor.model_copy(update={"laser": laser})
        self.sheet_from_object = (
            None if laser is None else np.linalg.inv(camera_from_object(described)) @ camera_from_object(sensor)
        )
        laser = described.laser
        origin, angle, fan = _trace_fan(described, medium)
        self._origin = opaque_point(origin)
        o, d = fan.origin, fan.direction
        slope, tilt = d[1] / d[2], d[0] / d[2]
        y0, x0 = _fit_series(slope, o[1] - slope * o[2], _SERIES_MM), _fit_series(slope, o[0] - tilt * o[2], _SERIES_MM)
        k, exit_z = _fit_series(slope, tilt, _SERIES_SLOPE), _fit_series(slope, o[2], _SERIES_MM)
        self.begins_at_z_mm = opaque(float(o[2].min()))
        far = o + 1e3 * d
        miss = np.hypot(y0(slope) + slope * far[2] - far[1], x0(slope) + k(slope) * far[2] - far[0]).max()
        if miss > _LARGEST_MISS_MM:
            raise DesignError(
                f"the laser's window bends the {laser.fan_angle_deg:g} deg fan too unevenly: its rays are traced "
                f"with an error of {miss:.3f} mm (limit {_LARGEST_MISS_MM:g} mm): narrow the fan or the window's tilt"
            )
        self._y0, self._x0, self._tilt, self._exit_z = map(_Series, (y0, x0, k, exit_z))
        self._dy0, self._dx0, self._dtilt = (_Series(each.deriv()) for each in (y0, x0, k))
        (low, high), (offset, scale) = y0.domain, y0.mapparms()
        straight = y0.cutdeg(1)
        self._start_y0, self._start_dy0 = opaque(float(straight(0.0))), opaque(float(straight.deriv()(0.0)))
        self._least, self._most = opaque(low - 0.05 * (high - low)), opaque(high + 0.05 * (high - low))
        self._offset, self._scale = opaque(offset), opaque(scale)
        self._power, self.power_w = _tabulate_power(laser, slope, angle, fan.weight)
        waist = laser.waist_radius_mm
        index = medium.refractive_index(laser.wavelength_nm)
        rayleigh = math.pi * waist**2 * index / (laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm)
        self._waist, self._rayleigh, self._waist_at = map(opaque, (waist, rayleigh, laser.waist_distance_mm))
        lobes = [(share, 2 * offset, radius) for offset, radius, share in laser.side_lobes]
        main = (1 - math.fsum(share for share, _, _ in lobes), 0.0, 1.0)
        self.parts: list[Part] = [(opaque(share), opaque(at), opaque(radius)) for share, at, radius in (main, *lobes)]
        reaches = [(abs(offset) / LIT_SIGMAS + radius, share / radius) for share, offset, radius in lobes]
        self.reach = max([1.0, *(reach for reach, _ in reaches)])
        self.bright_reach = max([1.0, *(reach for reach, peak in reaches if peak > _FAINT_PEAK * main[0])])
        self._extinction = opaque(medium.extinction_per_mm(laser.wavelength_nm))

    def evaluate(self, p: Point3f) -> SheetLight:
        """Return the light of the sheet at points in the OCS.

        The slope m of the fan ray through a point solves y0(m) + m Z = Y (Newton). The power between two fan rays is
        P'(m) dm. Its profile across the sheet is Gaussian with the standard deviation w / 2. The radius w at the
        distance s from the laser follows from w^2 = w0^2 (1 + ((s - s0) / zR)^2) (Siegman, Lasers, Eqs. 17.5, and 17.6
        for zR, with M2).
        """
        m = (p.y - self._start_y0) / (self._start_dy0 + p.z)
        for _ in range(_NEWTON_STEPS):
            t = self._normalise(m)
            m -= (self._y0(t) + m * p.z - p.y) / (self._dy0(t) + p.z)
            m = dr.clip(m, self._least, self._most)
        t = self._normalise(m)
        tilt, normal = self._tilt(t), self._compute_normal(m, t, p.z)
        distance = (p.x - self._x0(t) - tilt * p.z) * normal.x
        stretch = dr.sqrt(1 + m * m + tilt * tilt)
        exit_mm = (p.z - self._exit_z(t)) * stretch
        distances_ = dr.norm(p - self._origin) - self._waist_at
        sigma = 0.5 * self._waist * dr.sqrt(1 + dr.square(distances_ / self._rayleigh))
        # In a plane Z = const the power per length along Y is P'(m) dm / dY; normal.x projects the profile onto it.
        density = self._power.evaluate(m) / (self._dy0(t) + p.z) * normal.x
        in_middle = density / (sigma * math.sqrt(2 * math.pi)) * stretch * dr.exp(-self._extinction * exit_mm)
        in_middle = dr.select(exit_mm > 0, in_middle, 0.0)
        irradiance = in_middle * dr.exp(-0.5 * dr.square(distance / sigma))
        if len(self.parts) > 1:
            irradiance *= self.parts[0][0]
            for share, offset, radius in self.parts[1:]:
                distances_ = (distance / sigma - offset) / radius
                irradiance += in_middle * (share / radius) * dr.exp(-0.5 * dr.square(distances_))
        direction = mi.Vector3f(tilt, m, 1.0) / stretch
        return SheetLight(distance, sigma, irradiance, in_middle, direction, normal, exit_mm)

    def sample(self, u: Point3f) -> tuple[Point3f, Vector3f]:
        """Sample origins and directions of rays behind the window, in proportion to power, from uniform numbers.

        ``u.x`` selects the fan ray, ``u.y`` its lateral offset and ``u.z`` its tilt. Their standard deviations are w0 /
        2 at the waist and w0 / (2 zR). As both are independent, straight rays spread by w(s) / 2 at every s.
        """
        m = self._power.draw(u.x)
        t = self._normalise(m)
        tilt, z = self._tilt(t), self._exit_z(t)
        stretch = dr.sqrt(1 + m * m + tilt * tilt)
        along = cast(Vector3f, mi.Vector3f(tilt, m, 1.0))
        leaves = mi.Point3f(self._x0(t) + tilt * z, self._y0(t) + m * z, z)
        # Point of the ray at the waist's distance from the laser.
        from_laser = leaves - self._origin
        ahead = dr.dot(from_laser, along) / stretch
        to_waist = dr.safe_sqrt(ahead * ahead - dr.squared_norm(from_laser) + dr.square(self._waist_at)) - ahead
        waist_z = z + to_waist / stretch
        sigma = 0.5 * self._waist / self._compute_normal(m, t, waist_z).x
        beside, turned = sigma * _draw_normal(u.y), sigma / self._rayleigh * _draw_normal(u.z)
        leaves.x += beside - turned * to_waist
        along.x += turned * stretch
        return leaves, dr.normalize(along)

    def _normalise(self, m: Float) -> Float:
        return dr.fma(m, self._scale, self._offset)

    def _compute_normal(self, m: Float, t: Float, z: Float) -> Vector3f:
        """Return the unit normal of the surface X(Y, Z), from X_Y = (x0' + k' Z) / (y0' + Z) and X_Z = k - m X_Y."""
        # Both derivatives vanish at the fan's vertex.
        spread = dr.maximum(self._dy0(t) + z, _SMALLEST_SPREAD_MM)
        by_y = (self._dx0(t) + self._dtilt(t) * z) / spread
        return dr.normalize(mi.Vector3f(1.0, -by_y, m * by_y - self._tilt(t)))


def _trace_fan(sensor: Sensor, medium: Medium) -> tuple[np.ndarray, np.ndarray, Rays]:
    """Trace the fan; return the laser's origin (3,), ray angles (N,) and rays (3, N) behind the window in the OCS."""
    laser, pose = sensor.laser, laser_pose(sensor)
    to_object = np.linalg.inv(camera_from_object(sensor))
    rotation = build_frame(pose.axis, pose.normal)
    faces = WindowFaces(
        laser.window, medium, wavelength_nm=laser.wavelength_nm, origin_mm=pose.origin_mm, rotation=rotation
    )
    # Chebyshev nodes, denser towards the edges, prevent oscillation of the series.
    angle = -math.radians(laser.fan_angle_deg / 2) * np.cos(np.linspace(0, math.pi, _RAYS))
    fan = mi.Vector3f(rotation @ _compute_fan_directions(laser, angle))
    path = faces.trace(mi.Point3f(pose.origin_mm), fan, mode=mi.TransportMode.Importance)
    if not bool(dr.all(path.weight > 0)):
        raise DesignError(
            f"part of the laser's {laser.fan_angle_deg:g} deg fan does not pass its window of "
            f"{laser.window.aperture_diameter_mm:g} mm: enlarge the window or bring it closer"
        )
    d = to_object[:3, :3] @ path.direction.numpy().astype(float)
    o = np.broadcast_to(to_object[:3, :3] @ path.origin.numpy().astype(float) + to_object[:3, 3:], d.shape)
    passed = np.broadcast_to(path.weight.numpy().astype(float), angle.shape)
    return to_object[:3, :3] @ pose.origin_mm + to_object[:3, 3], angle, Rays(o, d, passed)


def _tabulate_power(laser: Laser, slope: np.ndarray, angle: np.ndarray, passed: np.ndarray) -> tuple[PowerTable, float]:
    """Return the power behind the window per slope, and the total power in W, from fan rays (N,)."""
    lit = _find_lit_angles(laser)
    first, last = np.interp(lit[[0, -1]], angle, slope)
    nodes = np.linspace(first, last, _NODES)
    angle_of, passes = _fit_series(slope, angle, _SERIES_SLOPE), _fit_series(slope, passed, 1e-6)
    density = _compute_power_per_angle(laser, np.clip(angle_of(nodes), lit[0], lit[-1])) * passes(nodes)
    between = np.union1d(lit, angle[(angle > lit[0]) & (angle < lit[-1])])
    total = float(np.trapezoid(_compute_power_per_angle(laser, between) * np.interp(between, angle, passed), between))
    return PowerTable(nodes, density * angle_of.deriv()(nodes), power_w=total), total


def _fit_series(slope: np.ndarray, values: np.ndarray, tolerance: float) -> Chebyshev:
    """Fit a Chebyshev series in the slope, truncated as far as the sum of the omitted terms allows."""
    fit = Chebyshev.fit(slope, values, _LARGEST_DEGREE, domain=(slope.min(), slope.max()))
    left = np.cumsum(np.abs(fit.coef[::-1]))[::-1]
    return fit.truncate(max(1, np.count_nonzero(left > tolerance)))


class _Series:
    """Chebyshev series with opaque coefficients: series of equal degree share a kernel."""

    def __init__(self, series: Chebyshev):
        self._coefficients = [opaque(float(each)) for each in series.coef]

    def __call__(self, t: Float) -> Float:
        """Evaluate at the normalised variable (-1 to 1) by Clenshaw's recurrence, exact in single precision."""
        ahead, beyond = mi.Float(0.0), mi.Float(0.0)
        for coefficient in self._coefficients[:0:-1]:
            ahead, beyond = dr.fma(2 * t, ahead, coefficient - beyond), ahead
        return dr.fma(t, ahead, self._coefficients[0] - beyond)


def _draw_normal(u: Float) -> Float:
    return math.sqrt(2.0) * dr.erfinv(dr.clip(2 * u - 1, -1 + 1e-7, 1 - 1e-7))


def _find_lit_angles(laser: Laser) -> np.ndarray:
    """Return the angles (K,) in rad that bound the smooth parts of the power per angle, which is 0 outside them."""
    half = laser.fan_angle_deg / 2
    table = laser.fan_table()
    return np.radians([angle for angle, _ in table] if table else (-half, half))


def _compute_fan_directions(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Return unit directions (3, N) of fan rays in the laser's frame.

    A beam tilted by alpha against the line optics leaves them as a cone. Its distance from a plane sheet is z
    tan(alpha) (1 / cos(angle) - 1); the central ray keeps the laser's axis.
    """
    bow = math.tan(math.radians(laser.bow_deg))
    along = np.stack([bow * (1 / np.cos(angle) - 1), np.tan(angle), np.ones_like(angle)])
    return along / np.linalg.norm(along, axis=0)


def _compute_power_per_angle(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Return the power in W/rad at lit angles (N,), before the window; its integral is the laser's power."""
    half = math.radians(laser.fan_angle_deg / 2)
    match laser.fan_profile:
        case "flat":
            relative, total = np.ones_like(angle), 2 * half
        case "gaussian":
            relative, total = np.exp(-2 * (angle / half) ** 2), half * math.sqrt(math.pi / 2) * math.erf(math.sqrt(2))
        case "powell" | tuple():
            nodes, powers = _find_lit_angles(laser), [power for _, power in laser.fan_table()]
            relative, total = np.interp(angle, nodes, powers), np.trapezoid(powers, nodes)
        case _:
            assert_never(laser.fan_profile)
    return 1e-3 * laser.power_mw * relative / total


class PowerTable:
    """Power per unit of a coordinate along the fan: linear between evenly spaced nodes (N,), zero outside them.

    ``density`` (N,) is the relative power per unit at the nodes, scaled to ``power_w`` in total. The values are stored
    in arrays, so that all profiles use the same kernel.
    """

    def __init__(self, nodes: np.ndarray, density: np.ndarray, *, power_w: float):
        low, step, self._cells = float(nodes[0]), float(nodes[1] - nodes[0]), len(nodes) - 1
        self._low, self._step, self._power_per_step = opaque(low), opaque(step), opaque(power_w / step)
        share = density / np.trapezoid(density)
        below = np.concatenate([[0.0], np.cumsum(0.5 * (share[1:] + share[:-1]))])
        self._share, self._below = to_jit(share), to_jit(below / below[-1])

    def evaluate(self, x: Float) -> Float:
        """Return the power in W per unit of the coordinate."""
        place = (x - self._low) / self._step
        # The second bound catches NaN, which clipping does not.
        cell = dr.minimum(mi.UInt32(dr.clip(place, 0.0, self._cells - 1.0)), self._cells - 1)
        share = dr.lerp(*self._gather_ends(cell), place - mi.Float(cell))
        return dr.select((place >= 0) & (place <= self._cells), self._power_per_step * share, 0.0)

    def draw(self, u: Float) -> Float:
        """Return the coordinate below which the fraction ``u`` of the power is emitted.

        Within a cell with the densities a and b at its ends, a t + (b - a) t^2 / 2 is solved for t, 0 to 1.
        """
        cell = dr.binary_search(0, self._cells - 1, lambda i: dr.gather(mi.Float, self._below, i + 1) <= u)
        rest = u - dr.gather(mi.Float, self._below, cell)
        a, b = self._gather_ends(cell)
        t = 2 * rest / dr.maximum(a + dr.safe_sqrt(a * a + 2 * (b - a) * rest), 1e-30)
        return self._low + self._step * (mi.Float(cell) + dr.clip(t, 0.0, 1.0))

    def _gather_ends(self, cell: UInt32) -> tuple[Float, Float]:
        return dr.gather(mi.Float, self._share, cell), dr.gather(mi.Float, self._share, cell + 1)


# --- translucent bodies -----------------------------------------------------------------------------------------------


def spread_irradiance(
    objects: Objects, si: SurfaceInteraction3f, normal: Vector3f, here: SheetLight, parts: Sequence[Part]
) -> Float:
    """Return the irradiance in W/mm2 that light leaving the bodies at surface points ``si`` stands for.

    Along the surface, the distance from the sheet changes by the sine of the angle between surface and sheet normal.
    Each Gaussian of the spread thus adds its variance times the squared sine to that of the sheet, the Gaussians
    ``parts``. The mean exit point is displaced along the tangential part of the light's direction. ``normal`` is the
    unit normal in the OCS, ``here`` the light of the sheet there.
    """
    across = dr.dot(normal, here.normal)
    tilted, variance = 1 - dr.square(across), dr.square(here.sigma_mm)
    cosine = dr.dot(here.direction, normal)
    ahead = dr.dot(here.direction, here.normal) - cosine * across
    distance = here.distance_mm - objects.spread_ahead_mm(si, cosine) * ahead
    total = mi.Float(0.0)
    for share, offset, radius in parts:
        squared, narrow = dr.square(distance - offset * here.sigma_mm), variance * dr.square(radius)
        for weight, added in objects.spread_parts(si):
            wide = narrow + added * tilted
            total += share * weight * dr.sqrt(variance / wide) * dr.exp(-0.5 * squared / wide)
    return here.in_middle * total


def lit_sigma_mm(objects: Objects, si: SurfaceInteraction3f, normal: Vector3f, here: SheetLight) -> Float:
    """Return the standard deviation that bounds the light at surface points, as that of a sheet without spread would.

    The widest Gaussian holds so little of the light that half its standard deviation is enough.
    """
    tilted = 1 - dr.square(dr.dot(normal, here.normal))
    _, widest = objects.spread_parts(si)[-1]
    return dr.sqrt(dr.square(here.sigma_mm) + 0.25 * widest * tilted)
