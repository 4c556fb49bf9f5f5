"""Read all numbers of the project's files without its own code, and compare those of two files."""

import contextlib
import json
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import h5py
import hdf5plugin  # noqa: F401 - registers the compression of captures
import laspy
import numpy as np
import pyarrow.parquet
import pye57
import trimesh
import yaml
from mcap.reader import make_reader

from uwlts.storage.mesh_file import has_faces, load_triangles
from uwlts.storage.ply import read_ply

RELATIVE = 1e-9
FLOORS = {"mm": 1e-9, "px": 2e-9, "rad": 2e-12, "deg": 2e-10, "s": 1e-9, "um": 1e-6, "step": 1.0, "": 2e-12}
"""Absolute differences that are ignored, by the unit in a name: no measurement resolves them.

They are 1e4 rounding errors of double precision (2.2e-16) of typical values: 500 mm, 1000 px, 1 rad, 60 deg, 500 s, and
1 without a unit. Coordinates stored as integers may differ by one step.
"""
SINGLE = 2.0 * np.finfo(np.float32).eps
"""Relative difference of numbers in single precision: one rounding in each direction."""
NOT_COMPARED = re.compile(r"(version|software|date|issued|sha256|digest|seal|seconds|platform|created|made|host)$")
"""Keys of values that differ between any two runs or versions."""
DIGEST = re.compile(r"\b[0-9a-f]{16,64}\b")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*:\d\d)")

Values = dict[str, np.ndarray | str]


@dataclass
class Agreement:
    """Difference of two sets of values: count of numbers, largest relative difference, and list of disagreements."""

    numbers: int = 0
    largest: float = 0.0
    differences: list[str] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)


def compare(old: Values, new: Values, name: str) -> Agreement:
    """Compare values of the same keys; different texts are noted, but do not count."""
    found = Agreement()
    found.differences += [f"{name}: only the old code writes {key}" for key in sorted(old.keys() - new.keys())]
    found.differences += [f"{name}: only the new code writes {key}" for key in sorted(new.keys() - old.keys())]
    for key in sorted(old.keys() & new.keys()):
        one, other = old[key], new[key]
        if isinstance(one, str) or isinstance(other, str):
            if not (isinstance(one, str) and isinstance(other, str)):
                found.differences.append(f"{name}: {key} is a text on one side and a number on the other")
            elif DIGEST.sub("", one) != DIGEST.sub("", other):
                found.texts.append(f"{name}: {key}: {one[:100]!r} is now {other[:100]!r}")
            continue
        found.numbers += one.size
        if one.shape != other.shape or one.dtype.kind != other.dtype.kind:
            found.differences.append(
                f"{name}: {key} has shape {one.shape}, {one.dtype} and now {other.shape}, {other.dtype}"
            )
            continue
        off, beyond = _difference(one, other, key)
        found.largest = max(found.largest, off)
        if beyond:
            found.differences.append(f"{name}: {key} differs in {beyond} of {one.size}, by up to {off:.1e} (relative)")
    return found


def _difference(one: np.ndarray, other: np.ndarray, key: str) -> tuple[float, int]:
    """Return the largest relative difference above the floor, and the number of values with too large a difference."""
    if one.dtype.kind not in "fc":
        count = int(np.count_nonzero(one != other))
        return (1.0 if count else 0.0), count
    single = one.dtype.itemsize < 8
    one, other = one.astype(float), other.astype(float)
    # NaN and infinity must be at the same positions.
    same = (one == other) | (np.isnan(one) & np.isnan(other))
    with np.errstate(invalid="ignore"):
        off = np.where(same, 0.0, np.abs(one - other))
        size = np.maximum(np.abs(one), np.abs(other))
    off = np.where(np.isfinite(off), off, np.inf)
    counts = off > _floor(one, key)
    with np.errstate(invalid="ignore"):
        relative = np.where(counts, off / np.where(size > 0, size, 1.0), 0.0)
    relative = np.where(np.isnan(relative), np.inf, relative)
    return float(relative.max(initial=0.0)), int(np.count_nonzero(relative > (SINGLE if single else RELATIVE)))


def _floor(values: np.ndarray, key: str) -> Any:
    if "covariance" in key and values.ndim >= 2 and values.shape[-1] == values.shape[-2]:
        # Divide a covariance by its standard deviations.
        std = np.sqrt(np.abs(np.einsum("...ii->...i", values)))
        return RELATIVE * std[..., :, None] * std[..., None, :]
    units = re.findall(r"_(mm2|mm|px|rad|deg|um|step|s)\b", key)
    if units and units[-1] == "mm2":
        return FLOORS["mm"] ** 2
    return FLOORS[units[-1] if units else ""]


def read_values(path: Path) -> Values:
    """Return all numbers and texts of a file by name; nothing for a page or another file that displays results."""
    match path.suffix:
        case ".json":
            return dict(_of_table(json.loads(path.read_text(encoding="utf-8"))))
        case ".yaml":
            return dict(_of_table(yaml.safe_load(path.read_text(encoding="utf-8"))))
        case ".toml":
            return dict(_of_table(tomllib.loads(path.read_text(encoding="utf-8"))))
        case ".h5":
            return dict(_of_hdf5(path))
        case ".ply":
            return dict(_of_ply(path))
        case ".laz":
            return dict(_of_laz(path))
        case ".e57":
            return dict(_of_e57(path))
        case ".mcap":
            return dict(_of_mcap(path))
        case ".glb" | ".stl":
            mesh = trimesh.load_mesh(path, process=False)
            return {"vertices_mm": np.asarray(mesh.vertices, np.float32), "faces": np.asarray(mesh.faces)}
        case ".parquet":
            table = pyarrow.parquet.read_table(path)
            return {name: np.asarray(table[name]) for name in table.column_names}
        case ".npy":
            return {"values": np.load(path)}
        case ".png" | ".tif" | ".tiff":
            return {"pixels": np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))}
        case ".csv" | ".xyz" | ".txt":
            return dict(of_text(path.read_text(encoding="utf-8")))
        case _:
            return {}


def of_text(text: str) -> Iterator[tuple[str, np.ndarray | str]]:
    """Yield the numbers in a text, in order, and the words between them; digests are words."""
    text = DIGEST.sub("DIGEST", text)
    yield "numbers", np.array([float(each) for each in NUMBER.findall(text)])
    yield "words", NUMBER.sub("#", text)


def _of_table(value: Any, key: str = "") -> Iterator[tuple[str, np.ndarray | str]]:
    if NOT_COMPARED.search(key):
        return
    if isinstance(value, dict):
        for name, each in value.items():
            yield from _of_table(each, f"{key}.{DIGEST.sub('DIGEST', str(name))}")
    elif isinstance(value, bool):
        yield key, np.array(value)
    elif isinstance(value, int | float):
        yield key, np.array(float(value))
    elif isinstance(value, list | tuple):
        array = _array(value)
        if array is not None:
            yield key, array
        else:
            for number, each in enumerate(value):
                yield from _of_table(each, f"{key}[{number}]")
            yield f"{key} (length)", np.array(len(value))
    elif value is not None:
        yield key, str(value)
    else:
        yield key, "none"


def _array(value: Any) -> np.ndarray | None:
    """Return nested lists as an array if they contain only numbers (None is not a number)."""
    try:
        array = np.array(value, dtype=object)
        if array.size and all(isinstance(each, int | float) and not isinstance(each, bool) for each in array.flat):
            return array.astype(float)
    except ValueError:
        pass
    return None


def _of_json_text(text: Any, key: str) -> Iterator[tuple[str, np.ndarray | str]]:
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    if isinstance(text, str) and text[:1] in "{[":
        with contextlib.suppress(ValueError):
            text = json.loads(text)
    yield from _of_table(text.item() if isinstance(text, np.generic) else text, key)


def _of_hdf5(path: Path) -> Iterator[tuple[str, np.ndarray | str]]:
    with h5py.File(path) as file:
        found: list[tuple[str, Any]] = [("", file)]
        file.visititems(lambda name, each: found.append((name, each)))
        for name, each in found:
            for label, value in each.attrs.items():
                yield from _of_json_text(value, f"{name}@{label}")
            if isinstance(each, h5py.Dataset):
                values = each[()]
                if isinstance(values, bytes | str):
                    yield from _of_json_text(values, name)
                elif values.dtype.names:
                    yield from ((f"{name}.{column}", values[column]) for column in values.dtype.names)
                elif values.dtype.kind in "OSU":
                    yield from ((f"{name}[{n}]", str(text)) for n, text in enumerate(np.ravel(values)))
                else:
                    yield name, values


def _of_ply(path: Path) -> Iterator[tuple[str, np.ndarray | str]]:
    table, comments = read_ply(path, "vertex", called="cloud")
    for column in table.dtype.names:
        yield f"vertex.{column}{'_mm' if column in ('x', 'y', 'z') else ''}", table[column]
    if has_faces(path):
        yield "face.vertex_indices", np.asarray(load_triangles(path).faces)
    metadata = [re.sub(r"^uwlts-metadata \d+/\d+ ", "", line) for line in comments if "-metadata " in line]
    yield from _of_json_text("".join(metadata), "metadata")
    for n, line in enumerate(each for each in comments if "-metadata " not in each):
        yield f"comment[{n}]", line


def _of_laz(path: Path) -> Iterator[tuple[str, np.ndarray | str]]:
    file = laspy.read(path)
    for column in file.point_format.dimension_names:
        if column in ("X", "Y", "Z"):
            yield f"{column}_step", np.asarray(file[column], float)
        else:
            yield column, np.asarray(file[column])
    yield "scales", np.asarray(file.header.scales)
    yield "offsets", np.asarray(file.header.offsets)


def _of_e57(path: Path) -> Iterator[tuple[str, np.ndarray | str]]:
    file = pye57.E57(str(path), mode="r")
    for number in range(file.scan_count):
        scan = file.read_scan_raw(number, ignore_unsupported_fields=True)
        yield from ((f"{number}.{column}", np.asarray(values)) for column, values in scan.items())


def _of_mcap(path: Path) -> Iterator[tuple[str, np.ndarray | str]]:
    with path.open("rb") as stream:
        for number, (_, channel, message) in enumerate(make_reader(stream).iter_messages()):
            yield f"{channel.topic}[{number}]", np.frombuffer(message.data, np.uint8)
