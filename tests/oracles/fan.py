"""Laser fan behind an untilted flat window, in closed form: paths and power of its rays.

The fan starts at the origin; x runs across the sheet, y along the fan and z along the laser's axis, all in mm. Every
ray stays in x = 0 because this plane contains the window's normal.
"""

import math
from dataclasses import dataclass

import numpy as np

from tests.oracles.optics import fresnel_transmittance


@dataclass(frozen=True, kw_only=True)
class Fan:
    """Fan with uniform power over its angle. Extinction and absorption are in 1/mm, lengths in mm, angles in rad."""

    power_w: float
    full_angle: float
    window_distance: float
    window_thickness: float
    glass_index: float
    medium_index: float
    glass_absorption: float
    extinction: float
    waist_radius: float
    waist_distance: float
    divergence: float  # half-angle of the 1/e2 radius far from the waist, in the medium

    @property
    def outer_face(self) -> float:
        """z of the window's outer face."""
        return self.window_distance + self.window_thickness

    def slopes(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tangents of the ray's angles in air, glass and medium."""
        sine = np.sin(angle)
        return tuple(np.tan(np.arcsin(sine / n)) for n in (1.0, self.glass_index, self.medium_index))

    def exit_y(self, angle: np.ndarray) -> np.ndarray:
        """y where the ray leaves the window."""
        air, glass, _ = self.slopes(angle)
        return self.window_distance * air + self.window_thickness * glass

    def y(self, angle: np.ndarray, z: np.ndarray) -> np.ndarray:
        """y of the ray at z in the medium."""
        return self.exit_y(angle) + self.slopes(angle)[2] * (z - self.outer_face)

    def angle_through(self, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Fan angle of the ray through points, by bisection: y grows with the angle."""
        low, high = (np.full(np.broadcast_shapes(np.shape(y), np.shape(z)), s * math.radians(85)) for s in (-1, 1))
        for _ in range(60):
            middle = (low + high) / 2
            above = self.y(middle, z) > y
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return (low + high) / 2

    def way_in_medium(self, angle: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Length of the ray from the window's outer face to z."""
        return (z - self.outer_face) * np.hypot(1, self.slopes(angle)[2])

    def transmittance(self, angle: np.ndarray) -> np.ndarray:
        """Return the fraction of the power that leaves the window, after both faces and the glass."""
        cosines = [1 / np.hypot(1, slope) for slope in self.slopes(angle)]
        first = fresnel_transmittance(cosines[0], n1=1.0, n2=self.glass_index)
        second = fresnel_transmittance(cosines[1], n1=self.glass_index, n2=self.medium_index)
        return first * second * np.exp(-self.glass_absorption * self.window_thickness / cosines[1])

    def power_per_angle(self, angle: np.ndarray) -> np.ndarray:
        """Return the power in W per rad of the fan behind the window; zero beyond its edges."""
        inside = np.abs(angle) <= self.full_angle / 2
        return np.where(inside, self.power_w / self.full_angle * self.transmittance(angle), 0.0)

    def y_per_angle(self, angle: np.ndarray, z: np.ndarray) -> np.ndarray:
        """dy/dangle at z in mm/rad. With sin = n sin', d tan'/dangle = cos / (n cos'^3)."""
        ways = (self.window_distance, self.window_thickness, z - self.outer_face)
        indices = (1.0, self.glass_index, self.medium_index)
        slopes = self.slopes(angle)
        return sum(w * np.cos(angle) / n * np.hypot(1, s) ** 3 for w, n, s in zip(ways, indices, slopes, strict=True))

    def sigma(self, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Standard deviation across the sheet: half the 1/e2 radius, a hyperbola about the waist."""
        away = np.hypot(y, z) - self.waist_distance
        return 0.5 * np.hypot(self.waist_radius, self.divergence * away)

    def irradiance(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Irradiance in W/mm2 on a surface square to the ray."""
        angle, sigma = self.angle_through(y, z), self.sigma(y, z)
        per_length = self.power_per_angle(angle) / self.y_per_angle(angle, z) * np.hypot(1, self.slopes(angle)[2])
        gauss = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)
        return per_length * gauss * np.exp(-self.extinction * self.way_in_medium(angle, z))
