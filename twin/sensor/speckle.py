"""Subjective speckle of a laser-lit surface: the noise in the image of the stripe due to surface roughness.

On the image sensor, a rough surface in coherent light forms a circular complex Gaussian field. The lens aperture limits
its spatial frequencies. The intensity is integrated over pixels, and over what does not interfere: polarisations and,
for a laser of finite line width, wavelengths. The result is a factor of mean 1 for every pixel.

This integral is a sum of independent exponential variables with weights l_i of sum 1. They are the eigenvalues of the
coherence over the pixel, times those of the wavelengths, times the fractions of the polarisations (Goodman, Speckle
Phenomena in Optics, Sec. 4.7). Its variance is sum l_i^2 and its third cumulant 2 sum l_i^3; both sums are products
over the three causes.

One exponential pattern is computed with the correlation of pixel integrals, and transformed to a distribution with
these cumulants. Sampling every variable would take a hundred times as long if a pixel contains many grains.
"""

from __future__ import annotations

import math
from functools import cache
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage, special
from scipy.special import j1

from twin.sensor.random_numbers import add_normal_numbers
from uwlts.errors import DesignError
from uwlts.model.sensor import Camera

# Period of the pattern across the stripe: at least this many pixels, wider than a stripe, and this many grains.
_TILE_PX = 64
_TILE_GRAINS = 16

# Widest grain in pixels.
_WIDEST_PX = 64.0
# Up to this grain in pixels, the field gets the correlation of pixel integrals (accuracy 0.01).
_FINE_PX = 1.25
# For wider grains, this is added to the square of the grain (pixels squared); the correlation is then accurate to
# 0.025, and to 0.005 from 4 pixels on.
_WIDENED_PX2 = 0.75
# Finest grain in pixels for the correlation of pixel integrals; neighbours are then correlated by 0.02.
_UNCORRELATED_PX = 0.1
# Finest grain in pixels for the third cumulant of pixel integrals; its excess over that of equal variables comes from
# the pixel's border and is proportional to the grain.
_BORDER_PX = 0.3

# Renewal length in resolution cells: the field's correlation then falls to one half at the same displacement as that of
# an Airy pattern (see `renewal_correlation`).
_RENEWAL_CELLS = 0.9
_RENEWAL_GROUPS = 8

_LEAST_CONTRAST = 1e-4  # less is invisible, and would divide by zero

# Nodes of the table of distributions, along half the skewness and along the cube root of an exponential variable.
_SKEWS = 65
_ROOTS = 513
_LARGEST_ROOT = 3.0  # cube root of 27, which one exponential variable in 5e11 exceeds


class Speckle:
    """Speckle pattern of a camera in laser light, for any position along the travel of the stage.

    A pattern depends only on seed, travel and pixel: frames, or parts of a frame, can be computed in any order. After
    ``2 renewal_mm`` of travel it is independent. ``wavelength_nm`` is that in air, between lens and image sensor.
    Different non-negative seeds give independent patterns. DesignError if the lens is focused within its focal length,
    or grains are wider than 64 pixels.
    """

    def __init__(self, camera: Camera, *, wavelength_nm: float, seed: int) -> None:
        focal, focus = camera.focal_length_mm, camera.focus_distance_mm
        if focus <= focal:
            raise DesignError(
                f"focus_distance_mm {focus:g} is not larger than focal_length_mm {focal:g}: the lens forms no image"
            )
        magnification = focal / (focus - focal)  # of the focused plane
        wavelength_mm = 1e-6 * wavelength_nm
        grain_mm = wavelength_mm * camera.f_number * (1 + magnification)
        grain_px = grain_mm / (1e-3 * camera.pixel_size_um)
        if grain_px > _WIDEST_PX:
            raise DesignError(
                f"at f/{camera.f_number:g} speckle grains are {grain_px:.0f} pixels wide, more than the {_WIDEST_PX:g} "
                "of this model: check f_number and pixel_size_um"
            )
        self.camera = camera
        self.renewal_mm = _RENEWAL_CELLS * grain_mm / magnification
        self._seed = seed
        self._along_width = camera.stripe_along == "width"
        self._pixel = pixel_contrast(grain_px) ** 2, _compute_third_cumulant(grain_px)
        self._tile = _Tile(camera.lines(), grain_px)

    def factors(
        self,
        rows: np.ndarray,
        columns: np.ndarray,
        *,
        travel_mm: float,
        polarisation: ArrayLike,
        coherence: ArrayLike = 1.0,
    ) -> np.ndarray:
        """Return factors (P,), float32, not negative and of mean 1, of the laser's light in pixels (P,) in any order.

        ``travel_mm`` is the travel of the stage; see `renewal_correlation` for its effect. ``polarisation`` is the
        degree of polarisation P of the scattered light, (P,) or a scalar, 0 to 1: 1 for bare metal, about 0 for paint
        and plastics, where light is scattered many times. The patterns of two orthogonal polarisations add in
        intensity, I = (1 + P) / 2 I_1 + (1 - P) / 2 I_2, with the contrast sqrt((1 + P^2) / 2) (Goodman, Speckle
        Phenomena in Optics, Ch. 3). ``coherence`` is the contrast of the unintegrated pattern of one polarisation, (P,)
        or a scalar, 1e-4 to 1 (smaller values are raised); see the function `coherence`. It multiplies the contrast, as
        averaging over the pixel area does (`pixel_contrast`).

        All factors have the same grains. If many patterns add up, the true correlation between pixels is smaller by
        up to a fifth.
        """
        # Small integer types would overflow in the index of a pixel in the tile.
        rows, columns = (np.asarray(values).astype(np.intp, casting="same_kind") for values in (rows, columns))
        polarised = np.square(np.asarray(polarisation, float))
        coherent = np.square(np.maximum(np.asarray(coherence, float), _LEAST_CONTRAST))
        squares, cubes = self._pixel
        # A Gaussian line (`coherence`) has weights proportional to r^k, with C^2 = (1 - r) / (1 + r).
        variance = squares * coherent * (1 + polarised) / 2
        cubes = cubes * 4 * np.square(coherent) / (3 + np.square(coherent)) * (1 + 3 * polarised) / 4
        along, across = (columns, rows) if self._along_width else (rows, columns)
        pattern = self._tile.intensity(_draw_amplitudes(self._tile.size, self._seed, travel_mm / self.renewal_mm))
        intensity = pattern[across % self._tile.across_px, along]
        factors = 1 + np.sqrt(variance) * _skew_exponential(intensity, cubes / variance**1.5)
        return np.maximum(factors, 0.0).astype(np.float32)


def coherence(roughness_um: ArrayLike, *, linewidth_nm: float, wavelength_nm: float, index: float = 1.0) -> np.ndarray:
    """Return the speckle contrast, above 0 up to 1, of a rough surface in laser light of a spectral width.

    A height h delays light that arrives and leaves along the normal by 2 n h = g h. Let heights be normally
    distributed with the standard deviation s. Patterns of wavenumbers that differ by q then have an amplitude
    correlation of exp(-(q g s)^2 / 2), and an intensity correlation of exp(-(q g s)^2). Over a Gaussian line of
    standard deviation d, q has the variance 2 d^2. The mean intensity correlation is C^2 = (1 + 4 (d g s)^2)^(-1/2)
    (Parry in Dainty, Laser Speckle and Related Phenomena, 1975; Goodman, Speckle Phenomena in Optics, Ch. 5).

    ``roughness_um``, of any shape, is the standard deviation of the surface's heights within a resolution cell. If
    light enters the material, give half the standard deviation of its optical path instead, with the index 1.
    ``linewidth_nm`` is the full width at half maximum of the laser's spectrum during an exposure, 0 for a coherent
    laser. ``wavelength_nm`` is the mean one in air, ``index`` the refractive index n of the medium relative to air.
    """
    spread_per_um = 1e3 * 2 * math.pi / wavelength_nm**2 * linewidth_nm / math.sqrt(8 * math.log(2))
    return (1 + 4 * (spread_per_um * index * 2 * np.asarray(roughness_um, float)) ** 2) ** -0.25


def pixel_contrast(grain_px: float) -> float:
    """Return the contrast of a coherent, polarised pattern averaged over square pixels.

    ``grain_px`` is lambda N (1 + m) in pixels. C^2 is the mean intensity correlation, |2 J1(z) / z|^2 with z = pi r /
    grain, over all pairs of points of the pixel (Goodman, Speckle Phenomena in Optics, Ch. 4).
    """
    nodes, weights = np.polynomial.legendre.leggauss(32 + math.ceil(8 / grain_px))
    lag, weights = (1 + nodes) / 2, weights * (1 - nodes) / 2
    z = math.pi * np.hypot(lag[:, None], lag) / grain_px
    return math.sqrt(weights @ (2 * j1(z) / z) ** 2 @ weights)


def renewal_correlation(lag: ArrayLike) -> np.ndarray:
    """Return the correlation of the complex fields at two positions that are ``lag`` renewal lengths apart.

    Real speckle moves with the surface, so a pixel sees a new pattern when the image has moved by a grain. Here,
    patterns fade into new ones instead: the correlation is 1 at lag 0, about 1 - (pi lag)^2 / 8 near it, one half at
    0.79, and 0 from 2 on. The renewal length is 0.9 lambda N (1 + m) / m of travel. The intensity correlation is the
    square.
    """
    lag = np.minimum(np.abs(lag), 2.0)
    return (1 - lag / 2) * np.cos(math.pi * lag / 2) + np.sin(math.pi * lag / 2) / math.pi


class _Tile:
    """Periodic tile of the pattern, as long as the stripe, from amplitudes of spatial frequencies."""

    def __init__(self, along_px: int, grain_px: float) -> None:
        least = math.ceil(_TILE_GRAINS * grain_px)
        gap = math.ceil(2 * grain_px)  # keeps the ends of the stripe uncorrelated, as the tile is periodic
        self.across_px = cast(int, fft.next_fast_len(max(_TILE_PX, least)))
        along_px = cast(int, fft.next_fast_len(max(along_px + gap, least)))
        if grain_px <= _FINE_PX:
            power = _compute_power_of_sums(self.across_px, along_px, grain_px)
        else:
            # The lens passes frequencies within a disc of diameter 1 / (lambda N (1 + m)) (Goodman, Introduction to
            # Fourier Optics, Sec. 6.2).
            radius = 0.5 / math.sqrt(grain_px**2 + _WIDENED_PX2)
            power = np.hypot(fft.fftfreq(self.across_px)[:, None], fft.fftfreq(along_px)) <= radius
        self._shape, self._bins = power.shape, np.flatnonzero(power)
        self._amplitude = np.sqrt(power.ravel()[self._bins] / power.sum()).astype(np.float32)
        self.size = self._bins.size

    def intensity(self, amplitudes: np.ndarray) -> np.ndarray:
        """Return the exponential intensity (across, along), whose mean is the mean square of the amplitudes (size,)."""
        spectrum = np.zeros(self._shape, np.complex64)
        spectrum.ravel()[self._bins] = amplitudes * self._amplitude
        field = np.asarray(fft.ifft2(spectrum, norm="forward", overwrite_x=True))
        return np.square(np.real(field)) + np.square(np.imag(field))


def _compute_power_of_sums(across_px: int, along_px: int, grain_px: float) -> np.ndarray:
    """Return the relative power (across, along) of a field whose intensity has the correlation of pixel integrals.

    The field correlation is the square root of the intensity correlation. The later transformation of the intensities
    reduces their correlation; this is compensated for monochromatic, polarised light.
    """
    correlation = _compute_correlation_of_sums(grain_px)
    wanted = correlation / correlation[0, 0]
    # By Mehler's formula for exponential variables (Laguerre polynomials), the n-th term of their transform is
    # correlated by the n-th power of their correlation.
    nodes, weights = np.polynomial.laguerre.laggauss(48)
    shaped = _skew_exponential(nodes, _compute_third_cumulant(grain_px) / pixel_contrast(grain_px) ** 3)
    terms = np.square((weights * shaped) @ np.polynomial.laguerre.lagvander(nodes, 12))[1:]
    drawn = np.linspace(0, 1, 1001)
    reshaped = np.polynomial.polynomial.polyval(drawn, np.concatenate([[0.0], terms / terms.sum()]))
    field = np.sqrt(np.interp(wanted, reshaped, drawn))

    def waves(length: int) -> np.ndarray:
        lags = np.arange(len(field))
        return np.cos(2 * math.pi / length * np.arange(length)[:, None] * lags) * np.where(lags > 0, 2.0, 1.0)

    return np.maximum(waves(across_px) @ field @ waves(along_px).T, 0.0)


def _compute_correlation_of_sums(grain_px: float) -> np.ndarray:
    """Return the covariance (L, L) of intensities integrated over two pixels at each row and column distance.

    It is the mean of |2 J1(z) / z|^2, as in `pixel_contrast`, over pairs of points of both pixels.
    """
    grain = max(grain_px, _UNCORRELATED_PX)
    reach = math.ceil(4 + 4 * grain)
    nodes, weights = np.polynomial.legendre.leggauss(5 + math.ceil(4 / grain))
    part, weights = (1 + nodes) / 2, weights / 2
    count = len(part)
    places = (np.arange(-1, reach + 1)[:, None] + part).ravel()
    # The density of distances between points of two pixels is triangular.
    pairs = np.zeros((reach + 1, places.size))
    for lag, row in enumerate(pairs):
        row[lag * count : (lag + 2) * count] = np.concatenate([weights * part, weights * (1 - part)])
    return pairs @ _compute_airy(np.hypot(places[:, None], places) / grain) ** 2 @ pairs.T


@cache
def _compute_third_cumulant(grain_px: float) -> float:
    """Return half the third cumulant of a coherent, polarised pattern averaged over square pixels.

    It is the mean, over triples of points of the pixel, of the product of 2 J1(z) / z for their three pairs; see
    `pixel_contrast`.
    """
    grain = max(grain_px, _BORDER_PX)
    nodes, weights = np.polynomial.legendre.leggauss(max(7, math.ceil(5 / grain)))
    x, y = (each.ravel() for each in np.meshgrid(nodes / 2, nodes / 2))
    root = np.sqrt(np.outer(weights, weights).ravel() / 4)
    coherence = root[:, None] * _compute_airy(np.hypot(x[:, None] - x, y[:, None] - y) / grain) * root
    twice = coherence @ coherence
    excess = float(np.sum(twice * coherence) / np.trace(twice) ** 2) - 1
    return pixel_contrast(grain_px) ** 4 * (1 + excess * min(1.0, grain_px / _BORDER_PX))


def _compute_airy(grains: np.ndarray) -> np.ndarray:
    """Return the correlation 2 J1(z) / z of the field at distances in grains."""
    z = math.pi * np.maximum(grains, 1e-9)
    return 2 * j1(z) / z


def _skew_exponential(exponential: np.ndarray, skew: ArrayLike) -> np.ndarray:
    """Transform exponential numbers monotonically to numbers (P,) of mean 0 and variance 1.

    Their half skewness is ``skew``, 0 to 1.
    """
    places = np.empty((2, len(exponential)))
    places[0], places[1] = np.multiply(skew, _SKEWS - 1), np.cbrt(exponential) * ((_ROOTS - 1) / _LARGEST_ROOT)
    return ndimage.map_coordinates(_compute_shapes(), places, order=1, mode="nearest")


@cache
def _compute_shapes() -> np.ndarray:
    """Return quantiles (skews, roots) of distributions of mean 0 and variance 1 at those of an exponential variable.

    ``skews`` are half skewnesses from 0 to 1, ``roots`` cube roots of the exponential variable. The distributions are
    of Pearson type III (shifted gamma), which approximate sums of exponential variables with the same three cumulants
    (Buckley and Eagleson, Austral. J. Statist. 30A, 150, 1988). They are exact for equal variables, and their lower
    limit is never below that of the sums.
    """
    roots = np.linspace(0, _LARGEST_ROOT, _ROOTS)
    above = np.exp(-(roots**3))
    shape = 1 / np.square(np.linspace(0, 1, _SKEWS)[1:, None])
    normal = -special.ndtri(above)
    normal[0] = 2 * normal[1] - normal[2]  # not minus infinity
    return np.vstack([normal, (special.gammainccinv(shape, above) - shape) / np.sqrt(shape)])


def _draw_amplitudes(size: int, seed: int, position: float) -> np.ndarray:
    """Return circular complex Gaussian amplitudes (size,), complex64, of mean square 1.

    ``position`` is in renewal lengths. Independent draws belong to the nodes of a lattice; between two nodes, they are
    combined with cosine and sine weights. Groups of frequencies have shifted lattices, so that no position is special.
    """
    result = np.empty(size, np.complex64)
    for group in range(_RENEWAL_GROUPS):
        part = result[group::_RENEWAL_GROUPS]
        shifted = position + group / _RENEWAL_GROUPS
        node = math.floor(shifted)
        angle = math.pi / 2 * (shifted - node)
        part[:] = math.cos(angle) * _draw(part.size, seed, group, node)
        part += math.sin(angle) * _draw(part.size, seed, group, node + 1)
    return result


def _draw(size: int, seed: int, group: int, node: int) -> np.ndarray:
    """Return circular complex Gaussian numbers (size,) of mean square 1 for a lattice node of either sign."""
    key = (group, 2 * node if node >= 0 else -2 * node - 1)
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))
    parts = np.zeros(2 * size, np.float32)
    add_normal_numbers(parts, math.sqrt(0.5), rng)
    return parts.view(np.complex64)
