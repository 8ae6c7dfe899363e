"""The MAT format, versions 4 and 5 (MATLAB up to 7.2), read without trust in what it says.

scipy.io.loadmat reads memory that is not the file's where a file says so, and takes the process
with it; a recording may come from anyone. Here every length is checked against the bytes that there
are. Read are real matrices, words, cells and structures; what else a file holds is passed over.

MathWorks, "MAT-File Format", R2023b, sections "Level 5 MAT-File Format" and "Level 4 MAT-File
Format".
"""

from __future__ import annotations

import math
import zlib
from typing import Any, Literal, NamedTuple

import numpy as np

Value = Any
"""An array; a list of values, for a cell; a list of dicts of values, for a structure."""

Order = Literal["little", "big"]

NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
"""Types of data elements, as NumPy's."""
WORDS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
"""Types of data elements that hold words, and how those are encoded."""

MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, CHAR, SPARSE, FIRST_NUMBER, LAST_NUMBER = 1, 2, 4, 5, 6, 15
"""Classes of arrays."""

COMPLEX = 0x0800

OLD_TYPES = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}
"""Types of numbers in version 4."""

MOST_DEPTH = 8
"""Of cells within structures within cells."""


class _Element(NamedTuple):
    kind: int
    body: memoryview


def read_mat(content: bytes, most_bytes: int) -> dict[str, Value]:
    """Return the variables of a file by name.

    Raises
    ------
    ValueError
        If the content is no MAT file of these versions, contradicts itself, or unpacks to more
        than `most_bytes`.
    """
    if len(content) >= 128 and content[126:128] in (b"IM", b"MI"):
        order: Order = "little" if content[126:128] == b"IM" else "big"
        return _version_5(content, order, most_bytes)
    return _version_4(content)


# Version 5 ------------------------------------------------------------------------------------


def _version_5(content: bytes, order: Order, most_bytes: int) -> dict[str, Value]:
    variables: dict[str, Value] = {}
    rest = memoryview(content)[128:]
    left = most_bytes
    while len(rest) >= 8:
        element, rest = _element(rest, order)
        if element.kind == COMPRESSED:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(element.body, left + 1)
            left -= len(unpacked)
            if left < 0:
                raise ValueError(f"it unpacks to more than {most_bytes >> 20} MiB")
            if not unpacker.eof:
                raise ValueError("what is packed in it is cut off")
            element, _ = _element(memoryview(unpacked), order)
        if element.kind != MATRIX:
            raise ValueError(f"it has an element of type {element.kind} in place of a variable")
        name, value = _matrix(element.body, order, 0)
        if value is not None:
            variables[name] = value
    return variables


def _element(view: memoryview, order: Order) -> tuple[_Element, memoryview]:
    """Return the first element of some bytes, and the bytes after it."""
    if len(view) < 8:
        raise ValueError("it is cut off")
    first = int.from_bytes(view[:4], order)
    if first >> 16:  # a small one: its length, its type, and up to 4 bytes in the tag itself
        kind, length, at, end = first & 0xFFFF, first >> 16, 4, 8
        if length > 4:
            raise ValueError(f"a small element of it says that it has {length} bytes")
    else:
        kind, length, at = first, int.from_bytes(view[4:8], order), 8
        padding = 0 if kind == COMPRESSED else -length % 8
        end = 8 + length + padding
    if at + length > len(view):
        raise ValueError(
            f"an element of it says that it has {length} bytes, and {len(view) - at} follow"
        )
    return _Element(kind, view[at : at + length]), view[min(end, len(view)) :]


def _matrix(view: memoryview, order: Order, depth: int) -> tuple[str, Value]:
    """Return an array's name and value; None for what is passed over."""
    if depth > MOST_DEPTH:
        raise ValueError(f"cells and structures in it are nested more than {MOST_DEPTH} deep")
    if len(view) == 0:  # an empty cell's content
        return "", np.empty((0, 0))
    element, rest = _element(view, order)
    flags = int(_numbers(element, order)[0]) if len(element.body) >= 4 else 0
    kind = flags & 0xFF
    element, rest = _element(rest, order)
    shape = tuple(int(n) for n in _numbers(element, order))
    if not 2 <= len(shape) <= 8 or min(shape) < 0:
        raise ValueError(f"an array of it has the shape {shape}")
    element, rest = _element(rest, order)
    name = bytes(element.body).decode("latin-1")
    count = math.prod(shape)
    if FIRST_NUMBER <= kind <= LAST_NUMBER:
        element, rest = _element(rest, order)
        if flags & COMPLEX:
            return name, None
        values = _numbers(element, order)
        if values.size != count:
            raise ValueError(f"{name!r} of shape {shape} has {values.size} numbers")
        return name, values.astype(np.float64).reshape(shape, order="F")
    if kind == CHAR:
        element, rest = _element(rest, order)
        encoding = WORDS.get(element.kind)
        if encoding is None:
            return name, None
        if encoding != "latin-1" and encoding != "utf-8":
            encoding += "-le" if order == "little" else "-be"
        text = bytes(element.body).decode(encoding, "replace")
        if shape[0] != 1 or len(text) != count:  # rows of words, which are stored by columns
            rows = [text[i :: shape[0]].rstrip() for i in range(min(shape[0], len(text)))]
            return name, np.array(rows, dtype=np.str_)
        return name, np.array([text], dtype=np.str_)
    if kind == CELL:
        values_of: list[Value] = []
        for _ in range(_affordable(count, rest)):
            element, rest = _element(rest, order)
            values_of.append(_content(element, order, depth))
        return name, values_of
    if kind == STRUCT:
        return name, _structure(rest, order, count, depth)
    return name, None


def _structure(rest: memoryview, order: Order, count: int, depth: int) -> list[dict[str, Value]]:
    element, rest = _element(rest, order)
    widths = _numbers(element, order)
    element, rest = _element(rest, order)
    width = int(widths[0]) if widths.size == 1 else 0
    if width < 1 or len(element.body) % width:
        raise ValueError(f"the fields of a structure have names of {width} bytes")
    raw = bytes(element.body)
    names = [
        raw[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(raw), width)
    ]
    found: list[dict[str, Value]] = []
    for _ in range(_affordable(count * len(names), rest) // max(len(names), 1)):
        fields = {}
        for field in names:
            element, rest = _element(rest, order)
            fields[field] = _content(element, order, depth)
        found.append(fields)
    return found


def _content(element: _Element, order: Order, depth: int) -> Value:
    if element.kind != MATRIX:
        raise ValueError(f"a cell of it holds an element of type {element.kind}")
    return _matrix(element.body, order, depth + 1)[1]


def _affordable(count: int, rest: memoryview) -> int:
    """Return a count of elements; raise ValueError if the bytes cannot hold them."""
    if count > len(rest) // 8:
        raise ValueError(f"it says that {count} arrays follow, in {len(rest)} bytes")
    return count


def _numbers(element: _Element, order: Order) -> np.ndarray[Any, np.dtype[Any]]:
    if element.kind not in NUMBERS:
        raise ValueError(f"it has an element of type {element.kind} in place of numbers")
    dtype = np.dtype(NUMBERS[element.kind]).newbyteorder("<" if order == "little" else ">")
    if len(element.body) % dtype.itemsize:
        raise ValueError(f"{len(element.body)} bytes of it are no numbers of {dtype.itemsize}")
    return np.frombuffer(element.body, dtype)


# Version 4 ------------------------------------------------------------------------------------


def _version_4(content: bytes) -> dict[str, Value]:
    variables: dict[str, Value] = {}
    at = 0
    while at < len(content):
        header = np.frombuffer(content[at : at + 20], "<i4") if at + 20 <= len(content) else None
        if header is None or not _is_old(header):
            big = None if header is None else header.byteswap()
            if big is None or not _is_old(big):
                raise ValueError("it begins like no MAT file")
            header, sign = big, ">"
        else:
            sign = "<"
        kind, rows, columns, imaginary, length = (int(n) for n in header)
        dtype = np.dtype(OLD_TYPES[kind // 10 % 10]).newbyteorder(sign)  # type: ignore[arg-type]
        begin = at + 20 + length
        size = rows * columns * dtype.itemsize
        end = begin + size * (2 if imaginary else 1)
        if end > len(content):
            raise ValueError(
                f"a matrix of {rows} x {columns} takes {size} bytes, and {len(content) - begin} "
                "follow"
            )
        name = content[at + 20 : begin].split(b"\0")[0].decode("latin-1")
        if kind % 10 == 0 and not imaginary:
            values = np.frombuffer(content[begin : begin + size], dtype).astype(np.float64)
            variables[name] = values.reshape((rows, columns), order="F")
        at = end
    if not variables:
        raise ValueError("it holds no matrix")
    return variables


def _is_old(header: np.ndarray[Any, np.dtype[Any]]) -> bool:
    """Whether five numbers begin a matrix of version 4."""
    kind, rows, columns, imaginary, length = (int(n) for n in header)
    return (
        0 <= kind < 2000
        and kind // 100 % 10 == 0
        and kind // 10 % 10 in OLD_TYPES
        and kind % 10 in (0, 1, 2)
        and min(rows, columns) >= 0
        and imaginary in (0, 1)
        and 1 <= length <= 256
    )
