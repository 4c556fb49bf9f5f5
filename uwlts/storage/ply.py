"""Files in PLY, text or binary: vertices with any numbers as properties, comments, and triangles."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError
from uwlts.files.reading import open_regular, shorten

_LONGEST_HEADER = 2**24  # bytes; comments of some scanners are long
_MOST_PROPERTIES = 1000  # more only occur in damaged files
_IN_ASCII = bytes(range(128)) + b"?" * 128  # comments may hold any bytes, such as names in UTF-8 or Latin-1
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8"}
_NAMES = {code: name for name, code in _TYPES.items()}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Property:
    """Property of an element: its name, type of numbers, and type of a list's length or None."""

    name: str
    kind: str
    length: str | None


@dataclass(frozen=True)
class _Header:
    text: bool
    order: str
    elements: dict[str, tuple[int, list[_Property]]]
    comments: list[str]
    size: int


def read_ply(path: Path, element: str, *, called: str) -> tuple[np.ndarray | None, list[str]]:
    """Read an element's table (N,) with the properties as fields, None without the element, and the comments.

    A list has one number in each column (N, K), or is an array of each object if lengths differ. Numbers in binary
    files without such objects are read from the disk on use. The whole file is examined, also after the element.

    Raises CaptureError if the file is missing, damaged or truncated.
    """
    header = _read_header(path, called=called)
    content = np.memmap(path, np.uint8, "r")[header.size :]
    lines = bytes(content).translate(_IN_ASCII).splitlines() if header.text else []
    found = None
    for name, (count, properties) in header.elements.items():
        if header.text:
            table, lines = _parse_lines(lines[:count], properties, count, path), lines[count:]
        else:
            table, used = _parse_bytes(content, properties, count, header.order, path)
            content = content[used:]
        found = table if name == element else found
    return found, header.comments


def read_comments(path: Path) -> list[str]:
    """Read the comments of a PLY file; CaptureError if its header is damaged."""
    return _read_header(path, called="cloud").comments


def encode_ply(columns: Mapping[str, np.ndarray], *, comments: Sequence[str] = ()) -> bytes:
    """Return a binary, little-endian file of vertices with columns (N,) as properties."""
    kinds = {name: values.dtype.newbyteorder("<") for name, values in columns.items()}
    vertices = np.empty(len(next(iter(columns.values()))), list(kinds.items()))
    for name, values in columns.items():
        vertices[name] = values
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {each}" for each in comments)]
    header += [f"element vertex {len(vertices)}"]
    header += [f"property {_NAMES[kind.str[1:]]} {name}" for name, kind in kinds.items()]
    return b"".join(["\n".join([*header, "end_header", ""]).encode("ascii"), vertices.view("u1").data])


def _fault(path: Path, what: str) -> CaptureError:
    return CaptureError(f"{path} is not a complete PLY file: {what}")


def _read_header(path: Path, *, called: str) -> _Header:
    with open_regular(path, called=called) as file:
        start, size = file.read(_LONGEST_HEADER), os.fstat(file.fileno()).st_size
    text, end, rest = start.partition(b"end_header")
    if not text.startswith((b"ply\n", b"ply\r")):
        raise _fault(path, "it does not begin with the line 'ply'")
    if not end:
        raise _fault(path, "its header has no end in the first 16 MiB")
    newline = b"\n" if text.startswith(b"ply\n") else b"\r\n" if text.startswith(b"ply\r\n") else b"\r"
    if not rest.startswith(newline):
        raise _fault(path, "early end-of-file, or other characters after end_header")
    order, elements, comments = "", {}, []
    count, properties = 0, []
    for line in text.translate(_IN_ASCII).decode("ascii").splitlines()[1:]:
        match line.split():
            case ["comment" | "obj_info" as kind, *_]:
                comments.append(line.strip().removeprefix(kind).strip())
            case []:
                pass
            case ["format", name, "1.0"] if name in _ORDERS and not order:
                order = name
            case ["element", name, number] if number.isdecimal() and len(number) <= 18 and name not in elements:
                count, properties = int(number), []
                elements[name] = count, properties
            case ["property", kind, name] if kind in _TYPES and elements:
                properties.append(_Property(name, _TYPES[kind], None))
            case ["property", "list", length, kind, name] if {length, kind} <= _TYPES.keys() and elements:
                properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case _:
                raise _fault(path, f"{shorten(repr(line))} is not an element, property, format or comment of PLY")
    if not order:
        raise _fault(path, "its header names no format")
    _require_complete(elements, size, path, ascii_text=order == "ascii")
    return _Header(order == "ascii", _ORDERS[order], elements, comments, len(text) + len(end) + len(newline))


def _require_complete(
    elements: dict[str, tuple[int, list[_Property]]], size: int, path: Path, *, ascii_text: bool
) -> None:
    """Raise CaptureError if names stand twice, or a file of ``size`` bytes is too short for its elements."""
    total, least = 0, 0
    for name, (number, columns) in elements.items():
        names = [each.name for each in columns]
        if len(set(names)) < len(names):
            raise _fault(path, f"a property of the element {shorten(name)} is declared twice")
        total += len(columns)
        # In text a number takes at least a digit and a separator; a list takes at least its length.
        least += number * sum(2 if ascii_text else np.dtype(c.length or c.kind).itemsize for c in columns)
    if total > _MOST_PROPERTIES:
        raise CaptureError(f"{path} has {total:,} properties; this program reads up to {_MOST_PROPERTIES:,}")
    # The last line of a text may end without a separator.
    if least > size:
        declared = f"its header declares at least {least:,} bytes of values, and the file has {size:,}"
        raise _fault(path, f"early end-of-file, {declared}")


def _make_table_type(properties: Sequence[_Property], order: str) -> np.dtype:
    return np.dtype([(one.name, "O" if one.length else order + one.kind) for one in properties])


def _parse_lines(lines: Sequence[bytes], properties: Sequence[_Property], count: int, path: Path) -> np.ndarray:
    """Parse the lines of an element, one for each row."""
    if len(lines) < count and properties:
        raise _fault(path, f"early end-of-file, {len(lines):,} of {count:,} lines of an element are there")
    table = np.empty(count if properties else 0, _make_table_type(properties, "="))
    columns: list[list[Any]] = [[] for _ in properties]
    for number, line in enumerate(lines if properties else ()):
        parts, place = line.split(), 0
        for one, column in zip(properties, columns, strict=True):
            word = parts[place] if place < len(parts) else b""
            length = int(word) if word.isdigit() and len(word) < 10 else len(parts)
            column.append(word if one.length is None else parts[place + 1 : place + 1 + length])
            place += 1 if one.length is None else 1 + length
        if place != len(parts):
            raise _fault(path, f"line {number + 1} of an element has {len(parts)} values; its header declares others")
    for one, column in zip(properties, columns, strict=True):
        try:
            if one.length is not None:
                table[one.name] = np.fromiter((np.array(each, float) for each in column), object, len(column))
                continue
            values = np.array([float(word) for word in column])
        except ValueError as error:
            raise _fault(path, f"{one.name}: {error}") from error
        if one.kind[0] in "iu":
            limits = np.iinfo(one.kind)
            if not ((values >= limits.min) & (values <= limits.max) & (values == np.round(values))).all():
                raise _fault(path, f"{one.name} has values that are no numbers of its type")
        with np.errstate(over="ignore"):
            table[one.name] = values
    return table


def _parse_bytes(
    content: np.ndarray, properties: Sequence[_Property], count: int, order: str, path: Path
) -> tuple[np.ndarray, int]:
    """Parse the bytes of an element; return its table and the number of bytes."""
    kind = _make_table_type(properties, order)
    if not kind.hasobject:
        used = count * kind.itemsize
        if used > len(content):
            raise _fault(path, f"early end-of-file, an element has {used:,} bytes, and the file {len(content):,} more")
        return (content[:used].view(kind) if used else np.empty(0, kind)), used
    row = _find_row_type(content, properties, order)
    if row is not None and 0 < (used := count * row.itemsize) <= len(content):
        rows = content[:used].view(row)
        (listed,) = (one for one in properties if one.length)
        if (rows[f"{listed.name} length"] == row[listed.name].shape[0]).all():
            return rows[[one.name for one in properties]], used
    return _parse_lists(np.asarray(content), properties, np.empty(count, kind), order, path)


def _parse_lists(
    content: np.ndarray, properties: Sequence[_Property], table: np.ndarray, order: str, path: Path
) -> tuple[np.ndarray, int]:
    """Fill the table of an element with lists of any lengths; return it and the number of bytes."""
    kinds, place = {code: np.dtype(order + code) for code in _NAMES}, 0

    def read(code: str, number: int) -> np.ndarray:
        nonlocal place
        place += number * kinds[code].itemsize
        if place > len(content):
            raise _fault(path, "early end-of-file within an element with lists")
        return content[place - number * kinds[code].itemsize : place].view(kinds[code])

    for number in range(len(table)):
        for one in properties:
            value = read(one.length or one.kind, 1)[0]
            if one.length is not None:
                if not 0 <= value <= len(content):
                    raise _fault(path, f"a list {one.name} has the length {value}")
                value = read(one.kind, int(value))
            table[one.name][number] = value
    return table, place


def _find_row_type(content: np.ndarray, properties: Sequence[_Property], order: str) -> np.dtype | None:
    """Return the type of rows whose only list has the length of that in the first row, such as triangles.

    None for rows of other kinds. The length is the field ``NAME length``; names of properties have no spaces.
    """
    if sum(one.length is not None for one in properties) != 1:
        return None
    fields: list[tuple[Any, ...]] = []
    for one in properties:
        if one.length is not None:
            place = np.dtype(fields).itemsize
            kind = np.dtype(order + one.length)
            first = content[place : place + kind.itemsize]
            length = float(first.view(kind)[0]) if len(first) == kind.itemsize else -1.0
            if not (0 <= length <= len(content) and length == int(length)):
                return None
            fields += [(f"{one.name} length", kind), (one.name, order + one.kind, (int(length),))]
        else:
            fields.append((one.name, order + one.kind))
    return np.dtype(fields)
