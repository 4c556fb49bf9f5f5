"""Calibration certificate: its content as typed objects, and its seal."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import JsonValue, PlainSerializer

from uwlts._version import __version__
from uwlts.calibration.joint.calibrated_volume import (
    CalibrationInUse,
    LengthUncertainty,
    index_key,
    length_uncertainties,
    prepare_use,
)
from uwlts.calibration.joint.next_shot import WHOLE_VOLUME, rank_next_shots
from uwlts.calibration.joint.observability import (
    Weakness,
    compute_mesh_lengths,
    find_weaknesses,
    format_weaknesses,
    list_regions,
)
from uwlts.calibration.joint.stored_estimate import require_joint
from uwlts.errors import CaptureError
from uwlts.files.json_files import SEAL, compute_seal, read_json
from uwlts.files.writing import hash_file
from uwlts.fitting.next_observation import Forecast
from uwlts.model.calibration import Calibration, calibration_digest
from uwlts.model.joint_estimate import ImageFit
from uwlts.model.parameter_keys import ParameterKey, WindowParameter, parse_parameter
from uwlts.model.sensor import Description, Medium
from uwlts.pages.toolkit import MISSING, format_to_scale


class ParameterRow(Description):
    """A parameter: words, unit, value, and standard uncertainties after and before calibration (None: unknown)."""

    name: str
    words: str
    unit: str
    value: float
    std: float | None
    std_before: float | None

    def texts(self) -> tuple[str, str]:
        """Return value and standard uncertainty as text, rounded to two digits of the uncertainty."""
        if self.std is None or not self.std > 0:
            return f"{self.value:.6g}", MISSING
        return format_to_scale(self.value, self.std), format_to_scale(self.std, self.std)


def parameter_rows(calibration: Calibration) -> tuple[ParameterRow, ...]:
    """Return all estimated parameters."""
    if (joint := calibration.joint) is not None:
        rows = zip(joint.parameters, joint.values, joint.std, joint.std_before, strict=True)
        return tuple(_make_row(*row) for row in rows)
    camera, window = calibration.camera, calibration.window
    known = calibration.std()
    std = {"f": known.fx_px, "fx": known.fx_px, "fy": known.fy_px, "cx": known.cx_px, "cy": known.cy_px}
    std |= known.distortion
    values = {"f": camera.fx_px} if camera.fx_px == camera.fy_px else {"fx": camera.fx_px, "fy": camera.fy_px}
    values |= {"cx": camera.cx_px, "cy": camera.cy_px}
    values |= {name: value for name, value in camera.distortion.model_dump().items() if value}
    rows = [_make_row(parse_parameter(name), value, std.get(name)) for name, value in values.items()]
    if window is not None:
        rows.append(_make_row(WindowParameter.DISTANCE, window.distance_mm, known.window_distance_mm))
        if window.refractions == 2:
            rows.append(_make_row(WindowParameter.THICKNESS, window.thickness_mm))
            rows.append(_make_row(WindowParameter.GLASS_INDEX, window.glass_index))
    return tuple(rows)


def _make_row(key: ParameterKey, value: float, std: float | None = None, before: float | None = None) -> ParameterRow:
    quantity = key.quantity
    return ParameterRow(
        name=key.text,
        words=quantity.words,
        unit=quantity.unit,
        value=value * quantity.factor,
        std=None if std is None else std * quantity.factor,
        std_before=None if before is None else before * quantity.factor,
    )


FORMAT = "uwlts-certificate"
VERSION = 1  # of the file format
# Number of best shots listed, in addition to the best one of each kind.
_BEST_SHOTS = 3


def read_certificate(path: str | Path) -> dict[str, JsonValue]:
    """Read the sealed JSON of a certificate; CaptureError if the file is missing or not a certificate."""
    content = read_json(path, called="certificate", check_seal=False)
    if content.get("format") != FORMAT:
        raise CaptureError(f'{path} is JSON but not a certificate: expected "format": "{FORMAT}"')
    if content.get("version") != VERSION:
        raise CaptureError(f"{path} has version {content.get('version')}; this program reads {VERSION}")
    return content


def check_certificate(path: str | Path, calibration: str | Path) -> list[str]:
    """Check a certificate's seal and that it belongs to a calibration file; return the problems found.

    Parameters
    ----------
    path : str or Path
        Certificate (JSON) to verify.
    calibration : str or Path
        The certified calibration file.

    Returns
    -------
    list of str
        Sentences about each problem; empty if the certificate is genuine and belongs to the file.

    Raises
    ------
    CaptureError
        A file cannot be read, or is not a certificate.
    """
    content, found = read_certificate(path), hash_file(calibration)
    against = []
    if content.get(SEAL) != compute_seal(content):
        against.append(f"{path} was changed after it was issued: its seal does not match its content")
    certified = content.get("calibration")
    if not isinstance(certified, dict):
        raise CaptureError(f"{path} is damaged: it does not name its calibration")
    if found != (stated := certified.get("sha256")):
        against.append(
            f"{calibration} is not the calibration certified by {path}, or was changed since: its SHA-256 is {found}, "
            f"the certificate states {stated}"
        )
    return against


_Pair = tuple[float, float]
_Medium = Annotated[Medium, PlainSerializer(lambda medium: medium.model_dump(mode="json", exclude_none=True))]


class CertifiedFile(Description):
    """The calibration file: name, SHA-256, the digest stored in clouds, date, and software."""

    file: str
    sha256: str
    digest: str
    date: JsonValue
    software: JsonValue


class Validity(Description):
    """A region covered by the evidence: its medium, refractive index and extent."""

    name: str
    medium: _Medium
    through_window: bool
    index: float
    index_std: float | None
    camera_depth_mm: _Pair
    y_mm: _Pair
    z_mm: _Pair
    outline_mm: tuple[_Pair, ...]
    stripe_points: int


class NextShot(Description):
    """A recommended shot: description, standard uncertainty of lengths before and after, and advice."""

    words: str
    before_mm: float
    after_mm: float
    advice: str


class Certificate(Description):
    """Certificate of a joint calibration; without a covered area (see ``remark``), lengths are not certified.

    Fields that are not set are omitted from the file.
    """

    format: str
    version: int
    sensor: str
    issued: str
    software: str
    calibration: CertifiedFile
    wavelength_nm: float
    made_from: dict[str, JsonValue]
    parameters: tuple[ParameterRow, ...]
    validity: tuple[Validity, ...]
    scatter_px: dict[str, float]
    shared_variance: dict[str, float]
    residuals: int
    strays: int
    images: tuple[ImageFit, ...]
    remark: str | None = None
    lengths: tuple[LengthUncertainty, ...] = ()
    lengths_std_mm: float | None = None
    cannot_tell: tuple[str, ...] = ()
    weaknesses: tuple[Weakness, ...] = ()
    next_shots: tuple[NextShot, ...] = ()
    sha256: str = ""

    def in_file(self) -> dict[str, JsonValue]:
        """Return the content as plain JSON with the keys of files."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


def make_certificate(calibration: Calibration, path: str | Path, *, issued: str) -> Certificate:
    """Return the sealed content of the certificate of a calibration file, issued at a time in ISO 8601.

    CalibrationError if the calibration is not a joint one, or its estimate is damaged.
    """
    joint, found = require_joint(calibration), list_regions(calibration)
    content = Certificate(
        format=FORMAT,
        version=VERSION,
        sensor=calibration.sensor_name,
        issued=issued,
        software=f"uwlts {__version__}",
        calibration=CertifiedFile(
            file=Path(path).name,
            sha256=hash_file(path),
            digest=calibration_digest(calibration),
            date=calibration.provenance.get("date"),
            software=calibration.provenance.get("software"),
        ),
        wavelength_nm=calibration.wavelength_nm,
        made_from=calibration.provenance,
        parameters=parameter_rows(calibration),
        validity=tuple(_describe_validity(prepare_use(calibration, region)) for region in found),
        scatter_px=joint.scatter_px,
        shared_variance=joint.shared_variance,
        residuals=joint.residual_count,
        strays=joint.outlier_count,
        images=joint.images,
    )
    if not found or not found[0].has_area():
        no_area = "the stripes of the evidence cover no area: the uncertainty of lengths is not known"
        none = "the calibration does not state which volume its evidence covers: calibrate again"
        added: dict[str, object] = {"remark": no_area if found else none}
    else:
        use = prepare_use(calibration, found[0])
        lengths, known = compute_mesh_lengths(use.known, found[0]), use.known
        weak = find_weaknesses(lengths, known.parameters.keys, known.covariance)
        added = {
            "lengths": tuple(length_uncertainties(use)),
            "lengths_std_mm": float(np.sqrt(np.mean(lengths.std_mm(known.covariance) ** 2))),
            "cannot_tell": tuple(format_weaknesses(weak)),
            "weaknesses": tuple(weak),
            "next_shots": _list_best_shots(rank_next_shots(calibration)),
        }
    content = content.model_copy(update=added)
    return content.model_copy(update={SEAL: compute_seal(content.in_file())})


def certificate_lines(content: Certificate) -> list[str]:
    """Return the main statements of a certificate for the terminal."""
    if content.remark is not None:
        return [content.remark]
    longest, volume = {row.axis: row for row in content.lengths}, content.validity[0]
    near, far = volume.camera_depth_mm
    lengths = [
        f"{1e3 * row.calibration_mm:.1f} µm of {row.length_mm:g} mm along {row.axis}" for row in longest.values()
    ]
    return [
        f"in {volume.name}, {near:.0f} to {far:.0f} mm from the camera's pupil, expanded uncertainty (k = 2) by the "
        f"calibration: {', '.join(lengths)}",
        *content.cannot_tell,
        *(f"next: {shot.advice}" for shot in content.next_shots[:1]),
    ]


def _list_best_shots(forecasts: Sequence[Forecast]) -> tuple[NextShot, ...]:
    """Return the best shots, and the best of each kind, in order."""
    kinds = [each.candidate.words.split(",")[0] for each in forecasts]
    return tuple(
        NextShot(
            words=f.candidate.words.rstrip(","), before_mm=f.before, after_mm=f.after, advice=f.advice(WHOLE_VOLUME)
        )
        for place, (kind, f) in enumerate(zip(kinds, forecasts, strict=True))
        if place < _BEST_SHOTS or kind not in kinds[:place]
    )


def _describe_validity(use: CalibrationInUse) -> Validity:
    region, known, index = use.region, use.known, index_key(use.known)
    low, high = region.outline_mm.min(axis=0), region.outline_mm.max(axis=0)
    return Validity(
        name=region.name,
        medium=region.medium,
        through_window=region.view.window,
        index=known.parameters.medium_index(known.values, known.view),
        index_std=None if index is None else require_joint(use.calibration).std_of(index),
        camera_depth_mm=region.camera_depth_mm.tolist(),
        y_mm=(float(low[0]), float(high[0])),
        z_mm=(float(low[1]), float(high[1])),
        outline_mm=region.outline_mm.tolist(),
        stripe_points=region.points,
    )
