"""Ground-truth file of a rendered capture, beside it; only the comparison with truth reads it."""

import hashlib
import json
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from uwlts.errors import CaptureError
from uwlts.files.reading import require_regular_file
from uwlts.model.sensor import Description, Medium, Sensor, Table
from uwlts.model.short_text import Brief
from uwlts.storage.hdf5_file import DAMAGE, read_array, read_label, write_arrays

FORMAT = "uwlts-truth"
VERSION = 1  # of the file format
_DIMENSIONS = {"centre_px": 2, "point_mm": 3, "normal": 3, "status": 2, "crossings": 2, "depth_mm": 2}
_LATER = {"pose": 3, "centroid_px": 2, "visible_fraction": 2, "mixed_fraction": 2}
"""Arrays that files of earlier versions lack, with their dimensions."""


class TruthStatus(IntEnum):
    """True visibility of the stripe on a profile line."""

    VISIBLE = 0
    NO_STRIPE = 1


class TruthHeader(Description):
    """All true parameters: the sensor as rendered, its medium, and the scene's description."""

    sensor: Sensor
    medium: Medium
    scene: Table


@dataclass(frozen=True, repr=False)
class Truth(Brief):
    """True stripe of every profile line of every frame; F frames, L lines.

    ``centre_px (F, L)`` is the image coordinate across the stripe of the middle of the sheet, as seen by the line's
    centre. ``point_mm (F, L, 3)`` and ``normal (F, L, 3)`` are the surface there in scene coordinates. ``status (F,
    L)`` is a `TruthStatus`. ``crossings (F, L)`` counts the lit crossings of the sheet; the brightest one is stored.
    ``depth_mm (H, W)`` is the camera-frame z of the surface at every pixel in the first frame. Missing values are NaN.
    ``pose (F, 4, 4)`` is ``T_scene_object`` of the sensor's OCS in mm.

    The light of a line's stripe is that of directly lit surfaces over pixel, pupil and exposure, without speckle, haze,
    side lobes and noise. The stripe is the run of pixels about the centre that exceed 1e-3 of the light there.
    ``centroid_px (F, L)`` is its centroid across the stripe. ``visible_fraction (F, L)`` is the fraction of the sheet's
    profile that is lit and seen on the surface at the centre: 1 for a whole stripe, less where an edge, a shadow or the
    image's border cuts it. ``mixed_fraction (F, L)`` is the fraction of the light from other surfaces, which are
    farther than one standard deviation of the sheet from the tangent plane at the centre. Files of earlier versions
    have None in place of these and of the pose.
    """

    centre_px: np.ndarray
    point_mm: np.ndarray
    normal: np.ndarray
    status: np.ndarray
    crossings: np.ndarray
    depth_mm: np.ndarray
    pose: np.ndarray | None = None
    centroid_px: np.ndarray | None = None
    visible_fraction: np.ndarray | None = None
    mixed_fraction: np.ndarray | None = None


def scene_digest(scene: Table) -> str:
    """Return the digest of a scene's description, by which a rendered capture and its truth know each other."""
    return hashlib.sha256(json.dumps(scene, sort_keys=True).encode()).hexdigest()[:16]


def truth_path(capture: str | Path) -> Path:
    """Return the path of a capture's truth file."""
    path = Path(capture)
    return path.with_name(path.name.removesuffix(".h5") + ".truth.h5")


def write_truth(path: str | Path, header: TruthHeader, truth: Truth, *, overwrite: bool = False) -> None:
    """Write a truth file completely or not at all; raises OutputError if that fails."""
    with write_arrays(path, file_format=FORMAT, version=VERSION, overwrite=overwrite) as append:
        append(vars(truth), header)


def read_truth(path: str | Path) -> tuple[TruthHeader, Truth]:
    """Read a truth file; raises CaptureError if it is missing, foreign, newer, damaged or inconsistent."""
    require_regular_file(path, called="truth file")
    try:
        with h5py.File(path, "r") as file:
            header = read_label(file, TruthHeader, path=path, file_format=FORMAT, version=VERSION)
            stored = _DIMENSIONS | {name: count for name, count in _LATER.items() if name in file}
            arrays: dict[str, Any] = {name: read_array(file, name, path=path) for name in stored}
    except DAMAGE as error:
        raise CaptureError(f"{path} is not a truth file, or is damaged: {error}") from error
    for name, dimensions in stored.items():
        values, kinds = arrays[name], "iu" if name in ("status", "crossings") else "f"
        if values is None or values.dtype.kind not in kinds or values.ndim != dimensions:
            raise CaptureError(f"{path} is damaged: it has no numbers '{name}' in {dimensions} dimensions")
    truth = Truth(**arrays)
    lines = truth.status.shape
    shapes = {name: getattr(truth, name).shape for name in stored if name not in ("depth_mm", "pose")}
    if shapes != {name: (*lines, 3) if name in ("point_mm", "normal") else lines for name in shapes}:
        raise CaptureError(f"{path} contradicts itself: its arrays have the shapes {shapes}")
    if truth.pose is not None and truth.pose.shape != (lines[0], 4, 4):
        raise CaptureError(f"{path} contradicts itself: it has {lines[0]} frames and poses {truth.pose.shape}")
    if not np.isin(truth.status, list(TruthStatus)).all():
        raise CaptureError(f"{path} holds unknown statuses; known are {[int(status) for status in TruthStatus]}")
    visible = truth.status == TruthStatus.VISIBLE
    if not all(np.isfinite(values[visible]).all() for values in (truth.centre_px, truth.point_mm, truth.normal)):
        raise CaptureError(f"{path} marks a stripe as visible where centre, point or normal are not finite")
    return header, truth
