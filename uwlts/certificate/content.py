"""What a certificate says, as plain JSON."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import uwlts
from uwlts.calibration.any_calibration import calibration_digest
from uwlts.calibration.joint.next_shot import Outlook, next_shots
from uwlts.calibration.joint.stored import require_joint
from uwlts.calibration.joint.volume import Region, lengths_over, regions
from uwlts.calibration.joint.weakness import told, weaknesses
from uwlts.calibration.model import Calibration
from uwlts.calibration.parameter_keys import ParameterKey, WindowParameter, parameter_of
from uwlts.calibration.sources import sha256_of
from uwlts.certificate.lengths import InUse, in_use, index_key, worth_of_lengths
from uwlts.certificate.seal import FORMAT, VERSION, sealed

_BEST_SHOTS = 3
NOT_JOINT = "the calibration was not estimated jointly: what lengths measured by it are worth is not known"


def certificate_of(calibration: Calibration, path: str | Path, *, issued: str) -> dict[str, Any]:
    """The sealed content of a certificate.

    Parameters
    ----------
    calibration : Calibration
    path : path
        Its file.
    issued : str
        When, in ISO 8601.

    Raises
    ------
    CalibrationError
        Its joint estimate is damaged.
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "sensor": calibration.sensor_name,
        "issued": issued,
        "software": f"uwlts {uwlts.__version__}",
        "calibration": {
            "file": Path(path).name, "sha256": sha256_of(path), "digest": calibration_digest(calibration),
            "date": calibration.provenance.get("date"), "software": calibration.provenance.get("software"),
        },
        "wavelength_nm": calibration.wavelength_nm,
        "made_from": calibration.provenance,
        "parameters": parameter_rows(calibration),
        "uncertainty_known": calibration.joint is not None,
    }  # fmt: skip
    return sealed(content | (_joint(calibration) if calibration.joint is not None else _by_turns(calibration)))


def certificate_lines(content: dict[str, Any]) -> list[str]:
    """The gist of a certificate for the terminal."""
    if "lengths" not in content:
        return [content["remark"]]
    longest = {row["axis"]: row for row in content["lengths"]}
    volume = content["validity"][0]
    return [
        f"in {volume['name']}, {volume['camera_depth_mm'][0]:.0f} to {volume['camera_depth_mm'][1]:.0f} mm from the "
        "camera's pupil, expanded uncertainty (k = 2) by the calibration: "
        + ", ".join(
            f"{1e3 * row['calibration_mm']:.1f} µm of {row['length_mm']:g} mm along {axis}"
            for axis, row in longest.items()
        ),
        *content["cannot_tell"],
        *(f"next: {shot['advice']}" for shot in content["next_shots"][:1]),
    ]


def parameter_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """Every parameter in words with its unit, value, and standard uncertainties after and before; None for unknown."""
    if (joint := calibration.joint) is not None:
        rows = zip(joint.parameters, joint.values, joint.std, joint.std_before, strict=True)
        return [_row(*row) for row in rows]
    camera, window = calibration.camera, calibration.window
    figures = calibration.residuals
    std = figures.get("camera", {}).get("std", {})
    names = ("f",) if camera.fx_px == camera.fy_px else ("fx", "fy")
    values = {"f": camera.fx_px, "fx": camera.fx_px, "fy": camera.fy_px, "cx": camera.cx_px, "cy": camera.cy_px}
    values |= camera.distortion.model_dump()
    shown = [*names, "cx", "cy", *(name for name, value in camera.distortion.model_dump().items() if value)]
    rows = [_row(parameter_of(name), values[name], std.get(name), None) for name in shown]
    if window is not None:
        rows.append(_row(WindowParameter.DISTANCE, window.distance_mm, figures.get("window", {}).get("std_mm"), None))
        if window.refractions == 2:
            rows.append(_row(WindowParameter.THICKNESS, window.thickness_mm, None, None))
            rows.append(_row(WindowParameter.GLASS_INDEX, window.glass_index, None, None))
    return rows


def _row(key: ParameterKey, value: float, std: float | None, before: float | None) -> dict[str, Any]:
    quantity = key.quantity
    return {
        "name": key.text,
        "words": quantity.words,
        "unit": quantity.unit,
        "value": value * quantity.factor,
        "std": None if std is None else std * quantity.factor,
        "std_before": None if before is None else before * quantity.factor,
    }


def _by_turns(calibration: Calibration) -> dict[str, Any]:
    """What is known of a calibration without a joint estimate."""
    figures, window = calibration.residuals, calibration.window
    media = [
        {"medium": found.medium.model_dump(mode="json", exclude_none=True), "index": found.index}
        for found in calibration.media
    ]
    rms = {step: {key: value for key, value in table.items() if key in ("rms_px", "rms_mm", "max_mm", "images")
                  and not isinstance(value, list)} for step, table in figures.items()}  # fmt: skip
    return {
        "remark": NOT_JOINT,
        "use": f"in {calibration.medium_kind} only" if window is None else "in air and in water",
        "media": media,
        "residuals": {step: table for step, table in rms.items() if table},
    }


def _joint(calibration: Calibration) -> dict[str, Any]:
    joint, found = require_joint(calibration), regions(calibration)
    stored = joint.in_file()
    content: dict[str, Any] = {
        "validity": [_validity(in_use(calibration, region)) for region in found],
        "scatter_px": joint.scatter_px,
        "shared_variance": joint.shared_variance,
        "residuals": joint.residual_count,
        "strays": joint.outlier_count,
        "images": stored.get("images", []),
    }
    if not found:
        return content | {"remark": "the calibration does not tell what volume its evidence covers: calibrate again"}
    if not found[0].has_area():
        return content | {"remark": "the stripes of the evidence cover no area: what lengths are worth is not known"}
    use = in_use(calibration, found[0])
    lengths, known = lengths_over(calibration, use.known, found[0]), use.known
    weak = weaknesses(lengths, known.parameters.keys, known.covariance)
    return content | {
        "lengths": [asdict(worth) for worth in worth_of_lengths(use)],
        "lengths_std_mm": float(np.sqrt(np.mean(lengths.std_mm(known.covariance) ** 2))),
        "cannot_tell": told(weak),
        "weaknesses": [asdict(each) | {"parameters": [key.text for key in each.parameters]} for each in weak],
        "next_shots": _shots(next_shots(calibration)),
    }


def _shots(outlooks: Sequence[Outlook]) -> list[dict[str, Any]]:
    return [
        {"words": o.words.rstrip(","), "before_mm": o.before_mm, "after_mm": o.after_mm, "advice": o.advice()}
        for o in _worth_telling(outlooks)
    ]


def _worth_telling(outlooks: Sequence[Outlook]) -> list[Outlook]:
    """The best shots, and the best of each kind, in their order."""
    kinds: dict[str, Outlook] = {}
    for outlook in outlooks:
        kinds.setdefault(outlook.words.split(",")[0], outlook)
    return [o for place, o in enumerate(outlooks) if place < _BEST_SHOTS or o in kinds.values()]


def _validity(use: InUse) -> dict[str, Any]:
    """Where evidence covers the volume, in which medium, and how well its index is known."""
    region: Region = use.region
    known, index = use.known, index_key(use.known)
    std = None if index is None else require_joint(use.calibration).std_of(index)
    low, high = region.outline_mm.min(axis=0), region.outline_mm.max(axis=0)
    return {
        "name": region.name,
        "medium": region.medium.model_dump(mode="json", exclude_none=True),
        "through_window": region.view.window,
        "index": known.parameters.medium_index(known.values, known.view),
        "index_std": std,
        "camera_depth_mm": region.camera_depth_mm.tolist(),
        "y_mm": [float(low[0]), float(high[0])],
        "z_mm": [float(low[1]), float(high[1])],
        "outline_mm": region.outline_mm.tolist(),
        "stripe_points": region.points,
    }
