"""The suite's demonstrations as Minari datasets: the recordings, played in their environment.

    iflow/LASA-Angle/human-v0        iflow/Letter-S/hand-model-v0
    iflow/Drumming/teacher-v0        iflow/LetterRecorded-S/human-v0

An episode is a recording. It begins at the recording's first sample, and each action is the one
that leads from where the environment is to the recording's next sample, rounded to the action
space's float32; rewards and observations are the environment's own answers. So every transition is
real, and playing an episode's actions gives its observations back bit for bit. A point mass follows
its recording to that rounding; the arm stays within millimetres of it. The extra ``minari`` is
needed.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from iflow_gym.demonstrations import Demonstrations

NAMESPACE = "iflow"

FOLDER_VARIABLE = "MINARI_DATASETS_PATH"
"""Minari's own variable for the folder of its datasets."""

CODE = "The package iflow-gym, iflow_gym/datasets/minari_export.py"
"""Where the code is, until it has an address."""


@dataclass(frozen=True)
class Source:
    """Who made the demonstrations of a family of environments, and how."""

    dataset: str
    author: str
    algorithm: str
    reference: str


_LASA = Source(
    "human",
    "LASA laboratory, EPFL",
    "Human handwriting, replayed",
    'S. M. Khansari-Zadeh and A. Billard, "Learning Stable Nonlinear Dynamical Systems with '
    'Gaussian Mixture Models", IEEE Transactions on Robotics 27(5), 2011.',
)
_URAIN = (
    'J. Urain, M. Ginesi, D. Tateo and J. Peters, "ImitationFlow: Learning Deep Stable Stochastic '
    'Dynamic Systems by Normalizing Flows", IROS 2020.'
)
SOURCES = {
    "LASA-": _LASA,
    "LetterRecorded-": Source("human", "J. Urain et al.", "Human drawing, replayed", _URAIN),
    "Letter-": Source(
        "hand-model", "The iflow-gym authors", "A model of a hand, replayed", f"After {_URAIN}"
    ),
    "DrummingRecorded-": Source(
        "human", "J. Urain et al.", "Kinesthetic teaching, replayed", _URAIN
    ),
    "Drumming-": Source(
        "teacher", "The iflow-gym authors", "A scripted teacher, replayed", f"After {_URAIN}"
    ),
}
"""By how an environment's short name begins."""


class MinariError(ValueError):
    """A dataset cannot be written or read."""


def exportable() -> list[str]:
    """Return the ids of the environments whose demonstrations can be exported."""
    import iflow_gym  # noqa: F401 (registers them)

    short = {i: i.removeprefix("iflow/") for i in gymnasium.registry if i.startswith("iflow/")}
    return [i for i, name in short.items() if name.startswith(tuple(SOURCES))]


def dataset_id(env_id: str) -> str:
    """Return the id of an environment's dataset, such as ``iflow/LASA-Angle/human-v0``."""
    short = env_id.removeprefix("iflow/")
    name, _, version = short.rpartition("-v")
    return f"{NAMESPACE}/{name}/{source_of(env_id).dataset}-v{version}"


def source_of(env_id: str) -> Source:
    """Return who made an environment's demonstrations."""
    short = env_id.removeprefix("iflow/")
    for prefix, source in SOURCES.items():
        if short.startswith(prefix):
            return source
    raise MinariError(
        f"Expected an environment with demonstrations of its own, got {env_id}: those of your own "
        "motion are a file already, and Disturbed has LASA's."
    )


def export_minari(
    env_id: str,
    *,
    folder: str | os.PathLike[str] | None = None,
    replace: bool = False,
    code_link: str = CODE,
) -> str:
    """Write an environment's demonstrations as a Minari dataset, and return its id.

    Parameters
    ----------
    env_id : str
        Such as ``"iflow/LASA-Angle-v0"``.
    folder : path, optional
        Of the datasets; by default Minari's own, which MINARI_DATASETS_PATH names.
    replace : bool
        Whether to write over a dataset that is there.
    code_link : str
        What the dataset's metadata say of the code.

    Raises
    ------
    MinariError
        If there is one already, or the environment has no demonstrations of its own.
    ImportError
        Without the extra ``minari``.
    """
    minari = import_minari()
    from minari.data_collector import EpisodeBuffer

    name, source = dataset_id(env_id), source_of(env_id)
    env = gymnasium.make(env_id, disable_env_checker=True)
    demos: Demonstrations = env.unwrapped.demonstrations  # type: ignore[attr-defined]
    with _datasets_in(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of metadata that there are none of
        if name in minari.list_local_datasets():
            if not replace:
                raise MinariError(
                    f"Expected no dataset {name}, got one that is there already: delete it, or "
                    "replace it (--replace)."
                )
            minari.delete_dataset(name)
        buffers = [EpisodeBuffer(id=i, **_episode(env, i)) for i in range(len(demos))]
        minari.create_dataset_from_buffers(
            name,
            buffers,
            env=env,
            algorithm_name=source.algorithm,
            author=source.author,
            code_permalink=code_link,
            description=_description(demos, source),
            requirements=["iflow-gym>=0.1"],
        )
    env.close()
    return name


def import_minari() -> Any:
    """Return the module minari; ImportError names the extra."""
    try:
        import h5py  # noqa: F401 (Minari's files)
        import minari
    except ImportError as error:
        raise ImportError(
            f"Expected the package minari for its datasets, got {error}: pip install "
            "'iflow-gym[minari]'."
        ) from error
    return minari


def _episode(env: gymnasium.Env[Any, Any], index: int) -> dict[str, Any]:
    """Return a recording, played in its environment."""
    player: Any = env.unwrapped
    path = player.demonstrations.positions[index]
    d = path.shape[1]
    options = {"demonstration": index}
    observation, info = player.reset(options=options)
    observations, actions, rewards, ends, infos = [observation], [], [], [], [info]
    for following in path[1:]:
        velocity = (following - observation[:d]) / player.dt
        action = np.asarray(
            player.command_to_action(velocity, observation), dtype=env.action_space.dtype
        )
        observation, reward, terminated, truncated, info = player.step(action)
        observations.append(observation)
        actions.append(action)
        rewards.append(float(reward))
        ends.append((bool(terminated), bool(truncated)))
        infos.append(info)
    return {
        "options": options,
        "observations": np.array(observations),
        "actions": np.array(actions),
        "rewards": np.array(rewards),
        "terminations": np.array([t for t, _ in ends]),
        "truncations": np.array([t for _, t in ends]),
        "infos": {
            key: np.array([i[key] for i in infos])
            for key, value in infos[0].items()
            if np.isscalar(value) and all(np.isscalar(i.get(key)) for i in infos)
        },
    }


def _description(demos: Demonstrations, source: Source) -> str:
    ends = (
        "They end at a goal."
        if demos.goal is not None
        else f"They repeat with a period of {demos.period:.4g} s."
    )
    shown = (
        f" The last {demos.held_out} episodes are held out: nothing is to be fitted on them."
        if demos.held_out
        else ""
    )
    return (
        f"{len(demos)} recordings of one motion, positions in {demos.length_unit}. {ends}{shown} "
        "Each was played in the environment: an action is the command that leads from where the "
        "environment is to the recording's next sample, rounded to float32, and observations and "
        f"rewards are the environment's. Data: {demos.source}. Reference: {source.reference}"
    )


@contextmanager
def _datasets_in(folder: str | os.PathLike[str] | None) -> Iterator[None]:
    """Let Minari have its datasets in a folder."""
    if folder is None:
        yield
        return
    before = os.environ.get(FOLDER_VARIABLE)
    os.environ[FOLDER_VARIABLE] = str(Path(folder).resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[FOLDER_VARIABLE]
        else:
            os.environ[FOLDER_VARIABLE] = before


def chosen_environments(patterns: Sequence[str]) -> list[str]:
    """Return the exportable environments that globs over ids or short names match."""
    from fnmatch import fnmatchcase

    known = exportable()
    chosen: dict[str, None] = {}
    for pattern in patterns:
        found = [
            i
            for i in known
            if any(fnmatchcase(n, pattern) for n in (i, i[6:], i[6:].rpartition("-v")[0]))
        ]
        if not found:
            raise MinariError(
                f"Expected environments with demonstrations of their own that match {pattern!r}, "
                "got none: `iflow-gym envs` lists all."
            )
        chosen |= dict.fromkeys(found)
    return list(chosen)
