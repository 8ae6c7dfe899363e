"""Minari datasets of positions as demonstrations."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iflow_gym.demonstrations import Demonstrations
from iflow_gym.minari_datasets.store import KEY, damage_told, load_dataset


def read_minari(
    dataset_id: str,
    *,
    key: str | None = None,
    indices: Sequence[int] | None = None,
    dt: float | None = None,
    goal: ArrayLike | None = None,
    goal_tolerance: float | None = None,
    period: float | None = None,
    episodes: Sequence[int] | None = None,
    name: str | None = None,
    length_unit: str | None = None,
    root: str | os.PathLike[str] | None = None,
) -> Demonstrations:
    """Return a Minari dataset on this disk as demonstrations, one an episode.

    Velocities are estimated from the positions. What `export_minari` wrote says all that is asked
    for here itself; of other datasets it has to be given.

    Parameters
    ----------
    dataset_id
        As `minari.load_dataset` takes it.
    key
        Which entry of a dictionary of observations holds the positions; of one within another,
        ``"outer/inner"``.
    indices
        Which components of an observation are the position, in their order: d of them.
    dt
        Seconds between an observation and the next, the same in all episodes.
    goal, goal_tolerance, period, name, length_unit
        As in `Demonstrations.from_arrays`.
    episodes
        Which ones, by their number; all by default.
    root
        Folder of Minari datasets; Minari's own by default.

    Raises
    ------
    FileNotFoundError
        If there is no such dataset on this disk: nothing is downloaded.
    ImportError
        If Minari is not installed.
    DatasetError
        A ValueError: if it is damaged, or larger than memory should hold.
    ValueError
        If it is not said, or not true, which numbers are positions and how long a step is; or if
        the positions are no demonstrations, as `Demonstrations.from_arrays` says.
    """
    dataset = load_dataset(dataset_id, root)
    said = _said(dataset)
    chosen = _chosen(episodes, dataset.total_episodes)
    if indices is None and key is None and "n_dims" in said:
        indices = range(said["n_dims"])
    played = iter(dataset.iterate_episodes([int(dataset.episode_indices[i]) for i in chosen]))
    positions = []
    for _ in chosen:  # one by one: an episode may hold pictures
        with damage_told(dataset_id):
            observations = next(played).observations
        positions.append(_positions(observations, key, indices))
    if goal is None and period is None:
        goal, period = said.get("goal"), said.get("period")
    return Demonstrations.from_arrays(
        positions,
        dt=_steps(dataset, chosen) if dt is None else dt,
        goal=goal,
        goal_tolerance=goal_tolerance,
        period=period,
        name=name or said.get("name", dataset_id),
        length_unit=length_unit or said.get("length_unit", "m"),
        source=f"Minari dataset {dataset_id}" + (f", {said['source']}" if "source" in said else ""),
        held_out=said.get("held_out", 0) if episodes is None else 0,
    )


_SAID: dict[str, tuple[type, ...]] = {
    "name": (str,), "source": (str,), "length_unit": (str,), "n_dims": (int,), "held_out": (int,),
    "period": (int, float), "goal": (list,),
}  # fmt: skip
"""What `export_minari` adds to a dataset's metadata and is read again, by its types."""

MOST_DIMS = 1000


def _said(dataset: Any) -> dict[str, Any]:
    """Return what `export_minari` said of a dataset; empty if another program wrote it."""
    with damage_told(dataset.spec.dataset_id):
        said = dataset.storage.metadata.get(KEY, {})
        if not isinstance(said, dict):
            raise ValueError(f"what {KEY} says is {said!r:.40}")
        found = {name: said[name] for name in _SAID if name in said}
        for name, value in found.items():
            if type(value) not in _SAID[name]:
                raise ValueError(f"its {name} is {value!r:.40}")
        if not 1 <= found.get("n_dims", 1) <= MOST_DIMS:
            raise ValueError(f"its n_dims is {found['n_dims']!r:.40}")
    return found


def _chosen(episodes: Sequence[int] | None, total: int) -> list[int]:
    if episodes is None:
        return list(range(total))
    chosen = [int(i) for i in episodes]
    if not chosen or any(not 0 <= i < total for i in chosen):
        raise ValueError(f"Expected episodes from 0 to {total - 1}, got {list(episodes)}.")
    return chosen


def _steps(dataset: Any, chosen: Sequence[int]) -> list[float]:
    """Return the seconds a step that the episodes' metadata say."""
    with damage_told(dataset.spec.dataset_id):
        indices = [int(dataset.episode_indices[i]) for i in chosen]
        found = list(dataset.storage.get_episode_metadata(indices))
    steps = [episode.get("dt") for episode in found]
    if any(step is None for step in steps):
        raise ValueError(
            f"Expected dt=, the seconds between an observation and the next: "
            f"{dataset.spec.dataset_id!r} does not say it."
        )
    with damage_told(dataset.spec.dataset_id):
        return [float(step) for step in steps]


def _positions(
    observations: Any, key: str | None, indices: Sequence[int] | None
) -> NDArray[np.float64]:
    """Return an episode's positions, shape (T, d)."""
    found, where = observations, "observations"
    for part in key.split("/") if key else ():
        if not isinstance(found, Mapping) or part not in found:
            raise ValueError(f"Expected {where} to have {part!r}, got {_told(found)}.")
        found, where = found[part], f"observations[{part!r}]"
    if isinstance(found, Mapping | tuple):
        raise ValueError(
            f"Expected key=, which of the observations are positions, got {key!r}: {_told(found)}."
        )
    array = np.asarray(found)
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"Expected {where} of real numbers and shape (T, n), got {array.dtype} of shape "
            f"{array.shape}: choose others by key=."
        )
    n = array.shape[1]
    if indices is None:
        raise ValueError(
            f"Expected indices=, which of the {n} components of {where} are the position, got "
            f"none: pass range({n}) if all are."
        )
    columns = [int(i) for i in indices]
    if not columns or len(set(columns)) < len(columns) or any(not 0 <= i < n for i in columns):
        raise ValueError(
            f"Expected indices of different components of {where}, from 0 to {n - 1}, got "
            f"{columns}."
        )
    return array[:, columns].astype(np.float64)


def _told(found: Any) -> str:
    """Return what a dictionary of observations holds, in words."""
    if not isinstance(found, Mapping):
        return "no dictionary"
    shapes = {
        name: "a dictionary" if isinstance(value, Mapping) else str(np.shape(value))
        for name, value in found.items()
    }
    return ", ".join(f"{name!r}: {shape}" for name, shape in shapes.items())
