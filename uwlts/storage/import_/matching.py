"""Role of each image of a folder, by patterns of names or by the columns of a table."""

import csv
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from uwlts.errors import DescriptionError, ImageError
from uwlts.files.reading import is_regular_file, natural_key, read_text
from uwlts.model.sensor import is_rigid
from uwlts.storage.capture import NO_STAGE, POSE_ROUNDED
from uwlts.storage.image_file import SUFFIXES
from uwlts.storage.import_.folder_description import ImportDescription, Patterns
from uwlts.storage.numbering import Counted, count_names, name_gaps, time_gaps
from uwlts.storage.pose_files import check_matrices

POSE_COLUMNS = tuple(f"pose_{row}{column}" for row in range(4) for column in range(4))
"""Elements of ``T_scene_object``, row by row."""

_NUMBERS = ("stage_mm", "exposure_ms", "time_s")
_COLUMNS = ("file", "light", "background", *_NUMBERS, *POSE_COLUMNS)
_MOST_TABLE_BYTES = 8 * 2**20  # a hundred thousand images
_LIGHTS = ("laser", "lamp", "both", "ignore")


@dataclass(frozen=True, eq=False)
class ImageRow:
    """One image: paths relative to the folder, NaN and None if unknown; ``number`` is the order."""

    file: str
    number: int = 0
    light: str | None = None
    background: str | None = None
    stage_mm: float = math.nan
    exposure_ms: float = math.nan
    time_s: float = math.nan
    pose: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Matched:
    """Images in order by their role; ``unmatched`` are images of the folder that nothing describes."""

    laser: list[ImageRow]
    lamp: list[ImageRow]
    unmatched: list[str]


def read_rows(path: Path) -> list[ImageRow]:
    """Read a CSV table with the column ``file``, separated by commas or semicolons.

    Further columns are any of light, background, stage_mm, exposure_ms, time_s, pose_00 to pose_33. Raises
    DescriptionError if the table is missing or empty, or has an unknown column, a repeated file, an unknown light, or a
    cell that is not a number.
    """
    text = read_text(path, most_bytes=_MOST_TABLE_BYTES, error=DescriptionError, called="table")
    lines = text.splitlines()
    if len(lines) < 2:
        raise DescriptionError(f"{path} is empty: expected a line of column names and one for each image")
    reader = csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",", skipinitialspace=True)
    try:
        reader.fieldnames = columns = [name.strip() for name in reader.fieldnames or ()]
        found = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise DescriptionError(f"{path} is no CSV table: {error}") from error
    if not {"file"} <= set(columns) <= set(_COLUMNS) or len(set(columns)) < len(columns):
        raise DescriptionError(
            f"{path} has the columns {', '.join(columns)}; expected file and any of "
            f"{', '.join(_COLUMNS[1:6])}, pose_00 to pose_33, each once"
        )
    rows = [_parse_row(number, cells, f"{path}, line {line}") for number, (line, cells) in enumerate(found)]
    twice = sorted(name for name, count in Counter(row.file for row in rows).items() if count > 1)
    _refuse_any(twice, f"{path} names ", " more than once: one line for each image")
    return rows


def _parse_row(number: int, cells: dict[str, str], place: str) -> ImageRow:
    if None in cells or None in cells.values():
        raise DescriptionError(f"{place}: there are more or fewer cells than columns")
    texts = dict.fromkeys(_COLUMNS, "") | {name: cell.strip() for name, cell in cells.items()}
    if not texts["file"]:
        raise DescriptionError(f"{place}: the file's name is missing")
    for file in (PurePosixPath(texts["file"]), PurePosixPath(texts["background"])):
        if file.is_absolute() or ".." in file.parts:
            raise DescriptionError(f"{place}: {file} is outside the folder; give its path relative to the folder")
    light = texts["light"].lower() or None
    if light is not None and light not in _LIGHTS:
        raise DescriptionError(f"{place}: the light is {light!r}; expected {', '.join(_LIGHTS)}")
    numbers: dict[str, Any] = {name: _parse(texts[name], f"{place}: {name}") for name in (*_NUMBERS, *POSE_COLUMNS)}
    pose = np.array([numbers.pop(name) for name in POSE_COLUMNS]).reshape(4, 4)
    given = np.count_nonzero(np.isfinite(pose))
    if given not in (0, 16):
        raise DescriptionError(f"{place}: only {given} of the 16 elements of the pose are given")
    if numbers["exposure_ms"] < 0:
        raise DescriptionError(f"{place}: exposure_ms is {numbers['exposure_ms']:g}; expected a time of 0 or more")
    if given and not is_rigid(pose, within=POSE_ROUNDED):
        pose = check_matrices(pose[None], place)[0]
    return ImageRow(texts["file"], number, light, texts["background"] or None, pose=pose if given else None, **numbers)


def _parse(text: str, place: str) -> float:
    """Return the finite number of a cell, NaN if it is empty."""
    try:
        value = float(text) if text else 0.0
    except ValueError as error:
        raise DescriptionError(f"{place} is {text!r}; expected a number with a decimal point") from error
    if not math.isfinite(value):
        raise DescriptionError(f"{place} is {text}; expected a finite number")
    return value if text else math.nan


def _refuse_any(names: list[str], before: str, after: str) -> None:
    """Raise a DescriptionError with the first three names, if there are any."""
    if names:
        raise DescriptionError(f"{before}{', '.join(names[:3])}{after}")


def image_files(folder: Path) -> list[str]:
    """Return the paths of the images in a folder and its subfolders, in natural order; ImageError if there is none."""
    found = [path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES]
    files = [name.as_posix() for name in found if not any(part.startswith(".") for part in name.parts)]
    if not files:
        raise ImageError(f"{folder} holds no image: expected files that end with {', '.join(SUFFIXES)}")
    return sorted(files, key=natural_key)


def match(folder: Path, given: ImportDescription, rows: list[ImageRow] | None) -> Matched:
    """Assign roles to a folder's images, by patterns or by the ``rows`` of a table.

    Raises ImageError if the folder contains no image; DescriptionError if no image has a role, an image has two, a
    named file is missing, or the background of an image is ambiguous.
    """
    files = image_files(folder)
    known = [ImageRow(name) for name in files] if rows is None else rows
    missing = [row.file for row in known if not is_regular_file(folder / row.file)]
    _refuse_any(missing, "the table names ", f", which {folder} does not hold")
    if any(row.light is not None for row in known):
        if given.laser or given.lamp:
            raise DescriptionError(
                "the table has a column light, and there are patterns laser or lamp: give one of them"
            )
        dark = [row.file for row in known if row.light is None]
        _refuse_any(dark, "the table does not give the light of ", ": laser, lamp, both or ignore")
        laser, lamp = ([row for row in known if row.light in (light, "both")] for light in ("laser", "lamp"))
        ignored = [row for row in known if row.light == "ignore"]
    else:
        ignored = [row for row in known if matches(row.file, given.ignore)]
        used = [row for row in known if row not in ignored]
        laser, lamp = ([row for row in used if matches(row.file, light)] for light in (given.laser, given.lamp))
        lit, under_lamp = {row.file for row in laser}, {row.file for row in lamp}
        _refuse_any(
            [] if lit == under_lamp else sorted(lit & under_lamp),
            "",
            " would be both laser and lamp image, others only one: narrow the patterns, give both lights the same "
            "patterns if all images show the laser on the lit target, or name both in a table's column light",
        )
    if not laser and not lamp:
        raise DescriptionError(
            f"none of the {len(files)} images of {folder} is a laser or a lamp image: give patterns such as laser = "
            "'laser*.png' and lamp = 'lamp*.png', or a table with a column light"
        )
    unwanted = {name for name in files if matches(name, given.ignore)}
    dark = [name for name in files if matches(name, given.background) and name not in unwanted]
    laser = _add_backgrounds(folder, dark, given, laser)
    described = {name for row in (*laser, *lamp, *ignored) for name in (row.file, row.background)} | unwanted
    unmatched = [name for name in files if name not in described]
    return Matched(laser, lamp, unmatched)


def matches(name: str, patterns: Patterns) -> bool:
    """Return whether a path relative to the folder, or its last part, matches a pattern."""
    wanted = (patterns,) if isinstance(patterns, str) else patterns
    return any(fnmatch(name, pattern) or fnmatch(PurePosixPath(name).name, pattern) for pattern in wanted)


def _add_backgrounds(folder: Path, found: list[str], given: ImportDescription, laser: list[ImageRow]) -> list[ImageRow]:
    """Return the laser images, either all with a background or none; ``found`` match the background's pattern."""
    named = [row.background for row in laser if row.background is not None]
    if named and (given.background or len(named) < len(laser)):
        advice = ", and there is a pattern as well: give one" if given.background else ": name it for all or none"
        raise DescriptionError(f"the table names a background for {len(named)} of {len(laser)} laser images{advice}")
    missing = [name for name in named if not is_regular_file(folder / name)]
    _refuse_any(missing[:1], "the table names the background ", f", which {folder} does not hold")
    if named or not given.background:
        return laser
    lit = sorted(set(found) & {row.file for row in laser}, key=natural_key)
    _refuse_any(lit, "", " would be both laser and background image: narrow the patterns")
    if len(found) not in (1, len(laser)):
        raise DescriptionError(
            f"there are {len(found)} background images for {len(laser)} laser images: expected one for all or one for "
            "each, else name them in a table's column background"
        )
    one, other = (count_names(names, series=True) for names in (found, [row.file for row in laser]))
    if one and other and len(found) > 1:
        first = int(one.numbers[0]) if set(one.numbers) & set(other.numbers) else None
        if (one.places(first) != other.places(first)).any():
            raise DescriptionError(
                "the numbers of laser and background images differ: name the backgrounds in a table's column background"
            )
    names = found * len(laser) if len(found) == 1 else found
    return [replace(row, background=name) for row, name in zip(laser, names, strict=True)]


def planned_frames(given: ImportDescription, matched: Matched, *, in_table: bool) -> tuple[list[ImageRow], list[str]]:
    """Return all images in the order of the table, or of their positions, and warnings; lamp images are first.

    Each has its position and its light, laser or lamp. Raises DescriptionError if positions are missing, given twice,
    or equal for two images of one light.
    """
    positions, warnings = _list_positions(given, {"laser": matched.laser, "lamp": matched.lamp})
    lamp_ms = given.exposure_ms if given.lamp_exposure_ms is None else given.lamp_exposure_ms
    frames = []
    for light, rows, usual_ms in (("lamp", matched.lamp, lamp_ms), ("laser", matched.laser, given.exposure_ms)):
        for place, row in enumerate(rows):
            stage_mm = row.stage_mm if positions is None else positions[light][place]
            if math.isnan(stage_mm):
                raise DescriptionError(
                    f"the position of {row.file} is missing: fill in stage_mm in the table, or leave it out"
                )
            exposure_ms = usual_ms if usual_ms is not None and math.isnan(row.exposure_ms) else row.exposure_ms
            number = row.number if in_table else place
            frames.append(replace(row, light=light, number=number, stage_mm=stage_mm, exposure_ms=exposure_ms))
    frames.sort(key=lambda row: (row.number, row.light == "laser"))
    if not given.repeated:
        _refuse_repeated(row for row in frames if row.pose is None)
    return frames, warnings


def stage_remark(given: ImportDescription) -> str:
    """Return the source of the positions, for the capture's provenance."""
    if given.stage.free:
        return NO_STAGE
    if given.stage.start_mm is not None:
        return f"from {given.stage.start_mm:g} mm in steps of {given.stage.step_mm:g} mm"
    return "positions as listed"


def _list_positions(
    given: ImportDescription, lights: dict[str, list[ImageRow]]
) -> tuple[dict[str, list[float]] | None, list[str]]:
    """Return the positions of the images of each light in their order, None if the table gives them; and warnings."""
    stage = given.stage
    in_column = any(math.isfinite(row.stage_mm) for rows in lights.values() for row in rows)
    elsewhere = stage.free or stage.start_mm is not None or stage.positions_mm is not None
    if in_column and elsewhere:
        raise DescriptionError("the table has a column stage_mm, and [stage] gives positions too: give one of them")
    if in_column:
        return None, []
    if not elsewhere:
        raise DescriptionError(
            "the positions of the stage are missing: give [stage] start_mm and step_mm, or positions_mm, or a table "
            "with a column stage_mm; or [stage] free = true if every image has a pose of its own"
        )
    count, *other = (len(rows) for rows in lights.values() if rows)
    if other not in ([], [count]):
        raise DescriptionError(
            f"there are {count} laser and {other[0]} lamp images: it is unknown which share a "
            "position; give a table with a column stage_mm"
        )
    if stage.free:  # numbered, as they have no positions
        return {light: [float(place) for place in range(len(rows))] for light, rows in lights.items()}, []
    counts, warnings = _count_images(lights)
    if stage.positions_mm is not None:
        if len(stage.positions_mm) != count:
            raise DescriptionError(
                f"positions_mm has {len(stage.positions_mm)} positions for {count} images of a light: expected one for "
                "each"
            )
        return {light: [*stage.positions_mm] for light in lights}, warnings
    start_mm, step_mm = stage.start_mm or 0.0, stage.step_mm or 0.0
    return {light: [start_mm + place * step_mm for place in each] for light, each in counts.items()}, warnings


def _count_images(lights: dict[str, list[ImageRow]]) -> tuple[dict[str, list[int]], list[str]]:
    """Return the number of each image from that of the first one, by the names of the files; and warnings of gaps.

    Both lights have the same first image if they have numbers in common.
    """
    counts: dict[str, list[int]] = {light: [*range(len(rows))] for light, rows in lights.items()}
    found: dict[str, Counted] = {}
    warnings = []
    for light, rows in lights.items():
        names = [row.file for row in rows]
        counted = count_names(names)
        gaps = name_gaps(names, counted)
        if counted is not None:
            found[light] = counted
        warnings += [f"{gap}. Positions from start_mm follow the numbers, positions_mm the order" for gap in gaps]
        if not gaps:
            warnings += time_gaps(names, np.array([row.time_s for row in rows]))
    shared = len(found) == 2 and bool(set.intersection(*(set(each.numbers.tolist()) for each in found.values())))
    first = min((int(each.numbers[0]) for each in found.values()), default=0) if shared else None
    return counts | {light: each.places(first).tolist() for light, each in found.items()}, warnings


def _refuse_repeated(frames: Iterable[ImageRow]) -> None:
    """Raise DescriptionError for two images of one light at one position, as from a step of zero or a repeated line."""
    seen: dict[tuple[str | None, float], ImageRow] = {}
    for row in frames:
        other = seen.setdefault((row.light, row.stage_mm), row)
        if other is not row:
            raise DescriptionError(
                f"{PurePosixPath(other.file).name} and {PurePosixPath(row.file).name} have the same position, "
                f"{row.stage_mm:g} mm: correct it, or give repeated = true if several images were taken there"
            )
