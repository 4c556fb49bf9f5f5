"""Halo of a laser stripe by scattering in the water, in closed form.

Light is scattered on the way to the surface and on the way to the camera. Let a surface point be at the distance x from
the sheet. Along the path D before the surface, the sheet scatters the fraction b dl per length; from the element at l
and y, the point receives p(a) / (x^2 + y^2 + l^2), with the phase function p at the angle a = atan(sqrt(x^2 + y^2) /
l). The sum over y and l is the line spread q(x) of single scattering per b. The same function describes the path to the
camera, with the distance from the camera ray instead of the sheet.

Small angles add up when light is scattered several times. The Fourier transform of the whole line spread is then that
of the unscattered stripe times exp(b Q), with the transform Q of q (Wells 1969, JOSA 59:686; Mobley, Light and Water,
Sec. 5.2). Light that is scattered once by a large angle, from the sheet straight into the camera, is neglected: it is a
thousandth of the halo.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

_LEAST_MM = 1e-3
"""Least distance from the sheet, far below a pixel; light scattered by less stays in the stripe."""
_DISTANCES, _ALONG, _ACROSS = 32, 96, 72
STEP_PX = 0.5  # below the width of any stripe
_CELLS = 4096
"""Step and number of cells of line spreads: some 2,000 px, beyond which little light is scattered."""


def line_spread(per_sr: Callable[[np.ndarray], np.ndarray], distance_mm: np.ndarray, path_mm: float) -> np.ndarray:
    """Return the line spread (N,) of single scattering, per mm and per scattering coefficient in 1/mm: no unit.

    ``per_sr`` is the phase function, 1/sr at angles in rad. Distances (N,) from the sheet are positive; ``path_mm`` is
    the path in the water before the surface.
    """
    # Logarithmic nodes: the integrand varies over the scale of the distance.
    x = distance_mm[:, None, None]
    along = np.geomspace(1e-2 * _LEAST_MM, path_mm, _ALONG)[:, None]
    across = np.geomspace(1e-2 * _LEAST_MM, path_mm, _ACROSS)
    aside = np.sqrt(x**2 + across**2)
    value = per_sr(np.clip(np.arctan2(aside, along), 1e-7, np.pi - 1e-7)) / (aside**2 + along**2)
    over_y = np.trapezoid(value * across, np.log(across), axis=2)
    return 2 * np.asarray(np.trapezoid(over_y * along[:, 0], np.log(along[:, 0])))


class HaloKernel:
    """Halo of single scattering per scattering coefficient in 1/mm, in cells of `STEP_PX` across the stripe.

    Parameters
    ----------
    per_sr
        Phase function: 1/sr at angles in rad.
    paths : sequence of (path_mm, mm_per_px)
        Paths of the light, and the distance from sheet or ray of the next pixel.
    """

    def __init__(self, per_sr: Callable[[np.ndarray], np.ndarray], paths: tuple[tuple[float, float], ...]):
        edges_px = STEP_PX * (np.arange(_CELLS // 2) + 0.5)
        half = np.zeros(_CELLS // 2 + 1)
        for path_mm, mm_per_px in paths:
            distance = np.geomspace(_LEAST_MM, edges_px[-1] * mm_per_px, _DISTANCES)
            spread = line_spread(per_sr, distance, path_mm)
            # Of the spread by the logarithm of the distance; light below the least distance stays in the stripe.
            integral = CubicSpline(np.log(distance), spread * distance).antiderivative()
            held = integral(np.log(edges_px * mm_per_px)) + spread[0] * distance[0]
            half[:-1] += np.concatenate([[2 * held[0]], np.diff(held)])
        self._transform = np.fft.rfft(np.concatenate([half, half[-2:0:-1]])).real
        place = np.fft.fftfreq(_CELLS, 1 / (_CELLS * STEP_PX))
        self._order = np.argsort(place)
        self.place_px = place[self._order]

    def profile(self, scattering_per_mm: float, *, sigma_px: float) -> np.ndarray:
        """Return the image of the stripe per px at `place_px`, for unscattered light with the integral 1.

        ``sigma_px`` is the standard deviation of the unscattered stripe.
        """
        turn = 2 * np.pi * np.fft.rfftfreq(_CELLS, STEP_PX)
        whole = np.exp(scattering_per_mm * self._transform - 0.5 * (turn * sigma_px) ** 2)
        return np.fft.irfft(whole, _CELLS)[self._order] / STEP_PX
