"""Fit of laser power, water, sheet and noise to the images of a scan, with uncertainties by the jackknife."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from uwlts.errors import CalibrationError, CaptureError, DescriptionError
from uwlts.files.reading import log_warnings
from uwlts.fitting.least_squares import fit_biweight, robust_std
from uwlts.fitting.propagation import jackknife
from uwlts.model.calibration import Calibration, calibration_digest
from uwlts.model.media import water_absorption_per_m
from uwlts.model.phase_functions import FournierForand, HenyeyGreenstein, PetzoldAverage, PhaseFunction
from uwlts.model.sensor import CaptureHeader
from uwlts.optics.fitness import check_fits
from uwlts.radiometry.followed_sensor import follow_sensor, outlook
from uwlts.radiometry.result import ImageEstimate, PartFit, Radiometry
from uwlts.radiometry.stripe_images import (
    BLOCKS,
    GROUP_LINES,
    TAIL_FIRST_PX,
    TAIL_PX,
    StripeImages,
    fill_gaps,
    fit_sigma,
    measure_noise,
    measure_stripes,
)
from uwlts.radiometry.stripe_light import STEP_PX, HaloKernel, StripeLight, defocus_variance, stripe_light
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import resolve_calibration
from uwlts.storage.capture import NO_STAGE, Capture, describe_source, open_capture
from uwlts.stripe import StripeSettings, find_stripes

_MOST_SCATTERING_PER_M = 6.0
"""Limit of the scattering coefficient, far beyond water in which a stripe is found at 0.5 m."""
_SCATTERING_NODES = 25  # of an interpolated table; the halo is nearly linear in the coefficient
_INSEPARABLE = 0.9
"""Absolute correlation of two estimates from which they are listed as not separable."""
_KNOWN_ATTENUATION = 0.3
"""Standard uncertainty of the attenuation in 1/m from which the described water is kept: over 0.7 m of path, the laser
power then changes by a fifth."""
_ROUNDS = 3  # between tail and brightness, which depend little on each other
_OTHER_PHASES = (
    HenyeyGreenstein(0.85), HenyeyGreenstein(0.95), FournierForand(1.0563, 3.3), FournierForand(1.1488, 3.9)
)  # fmt: skip
"""Phase functions at the ends of what particles in natural water have: mean cosines of 0.85 to 0.95, and slopes with
indices coupled by Mobley, Sundman and Boss (2002). The images rarely show which one it is."""
_SCATTERING_STD = 0.04
"""Relative standard uncertainty of the scattering coefficient by the model of the halo, for a known phase function. It
was chosen on the captures 0 to 11 of docs/studies/radiometry.py, and judged on others."""
_WIDTH_STD, _WIDTH_BY_HALO = 0.01, 0.05
"""Relative standard uncertainty of the sheet's radius by the neglected light that is scattered by less than a pixel: a
part, and one for each scattering length of path, chosen on seeds 0 to 9 of docs/studies/radiometry_faults.py."""
_WIDTH_BY_SURFACE, _POWER_BY_SURFACE = 0.2, 0.07
"""Relative standard uncertainties by light that enters a surface by up to 0.4 mm, which no halo shows: the sheet seems
up to 40 % thicker, the stripe up to 13 % darker (seeds 2600 to 2605 of the same study)."""
_LEAST_SIGMA_PX = 0.5
"""Least standard deviation of the sheet in the image for which its radius is separable from pixel and blur."""
_CELL_PX = 6  # of the tail, whose mean residuals are judged; the halo falls by a third there at most
_GRAINS, _LIGHT_MISFIT = 2.0, 0.03
"""Largest scatter of the light along the stripe: in that of its grains, and relative for normals and noise. Without
faults it is 1.4 times that of the grains at most (docs/studies/radiometry.py, seeds 300 to 307; judged on 500 on)."""
_HALO_MISFIT = 0.05
"""Largest rms of residuals beside the stripe, in the brightest light there; twice the largest on the same captures."""
_MOST_COLOUR_PER_M, _COLOUR_PER_NM = 39.0, 0.014
"""Absorption at 380 nm beyond that of water, and its decrease. The brownest of 20 Finnish and Estonian lakes has 19.5/m
(Sipelgas et al. 2003, Hydrology Research 34:361); twice as much leaves room for particles. At 635 nm it is 1.1/m."""
_SIGNIFICANT = 3.0  # standard uncertainties beyond the absorption of natural water: one of 740 by chance
_FAN_STD = 0.1
"""Standard uncertainty of the described power along the fan, relative, at its edges: line lasers are specified so."""


def fit_radiometry(
    capture: Capture | str | Path,
    calibration: Calibration | str | Path,
    *,
    reflectance: float = 0.8,
    repeats: Capture | str | Path | None = None,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> Radiometry:
    """Fit light, water and noise to what the images of a scan show, and describe the sensor with these values.

    The calibration gives each stripe centre's point, its paths in the water and the slope of the surface. The fall of
    the stripe's brightness with the path gives the attenuation, its halo the scattering, its width the thickness of the
    sheet. The surface is assumed matt (Lambert) with one reflectance. Standard uncertainties are by the jackknife over
    blocks of the scan.

    Parameters
    ----------
    capture : Capture or path
        Scan by a stage of a smooth, matt surface; one that extends over depth, such as an inclined plate, separates
        attenuation and laser power.
    calibration : Calibration or path
        Calibration of the sensor (uwlts calibrate).
    reflectance : float
        Diffuse reflectance of the surface. Images show only its product with the laser's power.
    repeats : Capture or path, optional
        Laser images that were repeated at one position and exposure, for the camera's gain; by default those in the
        scan, if there are any.
    stripe : StripeOptions or dict, optional
        As for `reconstruct`.
    progress : callable, optional
        Called after each image with the number of images done and the total number.

    Returns
    -------
    Radiometry
        Estimates with standard uncertainties and correlations, quantities that the images do not separate, the outlook
        for the operator, and the description of the sensor.

    Raises
    ------
    CaptureError, CalibrationError
        A file cannot be read; calibration and capture do not fit; the capture has free poses, images at too
        few positions, or too few stripe centres.
    DescriptionError
        The reflectance is not above 0 and up to 1.

    Examples
    --------
    >>> found = uwlts.fit_radiometry("wall.h5", "calibration.json")
    >>> found.save("today.json")
    """
    if not 0 < reflectance <= 1:
        raise DescriptionError(f"reflectance is {reflectance:g}; expected a number above 0 and up to 1")
    known = resolve_calibration(calibration)
    if not isinstance(known, Calibration):
        raise CalibrationError("a calibration by polynomials has no paths of the light: give one by models")
    with open_capture(capture) as scan:
        check_fits(scan.header, known, source=scan.path.name)
        if np.isfinite(scan.pose).any() or scan.header.provenance.get("stage") == NO_STAGE:
            raise CaptureError(
                f"{scan.path.name} has poses of a platform or of a target; the slope of the surface is found from the "
                "steps of a stage: give a scan by a stage"
            )
        if (response := scan.header.provenance.get("response")) is not None:
            log_warnings(scan.path.name, [f"the response of its images is {response}; what follows needs it"])
        stripes = fill_gaps(find_stripes(scan, options=stripe, progress=progress))
        light = stripe_light(scan.header, known, stripes, scan.stage_mm)
        images = measure_stripes(scan, stripes, light.usable, progress)
        evidence, *others = (
            _Evidence.gather(scan.header, known, light, images, phase)
            for phase in (_choose_phase(scan.header), *_OTHER_PHASES)
        )
        whole, covariance = evidence.estimate_with_covariance()
        separated = math.sqrt(covariance[1, 1]) < _KNOWN_ATTENUATION
        with nullcontext() if repeats is None else open_capture(repeats) as again:
            noise = measure_noise(scan if again is None else again)
        parts = (
            *evidence.judge(whole, covariance, _bound_natural_absorption(scan.header)),
            *([] if noise is None else [noise.fit]),
        )
        # With another phase function the absorption may seem unnatural: that is said, too.
        covariance = covariance + evidence.spread(whole, others)
        doubtful = {name for part in parts if part.misfit > 1 for name in part.names}
        log_warnings(scan.path.name, [f"the fit of its {part.line()}" for part in parts if part.misfit > 1])
        determined = separated and "attenuation_per_m" not in doubtful
        described = 1e3 * scan.header.medium.extinction_per_mm(scan.header.sensor.laser.wavelength_nm)
        if not determined:
            doubtful.add("attenuation_per_m")
            free, free_variance = whole[1], covariance[1, 1]
            whole, covariance = evidence.estimate_with_covariance(described)
            covariance += evidence.spread(whole, others, described)
            whole[1], covariance[1, 1] = free, free_variance
        found = list(zip(_NAMES, whole.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True))
        if noise is not None:
            found.append(("dark_noise_dn", noise.dark_dn, noise.dark_std))
            found.append(("gain_dn_per_e", noise.gain, noise.gain_std))
        estimates = tuple(
            ImageEstimate(name, value, std, *_TEXTS[name], name not in doubtful)
            for name, value, std in found
            if math.isfinite(value)
        )
        std = np.sqrt(np.diag(covariance))
        scale = np.where(std > 0, std, 1.0)
        correlation = covariance / np.outer(scale, scale)
        by_name = {estimate.name: estimate for estimate in estimates}
        sensor = follow_sensor(
            scan.header,
            known,
            {name: each.value for name, each in by_name.items() if each.determined},
            reflectance=reflectance,
            sheet_distance_mm=evidence.distance_mm,
            attenuation_per_m=whole[1] if determined else described,
            dark_e=evidence.dark_e,
            exposure_ms=float(np.median(images.exposure_ms)),
        )
        return Radiometry(
            date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            sensor=sensor,
            medium_name=scan.header.medium_name,
            reflectance=reflectance,
            estimates=estimates,
            correlation=correlation,
            parts=parts,
            not_separable=_find_inseparable(correlation, by_name, determined, described, float(np.ptp(evidence.paths))),
            outlook=outlook(scan.header, known, by_name, images, determined=determined),
            sources={
                "capture": describe_source(scan).model_dump(mode="json"),
                "calibration": calibration_digest(known),
            },
            path_mm=(float(evidence.paths.min()), float(evidence.paths.max())),
        )


_TEXTS = {
    "power_reflectance_mw": ("mW", "laser power times exposure scale times reflectance"),
    "attenuation_per_m": ("1/m", "beam attenuation of the water"),
    "scattering_per_m": ("1/m", "scattering by the water, for the described phase function"),
    "sheet_radius_mm": ("mm", "1/e² radius of the sheet at the surface"),
    "background_dn": ("DN", "grey value without the stripe, with daylight"),
    "stripe_sigma_px": ("px", "standard deviation of the stripe across, with blur"),
    "grain_contrast": ("", "contrast of the stripe's light along it"),
    "grain_length_lines": ("lines", "correlation length of this light along the stripe"),
    "fan_slope": ("", "relative change of the fan's power from its middle to its edge, odd part"),
    "fan_curvature": ("", "the same, even part"),
    "dark_noise_dn": ("DN", "noise of a pixel in the dark: read-out and dark current"),
    "gain_dn_per_e": ("DN/e", "gain of the camera"),
}
_NAMES = tuple(_TEXTS)[:10]


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Measured light of all groups and blocks, and the tables of halos for each block."""

    images: StripeImages
    sheet_per_px: np.ndarray
    blur_var: np.ndarray
    model: np.ndarray
    fan: np.ndarray
    paths: np.ndarray
    distance_mm: float
    path_mm: float
    dark_e: float
    tails: CubicSpline
    within: CubicSpline

    @classmethod
    def gather(
        cls,
        header: CaptureHeader,
        calibration: Calibration,
        light: StripeLight,
        images: StripeImages,
        phase: PhaseFunction,
    ) -> _Evidence:
        """Average the geometry over groups, and tabulate the halo of every block over the scattering coefficient."""
        held = images.of_group >= 0

        def mean(values: np.ndarray) -> np.ndarray:
            return _average_groups(images.of_group[held], values[held])

        mean_of_block = partial(_average_groups, images.block)
        sheet, ray = mean(light.sheet_per_px), mean(light.ray_per_px)
        to_laser, to_camera = mean(light.laser_path_mm), mean(light.camera_path_mm)
        index = calibration.medium_index(header.medium)
        blur = defocus_variance(header.sensor, calibration, mean(light.depth_mm), medium_index=index)
        sheet_of_block = mean_of_block(sheet)
        nodes = np.concatenate([[0.0], np.geomspace(1e-2, _MOST_SCATTERING_PER_M, _SCATTERING_NODES - 1)])
        core = images.width // 2
        tails, within = [], []
        of_block = map(mean_of_block, (ray, to_laser, to_camera))
        for of_sheet, seen, first, second in zip(sheet_of_block, *of_block, strict=True):
            kernel = HaloKernel(phase.per_sr, ((first, of_sheet), (second, seen)))
            middle = int(np.argmin(np.abs(kernel.place_px)))
            step = round(1 / STEP_PX)
            rows = [kernel.profile(1e-3 * b, sigma_px=1.0) for b in nodes]
            tails.append([row[middle + step :: step][:TAIL_PX] for row in rows])
            reach = round((core + 0.5) / STEP_PX)
            within.append([STEP_PX * row[middle - reach : middle + reach + 1].sum() for row in rows])
        detector = header.sensor.detector
        return cls(
            images=images,
            sheet_per_px=sheet_of_block,
            blur_var=mean_of_block(blur),
            model=images.exposure_ms * mean(light.grey_per_mw),
            fan=mean(light.fan_angle),
            paths=to_laser + to_camera,
            distance_mm=float(np.mean(mean(light.distance_mm))),
            path_mm=float(np.mean(to_laser + to_camera)),
            dark_e=1e-3
            * float(np.median(images.exposure_ms))
            * detector.dark_current_e_per_s
            * detector.dark_current_growth(),
            tails=CubicSpline(nodes, np.array(tails), axis=1),
            within=CubicSpline(nodes, np.array(within), axis=1),
        )

    def spread(
        self, whole: np.ndarray, others: Sequence[_Evidence], attenuation_per_m: float | None = None
    ) -> np.ndarray:
        """Return the mean square of the changes of the estimates ``whole`` with other phase functions."""
        changes = np.array([each.estimate(np.ones(BLOCKS, bool), attenuation_per_m) for each in others]) - whole
        return changes.T @ changes / len(changes)

    def estimate_with_covariance(self, attenuation_per_m: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the estimates in the order of `_NAMES`, and their covariance; with a given attenuation, if any.

        The covariance is that of the jackknife over the blocks, of the described profile of the fan, and of the model.
        """
        every = np.ones(BLOCKS, bool)
        whole = self.estimate(every, attenuation_per_m)
        left = np.array([self.estimate(np.arange(BLOCKS) != j, attenuation_per_m) for j in range(BLOCKS)])
        covariance = jackknife(left - left.mean(axis=0))
        for fan in np.eye(2):
            moved = self.estimate(every, attenuation_per_m, fan=_FAN_STD * fan) - whole
            covariance += np.outer(moved, moved)
        wider = math.hypot(_WIDTH_STD, _WIDTH_BY_SURFACE, _WIDTH_BY_HALO * 1e-3 * self.path_mm * whole[2])
        # In the order of `_NAMES`: power, attenuation, scattering, sheet.
        model = np.pad([_POWER_BY_SURFACE, 0.0, _SCATTERING_STD, wider], (0, len(_NAMES) - 4))
        covariance += np.diag((model * whole) ** 2)
        return whole, covariance

    def estimate(
        self, kept: np.ndarray, attenuation_per_m: float | None = None, fan: Sequence[float] | np.ndarray = (0.0, 0.0)
    ) -> np.ndarray:
        """Return the estimates from some blocks (BLOCKS,), for the fan's odd and even deviation from described."""
        images, some = self.images, kept[self.images.block]
        background, scattering = float(np.min(images.tail[kept])), 0.0
        for _ in range(_ROUNDS):
            scattering, background = self._fit_tail(kept, background)
        design, bright = self._make_brightness_equations(scattering, background)
        rest, weight = _fit_robustly(design[some], bright[some])
        root = np.sqrt(weight)
        # Rows for what is known: the attenuation if it is given, and the fan's described power.
        known = np.diag([0.0 if attenuation_per_m is None else 1e6, 1 / _FAN_STD, 1 / _FAN_STD])
        scale = max(math.sqrt(np.average(rest**2, weights=weight)), 1e-6)
        rows = np.vstack([design[some] * root[:, None] / scale, np.pad(known, ((0, 0), (1, 0)))])
        sides = np.append(bright[some] * root / scale, known @ [attenuation_per_m or 0.0, *fan])
        level, attenuation, slope, curve = np.linalg.lstsq(rows, sides, rcond=None)[0]
        power = math.exp(level + attenuation * 1e-3 * self.path_mm)
        sigma = np.array([fit_sigma(images.fine_px, profile) for profile in images.fine[kept]])
        radius = 2 * self.sheet_per_px[kept] * np.sqrt(np.maximum(sigma**2 - self.blur_var[kept], 0.0))
        grain = images.grain[kept].mean(axis=0)
        rho = grain / grain[0]
        ends = np.flatnonzero(rho <= 0)
        length = 1 + 2 * float(rho[1 : ends[0] if len(ends) else None].sum())
        return np.array([
            power, attenuation, scattering, float(np.mean(radius)), background,
            float(np.mean(sigma)), math.sqrt(max(grain[0], 0.0)), length, slope, curve,
        ])  # fmt: skip

    def _make_brightness_equations(self, scattering: float, background: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the design matrix (M, 4) of level, path and fan, and the logarithm (M,) of the light to explain."""
        images, path_m = self.images, 1e-3 * (self.paths - self.path_mm)
        light = np.maximum(images.light - images.width * background, 1e-3)
        design = np.column_stack([np.ones_like(path_m), -path_m, self.fan, self.fan**2 - 1 / 3])
        return design, np.log(light / (self.model * self.within(scattering)[images.block]))

    def _compute_halo(self, scattering: float, background: float) -> np.ndarray:
        """Return the grey values (BLOCKS, TAIL_PX) of the halo."""
        images = self.images
        light = _average_groups(images.block, images.light - images.width * background)
        return self.tails(scattering) * (light / self.within(scattering))[:, None]

    def _fit_tail(self, kept: np.ndarray, background: float) -> tuple[float, float]:
        """Return the scattering coefficient in 1/m, and the grey value of the background, from the tails.

        ``background`` is a first value, for the light of the stripe.
        """
        first = max(self.images.width // 2, TAIL_FIRST_PX)
        tail, count = self.images.tail[kept, first:], self.images.tail_count[kept, first:]

        def background_and_misfit(b: float) -> tuple[float, float]:
            rest = tail - self._compute_halo(b, background)[kept, first:]
            level = float(np.sum(count * rest) / np.sum(count))
            return level, float(np.sum(count * (rest - level) ** 2))

        found: Any = minimize_scalar(
            lambda b: background_and_misfit(b)[1], bounds=(0.0, _MOST_SCATTERING_PER_M), method="bounded",
            options={"xatol": 1e-5},
        )  # fmt: skip
        return float(found.x), background_and_misfit(float(found.x))[0]

    def judge(self, whole: np.ndarray, covariance: np.ndarray, natural: tuple[float, float]) -> tuple[PartFit, ...]:
        """Judge the fit of light along the stripe, halo and background, and the absorption, for `_NAMES`."""
        value = dict(zip(_NAMES, whole.tolist(), strict=True))
        fitted = value["scattering_per_m"], value["background_dn"]
        rest = _fit_robustly(*self._make_brightness_equations(*fitted))[0]
        # A pattern along the fan is the laser's: it repeats in all images.
        cell = np.argsort(np.argsort(self.fan)) // BLOCKS
        scatter = robust_std(rest - _average_groups(cell, rest)[cell])
        grain = value["grain_contrast"] * math.sqrt(value["grain_length_lines"] / GROUP_LINES)
        first = max(self.images.width // 2, TAIL_FIRST_PX)
        halo = self._compute_halo(*fitted)[:, first:]
        beside = self.images.tail[:, first:] - fitted[1] - halo
        between = robust_std(np.diff(beside, axis=1))  # neighbouring pixels: noise, times the root of two
        cells = np.array([part.mean(axis=1) for part in np.array_split(beside, halo.shape[1] // _CELL_PX, axis=1)])
        level, brightest = cells.mean(axis=0), float(halo[:, 0].mean())
        by_noise = between / np.sqrt([_CELL_PX, halo.shape[1]])
        most_of_shape, most_of_level = np.hypot(_HALO_MISFIT * brightest, by_noise).tolist()
        less = (np.array(_NAMES) == "attenuation_per_m") - 1.0 * (np.array(_NAMES) == "scattering_per_m")
        absorption, (least, most) = less @ whole, natural
        shape_dn, level_dn = float(np.std(cells - level)), float(np.std(level))
        return (
            PartFit(
                "light along the stripe",
                scatter / math.hypot(_GRAINS * grain, _LIGHT_MISFIT),
                f"it scatters by {100 * scatter:.2g} %, its grains by {100 * grain:.2g} %; mottle, print or dirt?",
                ("power_reflectance_mw", "attenuation_per_m", "fan_slope", "fan_curvature"),
            ),
            PartFit(
                "halo beside the stripe",
                shape_dn / most_of_shape,
                f"{shape_dn:.3g} DN beside the model, of {brightest:.3g} DN; translucent surface or daylight?",
                ("power_reflectance_mw", "attenuation_per_m", "scattering_per_m", "sheet_radius_mm", "background_dn"),
            ),
            PartFit(
                "background over the scan",
                level_dn / most_of_level,
                f"it differs by {level_dn:.3g} DN between parts of the scan; daylight?",
                ("scattering_per_m", "background_dn"),
            ),
            PartFit(
                "absorption of the water",
                max(least - absorption, absorption - most, 0.0) / (_SIGNIFICANT * math.sqrt(less @ covariance @ less)),
                f"attenuation less scattering is {absorption:.2g}/m, in natural water {least:.2g} to {most:.2g}/m; "
                "translucent surface, or another reflectance with the path?",
                ("power_reflectance_mw", "attenuation_per_m", "scattering_per_m", "background_dn"),
            ),
        )


def _average_groups(group: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the mean (G,) of the values (N,) of each group; ``group`` (N,) numbers those of the values."""
    return np.bincount(group, values) / np.bincount(group)


def _choose_phase(header: CaptureHeader) -> PhaseFunction:
    """Return the phase function of the medium's particles; Petzold's average particle if none are described."""
    scatterers = header.medium.scatterers(header.sensor.laser.wavelength_nm)
    particles = [each.phase for each in scatterers if each.phase.name != "molecular"]
    return particles[-1] if particles else PetzoldAverage()


def _bound_natural_absorption(header: CaptureHeader) -> tuple[float, float]:
    """Return the least and largest absorption of natural water, 1/m; of a medium with a described absorption, any."""
    if header.medium.kind not in ("fresh", "sea") or header.medium.absorption_per_m is not None:
        return 0.0, math.inf
    pure = water_absorption_per_m(wavelength_nm=header.sensor.laser.wavelength_nm)
    return pure, pure + _MOST_COLOUR_PER_M * math.exp(-_COLOUR_PER_NM * (header.sensor.laser.wavelength_nm - 380.0))


def _fit_robustly(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals and weights of a linear fit, by which edges, prints or scratches count less."""
    rows, weight = fit_biweight(design, values, np.ones(len(values), bool))
    return values - design @ (rows @ values), weight


def _find_inseparable(
    correlation: np.ndarray, by_name: dict[str, ImageEstimate], determined: bool, described: float, range_mm: float
) -> tuple[str, ...]:
    """Return the quantities that the images do not separate, as text."""
    found = ["laser power, exposure scale, transmission of lens and windows, and reflectance: only their product"]
    attenuation = by_name["attenuation_per_m"]
    if not determined:
        found.append(
            f"attenuation and laser power: the paths differ too little (attenuation ±{attenuation.std:.2g}/m); the "
            f"description keeps {described:.3g}/m, with the power that gives the observed brightness; scan a surface "
            "that extends over more depth"
        )
    else:
        found.append(
            "attenuation and a reflectance that changes with the path: 10 % over the scan change the attenuation by "
            f"{100 / range_mm:.2g}/m"
        )
    for i, j in zip(*np.triu_indices(len(_NAMES), 1), strict=True):
        if abs(correlation[i, j]) > _INSEPARABLE:
            a, b = (_TEXTS[_NAMES[k]][1] for k in (i, j))
            found.append(f"{a}, and {b}: correlated by {correlation[i, j]:.2f}")
    scattering = by_name["scattering_per_m"]
    if scattering.value < 2 * scattering.std:
        most = scattering.value + 2 * scattering.std
        found.append(f"scattering and none: below {most:.2g}/m no halo is seen beside the stripe")
    if "gain_dn_per_e" not in by_name:
        found.append("gain, noise in the dark and speckle: repeat laser images at one position and exposure")
    if by_name["stripe_sigma_px"].value < _LEAST_SIGMA_PX:
        found.append("radius of the sheet and pixel: the stripe is narrower than a pixel, and the radius is its limit")
    return tuple(found)
