"""Subjective speckle of a laser-lit surface: the noise that the surface's roughness puts on the image of the stripe.

A rough surface in coherent light forms on the image sensor a circular complex Gaussian field whose spatial frequencies
end at the lens's aperture. Its intensity is summed over the pixels and over what does not interfere: the polarisations
and, for a laser of some line width, its colours. What is left is a factor of mean 1 for every pixel of the image.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.special import j1

from uwlts.model.errors import DesignError, ImageError, RangeError
from uwlts.model.sensor import Camera

# The pattern repeats across the stripe after this many pixels, more than a stripe is wide, and this many grains.
_TILE_PX = 64
_TILE_GRAINS = 16

# Finest grain that is computed, as a part of a pixel, and widest, in pixels.
_FINEST_PX = 1 / 6
_WIDEST_PX = 64.0

# Renewal length by the resolution cell: the field's correlation then falls to one half where that of a moved Airy
# pattern does (see `renewal_correlation`).
_RENEWAL_CELLS = 0.9
_RENEWAL_GROUPS = 8

# Independent patterns that stand for the colours of a laser: at most so many, none below this part of the first.
_LOOKS = 4
_FAINTEST_LOOK = 0.01
_LEAST_CONTRAST = 1e-4

# Patterns made at a time: each needs some ten megabytes, with a fast lens a hundred.
_THREADS = 2


class Speckle:
    """Speckle pattern of a camera in the light of a laser, for any position along the travel of the stage.

    A pattern depends on the seed, the travel and the pixel only: frames can be asked for in any order, and any part of
    a frame alone. From ``2 renewal_mm`` of travel on it is a new one. ``wavelength_nm`` is that in air, the space
    between lens and image sensor; other seeds, which are not negative, give independent patterns. DesignError where the
    lens is focused within its focal length, or stopped down so far that grains are wider than 64 pixels; RangeError
    where the wavelength is not finite, or below 1 nm.
    """

    def __init__(self, camera: Camera, *, wavelength_nm: float, seed: int) -> None:
        focal, focus = camera.focal_length_mm, camera.focus_distance_mm
        if focus <= focal:
            raise DesignError(
                f"focus_distance_mm {focus:g} is not beyond focal_length_mm {focal:g}: such a lens forms no image"
            )
        magnification = focal / (focus - focal)  # of the focused plane
        wavelength_mm = 1e-6 * float(_within("the wavelength in nm", wavelength_nm, 1.0, math.inf))
        grain_mm = wavelength_mm * camera.f_number * (1 + magnification)
        grain_px = grain_mm / (1e-3 * camera.pixel_size_um)
        if grain_px > _WIDEST_PX:
            raise DesignError(
                f"at f/{camera.f_number:g} speckle grains are {grain_px:.0f} pixels wide, which is more than the "
                f"{_WIDEST_PX:g} this model allows: check f_number and pixel_size_um"
            )
        self.camera = camera
        self.renewal_mm = _RENEWAL_CELLS * grain_mm / magnification
        self._seed = seed
        self._along_width = camera.stripe_along == "width"
        self._tile = _Tile(camera.lines(), max(grain_px, _FINEST_PX))
        self._strength = 1.0 if grain_px >= _FINEST_PX else pixel_contrast(grain_px) / pixel_contrast(_FINEST_PX)

    def factors(
        self,
        rows: np.ndarray,
        columns: np.ndarray,
        *,
        travel_mm: float,
        polarisation: ArrayLike,
        coherence: ArrayLike = 1.0,
    ) -> np.ndarray:
        """Factors (P,), float32, not negative and of mean 1, for the laser's light in pixels (P,) in any order.

        The patterns of two orthogonal polarisations add in intensity, I = (1 + P) / 2 I_1 + (1 - P) / 2 I_2, which
        gives the contrast sqrt((1 + P^2) / 2) (Goodman, Speckle Phenomena in Optics, Ch. 3) for the degree of
        polarisation P of the scattered light, (P,) or one for all, 0 to 1: 1 for bare metal, about 0 for paint and
        plastics, in which light is scattered many times. ``coherence``, (P,) or one for all, is the contrast of the
        unintegrated pattern of one polarisation, 0 to 1 (see the function `coherence`), below 1e-4 taken for that; it
        multiplies the contrast, as averaging over the pixel's area does (`pixel_contrast`). For how the pattern changes
        with the travel see `renewal_correlation`. ImageError where a pixel lies outside the image, RangeError where
        travel, polarisation or coherence is not finite or outside its range.
        """
        # Small integers would overflow where a pixel's place in the tile is counted.
        rows, columns = (np.asarray(values).astype(np.intp, casting="same_kind") for values in (rows, columns))
        height, width = self.camera.height_px, self.camera.width_px
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        if not inside.all():
            worst = np.argmin(inside)
            raise ImageError(
                f"row {rows[worst]}, column {columns[worst]} lies outside the image of {height} rows and {width} "
                "columns: ask for pixels of the image only"
            )
        travel = float(_within("the travel in mm", travel_mm, -math.inf, math.inf))
        polarised = _within("the degree of polarisation", polarisation, 0.0, 1.0)
        looks = _look_weights(self._strength * _within("the coherence", coherence, 0.0, 1.0))
        shares = [(1 + polarised) / 2, (1 - polarised) / 2]
        weights = dict(enumerate((look * share).astype(np.float32) for look in looks for share in shares))
        weights = {number: weight for number, weight in weights.items() if np.any(weight > 0)}
        along, across = (columns, rows) if self._along_width else (rows, columns)
        place = along * self._tile.across_px + across % self._tile.across_px
        result = np.full(rows.shape, 1 - looks.sum(axis=0), np.float32)
        with ThreadPoolExecutor(_THREADS) as pool:
            patterns = pool.map(partial(self._pattern, position=travel / self.renewal_mm), weights)
            for weight, pattern in zip(weights.values(), patterns, strict=True):
                result += weight * pattern.ravel()[place]
        return result

    def _pattern(self, number: int, *, position: float) -> np.ndarray:
        """Intensity (along, across) of one of the independent patterns, ``position`` in renewal lengths."""
        return self._tile.intensity(_amplitudes(self._tile.size, self._seed, number, position))


def coherence(
    roughness_um: ArrayLike,
    *,
    linewidth_nm: float,
    wavelength_nm: float,
    index: float = 1.0,
    cosines: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Contrast, above 0 up to 1, of the speckle of a surface in the light of a laser with a spectral width.

    A height h delays the light by n (cos i + cos o) h = g h. With normal heights of standard deviation s, patterns of
    wavenumbers that differ by q are correlated by exp(-(q g s)^2 / 2) in amplitude, exp(-(q g s)^2) in intensity. Over
    a Gaussian line of standard deviation d, q has the variance 2 d^2, and the mean of the intensity's correlation is
    C^2 = (1 + 4 (d g s)^2)^(-1/2) (Parry in Dainty, Laser Speckle and Related Phenomena, 1975; Goodman, Speckle
    Phenomena in Optics, Ch. 5). Light that enters the material travels farther than its roughness says: for
    ``roughness_um`` put half the standard deviation of its optical path then, with the index 1.

    ``roughness_um`` is the standard deviation of the surface's heights within a resolution cell, of any shape;
    ``linewidth_nm`` the full width at half maximum of the laser's spectrum during an exposure, 0 for a coherent laser;
    ``wavelength_nm`` the mean wavelength in air; ``index`` the medium's refractive index n relative to air; ``cosines``
    those of the angles i and o between the surface's normal and the light that arrives and leaves. RangeError where a
    value is not finite, or negative.
    """
    roughness = _within("the roughness in um", roughness_um, 0.0, math.inf)
    width = _within("the line width in nm", linewidth_nm, 0.0, math.inf)
    wavelength = _within("the wavelength in nm", wavelength_nm, 1.0, math.inf)
    spread_per_um = 1e3 * 2 * math.pi / wavelength**2 * width / math.sqrt(8 * math.log(2))
    return (1 + 4 * (spread_per_um * index * sum(cosines) * roughness) ** 2) ** -0.25


def pixel_contrast(grain_px: float) -> float:
    """Contrast of a coherent, polarised pattern of grain lambda N (1 + m), in pixels, averaged over square pixels.

    C^2 is the mean of the intensity's correlation, |2 J1(z) / z|^2 with z = pi r / grain, over all pairs of points of
    the pixel (Goodman, Speckle Phenomena in Optics, Ch. 4).
    """
    nodes, weights = np.polynomial.legendre.leggauss(32 + math.ceil(8 / grain_px))
    lag, weights = (1 + nodes) / 2, weights * (1 - nodes) / 2
    z = math.pi * np.hypot(lag[:, None], lag) / grain_px
    return math.sqrt(weights @ (2 * j1(z) / z) ** 2 @ weights)


def renewal_correlation(lag: ArrayLike) -> np.ndarray:
    """Correlation of the complex fields at two positions that lie ``lag`` renewal lengths apart.

    The moved surface carries its speckle along, so a pixel sees a new pattern when the image has moved by a grain. Here
    patterns fade into new ones instead of moving: 1 at no lag, 1 - (pi lag)^2 / 8 near it, one half at 0.79, none from
    2 on. The renewal length is 0.9 lambda N (1 + m) / m of travel. Intensities are correlated by the square.
    """
    lag = np.minimum(np.abs(lag), 2.0)
    return (1 - lag / 2) * np.cos(math.pi * lag / 2) + np.sin(math.pi * lag / 2) / math.pi


class _Tile:
    """Periodic piece of the pattern, as long as the stripe, from amplitudes of the spatial frequencies of the aperture.

    The lens passes frequencies within a disc of diameter 1 / (lambda N (1 + m)) (Goodman, Introduction to Fourier
    Optics, Sec. 6.2). Moving the disc off the origin changes only the field's phase, so it starts at frequency zero.
    """

    def __init__(self, along_px: int, grain_px: float) -> None:
        least = math.ceil(_TILE_GRAINS * grain_px)
        apart = math.ceil(2 * grain_px)  # the ends of the stripe are neighbours in the tile
        self.across_px = cast(int, fft.next_fast_len(max(_TILE_PX, least)))
        self.along_px = cast(int, fft.next_fast_len(max(along_px + apart, least)))
        # Sums of so many samples per pixel, corrected as in `_over_pixels`, meet `pixel_contrast` to 1 %.
        self._samples = math.ceil(1.2 / grain_px + 0.7)
        across, along = (_frequencies(length / grain_px) for length in (self.across_px, self.along_px))
        disc = np.hypot(across[:, None], along) <= 0.5
        self._box = disc.shape
        self._bins = np.flatnonzero(disc)
        self.size = len(self._bins)

    def intensity(self, amplitudes: np.ndarray) -> np.ndarray:
        """Intensity (along, across) averaged over pixels; its mean is the mean square of the amplitudes (size,)."""
        spectrum = np.zeros(self._box, np.complex64)
        spectrum.ravel()[self._bins] = amplitudes * np.float32(1 / math.sqrt(self.size))
        rows, columns = self._samples * self.across_px, self._samples * self.along_px
        field = np.asarray(fft.ifft(spectrum, columns, axis=1, norm="forward"))
        field = np.asarray(fft.ifft(field, rows, axis=0, norm="forward", overwrite_x=True))
        fine = np.square(np.real(field)) + np.square(np.imag(field))
        return _over_pixels(np.ascontiguousarray(_over_pixels(fine, self._samples).T), self._samples)


def _frequencies(grains: float) -> np.ndarray:
    """Frequencies within the disc's diameter in units of it, centred, of a period that is so many grains long."""
    most = math.floor(grains / 2)
    return np.arange(-most, most + 1) / grains


def _over_pixels(fine: np.ndarray, samples: int) -> np.ndarray:
    """Means (R, C) over pixels of so many rows each of ``fine`` (samples R, C), which is periodic.

    The mean of f over an interval h is f + f'' h^2 / 24 at its middle, but for the fourth derivative. Of the second
    differences that stand for f'', only those at the pixel's ends are left in the sum. No weight is negative.
    """
    cells = fine.reshape(-1, samples, fine.shape[1])
    first, last = cells[:, 0], cells[:, -1]
    ends = np.roll(first, -1, axis=0) - last + np.roll(last, 1, axis=0) - first
    return (cells.sum(axis=1) + ends / 24) / samples


def _amplitudes(size: int, seed: int, pattern: int, position: float) -> np.ndarray:
    """Circular complex Gaussian amplitudes (size,), complex64, of mean square 1 at a position in renewal lengths.

    Independent draws belong to the nodes of a lattice; between two nodes their cosine and sine weighted sum is taken.
    Groups of frequencies have lattices shifted against each other, so that no position is special.
    """
    result = np.empty(size, np.complex64)
    for group in range(_RENEWAL_GROUPS):
        part = result[group::_RENEWAL_GROUPS]
        shifted = position + group / _RENEWAL_GROUPS
        node = math.floor(shifted)
        angle = math.pi / 2 * (shifted - node)
        part[:] = math.cos(angle) * _draw(part.size, seed, pattern, group, node)
        part += math.sin(angle) * _draw(part.size, seed, pattern, group, node + 1)
    return result


def _draw(size: int, seed: int, pattern: int, group: int, node: int) -> np.ndarray:
    """Circular complex Gaussian numbers (size,) of mean square 1 that belong to a lattice node of either sign."""
    key = (pattern, group, 2 * node if node >= 0 else -2 * node - 1)
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))
    parts = rng.standard_normal(2 * size, dtype=np.float32)
    parts *= np.float32(math.sqrt(0.5))
    return parts.view(np.complex64)


def _look_weights(contrast: np.ndarray) -> np.ndarray:
    """Weights (looks, ...) of independent patterns that together have a contrast; what they lack to 1 is even.

    The colours of a Gaussian line, correlated by a Gaussian, add up to independent patterns with the weights
    (1 - r) r^k, k = 0, 1, ... (eigenvalues by Mehler's formula; Rasmussen and Williams, Gaussian Processes for Machine
    Learning, Sec. 4.3.1), whose squares add up to C^2 = (1 - r) / (1 + r). The faint rest is replaced by its mean, and
    the others made up for its contrast. How many are kept depends on the pixel alone, not on its company.
    """
    squared = np.maximum(contrast, _LEAST_CONTRAST) ** 2
    ratio = (1 - squared) / (1 + squared)
    order = np.arange(_LOOKS).reshape(-1, *[1] * np.ndim(ratio))
    kept = ratio**order >= _FAINTEST_LOOK
    scale = (1 - ratio) / np.sqrt(1 - ratio ** (2 * kept.sum(axis=0)))
    return np.where(kept, scale * ratio**order, 0.0)


def _within(name: str, value: ArrayLike, least: float, most: float) -> np.ndarray:
    """The value as float64, refused if not finite or outside the range."""
    value = np.asarray(value, float)
    bad = ~(np.isfinite(value) & (value >= least) & (value <= most))
    if bad.any():
        raise RangeError(f"{name} is {value[bad].flat[0]:g}; it must be finite and from {least:g} to {most:g}")
    return value
