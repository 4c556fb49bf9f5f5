"""What the images show of a stripe: light across it, tail, width, grain along it, and noise of the camera."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from uwlts.errors import CaptureError
from uwlts.model.stripe import CaptureStripes
from uwlts.runtime.progress import ProgressListener
from uwlts.storage.capture import Capture
from uwlts.stripe.peak_window import FWHM_PER_SIGMA

TAIL_PX = 90
"""Largest distance from the stripe of the tail, where halo and background are told apart."""
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
"""Lines whose light is added: many grains, so that the logarithm of the sum has no bias to speak of."""
BLOCKS = 20
"""Blocks of consecutive groups for the jackknife: a standard uncertainty is then known to a sixth."""
_CLIPPED = 0.98
"""Fraction of full scale above which a pixel may be clipped."""
_BINS = 24
"""Bins of the photon transfer."""


@dataclass(frozen=True, eq=False)
class StripeImages:
    """Light of M groups of neighbouring stripe centres, in J blocks of consecutive groups.

    Attributes
    ----------
    light : (M,)
        Grey values across the stripe, added over ``width`` pixels, with the background; mean of the group.
    of_group : (N,) int
        Group of each stripe centre, -1 for unused ones.
    block : (M,) int
        Block of each group.
    exposure_ms : (M,)
        Exposure of each group.
    width : int
        Number of pixels across the stripe that are added.
    fine_px, fine : (K,), (J, K)
        Distances from the centre, and mean grey value there of each block.
    tail : (J, TAIL_PX)
        Mean grey value at 1, 2, ... pixels from the centre, on both sides.
    tail_count : (J, TAIL_PX)
        Number of pixels of ``tail``.
    grain : (J, _LAGS + 1)
        Mean product of the relative deviations of ``light`` from smooth at lags along the stripe, lines.
    gaps : float
        Fraction of the lines between the ends of the stripe that have no stripe centre.
    peak_dn : float
        Grey value that one of two hundred stripe centres exceeds.
    """

    light: np.ndarray
    of_group: np.ndarray
    block: np.ndarray
    exposure_ms: np.ndarray
    width: int
    fine_px: np.ndarray
    fine: np.ndarray
    tail: np.ndarray
    tail_count: np.ndarray
    grain: np.ndarray
    gaps: float
    peak_dn: float


def measure_stripes(
    capture: Capture, stripes: CaptureStripes, usable: np.ndarray, progress: ProgressListener
) -> StripeImages:
    """Measure the light across the stripe at its usable centres (N,) and beside it.

    Raises
    ------
    CaptureError
        Fewer than `BLOCKS` groups of centres can be used, or the capture has centre lines instead of images.
    """
    along, full_dn = capture.header.sensor.camera.stripe_along, capture.header.saturation_dn
    core = math.ceil(3 * float(np.nanmedian(stripes.width_px)) / FWHM_PER_SIGMA) + 3
    of_group, light, exposure = np.full(len(stripes.line), -1), [], []
    parts: list[_Part] = []
    gaps = [0, 0]
    frames = np.unique(stripes.frame).tolist()
    peaks = []
    for number, frame in enumerate(frames):
        own = np.flatnonzero(stripes.frame == frame)
        line = stripes.line[own]
        gaps[0] += int(line[-1] - line[0] + 1 - len(line))
        gaps[1] += int(line[-1] - line[0] + 1)
        image = capture.image(frame)
        profiles = (image if along == "height" else image.T).astype(np.float32)
        for run in _runs(line, usable[own]):
            chosen = own[run]
            part = _measure_run(profiles, stripes.line[chosen], stripes.centre_px[chosen], core, _CLIPPED * full_dn)
            whole = np.array_split(np.arange(len(chosen)), max(1, len(chosen) // GROUP_LINES))
            for some in whole:
                kept = some[part.unclipped[some]]
                if len(kept) < GROUP_LINES / 2:
                    continue
                of_group[chosen[kept]] = len(light)
                light.append(float(part.light[kept].mean()))
                exposure.append(float(capture.exposure_ms[frame]))
                parts.append(part.select(kept))
            peaks.append(part.values[:, part.middle])
        progress(number + 1, len(frames), "brightness of the stripe")
    if len(light) < BLOCKS:
        raise CaptureError(
            f"{capture.path.name} has {len(light)} groups of {GROUP_LINES} neighbouring stripe centres on a smooth "
            f"surface that are not saturated; {BLOCKS} are needed: record more images, or with a shorter exposure"
        )
    block = np.arange(len(light)) * BLOCKS // len(light)
    of_block = [_Part.join([part for part, at in zip(parts, block, strict=True) if at == j]) for j in range(BLOCKS)]
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
        gaps[0] / max(gaps[1], 1),
        float(np.quantile(np.concatenate(peaks), 0.995)),
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Pixels (N, 2 TAIL_PX + 1) about N neighbouring centres, at offsets ``offset`` (N,) of the middle pixel from the
    centre; NaN outside the image."""

    values: np.ndarray
    offset: np.ndarray
    light: np.ndarray
    deviation: np.ndarray
    unclipped: np.ndarray
    middle: int = TAIL_PX

    def select(self, kept: np.ndarray) -> _Part:
        columns = self.values, self.offset, self.light, self.deviation, self.unclipped
        return _Part(*(column[kept] for column in columns))

    @classmethod
    def join(cls, parts: list[_Part]) -> _Part:
        names = "values", "offset", "light", "deviation", "unclipped"
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

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


def _runs(line: np.ndarray, usable: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the places of consecutive usable lines, at least `SMOOTH_LINES` long."""
    breaks = np.flatnonzero((np.diff(line) != 1) | (usable[1:] != usable[:-1])) + 1
    for run in np.split(np.arange(len(line)), breaks):
        if len(run) >= SMOOTH_LINES and usable[run[0]]:
            yield run


def _measure_run(profiles: np.ndarray, line: np.ndarray, centre_px: np.ndarray, core: int, most: float) -> _Part:
    """Measure a run of neighbouring lines. Their centres are smoothed: grains move a centre, not the stripe."""
    smooth = savgol_filter(centre_px, SMOOTH_LINES, 2)
    middle = np.rint(smooth).astype(int)
    places = middle[:, None] + np.arange(-TAIL_PX, TAIL_PX + 1)
    inside = (places >= 0) & (places < profiles.shape[1])
    values = np.where(inside, profiles[line[:, None], np.clip(places, 0, profiles.shape[1] - 1)], np.nan)
    centre = values[:, TAIL_PX - core : TAIL_PX + core + 1]
    light = centre.sum(axis=1)
    with np.errstate(invalid="ignore"):
        unclipped = np.isfinite(light) & (centre.max(axis=1) < most)
    known = np.where(np.isfinite(light), light, np.nanmean(light))
    # The deviation refers to the light above the surroundings.
    above = known - centre.shape[1] * np.nanmedian(np.where(inside, values, np.nan))
    deviation = above / np.maximum(savgol_filter(above, SMOOTH_LINES, 2), 1e-3) - 1.0
    return _Part(values, middle - smooth, light, deviation, unclipped)


@dataclass(frozen=True)
class CameraNoise:
    """Noise of the camera: grey values per electron and standard deviation in the dark, with standard uncertainties.

    ``gain`` and its uncertainty are None without repeated images.
    """

    gain: float | None
    gain_std: float | None
    dark_dn: float
    dark_std: float


def measure_noise(
    capture: Capture, stripes: CaptureStripes, *, repeats: Capture | None, background_dn: float
) -> CameraNoise:
    """Measure noise by photon transfer from laser images that were repeated at one place and exposure (EMVA 1288).

    Speckle is the same in repeated images and does not add to their differences. Without repeated images, only the
    noise of pixels far from the stripe is measured, from differences of successive images.
    """
    source = capture if repeats is None else repeats
    pairs = _repeated(source)
    full_dn = source.header.saturation_dn
    if pairs:
        parts = []
        for first, second in pairs:
            a, b = (source.image(number).astype(np.float32) for number in (first, second))
            parts.append(np.stack([0.5 * (a + b), 0.5 * (a - b) ** 2]))
        mean, half = np.stack(parts, axis=1)
        # Each part of the jackknife has a piece of the stripe: all images of some of its lines.
        across = 1 if source.header.sensor.camera.stripe_along == "height" else 2
        pieces = zip(*(np.array_split(each, BLOCKS, axis=across) for each in (mean, half)), strict=True)
        bands = [np.stack([piece.ravel() for piece in pair]) for pair in pieces]
        edges = background_dn + np.concatenate([[-1e9], np.geomspace(2.0, 0.85 * full_dn, _BINS)])
        counted = np.array([_bin_variance(mean, variance, edges) for mean, variance in bands])
        whole = _fit_transfer(counted.sum(axis=0), background_dn)
        if whole is not None:
            left = np.array([
                _fit_transfer(counted.sum(axis=0) - part, background_dn) or whole for part in counted
            ])  # fmt: skip
            std = np.sqrt((BLOCKS - 1) / BLOCKS * ((left - left.mean(axis=0)) ** 2).sum(axis=0))
            dark = math.sqrt(max(whole[1], 0.0))
            return CameraNoise(whole[0], float(std[0]), dark, float(std[1]) / max(2 * dark, 1e-3))
    return _dark_noise(capture, stripes)


def _repeated(capture: Capture) -> list[tuple[int, int]]:
    """Return pairs of successive laser images at the same place and exposure."""
    lit = np.flatnonzero(capture.laser_on & capture.has_image)
    same = [
        (int(a), int(b))
        for a, b in zip(lit[:-1], lit[1:], strict=True)
        if capture.stage_mm[a] == capture.stage_mm[b] and capture.exposure_ms[a] == capture.exposure_ms[b]
    ]
    return [pair for number, pair in enumerate(same) if number % 2 == 0 or pair[0] != same[number - 1][1]]


def _bin_variance(mean: np.ndarray, variance: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the number, and the sums of means and of variances, (3, B) of pixels in bins of their mean."""
    cell = np.digitize(mean, edges) - 1
    held = (cell >= 0) & (cell < len(edges) - 1)
    sums = [np.bincount(cell[held], weight, len(edges) - 1) for weight in (None, mean[held], variance[held])]
    return np.array(sums, dtype=float)


def _fit_transfer(counted: np.ndarray, background_dn: float) -> tuple[float, float] | None:
    """Return gain and variance in the dark, without rounding, by weighted least squares; None if undetermined."""
    count, means, variances = counted
    held = count > 50
    if np.count_nonzero(held) < 4:
        return None
    mean, variance = means[held] / count[held] - background_dn, variances[held] / count[held]
    # The variance of a variance from pairs is twice its square.
    root = np.sqrt(count[held]) / np.maximum(variance, 1e-3)
    design = np.column_stack([mean, np.ones_like(mean)])
    gain, dark = np.linalg.lstsq(design * root[:, None], variance * root, rcond=None)[0]
    return float(gain), float(dark) - 1.0 / 12.0


def _dark_noise(capture: Capture, stripes: CaptureStripes) -> CameraNoise:
    along = capture.header.sensor.camera.stripe_along
    lit = np.flatnonzero(capture.laser_on & capture.has_image)
    found = []
    before: np.ndarray | None = None
    for frame in lit.tolist():
        image = capture.image(frame).astype(np.float32)
        profiles = image if along == "height" else image.T
        own = stripes.frame == frame
        values = np.full_like(profiles, np.nan)
        near = np.abs(np.arange(profiles.shape[1]) - stripes.centre_px[own][:, None]) <= TAIL_PX
        line = stripes.line[own]
        values[line] = np.where(near, np.nan, profiles[line])
        if before is not None:
            difference = (values - before)[np.isfinite(values) & np.isfinite(before)]
            if difference.size > 100:
                limit = 5 * max(float(np.quantile(np.abs(difference), 0.683)), 1.0)
                found.append(0.5 * float(np.var(difference[np.abs(difference) < limit])))
        before = values
    if not found:
        return CameraNoise(None, None, math.nan, math.nan)
    dark = math.sqrt(max(float(np.mean(found)) - 1.0 / 12.0, 0.0))
    spread = float(np.std(found)) / math.sqrt(len(found)) if len(found) > 1 else float(found[0])
    return CameraNoise(None, None, dark, spread / max(2 * dark, 1e-3))
