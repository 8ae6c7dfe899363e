"""The suite's demonstrations as Minari datasets of transitions."""

from __future__ import annotations

import copy
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from iflow_gym.minari_datasets.provenance import NOT_EXPORTED, PROVENANCE, Provenance
from iflow_gym.minari_datasets.store import KEY, datasets_root, the_minari
from iflow_gym.registration import register_all, registered_ids

VERSION = 0
"""Of the datasets: other transitions from the same recordings are another version."""

_ID = re.compile(r"iflow/(?P<family>[A-Za-z]+)(?P<rest>-\w+)?-v\d+")

_PER_EPISODE = ("demonstration", "dt", "pushed")
"""Entries of info that an episode has once, or not at all."""


def dataset_id_of(env_id: str, control_mode: str = "velocity") -> str:
    """Return the id of an environment's dataset: ``iflow/LASA-Angle/human-v0`` of LASA-Angle's.

    Raises ValueError for what has no demonstrations of its own.
    """
    provenance = _provenance(env_id)
    mode = "" if control_mode == "velocity" else f"-{control_mode}"
    return f"{re.sub(r'-v[0-9]+$', '', env_id)}/{provenance.name}{mode}-v{VERSION}"


def exportable() -> list[str]:
    """Return the ids of the environments that have demonstrations of their own."""
    register_all()
    families = tuple(f"iflow/{name}-" for name in PROVENANCE)
    return [i for i in registered_ids() if i.startswith(families)]


def export_minari(
    env_id: str,
    *,
    root: str | os.PathLike[str] | None = None,
    control_mode: str = "velocity",
    mirror: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> Any:
    """Write an environment's demonstrations as a Minari dataset, and return it.

    Parameters
    ----------
    env_id
        Of a LASA shape, a letter (the suite's or a recorded one), or drumming.
    root
        Folder of Minari datasets; Minari's own by default, which is ``MINARI_DATASETS_PATH`` or
        ``~/.minari/datasets``.
    control_mode
        Of the environment; another one than velocity is part of the dataset's id.
    mirror
        Folder that holds the recordings of the ``Recorded`` environments, in place of a download.
        The dataset does not name it.
    overwrite
        Whether to replace a dataset that an earlier call wrote.

    Returns
    -------
    minari.MinariDataset
        One episode a recording, those held out too, in their order.

    Raises
    ------
    FileExistsError
        If the dataset is there already.
    ImportError
        If Minari is not installed.
    ValueError
        If the environment has no demonstrations of its own.

    Notes
    -----
    Each recording is played in the environment from its first sample: the command at every step
    leads from where the mass is to the recording's next sample (in force mode, to its next
    velocity). Actions are rounded to the action space's float32 before they are carried out, so
    that stepping through a dataset's actions gives its observations and rewards again, bit for bit.
    In velocity mode the observations are the recording, to about 1e-8 of its size; the arm's are
    what the arm did, within a millimetre of the suite's own demonstrations, and within 2 cm of the
    recorded ones, which go deeper into the drums than it lets them.

    An episode is reset with ``options={"demonstration": i}``, which is stored; its metadata say
    ``dt`` in seconds and whether it is ``held_out``. The dataset appears whole or not at all.
    """
    minari = the_minari()
    dataset_id = dataset_id_of(env_id, control_mode)
    provenance = _provenance(env_id)
    options: dict[str, Any] = {} if control_mode == "velocity" else {"control_mode": control_mode}
    if mirror is not None:
        options["mirror"] = os.fspath(mirror)
    env = gymnasium.make(env_id, **options)
    _forget_mirror(env)
    try:
        with datasets_root(root) as folder:
            target = folder / dataset_id
            _check_free(target, overwrite)
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".export-", dir=folder) as partial:
                with datasets_root(partial):
                    _write(minari, dataset_id, env, provenance)
                _put(Path(partial), dataset_id, target, overwrite)
            return minari.load_dataset(dataset_id)
    finally:
        env.close()


def _forget_mirror(env: Any) -> None:
    """Leave a folder of this disk out of what the environment is recovered from."""
    spec = copy.deepcopy(env.unwrapped.spec)
    spec.kwargs.pop("mirror", None)
    env.unwrapped.spec = spec


def _provenance(env_id: str) -> Provenance:
    match = _ID.fullmatch(env_id) if isinstance(env_id, str) else None
    family = match["family"] if match else ""
    if family in NOT_EXPORTED:
        raise ValueError(
            f"Expected an environment with demonstrations of its own, got {env_id!r}: "
            f"{NOT_EXPORTED[family]}."
        )
    if family not in PROVENANCE or env_id not in gymnasium.registry:
        known = ", ".join(f"iflow/{name}-..." for name in PROVENANCE)
        raise ValueError(f"Expected the id of an environment ({known}), got {env_id!r}.")
    return PROVENANCE[family]


# Playing ----------------------------------------------------------------------------------------


def _episodes(env: Any) -> Iterator[dict[str, Any]]:
    """Yield each recording, played, as what Minari's episode buffer takes."""
    demonstrations = env.unwrapped.demonstrations
    for index in range(len(demonstrations)):
        options = {"demonstration": index}
        observation, info = env.reset(seed=index, options=options)
        observations, infos = [observation], [info]
        actions, rewards, terminations, truncations = [], [], [], []
        for k in range(1, len(demonstrations.positions[index])):
            action = _action(env.unwrapped, index, k, observation)
            observation, reward, terminated, truncated, info = env.step(action)
            observations.append(observation)
            actions.append(action)
            rewards.append(float(reward))
            terminations.append(terminated)
            truncations.append(truncated)
            infos.append(info)
        yield {
            "seed": index,
            "options": options,
            "observations": np.array(observations),
            "actions": np.array(actions),
            "rewards": np.array(rewards),
            "terminations": np.array(terminations),
            "truncations": np.array(truncations),
            "infos": _numbers(infos),
        }


def _action(env: Any, index: int, k: int, observation: NDArray[Any]) -> NDArray[np.float32]:
    """Return the action that leads to sample k of a recording, as the action space has it."""
    demonstrations = env.demonstrations
    if env.control_mode == "force":
        velocity = demonstrations.velocities[index][k]
    else:
        velocity = (demonstrations.positions[index][k] - observation[: env.n_dims]) / env.dt
    action: NDArray[np.float32] = env.command_to_action(velocity, observation).astype(np.float32)
    return action


def _numbers(infos: list[dict[str, Any]]) -> dict[str, NDArray[Any]]:
    """Return the entries of info that are one number a step, shape (T + 1,) each."""
    names = [
        name
        for name, value in infos[0].items()
        if isinstance(value, bool | int | float | np.number) and name not in _PER_EPISODE
    ]
    return {name: np.array([info[name] for info in infos]) for name in names}


# Writing ----------------------------------------------------------------------------------------


def _write(minari: Any, dataset_id: str, env: Any, provenance: Provenance) -> None:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    from iflow_gym import __version__

    demonstrations = env.unwrapped.demonstrations
    n = len(demonstrations)
    requirements = [f"iflow-gym>={__version__}"]
    if provenance in (PROVENANCE["Drumming"], PROVENANCE["DrummingRecorded"]):
        import mujoco

        # Contacts are solved slightly differently from one minor version to the next.
        requirements.append(f"mujoco=={'.'.join(mujoco.__version__.split('.')[:2])}.*")
    with warnings.catch_warnings():
        # There is no address that would reach the authors, and no link to this code's place.
        warnings.filterwarnings("ignore", message="`(author_email|code_permalink)` is set to None")
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            [EpisodeBuffer(**episode) for episode in _episodes(env)],
            env=env,
            eval_env=env,
            author=set(provenance.authors),
            algorithm_name=provenance.algorithm,
            description=_description(env, env.spec.id, provenance),
            requirements=requirements,
        )
    storage = dataset.storage
    shown = n - demonstrations.held_out
    storage.update_episode_metadata(
        [
            {"demonstration": i, "dt": demonstrations.dt[i], "held_out": i >= shown}
            for i in range(n)
        ],
        range(n),
    )
    end = (
        {"period": demonstrations.period}
        if demonstrations.goal is None
        else {"goal": demonstrations.goal.tolist()}
    )
    storage.update_metadata(
        {
            KEY: {
                "version": __version__,
                "environment": env.spec.id,
                "reference": provenance.reference,
                "licence": provenance.licence,
                "name": demonstrations.name,
                "source": demonstrations.source,
                "demonstrations_sha256": demonstrations.sha256,
                "length_unit": demonstrations.length_unit,
                "n_dims": demonstrations.n_dims,
                "held_out": demonstrations.held_out,
                **end,
            }
        }
    )


def _description(env: Any, env_id: str, provenance: Provenance) -> str:
    demonstrations = env.unwrapped.demonstrations
    n, held_out = len(demonstrations), demonstrations.held_out
    end = (
        f"repeat with a period of {demonstrations.period:.4g} s"
        if demonstrations.goal is None
        else "end at one goal"
    )
    return (
        f"The {n} demonstrations of {env_id} ({provenance.algorithm}), which {end}; one episode "
        f"each{f', the last {held_out} to be held out' if held_out else ''}. Unit of length: "
        f"{demonstrations.length_unit}. An episode's metadata have its sample time dt in seconds; "
        "its options reset the environment to its start. "
        f"Reference: {provenance.reference}. "
        f"Licence of the recordings: {provenance.licence}."
    )


def _check_free(target: Path, overwrite: bool) -> None:
    """Raise FileExistsError where a dataset is that may not be replaced."""
    if not target.exists():
        return
    if not overwrite:
        raise FileExistsError(
            f"Expected no dataset in {target}, got one: pass overwrite=True to replace it "
            "(--replace), or root=, another folder (--folder)."
        )
    from minari.dataset.minari_storage import MinariStorage

    try:
        ours = KEY in MinariStorage.read_raw_metadata(target / "data")
    except ValueError:  # no metadata, or ones that are no JSON
        ours = False
    if not ours:
        raise FileExistsError(
            f"Expected a dataset in {target} that export_minari wrote, got something else: it is "
            "left alone; remove it yourself, or pass root=, another folder (--folder)."
        )


def _put(partial: Path, dataset_id: str, target: Path, overwrite: bool) -> None:
    """Move a whole dataset from its partial root to its place."""
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = dataset_id.rpartition("/")[0]
    if namespace not in list_local_namespaces():
        create_namespace(namespace)
    if overwrite and target.exists():
        shutil.move(target, partial / "replaced")
    (partial / dataset_id).rename(target)
