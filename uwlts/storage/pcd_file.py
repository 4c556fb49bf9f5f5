"""PCD files of the Point Cloud Library, version 0.7: text, binary, and compressed (LZF)."""

import re
import struct
from pathlib import Path

import numpy as np

from uwlts.errors import CaptureError
from uwlts.files.reading import read_bytes
from uwlts.runtime.compiled import compiled

_MOST_BYTES = 2**31  # held in memory as a whole
_KINDS = {"F": "f", "I": "i", "U": "u"}
_LONGEST_HEADER = 2**16  # bytes; usual headers have 200
_LARGEST_RATIO = 132
"""Bytes that two or three bytes of LZF can stand for, divided by two: larger contents are damaged."""
_REST = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # position and quaternion of no motion


def read_pcd(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read the columns (N,) of a PCD file by name in lower case, and warnings; raises CaptureError if it is damaged."""
    content = read_bytes(path, most_bytes=_MOST_BYTES, called="cloud")
    match = re.search(rb"^DATA +(ascii|binary|binary_compressed) *\r?\n", content[:_LONGEST_HEADER], re.MULTILINE)
    if match is None:
        raise CaptureError(f"{path} is not a PCD file: it has no line DATA ascii, binary or binary_compressed")
    lines = (line.split() for line in content[: match.start()].decode("latin-1").splitlines())
    header = {line[0].upper(): line[1:] for line in lines if line and not line[0].startswith("#")}
    try:
        names = [name.lower() for name in header["FIELDS"]]
        sizes, kinds = [int(each) for each in header["SIZE"]], [_KINDS[each] for each in header["TYPE"]]
        counts = [int(each) for each in header.get("COUNT", ["1"] * len(names))]
        points = int(header["POINTS"][0] if "POINTS" in header else header["WIDTH"][0])
        viewpoint = tuple(map(float, header.get("VIEWPOINT", _REST)))
        if not 0 <= points < 2**31 or not len(names) == len(sizes) == len(kinds) == len(counts):
            raise ValueError("FIELDS, SIZE, TYPE and COUNT have different lengths")
        if not all(0 < count <= 4096 for count in counts):
            raise ValueError("a COUNT is not between 1 and 4096")
        # Padding has the name _, several times.
        kind = np.dtype(
            [(f"{n}", f"<{k}{s}", (c,)) for n, (k, s, c) in enumerate(zip(kinds, sizes, counts, strict=True))]
        )
        columns = _columns(content[match.end() :], match[1].decode(), kind, points)
    except (ValueError, LookupError, TypeError, ArithmeticError, MemoryError, struct.error) as error:
        raise CaptureError(f"{path} is not a complete PCD file: {error}") from error
    moved = [] if viewpoint == _REST else ["the VIEWPOINT of the file is not applied to the points"]
    return {name: column[:, 0] for name, column in zip(names, columns, strict=True)}, moved


def _columns(body: bytes, form: str, kind: np.dtype, points: int) -> list[np.ndarray]:
    """Return the columns (N, C) of a file's data; raises ValueError if there are fewer than declared."""
    fields = [kind[name] for name in kind.names or ()]
    if form == "binary":
        if len(body) < points * kind.itemsize:
            raise ValueError(f"{points} points need {points * kind.itemsize} bytes, found {len(body)}")
        table = np.frombuffer(body, kind, points)
        return [table[name] for name in kind.names or ()]
    if form == "ascii":
        numbers = np.array(body.split(), np.float64)
        width = sum(field.shape[0] for field in fields)
        if len(numbers) != points * width:
            raise ValueError(f"{points} points of {width} numbers were declared, {len(numbers)} numbers found")
        ends = np.cumsum([field.shape[0] for field in fields])[:-1]
        parts = np.split(numbers.reshape(points, width), ends, axis=1)
        # Numbers of 32 bits are rounded like those of other programs.
        return [
            part.astype(field.base) if field.base.kind == "f" else part
            for part, field in zip(parts, fields, strict=True)
        ]
    packed, size = struct.unpack("<II", body[:8])
    if size != points * kind.itemsize or len(body) < 8 + packed or size > _LARGEST_RATIO * packed:
        raise ValueError(f"{points} points need {points * kind.itemsize} bytes, {size} are declared")
    plain = np.empty(size, np.uint8)
    if _expand(np.frombuffer(body, np.uint8, packed, 8), plain) != size:
        raise ValueError("its compressed data is damaged")
    starts = np.cumsum([0, *(points * field.itemsize for field in fields)])
    return [
        np.frombuffer(plain, field.base, points * field.shape[0], start).reshape(points, -1)
        for field, start in zip(fields, starts, strict=False)
    ]


@compiled
def _expand(packed: np.ndarray, plain: np.ndarray) -> int:
    """Expand LZF data (bytes) into ``plain``, and return the number of bytes; -1 for damaged data.

    Control bytes below 32 precede that many literal bytes and one more; others are references: length in the upper
    three bits (7: plus the next byte) plus 2, distance in the lower five bits and another byte, plus 1.
    """
    at, done = 0, 0
    while at < packed.size:
        control = int(packed[at])
        at += 1
        if control < 32:
            count = control + 1
            if at + count > packed.size or done + count > plain.size:
                return -1
            for _ in range(count):
                plain[done] = packed[at]
                at += 1
                done += 1
            continue
        count = control >> 5
        if count == 7:
            if at >= packed.size:
                return -1
            count += int(packed[at])
            at += 1
        if at >= packed.size:
            return -1
        source = done - ((control & 31) << 8) - int(packed[at]) - 1
        at += 1
        count += 2
        if source < 0 or done + count > plain.size:
            return -1
        for _ in range(count):
            plain[done] = plain[source]
            source += 1
            done += 1
    return done
