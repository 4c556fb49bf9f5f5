"""Files of point clouds: HDF5, PLY with all fields for CloudCompare and MeshLab, and formats of other programs."""

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import log_warnings, open_regular, parse_json, require_regular_file
from uwlts.files.writing import refuse_unsuitable, require_ending, write_atomically, write_file
from uwlts.model.sensor import Description, Table
from uwlts.storage.cloud import (
    FARTHEST_SINGLE_MM,
    KINDS,
    NO_INDEX,
    PAIRS,
    PER_POINT,
    STEP,
    PointCloud,
    PointUncertainty,
    compute_normal_std,
    concatenate_clouds,
    find_float_step,
    metadata_json,
    note_step,
    omit_points,
)
from uwlts.storage.foreign_clouds import FORMATS, find_format
from uwlts.storage.hdf5_file import DAMAGE, find_dataset, read_array, read_format, read_label, write_arrays
from uwlts.storage.las_file import load_library
from uwlts.storage.number_tables import Unit, choose_scale, find_stated_unit
from uwlts.storage.ply import encode_ply, read_ply
from uwlts.storage.repeated_points import omit_repeated

FORMAT = "uwlts-cloud"
VERSION = 1  # of the file format

POINTS_OF_PART = 1_000_000
"""Number of points in a part of a large cloud."""

CLOUD_ENDINGS = (".ply", ".h5", *FORMATS)
"""Endings of the clouds that can be read."""
CLOUD_FORMATS = (".ply", ".h5", *(ending for ending, each in FORMATS.items() if each.write))
"""Endings of the clouds that can be written."""
COLOURED_FORMATS = (".ply", ".h5", *(ending for ending, each in FORMATS.items() if each.coloured))
"""Endings of the clouds that can be written with a colour of each point."""
PLY_COLOURS = ("red", "green", "blue")
FULL, SINGLE = ".full.ply", ".float.ply"
"""Endings of PLY files with the whole uncertainty, and with coordinates as float, for programs that read no double."""
_LEAN = (
    "it holds the standard deviations of each point along the surface normal, and no errors that points share: results "
    f"have no uncertainty. Use the cloud in HDF5 (NAME.h5) or in PLY with the whole uncertainty (NAME{FULL})"
)
_UNCERTAINTY = ["random_mm2", "position_mm", "patterns_mm", "poses_mm"]
"""Arrays of `PointUncertainty` in HDF5; the last one is optional."""
_PAIR_NAMES = tuple("xyz"[i] + "xyz"[j] for i, j in PAIRS)
_SHARED = "shared_errors"
_COMMENT = "uwlts-metadata"
# CloudCompare reads PLY with rply, which rejects a file with a comment of 1024 characters or more.
_PIECE_LENGTH = 900
_PIECE = re.compile(rf"{_COMMENT} (\d+)/(\d+) (.*);")
_Rows = Callable[[int], slice]


def write_cloud(
    path: str | os.PathLike[str], cloud: PointCloud, *, overwrite: bool = False, colours: np.ndarray | None = None
) -> None:
    """Write a cloud in the format of the path's ending, completely or not at all.

    docs/reference/cloud-formats.md describes the formats: unit, numbers, and fields of each.

    ``colours`` (N, 3) uint8, red, green and blue, are stored for other programs in PLY, LAS, LAZ and E57
    (`COLOURED_FORMATS`); HDF5 has the deviation instead. A PLY with colours names the intensity ``scalar_intensity``.

    Raises
    ------
    OutputError
        The ending is unknown, or the format cannot hold such a cloud or colours. The file exists and `overwrite` is not
        set, the folder is missing, or the disk is full.
    SetupError
        The format's library is not installed.
    """
    path = Path(path)
    require_ending(path, CLOUD_FORMATS if colours is None else COLOURED_FORMATS)
    if (form := find_format(path)) is not None and form.write is not None:
        if len(cloud) == 0:
            raise OutputError(f"the cloud has no points, and {path.suffix} cannot hold none: write PLY or HDF5")
        with write_atomically(path, overwrite=overwrite) as aside:
            form.write(aside, cloud, colours, path)
        return
    if _is_hdf5(path):
        with write_cloud_in_parts(path, overwrite=overwrite) as write:
            write(cloud)
        return
    single = str(path).lower().endswith(SINGLE)
    if single and np.abs(cloud.points_mm).max(initial=0.0) > FARTHEST_SINGLE_MM:
        raise OutputError(f"{path}: the cloud reaches beyond 16 m from the origin, too far for float: write NAME.ply")
    columns = dict(zip("xyz", cloud.points_mm.T.astype(np.float32 if single else np.float64), strict=True))
    if colours is not None:
        columns |= dict(zip(PLY_COLOURS, colours.T, strict=True))
    full = not is_lean(path)
    random, common = (None, None) if full and cloud.uncertainty is not None else compute_normal_std(cloud)
    # MeshLab shows a property named "intensity" as grey, in place of the colours.
    brightness = "intensity" if colours is None else "scalar_intensity"
    columns |= {brightness: cloud.intensity, "deviation": cloud.deviation_mm, "time": cloud.time_s}
    columns |= {"random_std": random, "common_std": common}
    for name, indices in (("frame", cloud.frame), ("line", cloud.line)):
        columns[name] = None if (indices == NO_INDEX).all() else indices
    columns = {name: values for name, values in columns.items() if values is not None}
    if full:
        columns |= _list_uncertainty_columns(cloud.uncertainty)
    cloud = cloud if full else replace(cloud, uncertainty=None)
    write_ply_points(path, columns, comments=_make_comments(_add_shared(cloud)), overwrite=overwrite)


@contextmanager
def write_cloud_in_parts(
    path: str | os.PathLike[str], *, overwrite: bool = False
) -> Iterator[Callable[[PointCloud], None]]:
    """Give the body a function that takes the parts of a cloud; see `write_cloud`.

    HDF5 is written part by part. For other formats all parts are held in memory.
    """
    if not _is_hdf5(path):
        parts: list[PointCloud] = []
        yield parts.append
        write_cloud(path, concatenate_clouds(parts) if len(parts) > 1 else parts[0], overwrite=overwrite)
        return
    with write_arrays(path, file_format=FORMAT, version=VERSION, overwrite=overwrite) as append:

        def write(part: PointCloud) -> None:
            arrays, known = {name: getattr(part, name) for name in KINDS}, part.uncertainty
            if known is not None:
                arrays |= {name: getattr(known, name) for name in _UNCERTAINTY}
                arrays["systematic_mm2"] = known.systematic_mm2()
            append(arrays, _CloudHeader(metadata=_add_shared(part)))

        yield write


PointCloud.writer = staticmethod(write_cloud)


def write_ply_points(
    path: Path, columns: Mapping[str, np.ndarray], *, comments: Sequence[str] = (), overwrite: bool
) -> None:
    """Write columns (N,) as properties of vertices, binary and little-endian, completely or not at all."""
    write_file(path, encode_ply(columns, comments=comments), overwrite=overwrite)


def refuse_unsuitable_cloud(path: str | os.PathLike[str], *, overwrite: bool, coloured: bool = False) -> None:
    """Raise OutputError or SetupError if a cloud, possibly with colours, cannot be written (`refuse_unsuitable`)."""
    path = Path(path)
    refuse_unsuitable(path, overwrite=overwrite)
    require_ending(path, COLOURED_FORMATS if coloured else CLOUD_FORMATS)
    form = find_format(path)
    for name in () if form is None else form.libraries:
        load_library(name, path.suffix.strip(".").upper())


def read_cloud(path: str | os.PathLike[str], *, unit: Unit | None = None) -> PointCloud:
    """Read a cloud from HDF5 (``.h5``), PLY, or a format of other programs.

    PLY of other programs needs only x, y, z. Further formats are text (``.xyz``, ``.csv`` and others, mm), LAS, LAZ and
    E57 (m). Field names as changed by CloudCompare (`scalar_intensity` and so on) are recognised. Missing intensity is
    NaN, missing frame and line are -1, and a deviation that is missing or all NaN is None.

    ``unit`` is that of PLY and text of other programs whose names of columns state none; by default mm.

    Raises
    ------
    CaptureError
        The file is missing, not a cloud, or truncated, has no x, y, z, or its metadata is damaged. It states
        another unit than ``unit``.
    """
    return read_thinned_cloud(path, unit=unit)[0]


def load_cloud(cloud: PointCloud | str | os.PathLike[str], *, unit: Unit | None = None) -> PointCloud:
    """Return a cloud to measure, as it is or read from a file; raises the errors of `read_cloud`.

    Repeated points are omitted with a warning. Another one says if the file has no more of the uncertainty than the
    standard deviation along the normal. Both are logged and added to the cloud's warnings.
    """
    found, warnings = omit_repeated(cloud if isinstance(cloud, PointCloud) else read_cloud(cloud, unit=unit))
    if found.random_std_mm is not None and found.uncertainty is None and _LEAN not in found.warnings:
        warnings.append(_LEAN)
    if not warnings:
        return found
    log_warnings("cloud" if isinstance(cloud, PointCloud) else cloud, warnings)
    return replace(found, warnings=[*found.warnings, *warnings])


def read_thinned_cloud(
    path: str | os.PathLike[str], at_most: int | None = None, *, unit: Unit | None = None
) -> tuple[PointCloud, int]:
    """Read every n-th point of a cloud's file, at most ``at_most``, and the number of points; see `read_cloud`.

    For HDF5 and binary PLY only these are held in memory.
    """
    with _name_errors(path):
        if (form := find_format(path)) is not None:
            if form.unit is not None:
                _refuse_other_unit(path, unit)
            whole = form.read(Path(path), unit)
            cloud, total = whole.select(_choose_rows(len(whole), at_most)), len(whole)
        else:
            cloud, total = _read_rows(Path(path), lambda count: _choose_rows(count, at_most), unit)
        if not len(cloud) and cloud.warnings:
            raise CaptureError(f"no point is left: {'; '.join(cloud.warnings)}")
    log_warnings(path, cloud.warnings)
    return cloud, total


def read_region(
    path: str | os.PathLike[str],
    low_mm: ArrayLike,
    high_mm: ArrayLike,
    at_most: int | None = None,
    *,
    unit: Unit | None = None,
) -> PointCloud:
    """Read the points in the box from ``low_mm`` (3,) to ``high_mm`` (3,), or an even sample of ``at_most``.

    HDF5 and binary PLY are read one part at a time.
    """
    low, high = np.asarray(low_mm, float), np.asarray(high_mm, float)
    if low.shape != (3,) or high.shape != (3,) or not (np.isfinite([low, high]).all() and (low < high).all()):
        raise CaptureError(f"a region goes from x, y, z to larger x, y, z; found {low.tolist()} to {high.tolist()} mm")
    found = [
        part.select(np.flatnonzero(np.all((part.points_mm >= low) & (part.points_mm <= high), axis=1)))
        for part in read_parts(path, unit=unit)
    ]
    whole = concatenate_clouds(found)
    return whole.select(_choose_rows(len(whole), at_most))


def read_parts(
    path: str | os.PathLike[str], most: int = POINTS_OF_PART, *, unit: Unit | None = None
) -> Iterator[PointCloud]:
    """Read a cloud's file in parts of at most ``most`` points, in order.

    For HDF5 and binary PLY only one part is held in memory.
    """
    if find_format(path) is not None:
        whole = read_cloud(path, unit=unit)
        yield from (whole.select(slice(start, start + most)) for start in range(0, max(len(whole), 1), most))
        return
    start, total = 0, 1
    while start < total:
        with _name_errors(path):
            part, total = _read_rows(Path(path), lambda _, start=start: slice(start, start + most), unit)
        log_warnings(path, part.warnings)
        yield part
        start += most


def unit_of(path: str | os.PathLike[str]) -> Unit:
    """Return the unit in which `write_cloud` writes coordinates, by the ending of the name."""
    form = find_format(path)
    return "mm" if form is None or form.unit is None else form.unit


def _refuse_other_unit(path: str | os.PathLike[str], unit: Unit | None) -> None:
    """Raise CaptureError if a file's format prescribes another unit than the given one."""
    prescribed = unit_of(path)
    if unit not in (None, prescribed):
        raise CaptureError(
            f"{path} is in {prescribed}, as its format prescribes, but the unit {unit} was given: omit it"
        )


@contextmanager
def _name_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Add the file's name to CaptureErrors without it."""
    try:
        yield
    except CaptureError as error:
        raise CaptureError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def _read_rows(path: Path, rows: _Rows, unit: Unit | None) -> tuple[PointCloud, int]:
    """Read selected rows of a file, and the number of all; ``rows`` selects them by that number."""
    ending = path.suffix.lower()
    if ending == ".h5":
        _refuse_other_unit(path, unit)
        return _read_hdf5(path, rows)
    if ending != ".ply":
        with open_regular(path, called="cloud") as file:
            if not file.read(4).startswith(b"ply"):
                raise CaptureError(f"{path} ends with none of {', '.join(CLOUD_ENDINGS)}, the formats of clouds")
    return _read_ply(path, rows, unit)


def _choose_rows(count: int, at_most: int | None) -> slice:
    """Return a slice with an even sample of at most ``at_most`` of ``count`` points."""
    return slice(None, None, 1 if at_most is None else max(1, -(-count // at_most)))


def name_cloud(path: str | os.PathLike[str]) -> str:
    """Return the name of a cloud's file without its ending, such as ``.ply`` or ``.cloud.h5``."""
    return re.sub(r"\.(cloud|full|float)$", "", Path(path).stem)


def is_lean(path: str | os.PathLike[str]) -> bool:
    """Return whether `write_cloud` writes no more of the uncertainty than standard deviations along the normal."""
    name = str(path).lower()
    return name.endswith(".ply") and not name.endswith(FULL)


def is_cloud(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a cloud, by its ending, or by its label if captures have the same ending."""
    if _is_hdf5(path):
        return read_format(Path(path)) == FORMAT
    if Path(path).suffix.lower() == ".ply":
        return True
    form = find_format(path)
    return form is not None and not form.ambiguous


def is_readable_cloud(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a cloud (`is_cloud`), or is text, which may contain one."""
    return is_cloud(path) or find_format(path) is not None


def _is_hdf5(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".h5"


def _list_uncertainty_columns(uncertainty: PointUncertainty | None) -> dict[str, np.ndarray]:
    """Return columns (N,) float32 by the names of their vertex properties."""
    if uncertainty is None:
        return {}
    parts = {"random": uncertainty.random_mm2, "systematic": uncertainty.systematic_mm2()}
    columns = {
        f"{part}_{pair}": each for part, each in parts.items() for pair, each in zip(_PAIR_NAMES, each.T, strict=True)
    }
    moves = {"position": uncertainty.position_mm}
    for part, several in (("pattern", uncertainty.patterns_mm), ("pose", uncertainty.poses_mm)):
        moves |= {f"{part}{k}": move for k, move in enumerate(() if several is None else several)}
    columns |= {f"{name}_{axis}": move[:, k] for name, move in moves.items() for k, axis in enumerate("xyz")}
    return {name: values.astype(np.float32) for name, values in columns.items()}


def _add_shared(cloud: PointCloud) -> Table:
    """Return the metadata to store, with the errors shared with other clouds."""
    if cloud.uncertainty is None or not cloud.uncertainty.shared:
        return cloud.metadata
    shared: Table = {name: np.round(each, 9).tolist() for name, each in cloud.uncertainty.shared.items()}
    return {**cloud.metadata, _SHARED: shared}


def _split_shared(metadata: Table, known: PointUncertainty | None) -> tuple[Table, PointUncertainty | None]:
    """Separate metadata from shared errors; raises CaptureError if the errors do not match the uncertainty."""
    if _SHARED not in metadata:
        return metadata, known
    rest = {name: each for name, each in metadata.items() if name != _SHARED}
    if known is None:
        return rest, None
    stated = metadata[_SHARED]
    try:
        if not isinstance(stated, dict):
            raise TypeError("not an object")
        shared = {name: np.array(each, dtype=np.float64) for name, each in stated.items()}
    except (TypeError, ValueError) as error:
        raise CaptureError(f"its metadata is damaged: {_SHARED} holds no numbers") from error
    return rest, replace(known, shared=shared)


def _make_comments(metadata: Table) -> list[str]:
    text = metadata_json(metadata)
    pieces = [text[start : start + _PIECE_LENGTH] for start in range(0, len(text), _PIECE_LENGTH)]
    # The semicolon protects a trailing blank of a piece, which readers strip.
    return [f"{_COMMENT} {number}/{len(pieces)} {piece};" for number, piece in enumerate(pieces, start=1)]


def _read_metadata(comments: list[str]) -> Table:
    stored = [comment for comment in comments if comment.startswith(_COMMENT)]
    if not stored:
        return {}
    pieces = [_PIECE.fullmatch(comment) for comment in stored]
    wanted = [(str(number), str(len(stored))) for number in range(1, len(stored) + 1)]
    if [piece and piece.groups()[:2] for piece in pieces] != wanted:
        raise CaptureError("its metadata is incomplete; write the file again or remove those comments")
    try:
        metadata = parse_json("".join(piece.group(3) for piece in pieces if piece))
    except ValueError as error:
        raise CaptureError(f"its metadata is damaged: {error}") from error
    if not isinstance(metadata, dict):
        raise CaptureError(f"its metadata is a {type(metadata).__name__}; expected a JSON object")
    return metadata


def _read_uncertainty(names: Mapping[str, str], column: Callable[[str], np.ndarray]) -> PointUncertainty | None:
    """Return the uncertainty in columns ``names``; None without all of them."""
    count, parts = (sum(f"{part}{k}_x" in names for k in range(len(names))) for part in ("pattern", "pose"))
    wanted = [[f"random_{pair}" for pair in _PAIR_NAMES]]
    wanted += [[f"{move}_{axis}" for axis in "xyz"] for move in ("position", *(f"pattern{k}" for k in range(count)))]
    if not count or not all(name in names for each in wanted for name in each):
        return None
    random, position, *patterns = (np.column_stack([column(name) for name in each]) for each in wanted)
    turned = [[f"pose{k}_{axis}" for axis in "xyz"] for k in range(parts)]
    known = parts and all(name in names for each in turned for name in each)
    poses = np.stack([np.column_stack([column(name) for name in each]) for each in turned]) if known else None
    return PointUncertainty(random, position, np.stack(patterns), poses_mm=poses)


def _read_ply(path: Path, rows: _Rows, unit: Unit | None) -> tuple[PointCloud, int]:
    try:
        whole, comments = read_ply(path, "vertex", called="cloud")
    except (OSError, MemoryError) as error:
        reason = (
            f"cannot be read: {error.strerror or error}"
            if isinstance(error, OSError)
            else "does not fit into the memory"
        )
        raise CaptureError(f"{path} {reason}") from error
    if whole is None:
        raise CaptureError(f"{path} is a PLY file without vertices; expected an element 'vertex'")
    vertices, names = whole[rows(len(whole))], whole.dtype.names or ()
    known = {name.lower().removeprefix("scalar_"): name for name in names} | {name: name for name in names}
    if missing := [axis for axis in "xyz" if axis not in known]:
        raise CaptureError(f"the vertices have no {', '.join(missing)}, only {', '.join(names) or 'nothing'}")

    def column(name: str, default: float, kind: type = np.float32) -> np.ndarray:
        if name not in known:
            return np.full(len(vertices), default, kind)
        values = vertices[known[name]]
        if values.dtype.kind not in "iuf" or values.ndim > 1:
            raise CaptureError(f"the property {known[name]} is a list; expected one number per point")
        return values.astype(kind)

    def indices(name: str) -> np.ndarray:
        values = column(name, NO_INDEX, np.float64)
        wrong = ~(np.isfinite(values) & (values == np.round(values)) & (np.abs(values) < 2**31))
        if wrong.any():
            raise CaptureError(f"{np.count_nonzero(wrong)} values of {name} are no whole numbers")
        return values.astype(np.int32)

    points = np.column_stack([column(axis, np.nan, np.float64) for axis in "xyz"])
    chosen, warnings = omit_points(points, {})
    points, vertices = points[chosen], vertices[chosen]
    uncertainty = _read_uncertainty(known, lambda name: column(name, np.nan))
    lean = known if uncertainty is None else ()
    deviation = column("deviation", np.nan)
    metadata, uncertainty = _split_shared(_read_metadata(comments), uncertainty)
    named, doubts = "mm", list[str]()
    if metadata.keys() - {STEP} or uncertainty is not None:
        _refuse_other_unit(path, unit)
    else:
        named, doubts = find_stated_unit(comments)
    scale = choose_scale(named, unit, path, CaptureError)
    cloud = PointCloud(
        points_mm=scale * points,
        intensity=column("intensity", np.nan),
        frame=indices("frame"),
        line=indices("line"),
        deviation_mm=None if np.isnan(deviation).all() else deviation,
        uncertainty=uncertainty,
        time_s=column("time", np.nan, np.float64) if "time" in known else None,
        metadata=metadata,
        warnings=[*doubts, *warnings],
        random_std_mm=column("random_std", np.nan) if "random_std" in lean else None,
        common_std_mm=column("common_std", np.nan) if "common_std" in lean else None,
    )
    return note_step(cloud, scale * find_float_step(points)), len(whole)


class _CloudHeader(Description):
    """Header of a cloud's HDF5 file."""

    metadata: Table


def _read_hdf5(path: Path, rows: _Rows) -> tuple[PointCloud, int]:
    require_regular_file(path, called="cloud")
    try:
        with h5py.File(path, "r") as file:
            header = read_label(file, _CloudHeader, path=path, file_format=FORMAT, version=VERSION)
            points = find_dataset(file, "points_mm", path=path)
            total = 0 if points is None or not points.ndim else len(points)
            chosen = rows(total)
            selection: dict[str, tuple[slice, ...]] = dict.fromkeys((*KINDS, *_UNCERTAINTY), (chosen,))
            selection |= dict.fromkeys(("patterns_mm", "poses_mm"), (slice(None), chosen))
            found = {name: read_array(file, name, path=path, selection=each) for name, each in selection.items()}
    except DAMAGE as error:
        raise CaptureError(f"{path} is not a complete HDF5 file of a cloud: {error}") from error
    arrays: dict[str, Any] = {name: values for name, values in found.items() if values is not None}
    # Conversion must not truncate integers, nor round fractions.
    wanted_kinds = {name: np.dtype(KINDS.get(name, np.float32)).kind for name in arrays}
    if unusable := [name for name, values in arrays.items() if values.dtype.kind != wanted_kinds[name]]:
        raise CaptureError(f"{path} is damaged: {', '.join(unusable)} are no numbers of the expected kind")
    integers = [name for name in ("frame", "line") if name in arrays]
    if unusable := [name for name in integers if (np.abs(arrays[name].astype(np.float64)) >= 2**31).any()]:
        raise CaptureError(f"{path} is damaged: {', '.join(unusable)} has values of more than 32 bits")
    parts = {name: arrays.pop(name) for name in _UNCERTAINTY if name in arrays}
    wanted = [*PER_POINT, *(_UNCERTAINTY[:-1] if parts else ())]
    if missing := [name for name in wanted if name not in arrays | parts]:
        raise CaptureError(f"{path} is damaged: it has no {', '.join(missing)}")
    metadata, known = _split_shared(header.metadata, PointUncertainty(**parts) if parts else None)
    return PointCloud(**arrays, uncertainty=known, metadata=metadata), total
