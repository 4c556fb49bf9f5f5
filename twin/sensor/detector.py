"""From light to grey values, after EMVA 1288: photons, electrons, noise, full well, gain, quantisation.

A camera's pixels differ from each other, the same way in every image (`fixed_pattern`); charge that a full pixel cannot
hold spills along its column (`spilled`); shot noise comes from `poisson_numbers`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import cast

import numpy as np
from scipy import special

from uwlts.model.errors import ImageError
from uwlts.model.sensor import Camera, Detector

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0
"""h c in J m (SI, exact)."""

MOST_ELECTRONS = 1e15
"""No pixel comes near it; beyond, Poisson numbers no longer fit into 64 bits."""

_BANDS = 8
"""Bands of rows with random numbers of their own: at most so many are made at a time."""
_STREAM = 1288
"""Keeps the pattern's random numbers apart from those of the images, whatever their seeds."""

POISSON_STEP = 0.125
"""Step of the means for which `poisson_numbers` has a table; smaller ones make a larger table and fewer events."""
LARGEST_MEAN = 32.0
"""Means from here on are left to NumPy."""
_LEVELS = int(LARGEST_MEAN / POISSON_STEP)
_CELLS = 4096
"""Cells of the unit interval in a table: twelve bits of a random number choose one."""
_COUNTS = 120
"""Counts with a probability above 1e-17 for every mean in the table."""
_SEVERAL = 255
"""Marks a cell that does not belong to a single count."""


def electrons_per_ms(irradiance: np.ndarray, camera: Camera, detector: Detector, *, wavelength_nm: float) -> np.ndarray:
    """Mean photo-electrons per ms and pixel for an irradiance in W/mm2 (EMVA 1288 release 4, Eq. 4)."""
    area_mm2 = (1e-3 * camera.pixel_size_um) ** 2 / camera.pixel_aspect
    photons_per_joule = 1e-9 * wavelength_nm / PLANCK_TIMES_LIGHT
    return irradiance * np.float32(1e-3 * area_mm2 * photons_per_joule * detector.quantum_efficiency)


def grey_values(
    electrons: np.ndarray,
    detector: Detector,
    *,
    exposure_ms: float,
    rng: np.random.Generator | None,
    pattern: FixedPattern | None = None,
) -> np.ndarray:
    """Image (H, W), uint8 or uint16, of mean photo-electrons (H, W).

    ``rng`` None leaves out all noise that changes from image to image, ``pattern`` None what differs from pixel to
    pixel. Shot noise of signal and dark current is Poisson's; blooming and the full well act before the readout, which
    adds its offset pattern and noise. Rounding is the only quantisation. Bands of rows have random numbers of their
    own, so that the image does not depend on how many of them are made at a time. ImageError where ``electrons`` is not
    a two-dimensional image of finite numbers from 0 to 1e15, or ``pattern`` has another size.
    """
    electrons = np.asarray(electrons, np.float32)
    if electrons.ndim != 2 or electrons.size == 0:
        raise ImageError(f"mean electrons have the shape {electrons.shape}; expected an image (H, W)")
    least, most = electrons.min(), electrons.max()
    if not (least >= 0 and most <= MOST_ELECTRONS):
        raise ImageError(
            f"mean electrons run from {least:g} to {most:g}; expected finite numbers from 0 to {MOST_ELECTRONS:g}"
        )
    if pattern is not None and pattern.gain.shape != electrons.shape:
        raise ImageError(
            f"the fixed pattern is of {pattern.gain.shape} pixels, the image of {electrons.shape}: make the pattern "
            "with the image's height and width"
        )
    count = min(_BANDS, len(electrons))
    detectors, exposures = [detector] * count, [exposure_ms] * count
    patterns = [None] * count if pattern is None else pattern.bands(count)
    rngs: list[np.random.Generator | None] = [None] * count
    if rng is not None:
        # They continue the given generator's seed; SFC64 is NumPy's fastest.
        seeds = cast(np.random.SeedSequence, rng.bit_generator.seed_seq).spawn(count)
        rngs = [np.random.Generator(np.random.SFC64(seed)) for seed in seeds]
    with ThreadPoolExecutor() as pool:
        charges = list(pool.map(_collected, np.array_split(electrons, count), detectors, exposures, patterns, rngs))
        if detector.blooming > 0:
            bloomed = spilled(np.concatenate(charges), full_well_e=detector.full_well_e, share=detector.blooming)
            charges = np.array_split(bloomed, count)
        return np.concatenate(list(pool.map(_digitised, charges, detectors, patterns, rngs)))


def _collected(
    electrons: np.ndarray,
    detector: Detector,
    exposure_ms: float,
    pattern: FixedPattern | None,
    rng: np.random.Generator | None,
) -> np.ndarray:
    """Electrons of light and dark current that an exposure collects, before any are lost."""
    dark = np.float32(1e-3 * exposure_ms * detector.dark_current_e_per_s * detector.dark_current_growth())
    mean = electrons if pattern is None else electrons * pattern.gain
    if pattern is not None:
        mean += pattern.hot_e_per_s * np.float32(1e-3 * exposure_ms)
    mean = mean + dark
    return mean if rng is None else poisson_numbers(mean, rng)


def _digitised(
    charge: np.ndarray, detector: Detector, pattern: FixedPattern | None, rng: np.random.Generator | None
) -> np.ndarray:
    """Grey values of collected electrons."""
    signal = np.minimum(charge, np.float32(detector.full_well_e))
    if pattern is not None:
        signal += pattern.offset_e
    if rng is not None:
        noise = rng.standard_normal(signal.shape, dtype=np.float32)
        noise *= np.float32(detector.read_noise_e)
        signal += noise
    signal *= np.float32(detector.gain_dn_per_e())
    signal += np.float32(detector.black_level_dn)
    np.rint(signal, out=signal)
    np.clip(signal, 0, detector.full_scale_dn(), out=signal)
    return signal.astype(np.uint8 if detector.bits == 8 else np.uint16)


@dataclass(frozen=True)
class FixedPattern:
    """Non-uniformity of one camera's pixels; every array is (H, W), float32."""

    gain: np.ndarray
    """Factor of the photo-electrons, 1 in the mean."""
    offset_e: np.ndarray
    """Offset of the readout in electrons, 0 in the mean."""
    hot_e_per_s: np.ndarray
    """Dark current of the hot pixels beyond that of the others, at the image sensor's temperature."""

    def bands(self, count: int) -> list[FixedPattern]:
        """The pattern of ``count`` bands of rows, as `numpy.array_split` cuts them."""
        parts = (np.array_split(array, count) for array in (self.gain, self.offset_e, self.hot_e_per_s))
        return [FixedPattern(*band) for band in zip(*parts, strict=True)]


def fixed_pattern(detector: Detector, *, height: int, width: int) -> FixedPattern | None:
    """The pattern of the camera with the detector's ``pattern_seed``; None if its pixels are all alike.

    Gain and offset are normal, the hot pixels' dark currents exponentially distributed, all independent from pixel to
    pixel. Each has random numbers of its own: changing one value leaves the others' pattern as it is.
    """
    spreads = (detector.prnu, detector.dsnu_e, detector.dsnu_row_e, detector.dsnu_column_e)
    if not any(spreads) and detector.hot_pixels_per_million == 0:
        return None
    seeds = np.random.SeedSequence(detector.pattern_seed, spawn_key=(_STREAM,)).spawn(5)
    rngs = [np.random.default_rng(seed) for seed in seeds]
    shapes = ((height, width), (height, width), (height, 1), (1, width))
    gain, pixels, rows, columns = (
        np.float32(spread) * rng.standard_normal(shape, dtype=np.float32)
        for spread, rng, shape in zip(spreads, rngs[:4], shapes, strict=True)
    )
    hot = np.zeros(height * width, np.float32)
    count = rngs[4].binomial(hot.size, 1e-6 * detector.hot_pixels_per_million)
    places = rngs[4].choice(hot.size, size=count, replace=False)
    mean = detector.hot_pixel_dark_current_e_per_s * detector.dark_current_growth()
    hot[places] = mean * rngs[4].standard_exponential(count, dtype=np.float32)
    return FixedPattern(1 + gain, pixels + rows + columns, hot.reshape(height, width))


def spilled(charge: np.ndarray, *, full_well_e: float, share: float) -> np.ndarray:
    """Charge (H, W) in electrons after blooming; the given array itself if no pixel is over its full well.

    Half of what a pixel holds above the full well goes up its column and half goes down. It fills the pixels it meets
    and keeps its direction over those that are full, until it fits or leaves the image. At each step from a full pixel
    to the next, ``share`` of it arrives and the rest is drained; a share of 1 loses none.
    """
    columns = np.flatnonzero((charge > full_well_e).any(axis=0))
    if columns.size == 0:
        return charge
    before = np.take(charge, columns, axis=1).astype(float)
    down_first, up_first = (_swept(image, full_well_e, share) for image in (before, before[::-1]))
    after = charge.copy()
    # Where the charge of two pixels meets, whichever comes first takes the room: the mean of both orders favours none.
    after[:, columns] = (down_first + up_first[::-1]) / 2
    return after


def _swept(charge: np.ndarray, full_well_e: float, share: float) -> np.ndarray:
    """Columns after the spilt charge has run down them, then up."""
    kept = np.minimum(charge, full_well_e)
    spilt_each_way = share / 2 * (charge - kept)
    for rows in (range(len(kept)), reversed(range(len(kept)))):
        arriving = np.zeros_like(kept[0])
        for row in rows:
            held = kept[row] + arriving
            kept[row] = np.minimum(held, full_well_e)
            arriving = share * (held - kept[row]) + spilt_each_way[row]
    return kept


def poisson_numbers(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poisson random numbers, float32, of the shape of their means (float32, finite, not negative).

    Most pixels of a laser image are nearly dark, for which this is several times faster than NumPy. A mean is split,
    m = m_j + r, with m_j on a grid of steps h and 0 <= r < h. The part of m_j is found by inversion in a table: one of
    4096 equal cells of the unit interval holds the uniform number, and nearly all cells belong to a single count; the
    others, and with them the tail, are settled by a further uniform number and the distribution function. The part of r
    is a Poisson process of density h over all pixels of which each event is kept with probability r / h (L. Devroye,
    Non-Uniform Random Variate Generation, 1986, sections III.2.4 and VI.1.3). Sums of Poisson numbers are Poisson's, so
    the result is exact to the resolution of a double.
    """
    flat = mean.ravel()
    large = np.flatnonzero(flat >= LARGEST_MEAN)
    if large.size == flat.size:
        return rng.poisson(mean).astype(np.float32)
    if large.size:
        flat = flat.copy()
        flat[large] = 0.0
    numbers = _small_poisson_numbers(flat, rng)
    numbers[large] = rng.poisson(mean.ravel()[large])
    return numbers.reshape(mean.shape)


def _small_poisson_numbers(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poisson random numbers (N,), float32, of means (N,) below LARGEST_MEAN."""
    count_of_cell, distribution = _poisson_tables()
    share = mean * np.float32(1 / POISSON_STEP)
    entry = share.astype(np.intp)
    share -= entry
    entry *= _CELLS
    # Sixteen bits at a time come fastest; the upper twelve choose the cell.
    entry += rng.integers(0, 2**16, mean.size, dtype=np.uint16) >> 4
    numbers = count_of_cell[entry]
    open_ = np.flatnonzero(numbers == _SEVERAL)
    level, cell = np.divmod(entry[open_], _CELLS)
    uniform = (cell + rng.random(open_.size)) / _CELLS
    numbers[open_] = np.count_nonzero(distribution[level] <= uniform[:, None], axis=1)
    events = rng.integers(0, mean.size, rng.poisson(POISSON_STEP * mean.size))
    np.add.at(numbers, events[rng.random(events.size) < share[events]], np.uint8(1))
    return numbers.astype(np.float32)


@cache
def _poisson_tables() -> tuple[np.ndarray, np.ndarray]:
    """The count of every cell of every level (levels * cells,), and the distribution functions (levels, counts)."""
    distribution = special.pdtr(np.arange(_COUNTS), POISSON_STEP * np.arange(_LEVELS)[:, None])
    edges = np.arange(_CELLS + 1) / _CELLS
    lowest = np.array([np.searchsorted(row, edges[:-1], side="right") for row in distribution])
    highest = np.array([np.searchsorted(row, edges[1:], side="left") for row in distribution])
    return np.where(lowest == highest, lowest, _SEVERAL).astype(np.uint8).ravel(), distribution
