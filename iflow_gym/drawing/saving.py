"""What is saved of a drawing: demonstrations as CSV, the model as a model file."""

from __future__ import annotations

import csv
import os
import re
from pathlib import Path

from iflow_gym.demonstrations import Demonstrations

COLUMNS = ("demo", "t", "x", "y")
"""Number of the demonstration, seconds since it began, millimetres."""

LONGEST_NAME = 60
DEFAULT_NAME = "drawing"
MOST_OF_A_NAME = 1000
"""So many files of one name, numbered, are in a folder at most."""

RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)", re.IGNORECASE)
"""Names that Windows keeps for devices."""


def file_stem(name: str) -> str:
    """Return a name made safe for a file on any system: letters, digits, ``-`` and ``_``.

    What else is in it becomes ``-``; nothing that is left of it becomes `DEFAULT_NAME`.
    """
    stem = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:LONGEST_NAME].strip("-")
    if not stem:
        return DEFAULT_NAME
    return f"{DEFAULT_NAME}-{stem}" if RESERVED.fullmatch(stem) else stem


def save_drawing(
    folder: str | os.PathLike[str], name: str, demonstrations: Demonstrations, model: bytes
) -> tuple[Path, Path]:
    """Write ``name.csv`` and ``name.safetensors`` into a folder, which is made; overwrite nothing.

    A number is added to a name that is taken. The CSV holds the demonstrations as they were fitted,
    in columns `COLUMNS`, every number with as many digits as it takes to read it back exactly.

    Parameters
    ----------
    folder : path
    name : str
        Anything, see `file_stem`.
    demonstrations : Demonstrations
    model : bytes
        Content of the model file.

    Returns
    -------
    table, model : Path
    """
    stem, folder = file_stem(name), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(1, MOST_OF_A_NAME + 1):
        numbered = stem if number == 1 else f"{stem}-{number}"
        table, model_file = folder / f"{numbered}.csv", folder / f"{numbered}.safetensors"
        if os.path.lexists(table) or os.path.lexists(model_file):
            continue
        with table.open("x", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            for demo, path in enumerate(demonstrations.positions):
                times = demonstrations.times(demo).tolist()
                writer.writerows([demo, t, *p] for t, p in zip(times, path.tolist(), strict=True))
        with model_file.open("xb") as binary:
            binary.write(model)
        return table, model_file
    raise FileExistsError(
        f"Expected fewer than {MOST_OF_A_NAME} files named {stem} in {folder}: choose another name."
    )
