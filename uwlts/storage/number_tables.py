"""Tables of numbers in text files of other programs: their separators, encodings, names and units."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from io import BytesIO
from itertools import takewhile
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
from pyarrow import csv

from uwlts.errors import DescriptionError, Error
from uwlts.files.reading import read_bytes, shorten

Unit = Literal["mm", "m"]
MM_PER_UNIT: dict[Unit, float] = {"mm": 1.0, "m": 1000.0}
ROTATION_NAMES = ("qw", "qx", "qy", "qz", "rx", "ry", "rz", "roll", "pitch", "yaw", "angle", "heading")
"""Names of columns with rotations, as `read_number_table` returns them; it returns positions as x, y, z."""

_MOST_BYTES = 512 * 2**20  # ten million rows
_LENGTHS = {"nm": 1e-6, "um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1e3, "km": 1e6}
_LENGTHS |= {"in": 25.4, "ft": 304.8, "yd": 914.4}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "gon": np.pi / 200}
_TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
_SAME_UNITS = {"degree": "deg", "°": "deg", "radian": "rad", "grad": "gon", "second": "s", "micron": "um"}
_SAME_UNITS |= {'"': "in", "inch": "in", "inches": "in", "foot": "ft", "feet": "ft"}
_PREFIXES = {"": "m", "milli": "mm", "centi": "cm", "micro": "um", "kilo": "km"}
_SAME_UNITS |= {f"{prefix}met{end}": unit for prefix, unit in _PREFIXES.items() for end in ("re", "er")}
"""Units by their names, which may have a plural with s."""
_UNITS = _LENGTHS | _ANGLES | _TIMES
_DIRECTIONS = {"east": (1, 0, 0), "north": (0, 1, 0), "up": (0, 0, 1)}
_DIRECTIONS |= {"west": (-1, 0, 0), "south": (0, -1, 0), "down": (0, 0, -1)}
_HEIGHTS = {"height": "up", "altitude": "up", "alt": "up", "elevation": "up", "depth": "down"}
_LETTERS = {name[0]: name for name in ("east", "north", "up", "down")}
_UNITS_OF = (
    {"time_s": _TIMES}
    | dict.fromkeys((*"xyz", *_DIRECTIONS), _LENGTHS)
    | dict.fromkeys((*ROTATION_NAMES[4:], "phi", "theta", "psi", "omega", "kappa"), _ANGLES)
)
"""Units of the columns whose units are converted or checked."""
_SAME_NAMES = {name: name for name in (*ROTATION_NAMES, *_DIRECTIONS)} | _HEIGHTS
_SAME_NAMES |= {f"{name}ing": name for name in ("east", "north", "west", "south")}
_SAME_NAMES |= dict.fromkeys(("azimuth", "bearing", "course", "cog", "compass", "hdg", "hdt", "hdm"), "heading")
_BEFORE_NAMES = re.compile(r"(?:p|pos|position|[xyz]|utm|local|true|mag|magnetic|compass|gyro)[._ ](.+)")
_OF_NUMBERS = {"q0": "qw", "q1": "qx", "q2": "qy", "q3": "qz"}
_TIME_NAMES = ("time", "t", "timestamp", "stamp", "time_s")
_IN_BRACKETS = re.compile(r"(.*?)[\s_]*[\[(<](.*)[\])>]")
_AT_END = re.compile(r"(.+?)[\s_/.\-]+([^\s_/.\-]+)|([xyz])(mm|cm|um|m)")
_POSITION = re.compile(
    r"(?:(?:p|t|(?:.*[._ /])?(?:pos|position|trans|translation|coord|coordinate|point))(?:[._ ](?:.*[._ ])?)?)?([xyz])"
    r"(?:[._ -]?(?:pos|position|coord|coordinate|value|axis))?"
)
_QUATERNION = re.compile(
    r"(?:.*[._ /])?(?:(?:q|quat|quaternion|orientation)(?:[._ ](?:.*[._ ])?)?([wxyz])|(?:rot|rotation)[._ ]?(w))"
)
_ROTATION = re.compile(r"(?:.*[._ /])?(?:r|rot|rotation|rotvec)[._ ]?([xyz])")
_DECIMAL_COMMA = re.compile(rb"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?")
_UNIT_IN_COMMENT = re.compile(
    r"\b(?:in|units?)\b[\s:=;,]*(?:the |are |is )?[\[(]?(m|cm|um|µm|in|inch(?:es)?|ft|feet|(?:centi)?met(?:re|er)s?)\b"
    r"|^\W*(?:1 )?(?:length|file|model|scene|linear|system)?[\s_]*units?\s*[:=]"
)
_STATED_UNIT = re.compile(
    r"\W*(?:(?:length|file|model|scene|linear|system)[\s_]*)?units?[\s:=;,]+[\[(\"']*([a-zµμ]+)\W*"
)
_NUMBER = re.compile(rb"[+-]?\d*(?:[.,](\d*))?")
_FIRST, _FEWEST = 200, 10
"""Number of rows whose decimals are counted, and fewest rows that show them."""
_COMMENTS = (b"#", b"//", b"%", b"!")
_LONGEST_BLOCK = 200
"""Number of lines before the names of columns, with a sensor's type, number and settings; those seen have 5 to 30."""


@dataclass(frozen=True, eq=False)
class NumberTable:
    """Columns (N,) by name, the units that their names state, and notes on uncertain readings.

    Times are in s. Other columns are in the unit that their name states. ``steps`` are those of their decimals.
    ``length_unit`` is that which a line beside the table states, as "unit: m"; empty without. ``directions`` are those
    of x, y and z if their names say it, such as east, north and up. ``titles`` are the names in the file, for messages.
    """

    path: Path
    columns: dict[str, np.ndarray]
    units: dict[str, str] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    length_unit: str = ""
    directions: tuple[str, ...] = ()
    titles: str = ""

    def mm_per_unit(self, unit: Unit | None = None) -> float:
        """Return the length unit of columns in mm, from their names or a line beside them, or ``unit``; by default 1.

        Raises DescriptionError if the names contradict each other or ``unit``.
        """
        stated = {name: self.units.get(name, "") for name in "xyz" if name in self.columns}
        if len(found := set(stated.values())) > 1:
            texts = ", ".join(f"{name} in {each or 'no stated unit'}" for name, each in stated.items())
            raise DescriptionError(f"{self.path} has {texts}; expected one unit in the names of all axes")
        in_names = next(iter(found), "") or self.length_unit
        if self.length_unit not in ("", in_names):
            raise DescriptionError(f"{self.path} names columns in {in_names}, and states the unit {self.length_unit}")
        return choose_scale(in_names, unit, self.path)


def choose_scale(stated: str, unit: Unit | None, path: Path, error: type[Error] = DescriptionError) -> float:
    """Return the unit of length that a file states in mm, else ``unit``, by default 1.

    Raises ``error`` if both are given and differ.
    """
    given = MM_PER_UNIT[unit or "mm"]
    if unit is not None and stated and _LENGTHS[stated] != given:
        raise error(f"{path} states {stated}, but the unit {unit} was given: leave the unit out, or correct the file")
    return _LENGTHS[stated] if stated else given


def find_stated_unit(texts: Iterable[str]) -> tuple[str, list[str]]:
    """Return the unit of length that comments state, as "unit: m", else an empty text and doubts about other words."""
    texts = [*texts]
    matches = (_STATED_UNIT.fullmatch(text.lower()) for text in texts)
    lengths = {_simplify_unit(match[1]) for match in matches if match} & _LENGTHS.keys()
    if len(lengths) == 1:
        return lengths.pop(), []
    stated = [text for text in texts if _UNIT_IN_COMMENT.search(text.lower())]
    doubt = "a comment may state another unit than that of the coordinates"
    return "", [f"{doubt}: {shorten(stated[0], 100)}"] if stated else []


def _split_lines(
    content: bytes, path: Path
) -> tuple[list[bytes], list[bytes], bytes | None, bytes | None, list[bytes]]:
    """Return comments at the beginning, lines before the names of columns, these names, units and rows."""
    lines = [stripped for line in content.splitlines() if (stripped := line.strip(b" ")) and not stripped.isspace()]
    comments = [*takewhile(lambda line: line.startswith(_COMMENTS), lines)]
    if any(mark in content for mark in _COMMENTS):
        lines = [line for line in lines if not line.startswith(_COMMENTS)]
    if not lines:
        raise DescriptionError(f"{path} is empty: expected a table of numbers")
    counted = None
    if len(lines) > 1 and lines[0].isdigit() and len(lines[0]) < 12 and len(_split(lines[1])) > 1:
        counted = int(lines.pop(0))
    lines, block = _drop_block(lines)
    header = None
    first = [cell.strip().strip(b'"') for cell in _split(lines[0])]
    if any(first) and not any(map(_is_number, first)):
        header, *lines = lines
        if not lines:
            raise DescriptionError(f"{path} has no rows after the names of its columns")
    unit_row = lines.pop(0) if len(lines) > 1 and header is not None and _is_unit_row(lines[0]) else None
    if counted not in (None, len(lines)):
        raise DescriptionError(
            f"{path} states {counted} rows in its first line and has {len(lines)}: it is incomplete or has several "
            "parts"
        )
    return comments, block, header, unit_row, lines


def read_number_table(path: Path, *, named: bool = True) -> NumberTable:
    """Read a table of numbers, separated by commas, semicolons, tabs or blanks.

    With separators other than commas, numbers may have decimal commas. Lines that begin with #, //, % or ! are
    comments; the last comment before the numbers names the columns if it contains x and z, or an angle. A first line
    with the number of rows is recognised, as are other lines before such names, a row of units below them, UTF-8,
    UTF-16 and Latin-1. Names are in lower case and without unit.
    Usual names for times, positions, quaternions and Euler angles become ``time_s``, ``x``, ``qw``, ``roll`` and so
    on. Without names, two columns are x and z, and others are numbered.

    Raises DescriptionError if the file is no such table, rows are missing, or a name states an unknown unit.
    """
    content = read_bytes(path, most_bytes=_MOST_BYTES, error=DescriptionError, called="table")
    content = _decode_wide(content, path)
    comments, block, header, unit_row, lines = _split_lines(content, path)
    delimiter, comma = _find_separators(lines[0])
    count = len(_split(lines[0], delimiter))
    named_in = header or next((each for each in reversed(comments) if _names_columns(each, delimiter, count)), None)
    cells = _name_cells(named_in, delimiter, count) if named_in else []
    if unit_row is not None:
        cells = _add_units(cells, _name_cells(unit_row, delimiter, count), path)
    body = b"\n".join(lines) + b"\n"
    if delimiter == b" " and b"  " in body:
        body = re.sub(rb" {2,}", b" ", body)
    comma = comma or (delimiter != b"," and b"," in body)
    if header is None and delimiter == b"," and _seems_decimal(lines[:_FIRST]):
        raise DescriptionError(
            f"{path} has cells such as '00' between commas: commas seem to be both decimal and separators. "
            "Export it with another separator"
        )
    names, units = _find_names_and_units(cells, path)
    if not names:
        names = ["x", "z"] if named and count == 2 else [str(number) for number in range(count)]
    if len(set(names)) < len(names):
        raise DescriptionError(f"{path} has the columns {', '.join(names)}: expected each name once")
    names, directions = _name_axes(names, path)
    units |= {axis: units.pop(name) for axis, name in zip("xyz", directions, strict=False) if name in units}
    columns = _parse(body, names, delimiter, comma, path)
    if lines[0].endswith(delimiter) and not (cells and cells[-1]) and np.isnan(columns[names[-1]]).all():
        del columns[names[-1]]
    if "time_s" in columns:
        columns["time_s"] = columns["time_s"] * _TIMES[units.get("time_s", "s")]
    notes = ["commas between digits were read as decimal commas, blanks as separators"] * (comma and delimiter == b" ")
    if block:
        notes.append(
            f"lines before the names of columns are omitted ({len(block)}): {shorten(_read(block[0]), 60)} ..."
        )
    stated, doubts = find_stated_unit(map(_read, [*block, *comments[:1000]]))
    notes += doubts if not units.keys() & set("xyz") else []
    decimals = map(_count_decimals, zip(*(_split(line, delimiter) for line in lines[:_FIRST]), strict=False))
    steps = {name: 10.0**-count for name, count in zip(names, decimals, strict=False) if count is not None}
    return NumberTable(path, columns, units, steps, notes, stated, directions, ", ".join(cells or names))


def _parse(body: bytes, names: list[str], delimiter: bytes, comma: bool, path: Path) -> dict[str, np.ndarray]:
    try:
        table = csv.read_csv(
            BytesIO(body),
            read_options=csv.ReadOptions(column_names=names, use_threads=False),
            parse_options=csv.ParseOptions(delimiter=delimiter.decode()),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.float64()),
                null_values=["", "NaN", "nan", "NAN", "-nan", "null", "None"],
                decimal_point="," if comma else ".",
            ),
        )
    except (pa.ArrowInvalid, pa.ArrowException) as error:
        raise DescriptionError(f"{path} is no table of numbers: {str(error).splitlines()[0]}") from error
    return {name: table[name].to_numpy(zero_copy_only=False).astype(np.float64) for name in names}


def _find_names_and_units(cells: list[str], path: Path) -> tuple[list[str], dict[str, str]]:
    """Return the usual names of columns, and the units that they state; raises DescriptionError for unknown ones."""
    names: list[str] = []
    units: dict[str, str] = {}
    for number, cell in enumerate(cells, start=1):
        name, unit = _split_unit(cell)
        if unit is not None and unit not in (known := _UNITS_OF.get(name, {unit: 1.0})):
            raise DescriptionError(
                f"{path} has a column {shorten(repr(cell))} with an unknown unit; expected one of {', '.join(known)}"
            )
        names.append(name or f"column {number}")
        units |= {names[-1]: unit} if unit else {}
    if {"q0", "q1", "q2", "q3"} <= set(names):  # the scalar is q0
        names = [_OF_NUMBERS.get(name, name) for name in names]
    if "qw" in names:
        names = [f"q{name[1]}" if name in ("rx", "ry", "rz") else name for name in names]
    full = _spell_directions(names)
    return full, {new: units[old] for old, new in zip(names, full, strict=True) if old in units}


def _name_axes(names: list[str], path: Path) -> tuple[list[str], tuple[str, ...]]:
    """Return names with x, y and z for three directions, and these; DescriptionError for a left-handed frame."""
    if "x" not in names and {"lat", "latitude"} & {*names}:
        raise DescriptionError(f"{path} has latitudes, which are angles: convert positions to lengths, such as UTM")
    known = _DIRECTIONS if "z" in names else _DIRECTIONS | {"x": _DIRECTIONS["east"], "y": _DIRECTIONS["north"]}
    found = tuple(name for name in names if name in known)
    if len(found) != 3 or not (volume := np.linalg.det([known[name] for name in found])):
        return names, ()
    if volume < 0 or "x" in found:
        other = ", or name x and y north and east if they are" if "x" in found else ""
        raise DescriptionError(
            f"{path} has the axes {', '.join(found)}, a left-handed frame that mirrors all shapes: exchange the first "
            f"two, or change the sign of the last{other}"
        )
    return [dict(zip(found, "xyz", strict=True)).get(name, name) for name in names], found


def _spell_directions(names: list[str]) -> list[str]:
    """Return three letters of directions, such as n, e and d, in full; up beside x and y as z, and z as up else."""
    same = _LETTERS if len(_LETTERS.keys() & names) == 3 else {}
    if {"x", "y"} <= {*names}:
        same = {} if "z" in names else {"up": "z"}
    elif len(_DIRECTIONS.keys() & names) == 2:
        same = {"z": "up"}
    return [same.get(name, name) for name in names]


def _is_unit_row(line: bytes) -> bool:
    """Return whether the cells of a line are units or empty."""
    cells = [_strip_unit(cell) for cell in re.split(r"[,;\t]" if re.search(rb"[,;\t]", line) else r"\s+", _read(line))]
    return any(cells) and all(not cell or cell in _UNITS for cell in cells)


def _strip_unit(cell: str) -> str:
    """Return a unit without quotes and brackets; empty for a dash or one, which mean none."""
    unit = _simplify_unit(cell.strip(" \"'[]()<>").lower())
    return "" if unit in ("-", "1") else unit


def _add_units(names: list[str], units: list[str], path: Path) -> list[str]:
    """Return names with the units of the row below; raises DescriptionError if a name states another unit."""
    if len(units) != len(names):
        raise DescriptionError(f"{path} has {len(names)} names of columns and {len(units)} units in the row below")
    found = []
    for name, unit in zip(names, map(_strip_unit, units), strict=True):
        stated = _split_unit(name)[1]
        if unit and stated not in (None, unit):
            raise DescriptionError(f"{path} has a column {shorten(repr(name))} and the unit {unit} in the row below")
        found.append(f"{name} [{unit}]" if unit and stated is None else name)
    return found


def _decode_wide(content: bytes, path: Path) -> bytes:
    """Return the content without byte order mark, UTF-16 as UTF-8."""
    start = content[:1000]
    kind = ""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        kind = "utf-16"
    elif start.count(0) > 0.4 * len(start) > 1:
        kind = "utf-16-le" if start[1::2].count(0) > start[::2].count(0) else "utf-16-be"
    try:
        return content.decode(kind).encode() if kind else content.removeprefix(b"\xef\xbb\xbf")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{path} is no table of numbers: it is no complete text in UTF-16") from error


def _seems_decimal(lines: list[bytes]) -> bool:
    """Return whether commas between cells seem to be decimal too: cells such as 00, or decimals in every second."""
    if any(re.search(rb"(^|,) *-?0\d", line) for line in lines):
        return True
    decimals = [[*map(bytes.strip, line.split(b",")[1::2])] for line in lines if line.count(b",") % 2]
    plain = all(cell.isdigit() for row in decimals for cell in row)
    lengths = [{*map(len, column)} for column in zip(*decimals, strict=False)]
    # Cells of one length in three columns.
    return plain and _FEWEST <= len(decimals) == len(lines) and len(lengths) > 2 and max(map(len, lengths)) == 1


def _drop_block(lines: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Remove lines that sensors write before the names of columns, and return them, too.

    The names contain x and z, or an angle, and a row of as many numbers follows, perhaps after a row of units.
    """
    for number, line in enumerate(lines[:_LONGEST_BLOCK]):
        further = lines[number + 1 : number + 3]
        if row := next((each for each in further if not _is_unit_row(each)), None):
            cells, delimiter = _split(row), _find_separators(row)[0]
            numbers = all(not cell.strip() or _is_number(cell) for cell in cells)
            if numbers and _names_columns(line, delimiter, len(cells)):
                return lines[number:], lines[:number]
    return lines, []


def _find_separators(line: bytes) -> tuple[bytes, bool]:
    """Return the separator of a line, and whether commas are decimal although blanks separate the numbers."""
    for mark in (b";", b"\t"):
        if mark in line.strip():
            return mark, False
    parts = line.split()
    if len(parts) > 1 and b"," in line and all(map(_DECIMAL_COMMA.fullmatch, parts)):
        return b" ", True
    return (b"," if b"," in line else b" "), False


def _split(line: bytes, delimiter: bytes = b"") -> list[bytes]:
    """Return the cells of a line, by default by its own separator."""
    delimiter = delimiter or _find_separators(line)[0]
    return line.split() if delimiter == b" " else line.split(delimiter)


def _count_decimals(cells: Iterable[bytes]) -> int | None:
    """Return the largest number of decimals; None if a number has an exponent, or too few rows show it."""
    found = [_NUMBER.fullmatch(cell.strip().strip(b'"')) for cell in cells]
    known = [len(match[1] or b"") for match in found if match]
    return max(known) if known and len(known) == len(found) >= _FEWEST else None


def _is_number(text: bytes) -> bool:
    try:
        float(text.replace(b",", b"."))
    except ValueError:
        return False
    return True


def _name_cells(line: bytes, delimiter: bytes, count: int) -> list[str]:
    """Return the names in a line, separated like the numbers or, if their count differs then, in another way."""
    text = re.sub(r"\s+(?=[\[(<])", "", re.sub(r"^(?:#|//|%|!)+\s*", "", _read(line)))
    mark = delimiter.decode()
    ways = [text.split(mark) if mark != " " else text.split(), re.split(r"[,;\t]", text), re.split(r"[,;\s]+", text)]
    found = next((cells for cells in ways if len(cells) == count), ways[0])
    return [cell.strip().strip('"').strip() for cell in found]


def _read(line: bytes) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _names_columns(line: bytes, delimiter: bytes, count: int) -> bool:
    """Return whether a comment names columns: x and z, or an angle."""
    cells = _name_cells(line, delimiter, count)
    names = {*_spell_directions([_split_unit(cell)[0] for cell in cells])}
    known = {"x", "z"} <= names or "angle" in names or len(names & _DIRECTIONS.keys()) == 3
    return len(cells) == count and known


def _split_unit(cell: str) -> tuple[str, str | None]:
    """Return the usual name of a column, and the unit in brackets or after a known name; None without."""
    text = cell.lower().removeprefix("scalar_")
    unit = None
    if match := _IN_BRACKETS.fullmatch(text):
        text, unit = match[1], _simplify_unit(match[2]) or None
    elif match := _AT_END.fullmatch(text):
        stem, last = match[1] or match[3], _simplify_unit(match[2] or match[4])
        if last in _UNITS and _normalise_name(stem) in _UNITS_OF.keys() | _LETTERS:
            text, unit = stem, last
    return _normalise_name(text.strip()), unit


def _simplify_unit(unit: str) -> str:
    unit = unit.strip().replace("µ", "u").replace("μ", "u")
    singular = unit.removesuffix("s") if len(unit) > len("sec") else unit
    return _SAME_UNITS.get(unit) or _SAME_UNITS.get(singular, unit)


def _normalise_name(name: str) -> str:
    if name in _TIME_NAMES:
        return "time_s"
    after = match[1] if (match := _BEFORE_NAMES.fullmatch(name)) else name
    if same := _SAME_NAMES.get(after, after if after in _LETTERS else ""):
        return same
    if match := _QUATERNION.fullmatch(name):
        return f"q{match[1] or match[2]}"
    if match := _POSITION.fullmatch(name):
        return match[1]
    match = _ROTATION.fullmatch(name)
    return f"r{match[1]}" if match else name
