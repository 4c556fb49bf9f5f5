"""Which image of a folder is what: by patterns of names, or by the columns of a table."""

import csv
import re
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

import numpy as np

from uwlts.model.errors import DescriptionError, ImageError
from uwlts.storage.import_.description import ImportDescription, Patterns
from uwlts.storage.import_.images import SUFFIXES

POSE_COLUMNS = tuple(f"pose_{row}{column}" for row in range(4) for column in range(4))
"""Elements of ``T_scene_object``, row by row."""

_NUMBERS = ("stage_mm", "exposure_ms", "time_s")
_COLUMNS = ("file", "light", "background", *_NUMBERS, *POSE_COLUMNS)
_LIGHTS = ("laser", "lamp", "ignore")


@dataclass(frozen=True, eq=False)
class Row:
    """Entries of a table for one image, None where there is none; ``number`` is its place in the table."""

    file: str
    number: int = 0
    light: str | None = None
    background: str | None = None
    stage_mm: float | None = None
    exposure_ms: float | None = None
    time_s: float | None = None
    pose: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Matched:
    """Images by what they are, as paths below the folder, in order; ``background`` holds one per laser image or none.

    ``unmatched`` are images of the folder that nothing describes.
    """

    laser: list[Row]
    lamp: list[Row]
    background: list[str]
    unmatched: list[str]


def natural_key(name: str) -> list[str | int]:
    """Key by which image9 comes before image10."""
    return [int(part) if part.isdigit() else part.casefold() for part in re.split(r"([0-9]+)", name)]


def image_files(folder: Path) -> list[str]:
    """Images below a folder in natural order, as paths with slashes; ImageError where there are none."""
    if not folder.is_dir():
        raise ImageError(f"no folder at {folder}")
    found = [path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES]
    names = [name.as_posix() for name in found if not any(part.startswith(".") for part in name.parts)]
    if not names:
        raise ImageError(f"{folder} holds no image: expected files that end with {', '.join(SUFFIXES)}")
    return sorted(names, key=natural_key)


def read_rows(path: Path) -> list[Row]:
    """Rows of a CSV table with the column ``file`` and any of light, background, stage_mm, exposure_ms, time_s, pose_00
    to pose_33; separated by commas or semicolons.

    Raises
    ------
    DescriptionError
        The table is missing, empty, has an unknown column, a file twice, an unknown light, or a cell that is no number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DescriptionError(f"cannot read the table {path}: {getattr(error, 'strerror', error)}") from error
    lines = text.splitlines()
    if len(lines) < 2:
        raise DescriptionError(f"{path} is empty: expected a line of column names and one for each image")
    reader = csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",", skipinitialspace=True)
    columns = [name.strip() for name in reader.fieldnames or ()]
    reader.fieldnames = columns
    unknown = [name for name in columns if name not in _COLUMNS]
    if unknown or "file" not in columns or len(set(columns)) < len(columns):
        raise DescriptionError(
            f"{path} has the columns {', '.join(columns)}; expected file and any of "
            f"{', '.join(_COLUMNS[1:6])}, pose_00 to pose_33, each once"
        )
    rows = [_row(number, cells, f"{path}, line {reader.line_num}") for number, cells in enumerate(reader)]
    names = [row.file for row in rows]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DescriptionError(f"{path} names {', '.join(twice[:3])} more than once: one line for each image")
    return rows


def match(folder: Path, given: ImportDescription, rows: list[Row] | None) -> Matched:
    """Sort a folder's images by what they are.

    Raises
    ------
    DescriptionError
        No image is known to be anything, one is two things, a named file is missing, or it is open which background
        belongs to which image.
    """
    files = image_files(folder)
    if rows is not None:
        missing = [row.file for row in rows if not (folder / row.file).is_file()]
        if missing:
            raise DescriptionError(f"the table names {', '.join(missing[:3])}, which {folder} does not hold")
    if rows is not None and any(row.light is not None for row in rows):
        if given.laser or given.lamp:
            raise DescriptionError(
                "the table has a column light, and there are patterns laser or lamp: give one of them"
            )
        dark = [row.file for row in rows if row.light is None]
        if dark:
            raise DescriptionError(f"the table does not give the light of {', '.join(dark[:3])}: laser, lamp or ignore")
        laser, lamp = ([row for row in rows if row.light == light] for light in ("laser", "lamp"))
        ignored = [row.file for row in rows if row.light == "ignore"]
    else:
        known = [Row(name) for name in files] if rows is None else rows
        ignored = [row.file for row in known if matches(row.file, given.ignore)]
        known = [row for row in known if row.file not in ignored]
        laser, lamp = ([row for row in known if matches(row.file, light)] for light in (given.laser, given.lamp))
    both = sorted({row.file for row in laser} & {row.file for row in lamp})
    if both:
        raise DescriptionError(
            f"{', '.join(both[:3])} would be both laser and lamp image: narrow the patterns; where the laser is drawn "
            "on the lit target, it is a laser image, and the image without laser is lamp and background"
        )
    if not laser and not lamp:
        raise DescriptionError(
            f"none of the {len(files)} images of {folder} is a laser or a lamp image: give patterns such as laser = "
            "'laser*.png' and lamp = 'lamp*.png', or a table with a column light"
        )
    background = _backgrounds(folder, [name for name in files if matches(name, given.background)], given, laser)
    used = {row.file for row in [*laser, *lamp]} | set(background) | set(ignored)
    unmatched = [name for name in files if name not in used and not matches(name, given.ignore)]
    return Matched(laser, lamp, background, unmatched)


def matches(name: str, patterns: Patterns) -> bool:
    """Whether a path below the folder, or its last part, matches a pattern."""
    wanted = (patterns,) if isinstance(patterns, str) else patterns
    return any(fnmatch(name, pattern) or fnmatch(PurePosixPath(name).name, pattern) for pattern in wanted)


def _backgrounds(folder: Path, found: list[str], given: ImportDescription, laser: list[Row]) -> list[str]:
    """One background per laser image, or none at all."""
    named = [row.background for row in laser if row.background is not None]
    if named and (given.background or len(named) < len(laser)):
        advice = ", and there is a pattern as well: give one" if given.background else ": name it for all or none"
        raise DescriptionError(f"the table names a background for {len(named)} of {len(laser)} laser images{advice}")
    if named:
        missing = [name for name in named if not (folder / name).is_file()]
        if missing:
            raise DescriptionError(f"the table names the background {missing[0]}, which {folder} does not hold")
        return named
    if not given.background:
        return []
    lit = sorted(set(found) & {row.file for row in laser}, key=natural_key)
    if lit:
        raise DescriptionError(f"{', '.join(lit[:3])} would be both laser and background image: narrow the patterns")
    if len(found) not in (1, len(laser)):
        raise DescriptionError(
            f"there are {len(found)} background images for {len(laser)} laser images: expected one for all or one for "
            "each, else name them in a table's column background"
        )
    return found * len(laser) if len(found) == 1 else found


def _row(number: int, cells: dict[str, str], place: str) -> Row:
    if None in cells or None in cells.values():
        raise DescriptionError(f"{place}: there are more or fewer cells than columns")
    texts = {name: cell.strip() for name, cell in cells.items()}
    if not texts["file"]:
        raise DescriptionError(f"{place}: the file's name is missing")
    for file in (PurePosixPath(texts["file"]), PurePosixPath(texts.get("background", ""))):
        if file.is_absolute() or ".." in file.parts:
            raise DescriptionError(f"{place}: {file} lies outside the folder; name it by its path below the folder")
    light = texts.get("light", "").lower() or None
    if light is not None and light not in _LIGHTS:
        raise DescriptionError(f"{place}: the light is {light!r}; expected {', '.join(_LIGHTS)}")
    numbers = {name: _number(texts.get(name, ""), f"{place}: {name}") for name in (*_NUMBERS, *POSE_COLUMNS)}
    elements = [numbers.pop(name) for name in POSE_COLUMNS]
    given = [element is not None for element in elements]
    if any(given) and not all(given):
        raise DescriptionError(f"{place}: only {sum(given)} of the 16 elements of the pose are given")
    pose = np.array(elements, dtype=np.float64).reshape(4, 4) if all(given) else None
    return Row(texts["file"], number, light, texts.get("background") or None, **numbers, pose=pose)


def _number(text: str, place: str) -> float | None:
    if not text:
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise DescriptionError(f"{place} is {text!r}; expected a number with a decimal point") from error
    if not np.isfinite(value):
        raise DescriptionError(f"{place} is {text}; expected a finite number")
    return value


@dataclass(frozen=True, eq=False)
class PlannedFrame:
    """A frame of the capture to be: image file, background file, and what is known of it; None where it is not."""

    path: Path
    laser_on: bool
    stage_mm: float
    exposure_ms: float | None
    time_s: float | None
    pose: np.ndarray | None
    background: Path | None


def planned_frames(folder: Path, given: ImportDescription, matched: Matched, *, in_table: bool) -> list[PlannedFrame]:
    """All frames in the order of the table, or of their positions, at each the lamp image before the laser image.

    Raises
    ------
    DescriptionError
        Positions are missing, given twice, or the same for two images of one light.
    """
    positions = _positions(given, matched)
    ordered = []
    for laser_on, rows in ((False, matched.lamp), (True, matched.laser)):
        exposure = given.exposure_ms if laser_on or given.lamp_exposure_ms is None else given.lamp_exposure_ms
        for place, row in enumerate(rows):
            frame = PlannedFrame(
                path=folder / row.file,
                laser_on=laser_on,
                stage_mm=_listed_mm(row) if positions is None else positions[place],
                exposure_ms=exposure if row.exposure_ms is None else row.exposure_ms,
                time_s=row.time_s,
                pose=row.pose,
                background=folder / matched.background[place] if laser_on and matched.background else None,
            )
            ordered.append((row.number if in_table else place, laser_on, frame))
    frames = [frame for *_, frame in sorted(ordered, key=lambda entry: entry[:2])]
    if not given.repeated:
        _refuse_repeated(frames)
    return frames


def stage_remark(given: ImportDescription) -> str:
    """Source of the positions, for the capture's provenance."""
    if given.stage.free:
        return "none: stage_mm counts the poses"
    if given.stage.start_mm is not None:
        return f"from {given.stage.start_mm:g} mm in steps of {given.stage.step_mm:g} mm"
    return "positions as listed"


def _positions(given: ImportDescription, matched: Matched) -> list[float] | None:
    """Position for each place in the natural order; None where the table gives them."""
    rows = [*matched.laser, *matched.lamp]
    stage, in_column = given.stage, any(row.stage_mm is not None for row in rows)
    elsewhere = stage.free or stage.start_mm is not None or stage.positions_mm is not None
    if in_column and elsewhere:
        raise DescriptionError("the table has a column stage_mm, and [stage] gives positions too: give one of them")
    if in_column:
        return None
    if not elsewhere:
        raise DescriptionError(
            "the positions of the stage are missing: give [stage] start_mm and step_mm, or positions_mm, or a table "
            "with a column stage_mm; or [stage] free = true if every image has a pose of its own"
        )
    counts = [len(rows) for rows in (matched.laser, matched.lamp) if rows]
    if len(set(counts)) > 1:
        raise DescriptionError(
            f"there are {counts[0]} laser and {counts[1]} lamp images: it is open which were taken at the same "
            "position; give a table with a column stage_mm"
        )
    count = counts[0]
    if stage.positions_mm is not None and len(stage.positions_mm) != count:
        raise DescriptionError(
            f"positions_mm has {len(stage.positions_mm)} positions for {count} images of a light: expected one for each"
        )
    if stage.positions_mm is not None:
        return list(stage.positions_mm)
    if stage.start_mm is not None and stage.step_mm is not None:
        return [stage.start_mm + place * stage.step_mm for place in range(count)]
    # Free poses have no positions; they are numbered.
    return [float(place) for place in range(count)]


def _listed_mm(row: Row) -> float:
    if row.stage_mm is None:
        raise DescriptionError(f"the position of {row.file} is missing: fill in stage_mm in the table, or leave it out")
    return row.stage_mm


def _refuse_repeated(frames: list[PlannedFrame]) -> None:
    """Two images of one light at one place, as from a step of zero or a line copied in the table."""
    seen: dict[tuple[bool, float], PlannedFrame] = {}
    for frame in frames:
        if frame.pose is not None:
            continue
        other = seen.setdefault((frame.laser_on, frame.stage_mm), frame)
        if other is not frame:
            raise DescriptionError(
                f"{other.path.name} and {frame.path.name} have the same position, {frame.stage_mm:g} mm: correct it, "
                "or give repeated = true if several images were taken there"
            )
