"""Daylight that a wavy water surface focuses to moving filaments on the surfaces below.

Rays of the sun, which stands vertically above, are refracted at a random surface of waves and counted on a horizontal
plane. The surface is periodic, so the pattern covers any area. The sun's disc blurs it.
"""

import math

import numpy as np

from twin.scene.platform_kinds import GRAVITY_M_S2

PATCH_MM = 512.0  # period of the surface; the focus of longer waves is at depths of many metres
CELLS = 1024
"""Number of cells of the pattern along each axis: 0.5 mm each, narrower than the sun's blur 0.2 m below the surface."""
_SHORTEST_MM = 17.0
"""Shortest wavelength: the slowest waves, between gravity and capillary waves, after which viscosity damps."""
_GRAVITY_MM_S2 = 1e3 * GRAVITY_M_S2
_TENSION_MM3_S2 = 7.3e4
"""Surface tension of water divided by its density (0.073 N/m, 1000 kg/m3)."""
_PEAK = 0.877
"""Angular frequency of the longest waves times the wind speed, divided by gravity (Pierson and Moskowitz 1964)."""
_SUN_RAD = 4.65e-3  # angular radius of the sun (half of 32 arc minutes)
_DIRECT = 0.9  # fraction of the daylight that comes directly from the sun under a clear sky
_STEP_MM = 4.0
_FAST_MM_S = 500.0
"""Exposures are divided so that waves, at this typical speed, advance by at most `_STEP_MM`."""
_MOST_MOMENTS = 8
_STREAM = 43
"""Random number stream of the waves, separate from others of the same seed."""


class Caustics:
    """Random water surface above a scene.

    The mean square slope is that of a clean sea, 0.003 + 0.00512 U at the wind speed U in m/s (Cox and Munk 1954). It
    is spread evenly over the logarithm of the wave number, from the longest waves to ``_SHORTEST_MM`` (saturated
    spectrum, elevation in proportion to k^-4: Phillips 1958). The patch holds those up to its period. Waves run in all
    directions with cos^2 of half the angle to the wind, which blows along X. ``index`` is that of the water; light that
    it scatters counts as even light.
    """

    def __init__(self, *, wind_m_s: float, depth_mm: float, index: float, scattering_per_mm: float, seed: int):
        self._depth_mm, self._index = depth_mm, index
        self._direct = _DIRECT * math.exp(-scattering_per_mm * depth_mm)
        number = 2 * math.pi * np.fft.fftfreq(CELLS, PATCH_MM / CELLS)
        self._kx, self._ky = number[None, :], number[:, None]
        k = np.hypot(self._kx, self._ky)
        k[0, 0] = 1.0
        largest = 2 * math.pi / _SHORTEST_MM
        held = (k <= largest) & (k >= 2 * math.pi / PATCH_MM * (1 - 1e-9))
        held[0, 0] = False
        spread = (1 + self._kx / k) / (2 * math.pi)
        # Slope variance per area of the wave-number plane: that per ln k, divided by k^2 and the directions.
        slopes = slope_variance_per_octave(wind_m_s) / math.log(2) * spread / k**2 * (2 * math.pi / PATCH_MM) ** 2
        rng = np.random.default_rng([seed, _STREAM])
        drawn = rng.normal(size=(2, CELLS, CELLS))
        # The mean of the squared real part of a wave is half of its squared amplitude; |drawn|^2 is 2 in the mean.
        self._elevation = np.where(held, np.sqrt(slopes) / k, 0.0) * (drawn[0] + 1j * drawn[1])
        self._frequency = angular_frequency(k)

    def slopes(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the slopes of the surface along X and Y (CELLS, CELLS) at a time."""
        waves = self._elevation * np.exp(-1j * time_s * self._frequency)
        along, across = (np.fft.ifft2(1j * k * waves, norm="forward").real for k in (self._kx, self._ky))
        return along, across

    def pattern(self, time_s: float, exposure_s: float = 0.0) -> np.ndarray:
        """Return the daylight on horizontal surfaces, relative to its mean (CELLS, CELLS), during an exposure."""
        moments = min(_MOST_MOMENTS, 1 + int(exposure_s * _FAST_MM_S / _STEP_MM))
        times = time_s + exposure_s * ((np.arange(moments) + 0.5) / moments - 0.5)
        light = np.mean(
            [focus_light(*self.slopes(t), depth_mm=self._depth_mm, index=self._index) for t in times], axis=0
        )
        # A disc of radius r has the variance r^2 / 4 along each axis. A cell more removes the spacing of the rays.
        blur = math.hypot(0.5 * self._depth_mm * _SUN_RAD / self._index, PATCH_MM / CELLS)
        passed = np.exp(-0.5 * blur**2 * (self._kx**2 + self._ky**2))
        sharp = np.fft.irfft2(np.fft.rfft2(light) * passed[:, : CELLS // 2 + 1], light.shape)
        return (1 - self._direct + self._direct * sharp).astype(np.float32)


def slope_variance_per_octave(wind_m_s: float) -> float:
    """Return the mean square slope of the waves within a factor of two in wavelength."""
    longest_mm = 2e6 * math.pi * wind_m_s**2 / (_PEAK**2 * _GRAVITY_MM_S2)
    octaves = math.log2(max(longest_mm, 2 * _SHORTEST_MM) / _SHORTEST_MM)
    return (0.003 + 0.00512 * wind_m_s) / octaves


def angular_frequency(number: np.ndarray) -> np.ndarray:
    """Return the angular frequency in 1/s of waves in deep water, from their wave number in 1/mm.

    omega^2 = g k + T k^3 with surface tension T per density (Lamb, Hydrodynamics, Sec. 267).
    """
    return np.sqrt(_GRAVITY_MM_S2 * number + _TENSION_MM3_S2 * number**3)


def focus_light(along: np.ndarray, across: np.ndarray, *, depth_mm: float, index: float) -> np.ndarray:
    """Return the irradiance (N, N) below a periodic surface, relative to its mean.

    A vertical ray meets the surface at the angle i of its slope and is refracted to r, sin r = sin i / n. It is shifted
    by the depth times tan(i - r) against the slope. Each ray's light is divided among the four nearest nodes. Slopes
    (N, N) are those along X (columns) and Y (rows) at nodes of `PATCH_MM` / N.
    """
    count = len(along)
    steepness = np.hypot(along, across)
    incidence = np.arctan(steepness)
    aside = depth_mm * count / PATCH_MM * np.tan(incidence - np.arcsin(np.sin(incidence) / index))
    aside /= np.maximum(steepness, 1e-12)
    x, y = np.arange(count) - aside * along, np.arange(count)[:, None] - aside * across
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    right, down = x - column, y - row
    light = np.zeros(count * count)
    for beside, below in ((0, 0), (0, 1), (1, 0), (1, 1)):
        place = (row + below) % count * count + (column + beside) % count
        share = (right if beside else 1 - right) * (down if below else 1 - down)
        light += np.bincount(place.ravel(), share.ravel(), light.size)
    return light.reshape(count, count)
