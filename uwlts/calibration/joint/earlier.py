"""Earlier joint calibration as prior knowledge of another one: its estimate, media, and record of evidence."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.joint.gathering import Gathered
from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.calibration.joint.scanned_surfaces import SLOPES
from uwlts.calibration.joint.stored_estimate import (
    StoredEstimate,
    convex_outline,
    read_original_estimate,
    require_joint,
    unused_name,
)
from uwlts.errors import CalibrationError
from uwlts.model.calibration import Calibration, KnownStage, calibration_digest
from uwlts.model.joint_estimate import CoveredRegion, JointEstimate, Origin
from uwlts.model.parameter_keys import ParameterKey, TargetParameter
from uwlts.model.sensor import Medium, to_rows
from uwlts.optics.fitness import check_fits
from uwlts.storage.capture import Capture


def require_suitable(captures: Sequence[Capture], calibration: Calibration) -> None:
    """Raise CalibrationError if captures are not of a joint calibration's sensor, or were used for it."""
    require_joint(calibration)
    for capture in captures:
        header, name = capture.header, capture.path.name
        if doubts := check_fits(header, calibration, source=name):
            raise CalibrationError("; ".join(doubts))
        wavelength = header.sensor.laser.wavelength_nm
        if wavelength != calibration.wavelength_nm:
            raise CalibrationError(
                f"{name} was taken with a laser of {wavelength:g} nm; the calibration is for "
                f"{calibration.wavelength_nm:g} nm"
            )
        if header.medium.kind != "air" and not header.sensor.camera.window.mounted:
            raise CalibrationError(f"{name} was taken without the camera's window; expected an image through it")


def join_media(gathered: Gathered, calibration: Calibration, *, new: bool) -> Gathered:
    """Return evidence whose media follow those of an earlier calibration; equal ones are the same unless ``new``.

    Raises CalibrationError if a capture was already used for the calibration.
    """
    used = {source.sha256 for source in calibration.origin().captures()}
    captures = Origin.model_validate(gathered.provenance).captures()
    if again := [source.file for source in captures if source.sha256 in used]:
        raise CalibrationError(f"{', '.join(again)} was already used for this calibration: take a new image")
    names = read_original_estimate(calibration, _AIR).parameters.media
    media = {name: known.medium for name, known in zip(names, calibration.media, strict=True)}
    places = []
    for name, medium in gathered.media.items():
        # As in `Calibration.medium_index`: the last of equal media.
        same = [number for number, known in enumerate(calibration.media) if known.medium == medium and not new]
        places.append(same[-1] if same else len(media))
        if not same:
            media[unused_name(name, media)] = medium

    def renumbered(view: ViewMedium) -> ViewMedium:
        return view if view.medium is None else ViewMedium(view.window, places[view.medium])

    return replace(
        gathered,
        media=media,
        series=[replace(each, view=renumbered(each.view)) for each in gathered.series],
        steps=[(step, renumbered(view)) for step, view in gathered.steps],
        scans=[replace(each, view=renumbered(each.view)) for each in gathered.scans],
    )


_AIR = Medium(kind="air")


def read_earlier(calibration: Calibration, gathered: Gathered) -> StoredEstimate:
    """Return the estimate of an earlier calibration as knowledge of the sensor that further evidence shows.

    The indices of water that is seen again have drifted. Parameters of another target are left out, and the direction
    of the stage if scans show it again: it is that in a frame which the calibration does not contain.
    """
    known = read_original_estimate(calibration, _AIR)
    parameters, covariance = known.parameters, known.covariance.copy()
    seen = {part.view.medium for part in (*gathered.series, *gathered.scans)} | {v.medium for _, v in gathered.steps}
    drift_k = gathered.sensor.uncertainty.drift_k
    for number, each in enumerate(calibration.media):
        if number in seen:
            place = parameters.places[parameters.index_key(number)]
            covariance[place, place] += (each.medium.index_per_kelvin(calibration.wavelength_nm) * drift_k) ** 2
    other: set[ParameterKey] = set()
    if gathered.series and gathered.series[0].found.target.model_dump(mode="json") != calibration.origin().target:
        other |= {key for key in parameters.keys if isinstance(key, TargetParameter)}
    if gathered.scans:
        other |= {*SLOPES}
    kept = [place for place, key in enumerate(parameters.keys) if key not in other]
    priors = {key: prior for key, prior in parameters.priors.items() if key not in other}
    return replace(
        known,
        parameters=replace(parameters, priors=priors),
        values=known.values[kept],
        covariance=covariance[np.ix_(kept, kept)],
    )


def merge_with_earlier(new: Calibration, earlier: Calibration) -> Calibration:
    """Return the calibration of an estimate that used an earlier one as prior knowledge, with the evidence of both.

    The scatter is from the new images if they have it. ``std_before`` is the prior uncertainty before any evidence.
    Stage directions that the new images do not show are kept.
    """
    turned = new.object_transform()[:3, :3].T @ earlier.object_transform()[:3, :3]
    found = [np.array(stage.described) for stage in new.stages]
    kept = tuple(
        KnownStage(described=stage.described, direction=tuple((turned @ stage.direction).tolist()))
        for stage in earlier.stages
        if not any(np.allclose(stage.described, other) for other in found)
    )
    figures = {name: earlier.figures(name) | new.figures(name) for name in new.residuals}
    return new.model_copy(
        update={
            "stages": new.stages + kept,
            "residuals": earlier.residuals | figures,
            "joint": _merge_estimates(require_joint(earlier), require_joint(new)),
            "provenance": _extend_provenance(earlier, new.provenance),
        }
    )


def _merge_estimates(before: JointEstimate, new: JointEstimate) -> JointEstimate:
    """Return the new estimate with the record of both estimates' evidence."""
    stated = dict(zip(before.parameters, before.std_before, strict=True))
    regions = {(region.window, region.medium): region for region in before.covered}
    regions |= {(region.window, region.medium): _extend_region(region, regions) for region in new.covered}
    return new.model_copy(
        update={
            # Parameters of the earlier estimate have no other prior knowledge in the new one.
            "std_before": tuple(
                stated.get(key) if std is None else std for key, std in zip(new.parameters, new.std_before, strict=True)
            ),
            "scatter_px": before.scatter_px | new.scatter_px,
            "shared_variance": before.shared_variance | new.shared_variance,
            "residual_count": before.residual_count + new.residual_count,
            "outlier_count": before.outlier_count + new.outlier_count,
            "images": before.images + new.images,
            "covered": tuple(regions.values()),
        }
    )


def _extend_region(region: CoveredRegion, covered: Mapping[tuple[bool, int | None], CoveredRegion]) -> CoveredRegion:
    """Extend a covered region by the earlier one of its view, in other water by the largest one through the window."""
    same = covered.get((region.window, region.medium))
    wet = [other for other in covered.values() if region.medium is not None and other.medium is not None]
    near = [same] if same is not None else [other for other in wet if other.window]
    if not near:
        return region
    most = max(near, key=lambda other: other.point_count)
    depths = (*region.camera_depth_mm, *most.camera_depth_mm)
    return region.model_copy(
        update={
            "point_count": region.point_count + most.point_count,
            "camera_depth_mm": (min(depths), max(depths)),
            "outline_mm": to_rows(convex_outline(np.array([*region.outline_mm, *most.outline_mm]))),
        }
    )


def _extend_provenance(earlier: Calibration, new: dict[str, JsonValue]) -> dict[str, JsonValue]:
    """Return the provenance of both, with the lists of captures and warnings joined."""
    old = earlier.provenance
    before: dict[str, JsonValue] = {key: old.get(key) for key in ("source", "date", "software")}
    joined: dict[str, JsonValue] = {"earlier": before | {"digest": calibration_digest(earlier)}}
    for key, added in new.items():
        known = old.get(key)
        if isinstance(added, list) and isinstance(known, list):
            joined[key] = [*known, *added]
    return old | new | joined
