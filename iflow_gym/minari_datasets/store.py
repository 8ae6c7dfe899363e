"""Minari's datasets on this disk: where they are, what their ids look like, loading one.

A dataset may come from anyone: what it says of its own size is looked at before memory is taken.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT_VARIABLE = "MINARI_DATASETS_PATH"
"""Environment variable that names Minari's folder of datasets."""

KEY = "iflow_gym"
"""Of what this package adds to a dataset's metadata."""

MOST_EPISODES = 1_000_000
"""Of a dataset that is read: Minari takes memory for as many as a dataset says it has."""

MOST_BYTES = 2**29
"""Of one array in it, unpacked."""

_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+")


class DatasetError(ValueError):
    """A Minari dataset is not what it should be."""


def the_minari() -> Any:
    """Return the module; raise ImportError with what to install."""
    try:
        import h5py  # noqa: F401 (Minari asks for it when a dataset is opened)
        import minari
    except ImportError as error:
        raise ImportError(
            f"Expected Minari to be installed, got {error}: pip install 'iflow-gym[minari]'."
        ) from error
    return minari


@contextmanager
def datasets_root(root: str | os.PathLike[str] | None) -> Iterator[Path]:
    """Have Minari keep its datasets in a folder for a while; None leaves its own.

    Minari asks the environment variable, which is the whole process's: not for several threads.
    """
    before = os.environ.get(ROOT_VARIABLE)
    if root is not None:
        os.environ[ROOT_VARIABLE] = os.fspath(Path(root).absolute())
    try:
        found = os.environ.get(ROOT_VARIABLE)
        yield Path(found) if found else Path.home() / ".minari" / "datasets"
    finally:
        if before is None:
            os.environ.pop(ROOT_VARIABLE, None)
        else:
            os.environ[ROOT_VARIABLE] = before


def check_id(dataset_id: str) -> str:
    """Return an id; raise ValueError unless it is one, and so a folder within Minari's."""
    if not (isinstance(dataset_id, str) and _ID.fullmatch(dataset_id)):
        raise ValueError(
            f"Expected an id of a Minari dataset, such as 'iflow/LASA-Angle/human-v0', got "
            f"{dataset_id!r}."
        )
    return dataset_id


def load_dataset(dataset_id: str, root: str | os.PathLike[str] | None = None) -> Any:
    """Return a dataset on this disk, as Minari has it; nothing is downloaded.

    Raises
    ------
    FileNotFoundError
        If there is none.
    DatasetError
        If it is damaged, or larger than memory should hold.
    ValueError
        If the id is none.
    """
    minari = the_minari()
    with datasets_root(root) as folder:
        data = folder / check_id(dataset_id) / "data"
        if not data.is_dir():
            there = sorted(folder.glob("**/data/metadata.json"))
            local = ", ".join(p.parents[1].relative_to(folder).as_posix() for p in there)
            raise FileNotFoundError(
                f"Expected the Minari dataset {dataset_id!r} in {folder}, got {local or 'none'}: "
                f"run `minari download {dataset_id}` first, or pass root=."
            )
        with damage_told(dataset_id):
            _check_sizes(data)
            return minari.load_dataset(dataset_id)


@contextmanager
def damage_told(dataset_id: str) -> Iterator[None]:
    """Turn whatever Minari and HDF5 make of a damaged dataset into a DatasetError."""
    try:
        yield
    except ImportError:
        raise
    except Exception as error:
        said = str(error).rstrip(".") or type(error).__name__
        raise DatasetError(
            f"Expected a whole Minari dataset {dataset_id!r}, got a damaged one or something else: "
            f"{said}. Export or download it again."
        ) from error


def _check_sizes(data: Path) -> None:
    import h5py

    metadata = json.loads((data / "metadata.json").read_text(encoding="utf-8"))
    if not isinstance(metadata, dict):
        raise ValueError(f"its metadata are a {type(metadata).__name__}")
    n = metadata.get("total_episodes")
    if type(n) is not int or not 0 <= n <= MOST_EPISODES:
        raise ValueError(f"it says that it has {n!r:.40} episodes")
    file = data / "main_data.hdf5"
    if not file.is_file():  # in another format than HDF5
        return

    def look(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.nbytes > MOST_BYTES:
            raise ValueError(f"{name} takes {item.nbytes >> 20} MiB; {MOST_BYTES >> 20} are read")

    with h5py.File(file, "r") as opened:
        opened.visititems(look)
