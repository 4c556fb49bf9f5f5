"""Labels of rendered images: ground truth of profile lines and pixels.

`MEANINGS` explains the arrays of a frame by name; missing values are NaN. If a line has several lit points of the
sheet, the labels belong to the brightest.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from twin.datasets.data_set import FAINT_BELOW, Label, LineStatus, Mask
from twin.scene.description import PrintedPlate
from uwlts.model.sensor import Detector

if TYPE_CHECKING:
    from twin.recording.sensor_simulator import SensorSimulator, SimulatedImage
    from twin.scene.platforms import Shot

_WINDOW_PX = 96  # half width of the window around a centre; wider stripes are truncated
_LEAST_E = 1e-6
"""Electrons below which a pixel counts as dark, because some processors and threads flush tiny numbers to zero."""
_LARGEST_HALF = 65504.0
"""Largest number of float16; brighter pixels are clipped to it. It is above the full well of usual sensors."""
NO_OBJECT = 255  # in a map of objects' numbers
MEANINGS = {
    "centre_px": "(lines,) float32: true centre of the stripe on each profile line, in px across it; NaN without one",
    "centroid_px": "(lines,) float32: centroid across the stripe of its direct light, in px, without speckle and noise",
    "status": "(lines,) uint8: " + ", ".join(f"{one.value} {one.name.lower()}" for one in LineStatus),
    "width_px": "(lines,) float32: full width at half maximum of the stripe across it, in px",
    "snr": "(lines,) float32: signal-to-noise ratio of the stripe's brightest pixel, without speckle",
    "bound_px": "(lines,) float32: Cramér-Rao bound of the centre's standard deviation, in px, without speckle",
    "visible_fraction": "(lines,) float32: fraction of the sheet's profile that is lit and seen on the surface at the "
    "centre: 1 for a whole stripe, less at edges, in shadows and at the image's border",
    "mixed_fraction": "(lines,) float32: fraction of the stripe's direct light from other surfaces than that at the "
    "centre",
    "point_mm": "(lines, 3) float32: surface point at the centre, in scene coordinates",
    "normal": "(lines, 3) float32: unit normal of the surface at the point",
    "object": "(lines,) int16: number of the object at the point, -1 for none",
    "target_px": "(points, 2) float32: image points of the calibration target; NaN if not visible",
    "mask": "(height, width) uint8: sum of " + ", ".join(f"{one.value} {str(one.name).lower()}" for one in Mask),
    "light_e": "(5, height, width) float16: mean photo-electrons without speckle and noise, from: direct light of the "
    "lit surface, light scattered once, longer paths, grains and bubbles, lamp and daylight",
    "depth_mm": "(height, width) float32: depth in the camera frame at each pixel's centre; NaN without a surface",
    "object_map": "(height, width) uint8: number of the object at each pixel's centre, 255 for none",
}
"""Meaning of the arrays of a sample."""


def make_labels(
    simulator: SensorSimulator, shot: Shot, taken: SimulatedImage, wanted: tuple[Label, ...]
) -> dict[str, np.ndarray]:
    """Return the wanted arrays of a shot by name."""
    from twin.recording.frame_truth import find_visible_surfaces

    arrays: dict[str, np.ndarray] = {}
    noise = noise_std_e(taken, simulator.sensor.detector, row_noise_e=simulator.options.flaws.row_noise)
    if {"centre", "quality", "points"} & set(wanted):
        lines = _make_line_labels(simulator, shot, taken, noise)
        names: dict[str, tuple[str, ...]] = {"centre": ("centre_px", "centroid_px", "status")}
        names["quality"] = "width_px", "snr", "bound_px", "visible_fraction", "mixed_fraction"
        names["points"] = "point_mm", "normal", "object"
        arrays |= {name: lines[name] for label, group in names.items() if label in wanted for name in group}
    if "masks" in wanted:
        arrays["mask"] = make_mask(
            taken,
            noise,
            saturation=simulator.sensor.detector.full_scale_dn(),
            along_width=simulator.sensor.camera.stripe_along == "width",
        )
    if "light" in wanted:
        light = np.stack([taken.direct, taken.scattered_once, taken.indirect, taken.particles, taken.even])
        arrays["light_e"] = np.minimum(light, _LARGEST_HALF).astype(np.float16)
    if "target" in wanted:
        arrays["target_px"] = _find_target_points(simulator, shot)
    if "depth" in wanted:
        depth, number = find_visible_surfaces(simulator.renderer, simulator.pose(shot))
        arrays |= {"depth_mm": depth, "object_map": np.where(number < 0, NO_OBJECT, number).astype(np.uint8)}
    return arrays


def _make_line_labels(
    simulator: SensorSimulator, shot: Shot, taken: SimulatedImage, noise: np.ndarray
) -> dict[str, np.ndarray]:
    """Return all labels of the profile lines of a shot."""
    from twin.recording.frame_truth import make_empty_truth, select_brightest, sort_lit_crossings

    camera, detector = simulator.sensor.camera, simulator.sensor.detector
    count, truth, number = camera.lines(), make_empty_truth(camera.lines()), np.full(camera.lines(), -1, np.int16)
    status = np.full(count, LineStatus.LASER_OFF, np.uint8)
    if simulator.shows(shot, "laser"):
        found = simulator.crossings(shot)
        truth, order = select_brightest(found, count), sort_lit_crossings(found)
        truth = simulator.measure_line_light(shot, truth)
        number[found.line[order]] = found.thing[order]
        status[:] = LineStatus.NOT_CROSSED
        status[found.line] = LineStatus.SHADOWED
    images = taken.direct, taken.total(), noise, taken.image >= detector.full_scale_dn()
    direct, total, noise, clipped = (each if camera.stripe_along == "width" else each.T for each in images)
    quality = stripe_quality(direct, noise, truth.centre_px, informative=total < detector.full_well_e, clipped=clipped)
    lit = np.isfinite(truth.centre_px)
    status[lit] = np.where(quality["snr"][lit] >= FAINT_BELOW, LineStatus.VISIBLE, LineStatus.FAINT)
    status[quality.pop("clipped")] = LineStatus.SATURATED
    of_truth = ("centre_px", "point_mm", "normal", "centroid_px", "visible_fraction", "mixed_fraction")
    floats = quality | {name: getattr(truth, name) for name in of_truth}
    return {name: values.astype(np.float32) for name, values in floats.items()} | {"status": status, "object": number}


def _find_target_points(simulator: SensorSimulator, shot: Shot) -> np.ndarray:
    """Return the image points (N, 2), float32, of the scene's first calibration target."""
    from twin.recording.frame_truth import project_points

    things = zip(simulator.scene.objects, simulator.scene.object_poses(), strict=True)
    plate, pose = next((thing, pose) for thing, pose in things if isinstance(thing, PrintedPlate))
    points = plate.described_target().points_mm @ pose[:3, :3].T + pose[:3, 3]
    return project_points(simulator.renderer, simulator.pose(shot), points).astype(np.float32)


def noise_std_e(taken: SimulatedImage, detector: Detector, *, row_noise_e: float = 0.0) -> np.ndarray:
    """Return the standard deviation (H, W) in electrons of the temporal noise of pixels (EMVA 1288 release 4, Eq. 13).

    It includes shot noise of light and dark current, read noise, that of rows, and quantisation with a variance of 1/12
    of a grey value squared. It does not include speckle and differences between pixels.
    """
    dark = 1e-3 * taken.exposure_ms * detector.dark_current_e_per_s * detector.dark_current_growth()
    constant = dark + detector.read_noise_e**2 + row_noise_e**2 + 1 / (12 * detector.gain_dn_per_e() ** 2)
    return np.sqrt(taken.total() + np.float32(constant))


def stripe_quality(
    direct: np.ndarray, noise: np.ndarray, centre: np.ndarray, *, informative: np.ndarray, clipped: np.ndarray
) -> dict[str, np.ndarray]:
    """Evaluate the stripe at true centres of L profile lines; NaN without a stripe.

    Returns "width_px", "snr", "bound_px" (L,), and "clipped" (L,): stripes with saturated pixels within the full width
    at half maximum.

    The stripe is the run of lit pixels that contains the centre. Its width is the full width at half maximum, with
    linear interpolation between pixels; NaN if the stripe is cut by the image's border. The bound is the Cramér-Rao
    bound for the position of a profile s of known shape in independent noise: 1 / sqrt(sum (ds/dx)^2 / std^2) over
    ``informative`` pixels (Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, Eq. 3.14, with
    a variance for each pixel).

    ``direct`` and ``noise`` (A, L) are the direct light of the stripe and the standard deviation of the noise in
    electrons: A pixels across the stripe, L profile lines. ``centre`` (L,) is NaN without a true centre; ``clipped``
    (A, L) are saturated pixels.
    """
    lines, across = np.flatnonzero(np.isfinite(centre)), len(direct)
    columns = np.arange(len(lines))
    row = np.rint(centre[lines]).astype(int) + np.arange(-_WINDOW_PX, _WINDOW_PX + 1)[:, None]
    inside = (row >= 0) & (row < across)
    pixel = np.clip(row, 0, across - 1) * direct.shape[1] + lines
    run = inside & np.take(direct > _LEAST_E, pixel)
    for side in (run[_WINDOW_PX:], run[_WINDOW_PX::-1]):
        np.logical_and.accumulate(side, axis=0, out=side)
    # Only the rows that any stripe reaches, and a dark one on each side.
    used = np.append(np.flatnonzero(run.any(axis=1)), _WINDOW_PX)
    rows = slice(max(used.min() - 1, 0), used.max() + 2)
    run, inside, pixel = run[rows], inside[rows], pixel[rows]
    signal = np.where(run, np.take(direct, pixel), np.float64(0))

    place = np.arange(len(signal))[:, None]
    peak = signal.argmax(axis=0)
    half = signal[peak, columns] / 2
    low = (signal < half) & inside
    first = np.where(low & (place < peak), place, -1).max(axis=0, initial=-1)
    last = np.where(low & (place > peak), place, len(signal)).min(axis=0, initial=len(signal))
    whole = (first >= 0) & (last < len(signal)) & (half > 0)
    start, end = np.where(whole, first, 0), np.where(whole, last, len(signal) - 1)
    rise, fall = signal[start + 1, columns] - signal[start, columns], signal[end - 1, columns] - signal[end, columns]
    with np.errstate(divide="ignore", invalid="ignore"):
        from_first = (half - signal[start, columns]) / rise
        to_last = (half - signal[end, columns]) / fall
        width = np.where(whole, end - start - from_first - to_last, np.nan)
    window_noise = np.take(noise, pixel).astype(float)
    # Five-point derivative: for a stripe of 1 px standard deviation, its error is a few percent; two points give 15 %.
    padded = np.pad(signal, ((2, 2), (0, 0)))
    slope = (padded[:-4] - 8 * padded[1:-3] + 8 * padded[3:-1] - padded[4:]) / 12
    known = inside & np.take(informative, pixel) & (signal > 0)
    information = np.where(known, np.square(slope / window_noise), 0.0).sum(axis=0)
    with np.errstate(divide="ignore"):
        bound = np.where(information > 0, 1 / np.sqrt(information), np.nan)
    within = (place > first) & (place < last) & inside
    snr = signal[peak, columns] / window_noise[peak, columns]

    def of_all_lines(values: np.ndarray, elsewhere: float | bool) -> np.ndarray:
        everywhere = np.full(len(centre), elsewhere)
        everywhere[lines] = values
        return everywhere

    saturated = (within & np.take(clipped, pixel) & (half > 0)).any(axis=0)
    found = {"width_px": width, "snr": snr, "bound_px": bound}
    return {name: of_all_lines(values, np.nan) for name, values in found.items()} | {
        "clipped": of_all_lines(saturated, False)
    }


def make_mask(taken: SimulatedImage, noise: np.ndarray, *, saturation: int, along_width: bool) -> np.ndarray:
    """Return the bits of `Mask` (H, W), uint8; ``noise`` (H, W) is the pixels' standard deviation in electrons."""
    brightest = taken.direct.max(axis=0 if along_width else 1, keepdims=True)
    bits = {
        Mask.STRIPE: taken.direct >= np.maximum(math.exp(-2) * brightest, 1.0),
        Mask.SATURATED: taken.image >= saturation,
        Mask.HAZE: taken.scattered_once > noise,
        Mask.SECONDARY: taken.indirect > noise,
        Mask.PARTICLES: taken.particles > noise,
    }
    return sum((np.uint8(bit) * held for bit, held in bits.items()), np.zeros(noise.shape, np.uint8))
