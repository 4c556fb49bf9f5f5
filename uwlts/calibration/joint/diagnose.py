"""Contradictions in a joint estimate, from its residuals: images, values and parts of the description."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import assert_never

import numpy as np
from scipy import special

from uwlts.calibration.joint.estimate import UNSETTLED, Estimate, Evidence, outliers
from uwlts.calibration.joint.gathering import USUAL_DISTORTION
from uwlts.calibration.joint.residuals import BENDS, SHIFT, STRETCH, TARGET, Residuals, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import SLOPES, SurfaceScanEvidence
from uwlts.fitting.least_squares import robust_std
from uwlts.model.parameter_keys import (
    LensParameter,
    MediumIndex,
    ParameterKey,
    ParameterLabel,
    SheetParameter,
    SingleParameter,
    StageParameter,
    StepHeight,
    TargetParameter,
    WindowParameter,
)
from uwlts.model.sensor import Sensor

_CHECK: dict[SingleParameter, str] = {
    WindowParameter.DISTANCE: "camera.window.distance_mm or uncertainty.window_distance_mm",
    WindowParameter.SLOPE_X: "the window's tilts or uncertainty.window_tilt_deg",
    WindowParameter.SLOPE_Y: "the window's tilts or uncertainty.window_tilt_deg",
    WindowParameter.THICKNESS: "camera.window: thickness_mm and mounted",
    WindowParameter.GLASS_INDEX: "camera.window.glass",
    SheetParameter.BOW: "the target's flatness, the laser, or uncertainty.bow_deg",
    SheetParameter.WINDOW_TURN: "the medium, or uncertainty.laser_window_tilt_deg",
    **dict.fromkeys(SLOPES, "stage_direction in the captures, or uncertainty.stage_alignment_deg"),
    **dict.fromkeys(BENDS, "the target's flatness, or uncertainty.target_bow_mm"),
    **dict.fromkeys(STRETCH, "the target's spacings, or uncertainty.target_stretch"),
    **dict.fromkeys((LensParameter.F, LensParameter.FX, LensParameter.FY), "the target's spacing, lens and focus"),
    **dict.fromkeys((LensParameter.P1, LensParameter.P2), "the lens, or uncertainty.tangential"),
}
"""Entries to check for the parameters with prior knowledge."""


def format_deviation(key: ParameterKey, value: float, known: float, std: float, *, sigmas: float) -> str:
    """Describe the deviation of a parameter, estimated from images only, from its prior value, with advice."""
    match key:
        case StageParameter.SCALE:
            return (
                f"the stage moves {1 + value:.5g} mm per mm of its positions, stated 1 +- {std:g} ({sigmas:.1f} "
                "standard uncertainties off): check the target's spacing and the stage's scale"
            )
        case MediumIndex():
            check = "the medium and the step's height in the captures, or `index`"
        case StepHeight():
            check = "which standard it is"
            if value > known:
                turn = np.degrees(np.arccos(known / value))
                check += (
                    f", and whether it faces the laser: a rotation by {turn:.1f}° about the stripe explains the height"
                )
        case LensParameter() | WindowParameter() | SheetParameter() | StageParameter() | TargetParameter():
            check = _CHECK.get(key, "the known camera")
        case _:
            assert_never(key)
    quantity = key.quantity
    return (
        f"{quantity.words} found {quantity.format_value(value, std)}, described as "
        f"{quantity.format_with_std(known, std)} ({sigmas:.1f} standard uncertainties off): check {check}"
    )


_LARGEST_TARGET_PX = 0.5
"""Scatter beyond which target points are misdetected or contradict each other, in every image."""
_LARGEST_STRIPE_PX = 1.0  # the same for stripes
_FEWEST_VALUES = 20  # residuals of an image: fewer give no reliable scatter
_OVER_OTHERS = 3.0  # times the scatter of other images, more than differences in sharpness and light explain
_OVER_OTHERS_PX = 0.15  # the same in px, if the others have little scatter; the larger limit applies
_OVER_NOISE = 2.5
"""Factor of the noise from an image's fine structure, which correlation can make up to twice too small."""
_WAVES_DOUBTFUL = 8.0
"""Correlated lines for a doubt: the filter that finds the stripe, and speckle, correlate 2 to 4."""
_WAVES_WRONG = 20.0  # correlated lines from which the model is incomplete
_OUTLIER_SHARE = 0.2  # fraction of outliers above which the images contain another structure
DOUBTFUL = 4.0
"""Standard uncertainties from the prior value for a doubt: one normal error in 16,000 is larger."""
_WRONG = 6.0
"""The same for a contradiction: design values are rough, so that smaller deviations are only doubts."""
_LEAST_GAIN = 0.02  # information gain, relative to the prior standard uncertainty, above rounding errors
_MUCH_GAINED = 0.5  # the same from which a parameter is included in Birge's ratio
_FALSE_ALARM = 1e-3  # probability that correct prior uncertainties are enlarged by Birge's ratio
_FEWEST_GAINED = 6  # parameters that Birge's ratio needs: six determine it to 30 %
_ROUGH_SIZE = 2e-3  # usual relative error of sizes that are stated without an uncertainty
_ALIKE = 3.0  # standard uncertainties within which sizes have the same relative error
_FOCAL_DOUBTFUL = 0.08
"""Relative error of the focal length for a doubt: lens names are rounded, and near focus lengthens it."""
_FOCAL_WRONG = 0.2  # the same for a contradiction
_POSITIONS_WRONG = 3.0
"""Rms position error of the stage divided by its stated uncertainty: four positions exceed it once in a million."""
_FEWEST_POSITIONS = 4  # for which the limit above holds
NOTICED = 3.0  # standard uncertainties: a parameter wrongly considered less certain loses little
_MOST_NAMED = 4  # findings of a kind that a message lists
_MOST_SAID = 6  # findings in a readable message


@dataclass(frozen=True)
class Findings:
    """Messages on what contradicts an estimate.

    ``contradictions`` are those of prior knowledge, and make the estimate useless. ``unfit`` maps the sources of images
    that contradict all others to messages. ``misfits`` are kinds of residuals with a systematic misfit. Doubts are
    everything else. ``stretch`` is the target's stretch from the evidence alone if it differs from the prior; pixels of
    another aspect ratio have the same effect. ``form`` says whether the target's form or size differs from the prior,
    as a wrong lens also makes it appear. ``judged`` doubts enlarged uncertainties, by ``enlarged`` all.
    """

    contradictions: list[str]
    unfit: dict[str, str]
    misfits: dict[str, str]
    doubts: list[str]
    stretch: dict[ParameterKey, float] = field(default_factory=dict)
    form: bool = False
    judged: tuple[str, ...] = ()
    enlarged: float = 1.0

    def all_against(self) -> list[str]:
        """Return all messages except doubts."""
        return [*self.contradictions, *_shorten_list(self.unfit.values()), *self.misfits.values()]

    def refusal(self) -> str:
        """Return an error message with the most severe findings."""
        every = self.all_against()
        more = len(every) - _MOST_SAID
        text = "; ".join(every[:_MOST_SAID])
        return f"the evidence contradicts itself: {text}" + (f"; and {more} more contradictions" if more > 0 else "")


_Found = Iterator[tuple[bool, str]]
"""Messages on an estimate, each with a flag: True for a contradiction, False for a doubt."""


@dataclass(frozen=True)
class _Image:
    """Robust scatter of one kind of residual in one image, and its fine-structure noise, independent of parameters."""

    source: str
    kind: str
    peers: tuple[str, object]
    scatter_px: float
    noise_px: float

    @classmethod
    def from_residuals(cls, residuals: Residuals, evidence: Evidence) -> "_Image":
        values = residuals.values
        scatter = robust_std(values)
        # A wrong model has the same effect on neighbouring points or lines.
        steps = np.diff(values.reshape(-1, 2 if residuals.kind == TARGET else 1), axis=0)
        noise = robust_std(steps) / np.sqrt(2.0) if len(steps) else scatter
        source, kind = evidence.sources[residuals.image], residuals.kind
        return cls(source, kind, (kind, evidence.view), scatter, noise)

    def largest_px(self) -> float:
        """Return the scatter that is too large for this kind, independent of the noise."""
        return _LARGEST_TARGET_PX if self.kind == TARGET else _LARGEST_STRIPE_PX


def check_consistency(result: Estimate, evidence: Sequence[Evidence], *, sensor: Sensor) -> Findings:
    """Check an estimate against its evidence and the sensor's description."""
    images = [
        _Image.from_residuals(residuals, piece)
        for piece, parts in zip(evidence, result.residuals, strict=True)
        for residuals in parts
        if len(residuals.values) >= _FEWEST_VALUES
    ]
    known = [*((each.wrong(), each.words()) for each in deviations(result)), *_check_stage(result, evidence, sensor)]
    lens = [*_check_lens(result, sensor)]
    earlier = [] if any(wrong for wrong, _ in known + lens) else [*_check_earlier(result)]
    unfit, noisy = _check_images(images)
    misfits, waves = _check_kinds(images), [*_check_correlations(result)]
    for wrong, kind, text in waves:
        if wrong:
            misfits[kind] = "; ".join(filter(None, [misfits.get(kind), text]))
    found = [*known, *earlier, *lens]
    doubts = [text for wrong, text in found if not wrong] + noisy
    doubts += [text for wrong, _, text in waves if not wrong]
    doubts += [
        f"{100 * share:.0f} % of the {kind} was left out as outliers: look at the images"
        for kind, share in find_excess_outliers(result).items()
    ]
    if result.stopped == UNSETTLED:
        doubts.append(f"{UNSETTLED}: some of the evidence contradicts the rest")
    return Findings([text for wrong, text in found if wrong], unfit, misfits, doubts)


@dataclass(frozen=True)
class Deviation:
    """Deviation of a parameter: its value from evidence ``alone``, and ``known`` before with uncertainty ``std``.

    ``gain`` is the information gain, relative to ``std``.
    """

    sigmas: float
    key: ParameterKey
    alone: float
    known: float
    std: float
    gain: float

    def wrong(self) -> bool:
        """Return whether it is a contradiction, not only a doubt."""
        return self.sigmas > _WRONG

    def words(self) -> str:
        """Describe the deviation and what to check."""
        return format_deviation(self.key, self.alone, self.known, self.std, sigmas=self.sigmas)


def deviations(result: Estimate, *, least: float = DOUBTFUL) -> list[Deviation]:
    """Return parameters that deviate from prior knowledge by at least ``least`` standard uncertainties, sorted.

    The stripe's shift on the target is excluded: images have little information on it, so that small model errors
    dominate. The size of k1 and k2 is that of usual lenses, and nothing that a lens contradicts.
    """
    parameters, covariance, found = result.parameters, result.covariance, []
    formal = covariance if result.formal_covariance is None else result.formal_covariance
    for key, value, known, std, after, exact in zip(
        parameters.keys,
        result.values,
        parameters.prior_mean(),
        parameters.prior_std(),
        np.diag(covariance),
        np.diag(formal),
        strict=True,
    ):
        if np.isfinite(std) and key not in (SHIFT, *USUAL_DISTORTION):
            # The estimate includes the prior, with the weight of the formal variance, in which tied parameters are
            # exact: this is the variance of their difference if both are right (for none tied, 1 - after / std^2).
            gain = float(np.sqrt(max(1.0 + (after - 2 * exact) / std**2, _LEAST_GAIN**2)))
            alone = known + (value - known) / gain**2
            found.append(Deviation(abs(value - known) / (gain * std), key, alone, known, std, gain))
    return sorted((each for each in found if each.sigmas >= least), key=lambda each: each.sigmas, reverse=True)


@dataclass(frozen=True)
class PriorDeviations:
    """Deviations of ``every`` parameter of an estimate (`deviations` with a limit of 0)."""

    every: list[Deviation]

    @cached_property
    def birge_ratio(self) -> float:
        """Factor of too small prior uncertainties of sensor, media and stage, at least 1.

        This is Birge's ratio, the RMS of deviations divided by standard uncertainties, if chance exceeds it less than
        once in a thousand calibrations.
        """
        gained = [d for d in self.every if d.gain > _MUCH_GAINED and not isinstance(d.key, TargetParameter)]
        squares = np.array([each.sigmas**2 for each in gained])
        if len(squares) < _FEWEST_GAINED or squares.sum() < special.chdtri(len(squares), _FALSE_ALARM):
            return 1.0
        return float(np.sqrt(squares.mean()))

    def of_target(self) -> list[Deviation]:
        """Return the deviations of the target's form and size."""
        return [each for each in self.every if isinstance(each.key, TargetParameter)]

    def form(self) -> list[Deviation]:
        """Return the noticeable deviations of the target's form and size."""
        return [each for each in self.of_target() if each.sigmas > NOTICED]

    def stretch(self) -> dict[ParameterKey, float]:
        """Return the target's stretch from the evidence alone if it is the cause of all deviations, else nothing.

        The largest deviation is taken as the cause: wrong spacings along both sides appear in the stage's scale.
        """
        if not any(each.key in STRETCH and each.sigmas > NOTICED for each in self.every[:1]):
            return {}
        return {each.key: each.alone for each in self.of_target() if each.key in STRETCH}

    def show_understated(self) -> bool:
        """Return whether stated uncertainties are too small, and no single other parameter is wrong."""
        others = (each for each in self.every if not isinstance(each.key, TargetParameter))
        return bool(self.form() or self.birge_ratio > 1.0) and not any(each.wrong() for each in others)


@dataclass(frozen=True)
class SizeDeviation:
    """Deviation ``off_mm`` of a scanned object's size from its description.

    ``std_mm`` is the stated standard uncertainty (infinite if unknown), ``off_std_mm`` that of the deviation.
    """

    scan: str
    quantity: ParameterLabel
    described_mm: float
    std_mm: float
    off_mm: float
    off_std_mm: float

    def sigmas(self) -> float:
        """Return the deviation in standard uncertainties."""
        return abs(self.off_mm) / self.off_std_mm

    def known(self) -> bool:
        """Return whether a standard uncertainty is stated."""
        return bool(np.isfinite(self.std_mm))

    def doubtful(self) -> bool:
        """Return whether a warning is due; without a stated uncertainty, only for large deviations."""
        return self.sigmas() > DOUBTFUL and (self.known() or abs(self.off_mm) > _ROUGH_SIZE * self.described_mm)

    def words(self) -> str:
        """Describe the deviation and what to check."""
        found = self.quantity.format_value(self.described_mm + self.off_mm, self.off_std_mm)
        described = f"{self.described_mm:g}{f' +- {self.std_mm:g}' if self.known() else ''} mm"
        return (
            f"{self.scan}: {self.quantity.words} found {found}, described as {described} ({self.off_mm:+.3f} mm or "
            f"{self.sigmas():.1f} standard uncertainties off): most likely it is described wrongly, check the artefact"
            + (", or give `unknown_sizes`" if self.known() else "; it was estimated")
        )


def compute_size_deviations(result: Estimate, evidence: Sequence[Evidence]) -> list[SizeDeviation]:
    """Compare the described sizes of scanned objects with those of an estimate without known sizes."""
    found = []
    for piece, local, covariance in zip(evidence, result.local, result.local_covariances, strict=True):
        if isinstance(piece, SurfaceScanEvidence):
            count = piece.surface.parameter_count
            sizes = piece.surface.sizes(local[:count])
            variance = np.einsum("ci,ij,cj->c", sizes.by_local, covariance[:count, :count], sizes.by_local)
            off_std = np.sqrt(variance + np.where(np.isfinite(sizes.std_mm), sizes.std_mm, 0.0) ** 2)
            figures = np.column_stack([sizes.described_mm, sizes.std_mm, sizes.off_mm, off_std]).tolist()
            named = zip(sizes.names, figures, strict=True)
            found += [SizeDeviation(piece.scan(), ParameterLabel(name, "mm"), *each) for name, each in named]
    return found


def describe_wrong_sizes(deviations: Sequence[SizeDeviation], *, least: float = _WRONG) -> list[str]:
    """Describe known sizes off by more than ``least`` standard uncertainties, largest first.

    If all known sizes have the same relative deviation, the scale of the calibration may be wrong instead.
    """
    known = [each for each in deviations if each.known()]
    far = sorted((each for each in known if each.sigmas() > least), key=SizeDeviation.sigmas, reverse=True)
    if not far:
        return []
    share, std = np.array([(each.off_mm, each.off_std_mm) for each in known]).T / [each.described_mm for each in known]
    common = float(np.sum(share / std**2) / np.sum(1 / std**2))
    texts = _shorten_list(each.words() for each in far)
    if len(known) > 1 and np.all(np.abs(share - common) < _ALIKE * std):
        texts.append(f"all known sizes are off by the same {100 * common:+.2f} %: also check the target's spacings")
    return texts


def _check_earlier(result: Estimate) -> _Found:
    """Describe the parameter with the largest change from an earlier calibration; others change with it."""
    earlier = result.parameters.earlier
    if earlier is None:
        return
    before, count = earlier.std(), len(earlier.values)
    gained = before**2 - np.diag(result.covariance)[:count]
    sigmas = np.abs(result.values[:count] - earlier.values) / np.sqrt(np.maximum(gained, (0.1 * before) ** 2))
    worst = int(np.argmax(sigmas))
    if sigmas[worst] > DOUBTFUL:
        quantity = result.parameters.keys[worst].quantity
        value, known, std = (float(each[worst]) for each in (result.values, earlier.values, before))
        yield (
            bool(sigmas[worst] > _WRONG),
            f"the new images contradict the earlier calibration by {sigmas[worst]:.1f} standard uncertainties, mostly "
            f"in the {quantity.words}: {quantity.format_value(value, std)} instead of "
            f"{quantity.format_with_std(known, std)}: check heights and media in the captures; if they are right, the "
            "sensor has changed: calibrate again",
        )


def _check_lens(result: Estimate, sensor: Sensor) -> _Found:
    """Compare the focal length with the lens's: errors of spacing, medium and stage can cancel in residuals."""
    camera, described = result.parameters.camera(result.values), sensor.camera.focal_length_px()
    off = abs(camera.fx_px / described - 1)
    if off > _FOCAL_DOUBTFUL:
        yield (
            off > _FOCAL_WRONG,
            f"the focal length is {camera.fx_px:.1f} px; expected {described:.1f} px from the description: check the "
            "target's spacing, the medium in the captures, and the lens",
        )


def _check_stage(result: Estimate, evidence: Sequence[Evidence], sensor: Sensor) -> _Found:
    """Compare directions and positions of the stage with its description."""
    alignment, std = sensor.uncertainty.stage_alignment_deg, sensor.uncertainty.stage_position_mm
    for piece, local in zip(evidence, result.local, strict=True):
        if not (isinstance(piece, TargetEvidence) and piece.staged):
            continue
        capture = next(iter(piece.sources.values())).split(", frame ")[0]
        tilt = float(np.degrees(np.arctan(np.hypot(*local[6:8]))))
        if tilt > _WRONG * alignment:
            yield (
                True,
                f"{capture}: the stage moves {tilt:.2g} deg off the target's normal; expected within "
                f"{alignment:g} deg (uncertainty.stage_alignment_deg)",
            )
        errors, images = local[8:], piece.images()
        if not len(errors):
            continue
        # The first position lacks an error parameter, so all others share its error.
        errors = errors - np.median(np.append(errors, 0.0))
        # A large error of one position distorts the camera parameters and so shifts the others.
        wrong = np.abs(errors) > _WRONG * max(std, robust_std(errors))
        rms = float(np.sqrt(np.mean(errors**2)))
        if 0 < wrong.sum() <= max(1, len(errors) // 4):
            stood = zip((piece.sources[image] for image in images[wrong]), errors[wrong], strict=True)
            stated = f"mm from its stated position (stated uncertainty {std:g} mm)"
            for text in _shorten_list(f"{source}: the stage was {error:+.3f} {stated}" for source, error in stood):
                yield True, text
        elif len(errors) >= _FEWEST_POSITIONS and rms > _POSITIONS_WRONG * std:
            yield (
                True,
                f"{capture}: the stage's positions scatter by {rms:.3f} mm, stated uncertainty {std:g} mm "
                "(uncertainty.stage_position_mm)",
            )


def _check_images(images: Sequence[_Image]) -> tuple[dict[str, str], list[str]]:
    """Find images that fit worse than similar ones: contradictions by source, and doubts for noisy images."""
    unfit: dict[str, str] = {}
    noisy: list[str] = []
    scatters: dict[object, list[float]] = {}
    for image in images:
        scatters.setdefault(image.peers, []).append(image.scatter_px)
    ordered = {peers: np.sort(values) for peers, values in scatters.items()}
    for image in images:
        # Of all images with the same peers, without this one.
        others = ordered[image.peers]
        others = np.delete(others, np.searchsorted(others, image.scatter_px))
        usual = float(np.median(others)) if len(others) else image.noise_px
        if image.scatter_px <= max(_OVER_OTHERS * usual, usual + _OVER_OTHERS_PX):
            continue
        shaped = image.scatter_px > _OVER_NOISE * image.noise_px
        than = f"in the other images {usual:.2f} px" if len(others) else f"its noise being {usual:.2f} px"
        text = f"{image.source}: the {image.kind} is {image.scatter_px:.2f} px off (rms), {than}"
        if shaped or image.scatter_px > image.largest_px():
            unfit.setdefault(image.source, text)
        else:
            noisy.append(text)
    return unfit, _shorten_list(noisy)


def _check_kinds(images: Sequence[_Image]) -> dict[str, str]:
    """Find kinds of residuals that scatter more than the images' noise."""
    found = {}
    for kind in dict.fromkeys(image.kind for image in images):
        of_kind = [image for image in images if image.kind == kind]
        scatter, noise = np.median([(image.scatter_px, image.noise_px) for image in of_kind], axis=0)
        if scatter > of_kind[0].largest_px() or scatter > max(_OVER_NOISE * noise, noise + _OVER_OTHERS_PX):
            worst = max(of_kind, key=lambda image: image.scatter_px)
            found[kind] = (
                f"the {kind} is {scatter:.2f} px off (rms) in most images; noise explains {noise:.2f} px; the worst is "
                f"{worst.source} with {worst.scatter_px:.2f} px"
            )
    return found


def _check_correlations(result: Estimate) -> Iterator[tuple[bool, str, str]]:
    """Find kinds with residuals correlated over many lines or points, as from a wrong lens or height."""
    for kind, noise in result.noise.items():
        if noise.together > _WAVES_DOUBTFUL:
            where, values, check = "along the stripe", "lines", "heights, media and what else was described"
            if kind == TARGET:
                where, values, check = "across the image", "points", "the target's flatness, and the lens"
            yield (
                noise.together > _WAVES_WRONG,
                kind,
                f"the {kind} has systematic deviations {where} beyond noise ({noise.sigma_px:.2f} px rms, equivalent "
                f"to one independent value in {noise.together:.0f} {values}): check {check}",
            )


def find_excess_outliers(result: Estimate) -> dict[str, float]:
    """Return the fraction of outliers for kinds of residuals with too many."""
    found = {}
    for kind, noise in result.noise.items():
        parts = [part for parts in result.residuals for part in parts if part.kind == kind]
        share = float(np.concatenate([outliers(part, noise) for part in parts]).mean())
        if share > _OUTLIER_SHARE:
            found[kind] = share
    return found


def _shorten_list(found: Iterable[str]) -> list[str]:
    """Shorten a list of similar messages."""
    every = list(found)
    more = len(every) - _MOST_NAMED
    return every[:_MOST_NAMED] + ([f"and {more} more images"] if more > 0 else [])
