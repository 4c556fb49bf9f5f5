"""Image sensor model after EMVA 1288: photons, electrons, noise, full well, gain, quantisation.

Pixels of a camera differ from each other in the same way in every image (`fixed_pattern`). Charge above the full well
of a pixel spills along its column (`spread_blooming`). Shot and read noise come from `twin.sensor.random_numbers`. The
peak finder of a 3D camera reduces an image to one number per profile line.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import cast

import numpy as np

from twin.sensor.random_numbers import add_normal_numbers, poisson_numbers
from uwlts.errors import ImageError
from uwlts.model.sensor import Camera, Detector
from uwlts.runtime.compiled import compiled
from uwlts.runtime.workers import count_processors

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0
"""h c in J m (SI, exact)."""

MOST_ELECTRONS = 1e15
"""Upper limit, far above any real pixel; larger Poisson numbers would not fit into 64 bits."""

_BANDS = 8
"""Number of bands of rows with independent random numbers, and of parallel tasks."""
_PARALLEL_PX = 2**19
"""Number of pixels from which bands are computed in parallel; below, threads cost more time than they save."""
_STREAM = 1288
"""Random number stream of the pattern, separate from those of the images."""


def electrons_per_ms(irradiance: np.ndarray, camera: Camera, detector: Detector, *, wavelength_nm: float) -> np.ndarray:
    """Return the mean photo-electrons per ms and pixel for an irradiance in W/mm2 (EMVA 1288 release 4, Eq. 4)."""
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
    """Return the image (H, W), uint8 or uint16, for mean photo-electrons.

    Signal and dark current have Poisson shot noise. Blooming and full well are applied before the read-out, which adds
    offset pattern and noise; the only quantisation is the final rounding. Bands of rows have independent random
    numbers, so that the image does not depend on the number of parallel tasks.

    Parameters
    ----------
    electrons : (H, W)
        Mean number of photo-electrons per pixel.
    detector
        Full well, noise, offset, gain and bits.
    exposure_ms
        Exposure time, for the dark current.
    rng
        Source of temporal noise; None: no noise.
    pattern
        Fixed-pattern noise of the detector; None: none.

    Raises
    ------
    ImageError
        ``electrons`` is not a two-dimensional image of finite numbers from 0 to 1e15, or ``pattern`` has another size.
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
            f"the fixed pattern is of {pattern.gain.shape} pixels, the image of {electrons.shape}: create the pattern "
            "with the height and width of the image"
        )
    count = min(_BANDS, len(electrons))
    detectors, exposures = [detector] * count, [exposure_ms] * count
    patterns = [None] * count if pattern is None else pattern.bands(count)
    rngs: list[np.random.Generator | None] = [None] * count
    if rng is not None:
        # Seeds derive from the given generator; SFC64 is NumPy's fastest bit generator.
        seeds = cast(np.random.SeedSequence, rng.bit_generator.seed_seq).spawn(count)
        rngs = [np.random.Generator(np.random.SFC64(seed)) for seed in seeds]
    with ThreadPoolExecutor(count_processors()) as pool:
        run = pool.map if electrons.size >= _PARALLEL_PX else map
        charges = list(run(_collect, np.array_split(electrons, count), detectors, exposures, patterns, rngs))
        if detector.blooming > 0:
            bloomed = spread_blooming(
                np.concatenate(charges), full_well_e=detector.full_well_e, share=detector.blooming
            )
            charges = np.array_split(bloomed, count)
        return np.concatenate(list(run(_digitise, charges, detectors, patterns, rngs)))


def _collect(
    electrons: np.ndarray,
    detector: Detector,
    exposure_ms: float,
    pattern: FixedPattern | None,
    rng: np.random.Generator | None,
) -> np.ndarray:
    """Return the electrons of light and dark current collected in an exposure, without saturation."""
    exposure_s = 1e-3 * exposure_ms
    dark = np.float32(exposure_s * detector.dark_current_e_per_s * detector.dark_current_growth())
    if pattern is None:
        mean = electrons + dark
    else:
        mean = np.empty_like(electrons, order="C")
        light, gain, hot = (values.ravel() for values in (electrons, pattern.gain, pattern.hot_e_per_s))
        _mean_electrons(light, gain, hot, exposure_s, float(dark), mean.ravel())
    return mean if rng is None else poisson_numbers(mean, rng)


@compiled
def _mean_electrons(
    light: np.ndarray, gain: np.ndarray, hot_e_per_s: np.ndarray, exposure_s: float, dark: float, mean: np.ndarray
) -> None:
    """Write the mean electrons (N,) of pixels with individual gain and dark current (N,) to ``mean``."""
    seconds, everywhere = np.float32(exposure_s), np.float32(dark)
    for i in range(len(light)):
        mean[i] = light[i] * gain[i] + hot_e_per_s[i] * seconds + everywhere


def _digitise(
    charge: np.ndarray, detector: Detector, pattern: FixedPattern | None, rng: np.random.Generator | None
) -> np.ndarray:
    """Return the grey values of collected electrons, which are overwritten."""
    signal = np.minimum(charge, np.float32(detector.full_well_e), out=charge)
    if pattern is not None:
        signal += pattern.offset_e
    if rng is not None:
        add_normal_numbers(signal, detector.read_noise_e, rng)
    image = np.empty(signal.shape, np.uint8 if detector.bits == 8 else np.uint16)
    scale, offset = np.float32(detector.gain_dn_per_e()), np.float32(detector.black_level_dn)
    _round(signal.ravel(), scale, offset, np.float32(detector.full_scale_dn()), image.ravel())
    return image


@compiled
def _round(signal: np.ndarray, scale: np.float32, offset: np.float32, most: np.float32, image: np.ndarray) -> None:
    """Scale, offset and round signals (N,), float32, to integers from 0 to ``most`` in the image (N,)."""
    nothing = np.float32(0)
    for i in range(len(signal)):
        image[i] = min(max(np.rint(signal[i] * scale + offset), nothing), most)


@dataclass(frozen=True)
class FixedPattern:
    """Non-uniformity of one camera's pixels; every array is (H, W), float32."""

    gain: np.ndarray
    """Factor of the photo-electrons, with mean 1."""
    offset_e: np.ndarray
    """Read-out offset in electrons, with mean 0."""
    hot_e_per_s: np.ndarray
    """Excess dark current of hot pixels, at the image sensor's temperature."""

    def bands(self, count: int) -> list[FixedPattern]:
        """Return the pattern of ``count`` bands of rows, as divided by `numpy.array_split`."""
        parts = (np.array_split(array, count) for array in (self.gain, self.offset_e, self.hot_e_per_s))
        return [FixedPattern(*band) for band in zip(*parts, strict=True)]


def fixed_pattern(detector: Detector, *, height: int, width: int) -> FixedPattern | None:
    """Return the pattern of a camera from the detector's ``pattern_seed``; None if all pixels are equal.

    Gain and offset are normally, dark currents of hot pixels exponentially distributed, and independent between pixels.
    Each has its own random numbers: changing one value leaves the patterns of the others unchanged.
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


def spread_blooming(charge: np.ndarray, *, full_well_e: float, share: float) -> np.ndarray:
    """Return the charge (H, W) in electrons after blooming; the given array itself if no pixel exceeds its full well.

    Half of the excess charge of a pixel moves up its column and half down. It fills pixels on its path and passes full
    ones, until it fits or leaves the image. At each step from a full pixel to the next, the fraction ``share`` is
    transferred and the rest is drained.
    """
    columns = np.flatnonzero((charge > full_well_e).any(axis=0))
    if columns.size == 0:
        return charge
    before = np.take(charge, columns, axis=1).astype(float)
    down_first, up_first = (_sweep(image, full_well_e, share) for image in (before, before[::-1]))
    after = charge.copy()
    # If charge of two pixels meets, the result depends on the order: average both orders.
    after[:, columns] = (down_first + up_first[::-1]) / 2
    return after


def _sweep(charge: np.ndarray, full_well_e: float, share: float) -> np.ndarray:
    """Return the columns after the excess charge has moved down, then up."""
    kept = np.minimum(charge, full_well_e)
    spilt_each_way = share / 2 * (charge - kept)
    for rows in (range(len(kept)), reversed(range(len(kept)))):
        arriving = np.zeros_like(kept[0])
        for row in rows:
            held = kept[row] + arriving
            kept[row] = np.minimum(held, full_well_e)
            arriving = share * (held - kept[row]) + spilt_each_way[row]
    return kept


# --- 3D cameras -------------------------------------------------------------------------------------------------------


INVALID = 0
"""Number of a line without a stripe."""
THRESHOLD = 0.06
"""Fraction of the full scale above which pixels count: above the noise, as usual for such cameras."""
_FEWEST_PX = 2
"""Smallest width of a stripe; narrower peaks are hot pixels."""
_REACH_PX = 64
"""Largest distance of a stripe's edge from its brightest pixel."""


@dataclass(frozen=True)
class PeakFinder:
    """Finder of peak positions across profile lines in steps of 1 / ``steps`` px.

    It uses the brightest pixel of a line and the contiguous pixels above the threshold, weighted by their excess, as
    the firmware of cameras does (Fisher and Naidu, "A comparison of algorithms for subpixel peak detection", 1996,
    centre of mass). ``full_scale_dn`` is the largest grey value.
    """

    camera: Camera
    full_scale_dn: int
    steps: int

    def scale_px(self) -> float:
        """Return the size of one step in pixels."""
        return 1 / self.steps

    def numbers(self, image: np.ndarray) -> np.ndarray:
        """Return positions (L,), uint16, in steps on the profile lines of an image (H, W).

        Lines without a stripe get `INVALID`.
        """
        across = image if self.camera.stripe_along == "width" else image.T
        lines, brightest = np.arange(across.shape[1]), across.argmax(axis=0)
        place = brightest + np.arange(-_REACH_PX, _REACH_PX + 1)[:, None]
        inside = (place >= 0) & (place < len(across))
        seen = across[np.clip(place, 0, len(across) - 1), lines].astype(np.float32)
        above = np.where(inside, np.maximum(seen - np.float32(THRESHOLD * self.full_scale_dn), 0), 0)
        # Pixels from the brightest one to the first dark one on either side.
        run = np.minimum.accumulate(above[_REACH_PX:] > 0, axis=0)
        before = np.minimum.accumulate(above[_REACH_PX::-1] > 0, axis=0)[::-1]
        together = np.concatenate([before[:-1], run])
        weight = np.where(together, above, 0)
        total = weight.sum(axis=0)
        whole = ~together[0] & ~together[-1] & ~(together & ((place == 0) | (place == len(across) - 1))).any(axis=0)
        found = whole & (together.sum(axis=0) >= _FEWEST_PX)
        centre = (place * weight).sum(axis=0) / np.where(found, total, 1)
        return np.where(found, np.rint(centre * self.steps), INVALID).astype(np.uint16)
