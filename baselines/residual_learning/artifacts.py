"""What a training run leaves in its folder, read back with checks.

agent.zip           the agent, in Stable-Baselines3's own format
base.safetensors    the base model, as its `save` writes it; none for learning from scratch
card.json           what belongs together: environment, demonstrations, base, settings, versions
checkpoints/        agents on the way, named by their steps
tensorboard/        the curves
evaluations.json    mean rewards on the way
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

from iflow_gym.baselines.registry import load_method
from iflow_gym.baselines.residual_learning.agents import AgentFileError, read_agent
from iflow_gym.baselines.residual_learning.settings import SettingsError, TrainingSettings
from iflow_gym.residual.composition import Composition
from iflow_gym.residual.policy import ResidualPolicy
from iflow_gym.system import DynamicalSystem

AGENT, LAST, BASE, CARD = "agent.zip", "last.zip", "base.safetensors", "card.json"
CARD_VERSION = 1


@dataclass(frozen=True)
class Card:
    """What a trained residual belongs to."""

    environment: str
    """Id that it was trained on."""
    demonstrations: str
    """sha256 of the environment's demonstrations."""
    base: str | None
    """Registered name or ``module:Class`` of the base's method; None for learning from scratch."""
    base_sha256: str | None
    """Of the base's file."""
    scale: float
    """Largest residual in greatest speeds."""
    stable: float | None
    """The shield's required rate as a share of the base's slowest; None without one."""
    settings: dict[str, Any]
    """`TrainingSettings`."""
    seed: int
    """Of the training."""
    steps: int = 0
    """Steps that the agent was trained for so far."""
    version: int = CARD_VERSION
    """Of this format."""

    @property
    def shield(self) -> bool | float:
        """What the wrapper and the policy take as `stable`."""
        return False if self.stable is None else self.stable


def sha256_of_file(path: Path) -> str:
    """Return the hash of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_card(folder: Path, card: Card) -> Path:
    """Write a card, whole or not at all."""
    target = folder / CARD
    partial = target.with_name(f"{CARD}.{os.getpid()}.partial")
    partial.write_text(json.dumps(dataclasses.asdict(card), indent=1, sort_keys=True) + "\n")
    partial.replace(target)
    return target


def read_card(folder: Path) -> Card:
    """Read a folder's card; raise AgentFileError for anything else."""
    path = folder / CARD
    if not path.is_file():
        raise FileNotFoundError(
            f"Expected a trained residual in {folder}, got no {CARD}: train one with "
            "`python baselines/residual.py train`."
        )
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        card = Card(**values)
        settings_of(card)
    except (ValueError, TypeError, SettingsError) as error:
        raise AgentFileError(f"{path} is no card of a residual: {error}.") from error
    if card.version > CARD_VERSION:
        raise AgentFileError(
            f"{path} has version {card.version}, this package reads up to {CARD_VERSION}: upgrade "
            "iflow-gym."
        )
    return card


def settings_of(card: Card) -> TrainingSettings:
    """Return the settings that a card holds."""
    return TrainingSettings(**card.settings)


def load_base(folder: Path, card: Card) -> DynamicalSystem | None:
    """Return the base of a folder, checked against its card; None for learning from scratch."""
    if card.base is None:
        return None
    path = folder / BASE
    if not path.is_file():
        raise FileNotFoundError(f"Expected the base model of the residual at {path}, got none.")
    if (found := sha256_of_file(path)) != card.base_sha256:
        raise AgentFileError(
            f"Expected {path} to be the base that the residual was trained on (sha256 "
            f"{str(card.base_sha256)[:12]}), got another model ({found[:12]}): its corrections "
            "belong to that base alone. Put the base back, or train a residual on this one."
        )
    system = load_method(card.base).load(path)
    assert isinstance(system, DynamicalSystem)
    return system


def load_residual(
    folder: str | os.PathLike[str],
    *,
    environment: str | None = None,
    base: str | os.PathLike[str] | None = None,
) -> ResidualPolicy:
    """Return the policy of a trained residual on its base.

    Parameters
    ----------
    folder
        That training left.
    environment : str, optional
        Id that the policy is to run in: another one than it was trained on is an error.
    base : path, optional
        Model file that the policy is to correct: another one than it was trained on is an error.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    AgentFileError
        If the environment or the base is another one, or a file is not what it should be.
    """
    folder = Path(folder)
    card = read_card(folder)
    if environment is not None and environment != card.environment:
        raise AgentFileError(
            f"Expected the environment that the residual in {folder} was trained on, "
            f"{card.environment!r}, got {environment!r}: train a residual for that one."
        )
    if base is not None and (found := sha256_of_file(Path(base))) != card.base_sha256:
        raise AgentFileError(
            f"Expected the base that the residual in {folder} was trained on (sha256 "
            f"{str(card.base_sha256)[:12]}), got {base} ({found[:12]}): its corrections belong to "
            "that base alone."
        )
    system = load_base(folder, card)
    composition = Composition(
        gymnasium.make(card.environment).unwrapped, system, card.scale, card.shield
    )
    agent = read_agent(
        settings_of(card),
        folder / AGENT,
        composition.observation_space,
        composition.action_space,
    )
    return ResidualPolicy(
        agent, system, card.scale, stable=card.shield, demonstrations=card.demonstrations
    )
