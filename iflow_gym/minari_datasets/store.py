"""Where Minari keeps its datasets on this disk, and what their ids look like."""

from __future__ import annotations

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

_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+")


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
