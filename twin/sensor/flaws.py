"""Flaws of real recordings that standard rendering does not include; see `twin.rendering_options.Flaws`.

Some are properties of the sensor (`as_built`). Others change the light on the image sensor (`vignette`, `add_glare`,
`laser_shares`) or the grey values that the camera delivers (`deliver_image`).
"""

import math
from typing import cast

import cv2
import numpy as np
from scipy.signal import fftconvolve

from twin.rendering_options import Flaws
from uwlts.errors import DescriptionError
from uwlts.model.library import merge_tables, validate_description
from uwlts.model.sensor import Camera, Sensor

GLARE_REACH = 0.15
"""Decay length of glare (1 / e) as a fraction of the image width (assumed from its visual appearance)."""
_SPOT_MM = 0.2, 3.0
"""Range of the diameters of spots on the window, from silt and fouling films to drops and fingerprints."""
_CELLS_PER_SPOT = 4  # so that a round spot stays round
_DIRT_STREAM = 41
"""Random number stream of the spots, separate from others of the same seed."""
_CELLS_PER_REACH = 16
"""Number of cells per decay length; the smooth veiling glare is then accurate to about 1e-3."""
LASER_SHARES = {"red": 1.0, "green": 0.083, "blue": 0.008}
"""Response to laser light at 635 nm behind colour filters, relative to red.

0.041 and 0.004 divided by 0.496 for the Nikon D5100 (Darrodi et al. 2015, J. Opt. Soc. Am. A 32, 381). Filters of
machine vision cameras may separate colours less.
"""
_PEDESTAL = 0.0, 30.0
"""Offset and radius of stray light in radii of the sheet (the radius is assumed)."""
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
    focus = camera.focus_distance_mm
    working = camera.f_number * (1 + camera.focal_length_mm / (focus - camera.focal_length_mm))
    blur_px = 0.5 * camera.focal_length_mm / working * (1 - inner / focus) * px_per_mm
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
    free = fftconvolve(free, disc / disc.sum(), mode="same").astype(np.float32)
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
    veil = np.maximum(fftconvolve(coarse, kernel, mode="same"), 0).astype(np.float32)
    veil = cv2.resize(veil, padded.shape[::-1], interpolation=cv2.INTER_LINEAR)[:height, :width]
    return np.float32(1 - share) * light + np.float32(share) * veil


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
