"""Labels of rendered images: what is known of every profile line and every pixel.

`MEANINGS` explains the arrays of a frame by their names; they are NaN where there is nothing.
Of several lit crossings on a line the brightest is labelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from twin.datasets.data_set import FAINT_BELOW, Label, LineStatus, Mask
from twin.scene.description import Printed
from uwlts.model.sensor import Detector

if TYPE_CHECKING:
    from twin.recording.studio import Exposed, Studio
    from twin.scene.motion import Shot

_WINDOW_PX = 96
"""Pixels to either side of a centre in which its stripe is looked for; wider ones are cut off there."""
_LEAST_E = 1e-6
"""Electrons below which a pixel counts as dark: the smallest numbers are zero on some processors and threads."""
_LARGEST_HALF = 65504.0
"""Largest number of float16; brighter pixels are clipped to it, far above any full well of use."""
NO_OBJECT = 255
MEANINGS = {
    "centre_px": "(lines,) float32: true centre of the stripe on each profile line, in px across it; NaN without one",
    "status": "(lines,) uint8: " + ", ".join(f"{one.value} {one.name.lower()}" for one in LineStatus),
    "width_px": "(lines,) float32: full width at half maximum of the stripe across it, in px",
    "snr": "(lines,) float32: signal over noise of the stripe's brightest pixel, speckle left out",
    "bound_px": "(lines,) float32: Cramér-Rao bound of the centre's standard deviation, in px, speckle left out",
    "point_mm": "(lines, 3) float32: surface at the centre, in scene coordinates",
    "normal": "(lines, 3) float32: unit normal of the surface there",
    "object": "(lines,) int16: number of the object there, -1 for none",
    "target_px": "(points, 2) float32: where the points of the calibration target are seen; NaN where they are not",
    "mask": "(height, width) uint8: sum of " + ", ".join(f"{one.value} {str(one.name).lower()}" for one in Mask),
    "light_e": "(5, height, width) float16: mean photo-electrons of light straight from the lit surface, scattered "
    "once, on longer ways, by grains and bubbles, and of lamp and day; without speckle and noise",
    "depth_mm": "(height, width) float32: depth in the camera frame of what each pixel's middle sees; NaN for nothing",
    "object_map": "(height, width) uint8: number of the object that each pixel's middle sees, 255 for none",
}
"""Meaning of the arrays of a sample."""


def labelled(studio: Studio, shot: Shot, taken: Exposed, wanted: tuple[Label, ...]) -> dict[str, np.ndarray]:
    """The wanted arrays of a shot that was taken by a studio, by their names."""
    from twin.recording.frame_truth import seen_surfaces

    arrays: dict[str, np.ndarray] = {}
    noise = noise_std_e(taken, studio.sensor.detector)
    if {"centre", "quality", "points"} & set(wanted):
        lines = _line_labels(studio, shot, taken, noise)
        names = {"centre": ("centre_px", "status"), "quality": ("width_px", "snr", "bound_px")}
        names["points"] = ("point_mm", "normal", "object")
        arrays |= {name: lines[name] for label, group in names.items() if label in wanted for name in group}
    if "masks" in wanted:
        arrays["mask"] = mask_of(
            taken,
            noise,
            saturation=studio.sensor.detector.full_scale_dn(),
            along_width=studio.sensor.camera.stripe_along == "width",
        )
    if "light" in wanted:
        light = np.stack([taken.direct, taken.scattered_once, taken.longer_ways, taken.particles, taken.even])
        arrays["light_e"] = np.minimum(light, _LARGEST_HALF).astype(np.float16)
    if "target" in wanted:
        arrays["target_px"] = _target_points(studio, shot)
    if "depth" in wanted:
        depth, number = seen_surfaces(studio.renderer, studio.pose(shot))
        arrays |= {"depth_mm": depth, "object_map": np.where(number < 0, NO_OBJECT, number).astype(np.uint8)}
    return arrays


def _line_labels(studio: Studio, shot: Shot, taken: Exposed, noise: np.ndarray) -> dict[str, np.ndarray]:
    """All labels of the profile lines of a shot."""
    from twin.recording.frame_truth import brightest, crossings, lit_dimmest_first, no_stripe

    camera, detector = studio.sensor.camera, studio.sensor.detector
    count, truth, number = camera.lines(), no_stripe(camera.lines()), np.full(camera.lines(), -1, np.int16)
    status = np.full(count, LineStatus.LASER_OFF, np.uint8)
    if studio.shows(shot, "laser"):
        found = crossings(studio.renderer, studio.pose(shot), travel=studio.travel(shot))
        truth, order = brightest(found, count), lit_dimmest_first(found)
        number[found.line[order]] = found.thing[order]
        status[:] = LineStatus.NOT_CROSSED
        status[found.line] = LineStatus.SHADOWED
    images = taken.direct, taken.total(), noise, taken.image >= detector.full_scale_dn()
    direct, total, noise, clipped = (each if camera.stripe_along == "width" else each.T for each in images)
    quality = stripe_quality(direct, noise, truth.centre_px, informative=total < detector.full_well_e, clipped=clipped)
    lit = np.isfinite(truth.centre_px)
    status[lit] = np.where(quality.snr[lit] >= FAINT_BELOW, LineStatus.VISIBLE, LineStatus.FAINT)
    status[quality.clipped] = LineStatus.SATURATED
    floats = {"centre_px": truth.centre_px, "point_mm": truth.point_mm, "normal": truth.normal}
    floats |= {"width_px": quality.width_px, "snr": quality.snr, "bound_px": quality.bound_px}
    return {name: values.astype(np.float32) for name, values in floats.items()} | {"status": status, "object": number}


def _target_points(studio: Studio, shot: Shot) -> np.ndarray:
    """Image points (N, 2), float32, of the points of the scene's first calibration target."""
    from twin.recording.frame_truth import image_points

    things = zip(studio.scene.objects, studio.scene.object_poses(), strict=True)
    plate, pose = next((thing, pose) for thing, pose in things if isinstance(thing, Printed))
    points = plate.described_target().points_mm @ pose[:3, :3].T + pose[:3, 3]
    return image_points(studio.renderer, studio.pose(shot), points).astype(np.float32)


def noise_std_e(taken: Exposed, detector: Detector) -> np.ndarray:
    """Standard deviation (H, W) in electrons of a pixel's noise from image to image (EMVA 1288 release 4, Eq. 13).

    Shot noise of light and dark current, noise of the readout, and rounding, whose variance is a twelfth of a grey
    value squared. Speckle is none of it, nor is what differs from pixel to pixel.
    """
    dark = 1e-3 * taken.exposure_ms * detector.dark_current_e_per_s * detector.dark_current_growth()
    constant = dark + detector.read_noise_e**2 + 1 / (12 * detector.gain_dn_per_e() ** 2)
    return np.sqrt(taken.total() + np.float32(constant))


@dataclass(frozen=True)
class LineQuality:
    """Of the stripe on L profile lines: width, signal to noise, least standard deviation of its centre, all (L,).

    ``clipped`` (L,) says whether pixels within its full width at half maximum are saturated. NaN where no stripe is.
    """

    width_px: np.ndarray
    snr: np.ndarray
    bound_px: np.ndarray
    clipped: np.ndarray


def stripe_quality(
    direct: np.ndarray, noise: np.ndarray, centre: np.ndarray, *, informative: np.ndarray, clipped: np.ndarray
) -> LineQuality:
    """Quality of the stripe about true centres (L,), from images of its own light and of the noise, in electrons.

    Images are (A, L), A being the pixels across the stripe. The stripe is the run of lit pixels that holds the centre.
    Its width lies between the places where the light passes half of its maximum, linear between pixels; NaN where the
    image cuts it. The bound is that of Cramér and Rao for a profile s of known shape that moves across independent
    noise: 1 / sqrt(sum (ds/dx)^2 / std^2) over ``informative`` pixels (Kay, Fundamentals of Statistical Signal
    Processing: Estimation Theory, 1993, Eq. 3.14, with a variance for each pixel).
    """
    lines, across = np.flatnonzero(np.isfinite(centre)), len(direct)
    columns = np.arange(len(lines))
    row = np.rint(centre[lines]).astype(int) + np.arange(-_WINDOW_PX, _WINDOW_PX + 1)[:, None]
    inside, row = (row >= 0) & (row < across), np.clip(row, 0, across - 1)
    signal = direct[row, lines].astype(float)
    lit = inside & (signal > _LEAST_E)
    signal[~lit] = 0.0
    behind = np.logical_and.accumulate(lit[_WINDOW_PX:], axis=0)
    before = np.logical_and.accumulate(lit[_WINDOW_PX::-1], axis=0)[::-1]
    signal[:_WINDOW_PX][~before[:-1]] = 0.0
    signal[_WINDOW_PX:][~behind] = 0.0

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
    window_noise = noise[row, lines].astype(float)
    # Five points know the slope of a stripe of 1 px standard deviation to some percent, two to 15 %.
    padded = np.pad(signal, ((2, 2), (0, 0)))
    slope = (padded[:-4] - 8 * padded[1:-3] + 8 * padded[3:-1] - padded[4:]) / 12
    known = inside & informative[row, lines] & (signal > 0)
    information = np.where(known, np.square(slope / window_noise), 0.0).sum(axis=0)
    with np.errstate(divide="ignore"):
        bound = np.where(information > 0, 1 / np.sqrt(information), np.nan)
    within = (place > first) & (place < last) & inside
    snr = signal[peak, columns] / window_noise[peak, columns]

    def of_all_lines(values: np.ndarray, elsewhere: float | bool) -> np.ndarray:
        everywhere = np.full(len(centre), elsewhere)
        everywhere[lines] = values
        return everywhere

    return LineQuality(
        *(of_all_lines(values, np.nan) for values in (width, snr, bound)),
        clipped=of_all_lines((within & clipped[row, lines] & (half > 0)).any(axis=0), False),
    )


def mask_of(taken: Exposed, noise: np.ndarray, *, saturation: int, along_width: bool) -> np.ndarray:
    """Bits of `Mask` (H, W), uint8, with the noise (H, W) of every pixel in electrons."""
    brightest = taken.direct.max(axis=0 if along_width else 1, keepdims=True)
    bits = {
        Mask.STRIPE: taken.direct >= np.maximum(math.exp(-2) * brightest, 1.0),
        Mask.SATURATED: taken.image >= saturation,
        Mask.HAZE: taken.scattered_once > noise,
        Mask.SECONDARY: taken.longer_ways > noise,
        Mask.PARTICLES: taken.particles > noise,
    }
    return sum((np.uint8(bit) * held for bit, held in bits.items()), np.zeros(noise.shape, np.uint8))
