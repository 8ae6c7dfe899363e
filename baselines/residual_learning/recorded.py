"""A trained residual beside its record: one model file, as every method's is.

What Stable-Baselines3 writes holds pickles, and what its optimizers remember. A run keeps that in
its own folder, to go on from (`artifacts`); what is published are the policy's tensors and the
card, in safetensors and JSON. The base is not copied: it is the model beside its own record.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import gymnasium
import torch

from iflow_gym.baselines.registry import load_method
from iflow_gym.baselines.residual_learning.agents import AgentFileError, make_agent, spaces_only
from iflow_gym.baselines.residual_learning.artifacts import Card, settings_of, sha256_of_file
from iflow_gym.model_files import model_file_errors, read_model_file, write_model_file
from iflow_gym.residual.composition import Composition
from iflow_gym.residual.policy import ResidualPolicy


def write_recorded(path: Path, name: str, policy: ResidualPolicy, card: Card) -> Path:
    """Write the model of a row's record.

    Parameters
    ----------
    path : Path
        Ends in ``.safetensors``.
    name : str
        Of the row.
    policy : ResidualPolicy
        Its agent is one of Stable-Baselines3.
    card : Card
        Of the run.
    """
    tensors = policy.agent.policy.state_dict()
    header = {
        "method": name,
        "config": card.settings,
        "n_dims": int(policy.agent.action_space.shape[0]),
        "card": dataclasses.asdict(card),
    }
    arrays = {key: value.detach().cpu().numpy() for key, value in tensors.items()}
    return write_model_file(path, header, arrays)


def load_recorded(
    path: str | os.PathLike[str], base: str | os.PathLike[str] | None = None
) -> ResidualPolicy:
    """Return the policy of a record's model.

    Parameters
    ----------
    path
        ``<results>/<row>/<environment>.<protocol>.seed<k>.safetensors``.
    base : path, optional
        Its base; that of the same name in the folder of the base's method by default.

    Raises
    ------
    FileNotFoundError
        If there is no such file, or none of the base.
    ModelFileError
        If the file is none of these.
    AgentFileError
        If the base is another one than the residual was trained on.
    """
    path = Path(path)
    header, arrays = read_model_file(path)
    with model_file_errors(path, str(header["method"])):
        card = Card(**header["card"])
        settings = settings_of(card)
        tensors = {key: torch.from_numpy(value) for key, value in arrays.items()}
    system = _base_of(path, card, None if base is None else Path(base))
    composition = Composition(
        gymnasium.make(card.environment).unwrapped, system, card.scale, card.shield
    )
    spaces = composition.observation_space, composition.action_space
    agent = make_agent(settings, spaces_only(*spaces, settings.num_envs), 0, None)
    with model_file_errors(path, str(header["method"])):
        agent.policy.load_state_dict(tensors)
    return ResidualPolicy(
        agent, system, card.scale, stable=card.shield, demonstrations=card.demonstrations
    )


def _base_of(path: Path, card: Card, base: Path | None) -> Any:
    """Return the base that a card names, from the model beside its record; None without one."""
    if card.base is None:
        return None
    place = path.resolve().parents[1] / card.base / path.name if base is None else base
    if not place.is_file():
        raise FileNotFoundError(
            f"Expected the base of {path} at {place}, got none: name its file as base."
        )
    if (found := sha256_of_file(place)) != card.base_sha256:
        raise AgentFileError(
            f"Expected {place} to be the base that {path} was trained on (sha256 "
            f"{str(card.base_sha256)[:12]}), got another model ({found[:12]}): its corrections "
            "belong to that base alone."
        )
    return load_method(card.base).load(place)
