"""Recordings from text: columns between commas, semicolons, tabs or spaces, with a heading."""

from __future__ import annotations

import csv
import io

import numpy as np

from iflow_gym.recordings.columns import Column, Columns, Reading, from_table
from iflow_gym.recordings.raw import RecordingError
from iflow_gym.recordings.reading import Source

NOTHING = ("", "nan", "na", "n/a", "null", "none", "-", "?")
"""Cells that say that something is missing, in lower case."""

DELIMITERS = (",", ";", "\t")


def read(source: Source, columns: Columns) -> Reading:
    """Read a table of text.

    The first line that is no comment (``#``, ``%``) may be a heading. Where semicolons or tabs are
    between the cells, numbers may have decimal commas. Empty cells and NaN are missing samples.

    Raises
    ------
    RecordingError
        If the text is no table, or a needed cell is no number.
    """
    content = source.read()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(
            f"Expected {source.name} to be text in UTF-8, got other bytes ({error.reason} at byte "
            f"{error.start}): save it as UTF-8, or say what format it is (--format)."
        ) from error
    if "\0" in text:
        raise RecordingError(
            f"Expected {source.name} to be text, got a file with zero bytes: say what format it is "
            "(--format)."
        )
    rows, lines = _rows(text, columns.delimiter, source.name)
    if len(rows) < 2:
        came = "a single line" if rows else "comments and empty lines alone"
        raise RecordingError(
            f"Expected a table in {source.name}, a heading and a line for each sample, got {came}."
        )
    headed = any(_number(cell) is None for cell in rows[0])
    width = len(rows[0])
    for row, line in zip(rows, lines, strict=True):
        if len(row) != width:
            raise RecordingError(
                f"Expected {width} cells in line {line} of {source.name}, as in its first line, "
                f"got {len(row)}."
            )
    heading = [cell.strip() for cell in rows[0]] if headed else [str(i) for i in range(width)]
    if len(set(heading)) < width:
        twice = sorted({h for h in heading if heading.count(h) > 1})
        raise RecordingError(
            f"Expected different headings in {source.name}, got {', '.join(twice)} more than once."
        )
    if not headed and columns.positions is None:
        grouped = ", or --group 0 --time 1 --positions 2 3 where column 0 tells recordings apart"
        grouped = grouped if width > 3 else ""
        raise RecordingError(
            f"Expected a heading in {source.name}, such as t,x,y, got numbers in the first line: "
            f"name the columns by their numbers, 0 to {width - 1} (for instance --time 0 "
            f"--positions 1 2{grouped})."
        )
    body = rows[1:] if headed else rows
    table = {name: _column([row[i] for row in body]) for i, name in enumerate(heading)}
    return from_table(table, columns, source.name, lines[-len(body) :])


def _rows(text: str, delimiter: str | None, name: str) -> tuple[list[list[str]], list[int]]:
    """Return the cells of each line that is a row, and the lines' numbers from 1."""
    kept = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith(("#", "%"))
    ]
    if not kept:
        return [], []
    first = kept[0][1]
    if delimiter is None:
        delimiter = max(DELIMITERS, key=first.count)
        delimiter = delimiter if delimiter in first else " "
    elif len(delimiter) != 1:
        raise RecordingError(f"Expected a delimiter of one character, got {delimiter!r}.")
    lines = [number for number, _ in kept]
    if delimiter == " ":
        return [line.split() for _, line in kept], lines
    try:
        rows = list(
            csv.reader(io.StringIO("\n".join(line for _, line in kept)), delimiter=delimiter)
        )
    except csv.Error as error:
        raise RecordingError(f"Expected {name} to be a table of text, got {error}.") from error
    if len(rows) != len(lines):
        raise RecordingError(
            f"Expected a line for each row of {name}, got quotes around several lines."
        )
    if delimiter != ",":
        rows = [[cell.replace(",", ".") if _comma(cell) else cell for cell in row] for row in rows]
    return rows, lines


def _comma(cell: str) -> bool:
    """Whether a cell is a number with a decimal comma."""
    return cell.count(",") == 1 and "." not in cell and _number(cell.replace(",", ".")) is not None


def _number(cell: str) -> float | None:
    """Return the number in a cell, nan where it is missing; None for a word."""
    text = cell.strip().lower()
    if text in NOTHING:
        return float("nan")
    if "_" in text:  # a number to Python, a word to anyone else
        return None
    try:
        return float(text)
    except ValueError:
        return None


def _column(cells: list[str]) -> Column:
    numbers = [_number(cell) for cell in cells]
    if any(number is None for number in numbers):
        return np.array([cell.strip() for cell in cells], dtype=np.str_)
    return np.array(numbers, dtype=np.float64)
