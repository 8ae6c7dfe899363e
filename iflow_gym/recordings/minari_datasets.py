"""Recordings from Minari datasets: an episode is a recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from iflow_gym.recordings.columns import TIMES, Columns, Reading
from iflow_gym.recordings.raw import RawRecording, RecordingError
from iflow_gym.recordings.reading import Source
from iflow_gym.recordings.steps import Note

MOST_GUESSED = 3
"""Observations of so many numbers are taken to be a position."""

DRUMMING = 3
"""Coordinates of the stick's tip, which come first in the arm's observations."""


def read(source: Source, columns: Columns) -> Reading:
    """Read the episodes of a dataset that is on this machine.

    Positions are observations: the columns that `Columns.positions` names by their numbers from 0,
    or, where observations are a dict, by a key. The suite's own datasets know theirs. Times are the
    infos' ``time``, or `Columns.dt` apart.

    Raises
    ------
    RecordingError
        If there is no such dataset, or its observations are not what was named.
    ImportError
        Without the extra ``minari``.
    """
    from iflow_gym.minari_datasets.store import damage_told, load_dataset

    if source.content is not None:
        raise RecordingError("Expected a Minari dataset by its id, got standard input.")
    try:
        dataset = load_dataset(source.name)
        with damage_told(source.name):
            episodes = list(dataset.iterate_episodes())
            env_spec = dataset.spec.env_spec
    except (FileNotFoundError, ValueError) as error:
        raise RecordingError(
            f"{error} `minari list local` says which datasets there are."
        ) from error
    env_id = getattr(env_spec, "id", None) or ""
    reading = Reading()
    for i, episode in enumerate(episodes):
        name = f"{source.name}, episode {i}"
        observations, taken = _positions(episode.observations, columns, env_id, name)
        times, said = _times(episode.infos, len(observations), columns, name)
        recording = RawRecording(name, times, observations)
        notes = []
        if i == 0:
            text = f"took {said}; positions {taken}"
            values = {"time": said, "positions": taken, "episodes": len(episodes)}
            notes = [Note("columns", source.name, text, values)]
        reading = reading + Reading([recording], notes)
    if not reading.recordings:
        raise RecordingError(f"Expected episodes in {source.name}, got none.")
    return reading


def _positions(
    observations: Any, columns: Columns, env_id: str, name: str
) -> tuple[np.ndarray[Any, np.dtype[np.float64]], str]:
    chosen = columns.positions
    if isinstance(observations, dict):
        key = chosen[0] if chosen else None
        if key not in observations:
            raise RecordingError(
                f"Expected the key of the positions among {', '.join(observations)} in {name} "
                f"(--positions), got {key or 'none'}."
            )
        observations, chosen = observations[key], chosen[1:] if chosen else None
    try:
        values = np.asarray(observations)
        if values.dtype.kind not in "fiub":
            raise TypeError(f"values of type {values.dtype}")
        values = values.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"Expected observations of numbers in {name}, got {error}.") from error
    if values.ndim != 2:
        raise RecordingError(
            f"Expected observations of shape (samples, numbers) in {name}, got {values.shape}."
        )
    if chosen:
        try:
            indices = [range(values.shape[1])[int(c)] for c in chosen]
        except (IndexError, ValueError):
            raise RecordingError(
                f"Expected positions by their numbers, 0 to {values.shape[1] - 1}, in {name}, got "
                f"{', '.join(chosen)}."
            ) from None
    elif env_id.startswith("iflow/Drumming"):
        indices = list(range(DRUMMING))
    elif values.shape[1] <= MOST_GUESSED:
        indices = list(range(values.shape[1]))
    else:
        raise RecordingError(
            f"Expected to know which of {values.shape[1]} numbers of an observation of {name} are "
            "the position: name them by their numbers (--positions 0 1)."
        )
    return values[:, indices], f"observations {', '.join(map(str, indices))}"


def _times(
    infos: Any, n: int, columns: Columns, name: str
) -> tuple[np.ndarray[Any, np.dtype[np.float64]], str]:
    if columns.dt is not None:
        return np.asarray(np.arange(n) * columns.dt, dtype=np.float64), f"every {columns.dt:g} s"
    known = infos if isinstance(infos, dict) else {}
    key = columns.time or next((k for k in TIMES if k in known), None)
    if key is not None and key in known:
        times = np.asarray(known[key])
        if times.shape == (n,) and times.dtype.kind in "fiu":
            return times.astype(np.float64), f"time infos {key}"
    raise RecordingError(
        f"Expected the times of {n} observations in the infos of {name}, got "
        f"{', '.join(map(str, known)) or 'none'}: give the seconds a sample (--dt)."
    )
