"""Light across a stripe and beside it, grain along it, and noise of the camera, measured in images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import special
from scipy.optimize import minimize_scalar
from scipy.signal import savgol_filter
from scipy.special import erf

from uwlts.errors import CaptureError
from uwlts.fitting.propagation import jackknife
from uwlts.model.stripe import CaptureStripes
from uwlts.radiometry.result import PartFit
from uwlts.runtime.progress import ProgressListener
from uwlts.storage.capture import Capture
from uwlts.stripe.peak_window import FWHM_PER_SIGMA

TAIL_PX = 90
"""Largest distance from the stripe of the tail, where halo and background are separated."""
TAIL_FIRST_PX = 12
"""Least distance of the tail. Closer to the stripe, flare of the lens and blur add to the halo, and rendered halos are
smoothed over cells of 8 px."""
SMOOTH_LINES = 25
"""Lines over which a surface and its brightness are smooth; grains are finer."""
_LAGS = 8
"""Lags along the stripe for the correlation of grains, lines."""
_FINE_PX = 0.25
"""Cells of the mean profile across the stripe."""
GROUP_LINES = 16
"""Lines whose light is added: many grains, so that the bias of the logarithm of the sum is negligible."""
BLOCKS = 20
"""Blocks of consecutive groups for the jackknife: a standard uncertainty is then known to a sixth."""
CLIPPED = 0.98
"""Fraction of full scale above which a pixel may be clipped."""
_MOST_CLIPPED = 0.02
"""Largest fraction of lines with clipped pixels in a run; their light is too low by about a tenth."""
LONGEST_GAP = 8
"""Longest gap along the stripe, lines, in which centres are interpolated."""
_ROUNDS = 5  # of weights, which follow from the fitted variance
_BINS = 24  # of the photon transfer
_FEWEST_PIXELS = 50  # of a bin
_ROUNDING = 1.0 / 12.0  # variance of the rounding to grey values
_TRANSFER_MISFIT, _TRANSFER_LIMIT = 0.05, 1.75
"""Relative misfit of a variance that the gain's use allows, and the largest rms of deviations in their own standard
deviations: with 15 bins, one of a million exceeds it by chance."""
_STILL = 0.99  # fraction of the pixels without particles that are kept for the noise
_BAND_PX = 32
"""Width of the bands across the stripe. The dimmest is taken as dark; each has thousands of pixels."""
_HALO_STD = 0.5
"""Relative standard uncertainty of the light of the halo, because the dimmest band can have some, too.

Chosen with the width of the bands on the drawn captures 100 to 111 of docs/studies/radiometry.py, and judged on others.
"""


@dataclass(frozen=True, eq=False)
class StripeImages:
    """Light of M groups of neighbouring stripe centres, in J blocks of consecutive groups."""

    light: np.ndarray
    """(M,); grey values across the stripe, added over ``width`` pixels, with the background; mean of the group."""
    of_group: np.ndarray  # (N,) int; group of each stripe centre, -1 for unused ones
    block: np.ndarray  # (M,) int; block of each group
    exposure_ms: np.ndarray  # (M,); exposure of each group
    width: int  # number of pixels across the stripe that are added
    # (K,) and (J, K); distances from the centre, and mean grey value there of each block.
    fine_px: np.ndarray
    fine: np.ndarray
    tail: np.ndarray
    """(J, TAIL_PX); mean grey value at 1, 2, ... pixels from the centre, on both sides."""
    tail_count: np.ndarray  # (J, TAIL_PX); number of pixels of ``tail``
    grain: np.ndarray
    """(J, _LAGS + 1); mean product of the relative deviations of ``light`` from smooth at lags along the stripe,
    lines."""
    peak_dn: float  # grey value that one of two hundred stripe centres exceeds


def fill_gaps(stripes: CaptureStripes) -> CaptureStripes:
    """Interpolate centres in short gaps.

    Lines without a centre are dim by chance; without them, a faint stripe would seem brighter than it is.
    """
    missing = np.where(np.diff(stripes.frame) == 0, np.diff(stripes.line) - 1, 0)
    short = (missing > 0) & (missing <= LONGEST_GAP)
    before = np.repeat(np.flatnonzero(short), missing[short])
    step = np.concatenate([np.arange(1, count + 1) for count in missing[short].tolist()] or [np.empty(0, int)])
    share = step / (missing[before] + 1)
    place = np.concatenate([np.arange(len(stripes.line)), before + share])
    order, source = np.argsort(place, kind="stable"), np.concatenate([np.arange(len(stripes.line)), before])
    filled = stripes[source[order]]
    line = np.concatenate([stripes.line, stripes.line[before] + step])[order]
    centre = np.interp(place[order], np.arange(len(stripes.line)), stripes.centre_px)
    return replace(filled, line=line, centre_px=centre)


def measure_stripes(
    capture: Capture, stripes: CaptureStripes, usable: np.ndarray, progress: ProgressListener
) -> StripeImages:
    """Measure the light across the stripe at its usable centres (N,) and beside it.

    Runs of lines with more than a few clipped pixels are left out as a whole: to leave out single bright lines would
    make the stripe seem darker.

    Raises CaptureError if fewer than `BLOCKS` groups of centres can be used.
    """
    along, full_dn = capture.header.sensor.camera.stripe_along, capture.header.saturation_dn
    core = math.ceil(3 * float(np.nanmedian(stripes.width_px)) / FWHM_PER_SIGMA) + 3
    of_group, light, exposure = np.full(len(stripes.line), -1), [], []
    parts: list[_Part] = []
    frames = np.unique(stripes.frame).tolist()
    peaks, clipped = [], 0
    for number, frame in enumerate(frames):
        members = np.flatnonzero(stripes.frame == frame)
        line = stripes.line[members]
        image = capture.image(frame)
        profiles = (image if along == "height" else image.T).astype(np.float32)
        for run in _split_runs(line, usable[members]):
            chosen = members[run]
            part = _measure_run(profiles, stripes.line[chosen], stripes.centre_px[chosen], core, CLIPPED * full_dn)
            peaks.append(part.values[:, TAIL_PX])
            if np.mean(part.clipped) > _MOST_CLIPPED:
                clipped += len(run)
                continue
            for some in np.array_split(np.arange(len(chosen)), max(1, len(chosen) // GROUP_LINES)):
                kept = some[np.isfinite(part.light[some])]
                if len(kept) < GROUP_LINES / 2:
                    continue
                of_group[chosen[kept]] = len(light)
                light.append(float(part.light[kept].mean()))
                exposure.append(float(capture.exposure_ms[frame]))
                parts.append(_Part(*(column[kept] for column in part)))
        progress(number + 1, len(frames), "brightness of the stripe")
    if len(light) < BLOCKS:
        share = clipped / max(len(stripes.line), 1)
        advice = (
            "record them with a shorter exposure" if share > 0.5 else "record more images of a smooth, matt surface"
        )
        raise CaptureError(
            f"{capture.path.name} has {len(light)} groups of {GROUP_LINES} neighbouring stripe centres on a smooth "
            f"surface that are not saturated, and {BLOCKS} are needed; {100 * share:.0f} % of the centres are in "
            f"saturated pieces of the stripe: {advice}"
        )
    block = np.arange(len(light)) * BLOCKS // len(light)
    of_block = [
        _Part(*map(np.concatenate, zip(*(parts[k] for k in np.flatnonzero(block == j)), strict=True)))
        for j in range(BLOCKS)
    ]
    edges = np.arange(-core - _FINE_PX / 2, core + _FINE_PX, _FINE_PX)
    tails = [part.tail() for part in of_block]
    return StripeImages(
        np.array(light),
        of_group,
        block,
        np.array(exposure),
        2 * core + 1,
        0.5 * (edges[1:] + edges[:-1]),
        np.array([part.mean_profile(edges) for part in of_block]),
        np.array([mean for mean, _ in tails]),
        np.array([count for _, count in tails]),
        np.array([part.grain() for part in of_block]),
        float(np.quantile(np.concatenate(peaks), 0.995)),
    )


class _Part(NamedTuple):
    """Pixels about N neighbouring centres."""

    values: np.ndarray  # (N, 2 TAIL_PX + 1); grey values, NaN outside the image
    offset: np.ndarray  # (N,); distance of the middle pixel from the centre
    # (N,); light added across the stripe, and its relative deviation from smooth.
    light: np.ndarray
    deviation: np.ndarray
    clipped: np.ndarray  # (N,) bool

    def mean_profile(self, edges: np.ndarray) -> np.ndarray:
        """Return the mean grey value (K,) in cells of the distance from the centre; NaN in empty cells."""
        place = self.offset[:, None] + np.arange(-TAIL_PX, TAIL_PX + 1)
        cell = np.digitize(place.ravel(), edges) - 1
        held = (cell >= 0) & (cell < len(edges) - 1) & np.isfinite(self.values.ravel())
        count = np.bincount(cell[held], minlength=len(edges) - 1)
        total = np.bincount(cell[held], self.values.ravel()[held], minlength=len(edges) - 1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def tail(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean grey value (TAIL_PX,) at whole distances from the centre, and the number of pixels."""
        finite = np.isfinite(self.values)
        total, count = np.where(finite, self.values, 0.0).sum(axis=0), finite.sum(axis=0)
        sums = [each[TAIL_PX + 1 :] + each[TAIL_PX - 1 :: -1] for each in (total, count)]
        return sums[0] / np.maximum(sums[1], 1), sums[1]

    def grain(self) -> np.ndarray:
        """Return the mean products (_LAGS + 1,) of the relative deviations at lags."""
        d = self.deviation
        return np.array([np.mean(d[: len(d) - lag] * d[lag:]) for lag in range(_LAGS + 1)])


def _split_runs(line: np.ndarray, usable: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the places of consecutive usable lines, at least `SMOOTH_LINES` long."""
    breaks = np.flatnonzero((np.diff(line) != 1) | (usable[1:] != usable[:-1])) + 1
    for run in np.split(np.arange(len(line)), breaks):
        if len(run) >= SMOOTH_LINES and usable[run[0]]:
            yield run


def _measure_run(profiles: np.ndarray, line: np.ndarray, centre_px: np.ndarray, core: int, most: float) -> _Part:
    """Measure a run of neighbouring lines. Their centres are smoothed: grains move a centre, not the stripe."""
    smooth = np.asarray(savgol_filter(centre_px, SMOOTH_LINES, 2))
    middle = np.rint(smooth).astype(int)
    places = middle[:, None] + np.arange(-TAIL_PX, TAIL_PX + 1)
    inside = (places >= 0) & (places < profiles.shape[1])
    values = np.where(inside, profiles[line[:, None], np.clip(places, 0, profiles.shape[1] - 1)], np.nan)
    centre = values[:, TAIL_PX - core : TAIL_PX + core + 1]
    light = centre.sum(axis=1)
    with np.errstate(invalid="ignore"):
        clipped = centre.max(axis=1) >= most
    known = np.where(np.isfinite(light), light, np.nanmean(light))
    # The deviation refers to the light above the surroundings.
    above = known - centre.shape[1] * np.nanmedian(np.where(inside, values, np.nan))
    deviation = above / np.maximum(np.asarray(savgol_filter(above, SMOOTH_LINES, 2)), 1e-3) - 1.0
    return _Part(values, middle - smooth, light, deviation, clipped)


def fit_sigma(place_px: np.ndarray, profile: np.ndarray) -> float:
    """Return the standard deviation in px of a Gaussian, integrated over pixels, that fits a mean profile best."""
    held = np.isfinite(profile)
    x, y = place_px[held], profile[held]

    def misfit(log_sigma: float) -> float:
        sigma = math.sqrt(2) * math.exp(log_sigma)
        shape = 0.5 * (erf((x + 0.5) / sigma) - erf((x - 0.5) / sigma))
        design = np.column_stack([shape, np.ones_like(x)])
        return float(np.sum((y - design @ np.linalg.lstsq(design, y, rcond=None)[0]) ** 2))

    limits = math.log(0.1), math.log(float(x[-1]))
    found: Any = minimize_scalar(misfit, bounds=limits, method="bounded")
    return math.exp(float(found.x))


@dataclass(frozen=True)
class CameraNoise:
    """Noise of the camera: grey values per electron and standard deviation in the dark, with standard uncertainties."""

    gain: float
    gain_std: float
    dark_dn: float
    dark_std: float
    fit: PartFit


def measure_noise(source: Capture) -> CameraNoise | None:
    """Measure noise by photon transfer from laser images that were repeated at one place and exposure (EMVA 1288).

    Speckle is the same in repeated images and does not add to their differences. Pixels that particles change in one of
    the images are left out. Returns None without repeated images.
    """
    full_dn = source.header.saturation_dn
    parts, repeated = [], _find_repeats(source)
    for numbers in repeated:
        images = np.stack([source.image(number) for number in numbers.tolist()]).astype(np.float32)
        # Particles change the mean of a pixel, but seldom its median.
        parts.append(np.stack([np.median(images, axis=0), _measure_variance(images)]))
    if not parts:
        return None
    mean, variance = np.stack(parts, axis=1)
    # Most pixels are dark.
    noise_dn, background_dn = math.sqrt(float(np.nanmedian(variance))), float(np.median(mean))
    # The means of dark pixels differ by noise alone: they are one bin.
    dark_dn = max(6.0 * noise_dn / math.sqrt(2.0), 2.0)
    edges = background_dn + np.concatenate([[-math.inf], np.geomspace(dark_dn, 0.85 * full_dn, _BINS)])
    # Each part of the jackknife has a piece of the stripe: all images of some of its lines.
    across = 1 if source.header.sensor.camera.stripe_along == "height" else 2
    pieces = zip(*(np.array_split(each, BLOCKS, axis=across) for each in (mean, variance)), strict=True)
    counted = np.array([_sum_by_bins(m.ravel(), v.ravel(), edges) for m, v in pieces])
    whole = _fit_transfer(counted.sum(axis=0), background_dn)
    if whole is None:
        return None
    left = np.array([_fit_transfer(counted.sum(axis=0) - part, background_dn) or whole for part in counted])
    std = np.sqrt(np.diag(jackknife(left - left.mean(axis=0))))
    # The intercept is the variance of the pixels beside the stripe, which includes the shot noise of its halo.
    lines_last = mean if across == 2 else mean.transpose(0, 2, 1)
    halo = whole[0] * max(background_dn - _find_dimmest(lines_last, background_dn + dark_dn), 0.0)
    dark = math.sqrt(max(whole[1] - halo, 0.0))
    variance_std = math.hypot(float(std[1]), _HALO_STD * halo)
    freedom = float(np.mean([len(numbers) - 1 for numbers in repeated]))
    fit = _judge_transfer(counted.sum(axis=0), background_dn, *whole, freedom)
    return CameraNoise(whole[0], float(std[0]), dark, variance_std / max(2 * dark, 1e-3), fit)


def _measure_variance(images: np.ndarray) -> np.ndarray:
    """Return the variance (H, W) of N repeated images; NaN where it is beyond the usual of equally bright pixels.

    Variances of normal noise have a chi-square distribution with N - 1 degrees of freedom. The median of a bin gives
    its scale. Kept variances are corrected for those beyond the limit.
    """
    variance, middle, freedom = images.var(axis=0, ddof=1), np.median(images, axis=0), len(images) - 1
    limit = float(special.chdtri(freedom, 1 - _STILL))
    above = np.maximum(middle - np.median(middle), 1.0)
    cell = np.digitize(above, np.geomspace(2.0, max(float(above.max()), 4.0), _BINS))
    most = np.array([np.median(variance[cell == k]) if (cell == k).any() else 0.0 for k in range(_BINS + 1)])
    most = np.maximum(most, _ROUNDING) * limit / float(special.chdtri(freedom, 0.5))
    kept = variance <= most[cell]
    return np.where(kept, variance * _STILL / float(special.chdtr(freedom + 2, limit)), np.nan)


def _find_repeats(capture: Capture) -> list[np.ndarray]:
    """Return the numbers of successive laser images at the same place and exposure, two or more each."""
    lit = np.flatnonzero(capture.laser_on)
    moved = (np.diff(capture.stage_mm[lit]) != 0) | (np.diff(capture.exposure_ms[lit]) != 0)
    return [numbers for numbers in np.split(lit, np.flatnonzero(moved) + 1) if len(numbers) > 1]


def _sum_by_bins(mean: np.ndarray, variance: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the number, and the sums of means and of variances, (3, B) of pixels in bins of their mean."""
    cell = np.digitize(mean, edges) - 1
    held = (cell >= 0) & (cell < len(edges) - 1) & np.isfinite(variance)
    sums = [np.bincount(cell[held], weight, len(edges) - 1) for weight in (None, mean[held], variance[held])]
    return np.array(sums, dtype=float)


def _find_dimmest(mean: np.ndarray, most: float) -> float:
    """Return the least mean grey value of bands across the stripe, from pixels of images (G, N, L) below ``most``."""
    dark = np.where(mean < most, mean, np.nan)
    bands = [dark[:, at : at + _BAND_PX] for at in range(0, dark.shape[1] - _BAND_PX + 1, _BAND_PX)]
    held = [band for band in bands if np.count_nonzero(np.isfinite(band)) > band.size / 2]
    return min((float(np.nanmean(band)) for band in held), default=float(np.nanmean(dark)))


def _judge_transfer(counted: np.ndarray, background_dn: float, gain: float, dark: float, freedom: float) -> PartFit:
    """Judge the deviations of the variances from the line of the photon transfer; bins as for `_fit_transfer`.

    A variance with f degrees of freedom has the relative standard deviation sqrt(2 / f).
    """
    count, means, variances = counted[:, counted[0] > _FEWEST_PIXELS]
    expected = np.maximum(gain * (means / count - background_dn) + dark + _ROUNDING, 1e-3)
    rest = variances / count / expected - 1
    misfit = math.sqrt(np.sum(rest**2 / (2 / (freedom * count) + _TRANSFER_MISFIT**2)) / (len(rest) - 2))
    largest = 100 * float(np.abs(rest).max())
    return PartFit(
        "noise of repeated images",
        misfit / _TRANSFER_LIMIT,
        f"variances differ by up to {largest:.0f} % from a line; unsteady laser, particles, or a curved response?",
        ("dark_noise_dn", "gain_dn_per_e"),
    )


def _fit_transfer(counted: np.ndarray, background_dn: float) -> tuple[float, float] | None:
    """Return gain and variance in the dark, without rounding, by weighted least squares; None if undetermined."""
    count, means, variances = counted
    held = count > _FEWEST_PIXELS
    if np.count_nonzero(held) < 4:
        return None
    mean, variance = means[held] / count[held] - background_dn, variances[held] / count[held]
    design, expected = np.column_stack([mean, np.ones_like(mean)]), np.full_like(mean, float(np.mean(variance)))
    gain = dark = 0.0
    for _ in range(_ROUNDS):
        # The standard deviation of a variance is proportional to its expectation.
        root = np.sqrt(count[held]) / np.maximum(expected, 1e-3)
        gain, dark = np.linalg.lstsq(design * root[:, None], variance * root, rcond=None)[0]
        expected = gain * mean + dark
    return float(gain), float(dark) - _ROUNDING
