"""The recordings of the ImitationFlow authors: letters traced round and round, and drumming.

Published with Urain, Ginesi, Tateo & Peters, "ImitationFlow: Learning deep stable stochastic
dynamic systems by normalizing flows", IROS 2020, in the repository TheCamusean/iflow under the MIT
licence, Copyright (c) 2020 Julen Urain. They are never part of this package: a file is downloaded
from a fixed commit when it is first asked for, checked against its sha256, and kept in the
operating system's cache folder. A folder with the files serves a machine without a network.
"""

from __future__ import annotations

import difflib
import hashlib
import io
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.rounds import period_of

LETTERS = ("I", "R", "O", "S")

COMMIT = "bbab87a69727a21a4989d98e5074e8019a6cc5f0"

BASE_URL = f"https://raw.githubusercontent.com/TheCamusean/iflow/{COMMIT}/data"

MIRROR_VARIABLE = "IFLOW_GYM_RECORDED"
"""Environment variable that names a folder with the recordings, instead of a download."""

DT = 0.01
"""Sample time in seconds, as in the authors' code."""


class RecordedFile(NamedTuple):
    """A file of the authors: where it is in their `data` folder and in a mirror, and its hash."""

    path: str
    mirrored: str
    sha256: str


FILES = {
    "I": RecordedFile(
        "IROS_dataset/IShape.npy",
        "letters_recorded/IShape.npy",
        "6caeb5c6e4f120529146eb0aba0c9c1d717f0de263450ffa20a260a2073f18e7",
    ),
    "R": RecordedFile(
        "IROS_dataset/RShape.npy",
        "letters_recorded/RShape.npy",
        "b159f0dfe17ab87590846bcb47de0b139522dda74a68f703db8a7c62b901486e",
    ),
    "O": RecordedFile(
        "IROS_dataset/OShape.npy",
        "letters_recorded/OShape.npy",
        "f4940b6abd7fdc82a9ddd180f9a7fc3fa22d568dc1ff1a36805536989bb1cc81",
    ),
    "S": RecordedFile(
        "IROS_dataset/SShape.npy",
        "letters_recorded/SShape.npy",
        "c2f72e947070fe72fcbdb3baccf3eb137ca50a7a8756f4dc9c31c9ae3dffda14",
    ),
    "drums": RecordedFile(
        "DRUMS_dataset/Drums.npy",
        "drums_recorded/Drums.npy",
        "558149f28932a90122c0a0f76706a39ade1268c5c067326b0e794f21b92d690f",
    ),
}
"""The recordings, by letter, and the drumming."""


def load_recorded_letter(letter: str, mirror: str | Path | None = None) -> Demonstrations:
    """Return the recordings of a letter: 3 of I, 2 of R, 1 of O and of S.

    Parameters
    ----------
    letter : str
        One of `LETTERS`.
    mirror : path, optional
        A folder with ``letters_recorded/``, read instead of a download; by default the one that
        the environment variable IFLOW_GYM_RECORDED names, if it is set.

    Returns
    -------
    Demonstrations
        Recordings of about 2 to 4 rounds, shape (T_i, 2), 100 Hz, in the authors' drawing unit:
        I, O and S are about one such unit high, R three. Velocities are central differences of
        the positions. The period is the mean over the recordings; those of I take 0.5 to 1.1 s a
        round.

    Raises
    ------
    ValueError
        If the letter is unknown, or a file is not the authors'.
    OSError
        If the recordings cannot be had, with the ways to get them (FileNotFoundError for a mirror
        that lacks the file).
    """
    if letter not in LETTERS:
        close = difflib.get_close_matches(str(letter).upper()[:1], LETTERS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"Unknown letter {letter!r}.{hint} Known: {', '.join(LETTERS)}.")
    return _cycles(letter, mirror, range(2), f"Recorded-{letter}", "drawing unit")


def load_recorded_drums(
    mirror: str | Path | None = None, *, orientation: bool = False
) -> Demonstrations:
    """Return six kinesthetic recordings of drumming on two drums.

    A round is an arch there and an arch back: two strokes, about 5 s.

    Parameters
    ----------
    mirror : path, optional
        A folder with ``drums_recorded/``; see `load_recorded_letter`, whose errors are raised too.
    orientation : bool
        Add the stick's roll, pitch and yaw in radians to x, y and z.

    Returns
    -------
    Demonstrations
        6 recordings of about two rounds, shape (1000, 3) in metres, 100 Hz, or (1000, 6) with the
        orientation. Velocities are central differences. The period is found from x, y and z.
    """
    columns = range(6 if orientation else 3)
    return _cycles("drums", mirror, columns, "Recorded-drums", "m, rad" if orientation else "m")


def _cycles(
    key: str, mirror: str | Path | None, columns: range, name: str, length_unit: str
) -> Demonstrations:
    recordings = np.load(io.BytesIO(_content(key, mirror)), allow_pickle=False)
    return Demonstrations.from_arrays(
        [r[:, columns] for r in recordings],
        dt=DT,
        period=_mean_period(key, recordings),
        name=name,
        length_unit=length_unit,
        source=f"TheCamusean/iflow {COMMIT[:7]}, data/{FILES[key].path}, "
        f"sha256 {FILES[key].sha256}",
    )


_PERIODS: dict[str, float] = {}


def _mean_period(key: str, recordings: FloatArray) -> float:
    if key not in _PERIODS:  # the files are always the same
        periods = [period_of(r[:, :3], DT) for r in recordings]
        _PERIODS[key] = round(float(np.mean(periods)), 4)
    return _PERIODS[key]


def _content(key: str, mirror: str | Path | None) -> bytes:
    """Return a file's bytes, checked against its hash."""
    file = FILES[key]
    named = mirror or os.environ.get(MIRROR_VARIABLE)
    path = Path(named).expanduser() / file.mirrored if named else _downloaded(file)
    if not path.is_file():
        raise FileNotFoundError(
            f"Expected {path.name} at {path}, in the mirror that "
            + ("mirror= names" if mirror else f"{MIRROR_VARIABLE} names")
            + f", got no such file. {_ways(file)}"
        )
    content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != file.sha256:
        raise ValueError(
            f"Expected {path} with sha256 {file.sha256}, got {digest} ({len(content)} bytes): the "
            f"file is incomplete or another one; delete it. {_ways(file)}"
        )
    return content


def local_file(key: str, mirror: str | Path | None = None) -> Path:
    """Return where a recording is looked for on this machine, be it there or not.

    `key` is one of `FILES`; for `mirror` see `load_recorded_letter`.
    """
    file = FILES[key]
    if named := mirror or os.environ.get(MIRROR_VARIABLE):
        return Path(named).expanduser() / file.mirrored
    return _cache() / _cached_name(file)


def _cache() -> Path:
    import pooch  # here, because a mirror needs no downloads

    return Path(pooch.os_cache("iflow-gym")) / COMMIT[:7]


def _cached_name(file: RecordedFile) -> str:
    return file.path.replace("/", "-")


def _downloaded(file: RecordedFile) -> Path:
    """Return the file in the cache, downloaded into it where it is not there yet.

    pooch writes beside the file and moves it into its place once the hash is right: what is
    interrupted leaves nothing behind.
    """
    import pooch

    cache = _cache()
    try:
        with _quiet(pooch.get_logger()):
            return Path(
                pooch.retrieve(
                    _url(file),
                    known_hash=f"sha256:{file.sha256}",
                    fname=_cached_name(file),
                    path=cache,
                )
            )
    except ValueError as error:
        raise ValueError(
            f"Expected {_url(file)} with sha256 {file.sha256}, got another file: {error} "
            f"{_ways(file)}"
        ) from error
    except OSError as error:  # requests' errors are OSErrors too
        raise OSError(
            f"{file.path} could not be downloaded into {cache}: {error}\n{_ways(file)}"
        ) from error


def _url(file: RecordedFile) -> str:
    return f"{BASE_URL}/{file.path}"


def _ways(file: RecordedFile) -> str:
    return (
        f"To get it by hand, save {_url(file)} as {file.mirrored} in a folder of your choice, and "
        f"set {MIRROR_VARIABLE} to that folder or pass it as mirror=."
    )


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """Keep a library from printing to the terminal."""
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
