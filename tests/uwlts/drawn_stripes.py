"""Captures of drawn stripes on objects in water, through the window by Fermat's principle: NumPy, no renderer."""

import math

import numpy as np

from tests.uwlts.calibration_views import WATER, square_sensor, step_profile, through_window
from uwlts.model.sensor import Distortion, Medium
from uwlts.storage.capture import CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter

RADIUS_MM, SPACING_MM = 25.06, 99.18
SPHERES = {"kind": "spheres", "diameters_mm": (2 * RADIUS_MM,) * 2, "spacings_mm": (SPACING_MM,)}
STAGE_MM = np.arange(-20.0, 21.0, 4.0)
SIGMA_PX, AMPLITUDE, DARK = 1.4, 180.0, 8.0


def coarse_sensor(*, window_mounted):
    """Return the thesis's sensor with a quarter of the pixels, no distortion and a window square to its axis."""
    sensor = square_sensor()
    window = sensor.camera.window.model_copy(update={"mounted": window_mounted})
    camera = sensor.camera.model_copy(
        update={
            "width_px": 640,
            "height_px": 512,
            "pixel_size_um": 10.6,
            "principal_point_px": (322.0, 254.0),
            "distortion": Distortion(),
            "window": window,
        }
    )
    return sensor.model_copy(update={"camera": camera})


SENSOR = coarse_sensor(window_mounted=True)
SHAPE = (SENSOR.camera.height_px, SENSOR.camera.width_px)


def stripe_image(pieces, rng):
    """Draw a Gaussian line through the pixels (N, 2) of each piece; in common columns, the last piece is in front."""
    centre, columns = np.full(SHAPE[1], -100.0), np.arange(SHAPE[1])
    for pixels in pieces:
        here = (columns >= pixels[:, 0].min()) & (columns <= pixels[:, 0].max())
        order = np.argsort(pixels[:, 0])
        centre[here] = np.interp(columns[here], pixels[order, 0], pixels[order, 1])
    rows = np.arange(SHAPE[0])[:, None]
    image = DARK + AMPLITUDE * np.exp(-(((rows - centre) / SIGMA_PX) ** 2) / 2)
    image += rng.normal(size=SHAPE)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def draw_centres(centre_px, length_px, *, stripe_along):
    """Draw a Gaussian line without noise at centres (L,) on profile lines of a length; NaN is a dark line.

    Rounding to grey values moves the centres by less than 0.01 px.
    """
    away = np.arange(length_px)[:, None] - centre_px
    grey = AMPLITUDE * np.exp(-0.5 * (np.nan_to_num(away, nan=np.inf) / SIGMA_PX) ** 2)
    return np.rint(grey if stripe_along == "width" else grey.T).astype(np.uint8)


def step_image(depth_mm, *, tilt=0.0, shift_mm=0.0, **step):
    """The stripe on base, block and base of a step standard."""
    points = step_profile(depth_mm, tilt=tilt, shift_mm=shift_mm, **step)
    block = np.abs(np.linspace(-75, 75, len(points)) - shift_mm) < 30
    left, middle, right = np.split(points, np.flatnonzero(np.diff(block.astype(int))) + 1)
    pieces = [through_window(SENSOR, piece) for piece in (left, right, middle)]
    return stripe_image(pieces, np.random.default_rng(0))


def sphere_profiles(depth_mm):
    """Return stripe pixels on two spheres side by side: for each stage position, one array per sphere."""
    around, profiles = np.linspace(-1.1, 1.1, 121), []
    for x in STAGE_MM:
        circle = math.sqrt(RADIUS_MM**2 - x**2)
        profiles.append(
            [
                through_window(
                    SENSOR,
                    np.column_stack([0 * around, y + circle * np.sin(around), depth_mm - circle * np.cos(around)]),
                )
                for y in (-SPACING_MM / 2, SPACING_MM / 2)
            ]
        )
    return profiles


def write(path, images, *, stage_mm=None, sensor=SENSOR, medium=None, **header):
    """Write a capture of images with the laser on."""
    header = CaptureHeader(
        name=path.stem,
        sensor=sensor,
        medium_name="water" if medium is None else medium.kind,
        saturation_dn=255,
        medium=Medium(kind="custom", index=WATER) if medium is None else medium,
        stage_direction=(1.0, 0.0, 0.0),
    ).model_copy(update=header)
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number, image in enumerate(images):
            writer.append(Frame(image, 0.0 if stage_mm is None else float(stage_mm[number]), True, 1.0, 0.0))
    return path
