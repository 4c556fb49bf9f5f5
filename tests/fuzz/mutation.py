"""Mutations of valid files: of single bytes, and of the contents of each format."""

import contextlib
import json
import struct
import zlib
from pathlib import Path
from random import Random

import h5py
import numpy as np

ODD_JSON = ("null", "true", "NaN", "-Infinity", "1e999", "1e308", "-1e308", "5e-324", "-1", "0", "1" * 25, "1" * 5000)
ODD_JSON += ('""', '"\\u0000"', '"../../etc/passwd"', "[]", "{}", "[[[[]]]]", '{"a":1,"a":2}', "[" * 200 + "]" * 200)
ODD_JSON += ('"' + "x" * 5000 + '"', "[1,2,3,4]", "1e-308", "1.5", "9007199254740993")
ODD_TOML = (
    "nan",
    "-inf",
    "1e308",
    "-1e308",
    "5e-324",
    "-1",
    "0",
    "0x" + "f" * 40,
    "9" * 5000,
    '""',
    '"\\u0000"',
    "true",
)
ODD_TOML += (
    '"../../etc/passwd"',
    "[]",
    "{}",
    "{ a = 1 }",
    "[[[]]]",
    "2020-01-01",
    "1e-308",
    "[1, 2, 3]",
    '"' + "x" * 5000 + '"',
)
ODD_TOML += ("99999999", '"thesis"', "[nan, 1.0, 2.0]", "1e12", "1e-12")
ODD_WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "1e999",
    "9" * 30,
    "9" * 5000,
    "\0",
    "",
    "&a",
    "*a",
    "[",
    "{",
    "]",
    "-",
    "x" * 5000,
)
ODD_WORDS += (
    "list",
    "uchar",
    "float64",
    "99999999",
    "4294967296",
    "1e-308",
    "<a>",
    "!!python/object:os.system",
    "é",
    "²",
)
ODD_NUMBERS = (np.nan, np.inf, -1.0, 1e305, 1e-320, 0.0, 1e18)


def changed(content: bytes, form: str, rng: Random, folder: Path) -> bytes:
    """Return the content with a random change; ``folder`` is for files that are changed in place."""
    if rng.random() < 0.4:
        return _bytes(content, rng)
    forms = {"json": _json, "toml": _toml, "lines": _words, "image": _image, "bytes": _bytes}
    if form == "hdf5":
        return _hdf5(content, rng, folder / "changed.h5")
    return forms[form](content, rng)


def _bytes(content: bytes, rng: Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        place = rng.randrange(len(data) + 1)
        length = min(rng.choice((1, 2, 4, 8, 64)), len(data) - place)
        match rng.randrange(6):
            case 0:
                data[place : place + length] = rng.randbytes(length)
            case 1:
                data[place : place + length] = rng.choice((b"\0", b"\xff", b"\x7f", b"\x80")) * length
            case 2:
                del data[place : place + rng.choice((length, len(data)))]
            case 3:
                data[place:place] = data[place : place + rng.choice((1, 16, 256))] * rng.choice((1, 3, 50))
            case 4 if length:
                data[place] ^= 1 << rng.randrange(8)
            case _:
                start = rng.randrange(len(data) + 1)
                data[place : place + length] = data[start : start + length]
    return bytes(data)


_HOLE = "\ue000"


def _json(content: bytes, rng: Random) -> bytes:
    """Replace, remove or repeat one or more values."""
    table, odd = json.loads(content), []
    if isinstance(table, dict) and rng.random() < 0.9:
        # With its seal, every changed file would be refused for this alone.
        table.pop("sha256", None)
    for _ in range(rng.choice((1, 1, 1, 3))):
        place, key = table, None
        while isinstance(place, dict | list) and place:
            above, key = place, rng.choice([*(place if isinstance(place, dict) else range(len(place)))])
            place = above[key]
            if rng.random() < 0.2:
                break
        if key is None:
            continue
        if rng.random() < 0.1:
            del above[key]
            continue
        if isinstance(place, int | float) and rng.random() < 0.3:
            above[key] = place * rng.choice((-1, 1 + 1e-9, 1e3, 1e-3, 1e30))
            continue
        above[key] = f"{_HOLE}{len(odd)}{_HOLE}"
        odd.append(rng.choice(ODD_JSON))
    text = json.dumps(table, ensure_ascii=False)
    for number, each in enumerate(odd):
        text = text.replace(f'"{_HOLE}{number}{_HOLE}"', each)
    return text.encode("utf-8", "surrogatepass")


def _toml(content: bytes, rng: Random) -> bytes:
    """Replace the values of one or more keys, or remove, repeat or move a line."""
    lines = content.decode().splitlines()
    for _ in range(rng.choice((1, 1, 2, 4))):
        place = rng.randrange(len(lines))
        key, equals, _ = lines[place].partition("=")
        if equals and rng.random() < 0.8:
            lines[place] = f"{key}= {rng.choice(ODD_TOML)}"
        else:
            lines.insert(rng.randrange(len(lines)), lines.pop(place) if rng.random() < 0.5 else lines[place])
    return "\n".join(lines).encode()


def _words(content: bytes, rng: Random) -> bytes:
    """Replace one or more words of the text; in binary PLY, only words of the header."""
    head, end, tail = content.partition(b"end_header\n") if content.startswith(b"ply") else (content, b"", b"")
    if b"ascii" in head:
        head, end, tail = content, b"", b""
    for _ in range(rng.choice((1, 1, 2, 4))):
        words = head.split(rng.choice((b" ", b" ", b",", b"\n")))
        words[rng.randrange(len(words))] = rng.choice(ODD_WORDS).encode()
        head = (b" " if len(words) < 3 or rng.random() < 0.02 else _between(head, words)).join(words)
    return head + end + tail


def _between(head: bytes, words: list[bytes]) -> bytes:
    """Return the separator between the words of a text."""
    return next(mark for mark in (b" ", b",", b"\n") if head.count(mark) == len(words) - 1 or mark == b"\n")


def _image(content: bytes, rng: Random) -> bytes:
    """Change sizes in the header; the checksum of a PNG is updated."""
    data = bytearray(content)
    if data.startswith(b"\x89PNG"):
        size = [rng.choice((0, 1, 16, 20000, 2**31 - 1, rng.randrange(2**32))) for _ in range(2)]
        data[16:24] = struct.pack(">II", *size)
        if rng.random() < 0.5:
            data[24:29] = bytes(rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255)) for _ in range(5))
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
        return bytes(data)
    place = rng.randrange(min(len(data), 600) if rng.random() < 0.5 else len(data))
    data[place : place + 2] = rng.choice((b"\xff\xff", b"\0\0", b"\x7f\xff", b"\x20\x4e"))
    return bytes(data)


def _hdf5(content: bytes, rng: Random, path: Path) -> bytes:
    """Change values, shapes, types, links or the label with the HDF5 library."""
    path.write_bytes(content)
    odd = AttributeError, OSError, RuntimeError, ValueError, TypeError, KeyError, ArithmeticError
    with contextlib.suppress(*odd), h5py.File(path, "r+") as file:
        for _ in range(rng.choice((1, 1, 2))):
            name = rng.choice(list(file))
            if file[name].nbytes > 10**6:
                break
            values, kind = np.asarray(file[name]), rng.randrange(8)
            if kind in (0, 1) and values.size:
                file[name][tuple(rng.randrange(n) for n in values.shape)] = rng.choice(ODD_NUMBERS)
            elif kind == 2:
                label = file.attrs["header"]
                del file.attrs["header"]
                file.attrs["header"] = np.bytes_(_json(bytes(label), rng))
            else:
                _replaced(file, name, values, rng)
    return path.read_bytes()


def _replaced(file: h5py.File, name: str, values: np.ndarray, rng: Random) -> None:
    """Replace a dataset by another object."""
    del file[name]
    huge = (rng.choice((10**6, 10**9, 2**40)), *values.shape[1:])
    match rng.randrange(9):
        case 0:
            file[name] = h5py.ExternalLink("/etc/hostname", "/x")
        case 1:
            file[name] = h5py.SoftLink(f"/{name}")
        case 2:
            file.create_dataset(name, huge, values.dtype, chunks=True, compression="gzip")
        case 3:
            file.create_dataset(name, huge, values.dtype)
        case 4:
            kind = rng.choice(("S3", "c16", "i8", "u1", "f2", "i1", ">f8", h5py.string_dtype()))
            file.create_dataset(name, values.shape, kind)
        case 5:
            file.create_group(name)
        case 6:
            file.create_dataset(name, data=values[: len(values) // 2] if values.ndim else 0)
        case 7:
            file.create_dataset(name, values.shape, values.dtype, external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])
        case _:
            layout = h5py.VirtualLayout(values.shape, values.dtype)
            layout[...] = h5py.VirtualSource("/nowhere.h5", "x", values.shape)
            file.create_virtual_dataset(name, layout)
