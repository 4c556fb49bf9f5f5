"""Image sensor model after EMVA 1288: photons, electrons, noise, full well, gain, quantisation.

Pixels of a camera differ from each other in the same way in every image (`fixed_pattern`). Charge above the full well
of a pixel spills along its column (`spread_blooming`). Shot and read noise come from `twin.sensor.random_numbers`. The
rest are flaws of real recordings (`twin.rendering_options.Flaws`).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from twin.rendering_options import Flaws
from twin.sensor.random_numbers import add_normal_numbers, poisson_numbers
from uwlts.errors import DescriptionError, ImageError
from uwlts.model.library import merge_tables, validate_description
from uwlts.model.sensor import Camera, Detector, Sensor
from uwlts.runtime.compiled import compiled
from uwlts.runtime.workers import count_processors

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0  # h c in J m (SI, exact)

MOST_ELECTRONS = 1e15  # upper limit, far above any real pixel; larger Poisson numbers would not fit into 64 bits

_BANDS = 8  # number of bands of rows with independent random numbers, and of parallel tasks
_PARALLEL_PX = 2**19
"""Number of pixels from which bands are computed in parallel; below, threads cost more time than they save."""
_STREAM = 1288  # random number stream of the pattern, separate from those of the images


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
    row_noise_e: float = 0.0,
) -> np.ndarray:
    """Return the image (H, W), uint8 or uint16, for mean photo-electrons (H, W) and their exposure time.

    Signal and dark current have Poisson shot noise. Blooming and full well are applied before the read-out, which adds
    offset pattern and noise. The noise with the standard deviation ``row_noise_e`` is common to the pixels of a row.
    The only quantisation is the final rounding. Bands of rows have independent random numbers, so that the image does
    not depend on the number of parallel tasks. Without ``rng`` there is no temporal noise, without ``pattern`` no fixed
    one. ImageError if the electrons are not finite numbers from 0 to 1e15.
    """
    electrons = np.asarray(electrons, np.float32)
    least, most = electrons.min(), electrons.max()
    if not (least >= 0 and most <= MOST_ELECTRONS):
        raise ImageError(
            f"mean electrons run from {least:g} to {most:g}; expected finite numbers from 0 to {MOST_ELECTRONS:g}"
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
        return np.concatenate(list(run(_digitise, charges, detectors, patterns, rngs, [row_noise_e] * count)))


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
        _write_mean_electrons(light, gain, hot, exposure_s, float(dark), mean.ravel())
    return mean if rng is None else poisson_numbers(mean, rng)


@compiled
def _write_mean_electrons(
    light: np.ndarray, gain: np.ndarray, hot_e_per_s: np.ndarray, exposure_s: float, dark: float, mean: np.ndarray
) -> None:
    """Write the mean electrons (N,) of pixels with individual gain and dark current (N,) to ``mean``."""
    seconds, everywhere = np.float32(exposure_s), np.float32(dark)
    for i in range(len(light)):
        mean[i] = light[i] * gain[i] + hot_e_per_s[i] * seconds + everywhere


def _digitise(
    charge: np.ndarray,
    detector: Detector,
    pattern: FixedPattern | None,
    rng: np.random.Generator | None,
    row_noise_e: float,
) -> np.ndarray:
    """Return the grey values of collected electrons, which are overwritten."""
    signal = np.minimum(charge, np.float32(detector.full_well_e), out=charge)
    if pattern is not None:
        signal += pattern.offset_e
    if rng is not None:
        add_normal_numbers(signal, detector.read_noise_e, rng)
        if row_noise_e:
            signal += np.float32(row_noise_e) * rng.standard_normal((len(signal), 1), np.float32)
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


GLARE_REACH = 0.15
"""Decay length of glare (1 / e) as a fraction of the image width (assumed from its visual appearance)."""
GHOST_BLUR = 0.01  # standard deviation of a ghost's blur as a fraction of the image width (assumed)
_SPOT_MM = 0.2, 3.0
"""Range of the diameters of spots on the window, from silt and fouling films to drops and fingerprints."""
_CELLS_PER_SPOT = 4  # so that a round spot stays round
_DIRT_STREAM = 41  # random number stream of the spots, separate from others of the same seed
_CELLS_PER_REACH = 16  # number of cells per decay length; the smooth veiling glare is then accurate to about 1e-3
LASER_SHARES = {"red": 1.0, "green": 0.083, "blue": 0.008}
"""Response to laser light at 635 nm behind colour filters, relative to red.

0.041 and 0.004 divided by 0.496 for the Nikon D5100 (Darrodi et al. 2015, J. Opt. Soc. Am. A 32, 381). Filters of
machine vision cameras may separate colours less.
"""
_PEDESTAL = 0.0, 30.0  # offset and radius of stray light in radii of the sheet (the radius is assumed)
_FIRST_LOBES = (-2.0, 0.4), (2.0, 0.4)
"""Offsets and radii of the first side lobes in radii of the sheet.

Fraunhofer diffraction of a Gaussian beam at a slit as wide as 0.8 to 1 of its 1/e^2 diameter: each has 0.8 to 0.3 % of
the power, its centroid at 1.98 to 2.01 and a radius of 0.38 to 0.43.
"""
_RGGB = (("red", "green"), ("green", "blue"))


def as_built(sensor: Sensor, flaws: Flaws) -> Sensor:
    """Return the sensor with the flaws of its laser, pixels, lens and shutter.

    DescriptionError if they are incompatible.
    """
    if flaws.jpeg and sensor.detector.bits != 8:
        raise DescriptionError(
            f"jpeg holds 8-bit images, the sensor '{sensor.name}' gives {sensor.detector.bits} bits: take a sensor "
            "with detector.bits = 8, or omit jpeg"
        )
    camera = sensor.camera
    built = {"pixel_aspect": camera.pixel_aspect * flaws.pixel_aspect}
    lens = {"p1": camera.distortion.p1 + flaws.tangential}
    shutter = {"shutter": "rolling", "line_time_us": flaws.rolling_shutter} if flaws.rolling_shutter else {}
    lobes = [(*_PEDESTAL, flaws.stray_light)] * (flaws.stray_light > 0)
    lobes += [(*lobe, flaws.side_lobes / 2) for lobe in _FIRST_LOBES if flaws.side_lobes > 0]
    laser = {"side_lobes": [*sensor.laser.side_lobes, *lobes]} if lobes else {}
    changes = {"camera": built | {"distortion": lens}, "detector": shutter, "laser": laser}
    return validate_description(
        Sensor, merge_tables(sensor.model_dump(), changes), f"{sensor.name} with {', '.join(flaws.names())}"
    )


def vignette(camera: Camera, loss: float) -> np.ndarray:
    """Return the transmission (H, W), float32, of the lens with vignetting: 1 - loss (r / R)^2.

    r is the distance from the principal point, and R that of the farthest corner.
    """
    cx, cy = camera.principal_point()
    y, x = np.ogrid[: camera.height_px, : camera.width_px]
    squared = (x - cx) ** 2 + (y - cy) ** 2
    return (1 - loss * squared / squared.max()).astype(np.float32)


def dirt(camera: Camera, share: float, *, seed: int) -> np.ndarray:
    """Return the transmission (H, W), float32, of a dirty window.

    Opaque spots of 0.2 to 3 mm at random positions cover the fraction ``share`` of the window; each logarithmic
    interval of sizes covers the same area. A pixel sees a disc of the window, the pupil reduced by the distance to the
    focused plane, and loses the covered fraction of it: 1 - share in the mean.
    """
    inner = camera.window.distance_mm
    px_per_mm = camera.focal_length_px() / inner
    pupil_mm = 0.5 * camera.focal_length_mm / camera.working_f_number()
    blur_px = pupil_mm * (1 - inner / camera.focus_distance_mm) * px_per_mm
    largest_px = 0.5 * _SPOT_MM[1] * px_per_mm
    margin = math.ceil(blur_px + largest_px)
    # The radius of the smallest spot spans at least `_CELLS_PER_SPOT` cells.
    fine = max(1, math.ceil(_CELLS_PER_SPOT / (0.5 * _SPOT_MM[0] * px_per_mm)))
    height, width = (side + 2 * margin for side in (camera.height_px, camera.width_px))
    rng = np.random.default_rng([seed, _DIRT_STREAM])
    free = np.ones((height * fine, width * fine), np.float32)
    # Random discs leave exp(-covered area / area) free (Chiu et al., Stochastic Geometry, 2013, Eq. 3.6).
    left = -math.log1p(-share) * free.size
    while left > 0:
        radius = 0.5 * math.exp(rng.uniform(*np.log(_SPOT_MM))) * px_per_mm * fine
        area = math.pi * radius**2
        # Each logarithmic interval of sizes covers the same area. The last spot is added with the probability that
        # preserves the mean area.
        for _ in range(rng.poisson((largest_px * fine / radius) ** 2)):
            if left < rng.random() * area:
                left = 0.0
                break
            centre = [round(16 * rng.uniform(-radius, side + radius)) for side in free.shape[::-1]]
            # OpenCV fills all cells touched by a circle, half a cell beyond its radius.
            cv2.circle(free, centre, max(1, round(16 * (radius - 0.5))), 0.0, -1, shift=4)
            left -= area * free.size / math.prod(side + 2 * radius for side in free.shape)
    free = cv2.resize(free, (width, height), interpolation=cv2.INTER_AREA)
    reach = np.arange(-math.ceil(blur_px), math.ceil(blur_px) + 1)
    disc = (np.hypot(reach[:, None], reach) <= max(blur_px, 0.5)).astype(np.float32)
    free = _convolve(free, disc / disc.sum())
    return np.clip(free[margin : margin + camera.height_px, margin : margin + camera.width_px], 0, 1)


def add_glare(light: np.ndarray, share: float) -> np.ndarray:
    """Spread the fraction ``share`` of light (H, W) as veiling glare.

    The kernel is exp(-r / w) / (2 pi w^2) with w = `GLARE_REACH` image widths. Light is lost only beyond the image
    borders.
    """
    height, width = light.shape
    cell = max(1, int(GLARE_REACH * width / _CELLS_PER_REACH))
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.pad(light, ((0, rows * cell - height), (0, columns * cell - width)))
    coarse = cv2.resize(padded, (columns, rows), interpolation=cv2.INTER_AREA)
    y, x = np.ogrid[1 - rows : rows, 1 - columns : columns]
    cell_per_reach = cell / (GLARE_REACH * width)
    kernel = np.exp(-np.hypot(x, y) * cell_per_reach) * cell_per_reach**2 / (2 * math.pi)
    veil = np.maximum(_convolve(coarse, kernel), 0)
    veil = cv2.resize(veil, padded.shape[::-1], interpolation=cv2.INTER_LINEAR)[:height, :width]
    return np.float32(1 - share) * light + np.float32(share) * veil


def _convolve(light: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return light (H, W), float32, convolved with a kernel and dark beyond its border."""
    # Takes a second to import, which images without this light do not need.
    from scipy.signal import fftconvolve

    return fftconvolve(light, kernel, mode="same").astype(np.float32)


def add_ghost(light: np.ndarray, camera: Camera, share: float) -> np.ndarray:
    """Mirror the fraction ``share`` of light (H, W) at the principal point, blurred by a Gaussian of `GHOST_BLUR`.

    Light that the image sensor and then a surface of the lens reflect forms such an image, upside down and blurred.
    """
    cx, cy = camera.principal_point()
    turned = np.array([[-1, 0, 2 * cx], [0, -1, 2 * cy]])
    ghost = cv2.warpAffine(light, turned, light.shape[::-1])
    blurred = cv2.GaussianBlur(ghost, (0, 0), GHOST_BLUR * camera.width_px)
    return np.float32(1 - share) * light + np.float32(share) * blurred


def laser_shares(height: int, width: int) -> np.ndarray:
    """Return the response (H, W), float32, to laser light at 635 nm behind the filters of a colour sensor (RGGB)."""
    cell = np.array([[LASER_SHARES[colour] for colour in row] for row in _RGGB], np.float32)
    return np.tile(cell, (-(-height // 2), -(-width // 2)))[:height, :width]


def deliver_image(image: np.ndarray, flaws: Flaws) -> np.ndarray:
    """Return the grey values (H, W) that the camera delivers.

    A colour camera delivers its red channel, with missing colours interpolated linearly. JPEG stores brightness at
    every pixel but colour at every second one only (4:2:0), which blurs monochromatic light.
    """
    if flaws.colour_filter:
        image = cv2.cvtColor(image, cv2.COLOR_BayerRGGB2BGR)
    if flaws.jpeg:
        _, file = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, flaws.jpeg])
        image = cast(np.ndarray, cv2.imdecode(file, cv2.IMREAD_UNCHANGED))
    return np.ascontiguousarray(image[..., 2]) if flaws.colour_filter else image
