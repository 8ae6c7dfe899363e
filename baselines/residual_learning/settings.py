"""Settings of a training run, read from a TOML preset."""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from iflow_gym.residual.composition import SCALE

FOLDER = Path(__file__).parents[1] / "presets" / "residual"

Algorithm = Literal["ppo", "sac", "td3"]
ALGORITHMS: tuple[Algorithm, ...] = get_args(Algorithm)

Reward = Literal["environment", "hits"]
REWARDS: tuple[Reward, ...] = get_args(Reward)


class SettingsError(ValueError):
    """A preset or a setting is not understood."""


@dataclass(frozen=True)
class TrainingSettings:
    """What is trained, and for how long."""

    algorithm: Algorithm = "ppo"
    """Of Stable-Baselines3."""
    total_steps: int = 400_000
    """Steps of single environments."""
    num_envs: int = 64
    """Environments that step together."""
    scale: float = SCALE
    """Largest residual in greatest speeds."""
    scratch_scale: float = 0.4
    """The same where there is no base: twice the peak speed of recordings in the plane."""
    scratch_log_std_init: float | None = None
    """For PPO: the logarithm of the exploration's standard deviation at the beginning where there
    is no base, in place of the policy's own: with nothing under it an agent has more to find."""
    reward: Reward = "environment"
    """What is learned from: the environment's own reward, or for drumming "hits", that of
    `iflow_gym.envs.hit_reward.HitReward`."""
    reward_scale: float = 1.0
    """What rewards are multiplied by for the agent. With 1 - gamma the values that it learns are of
    order 1, and do not drown the policy's gradient where both are clipped together."""
    decay: bool = True
    """Whether the learning rate falls linearly to 0 over the run, so that it ends at rest."""
    last_log_std: float | None = None
    """For PPO: the logarithm of the exploration's standard deviation falls linearly to this over
    the run, in place of being learned. A projection takes off what of the noise leads outward, so
    that noise alone carries inward; what an agent leaves to it is missing when it acts without."""
    action_noise: float = 0.0
    """Standard deviation of the noise of TD3's exploration, in largest residuals."""
    n_evaluations: int = 20
    """How often the agent is evaluated, evenly, on all recordings' starts; the best one is kept."""
    n_checkpoints: int = 4
    """How often the agent is kept as a checkpoint, evenly."""
    keywords: dict[str, Any] = field(default_factory=dict)
    """The algorithm's own."""
    policy: dict[str, Any] = field(default_factory=dict)
    """The policy's: ``policy_kwargs``."""

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise SettingsError(
                f"Expected an algorithm of {', '.join(ALGORITHMS)}, got {self.algorithm!r}."
            )
        if self.reward not in REWARDS:
            raise SettingsError(f"Expected a reward of {', '.join(REWARDS)}, got {self.reward!r}.")
        for name in ("total_steps", "num_envs", "n_evaluations", "n_checkpoints"):
            if not (isinstance(value := getattr(self, name), int) and value >= 1):
                raise SettingsError(f"Expected {name} >= 1, a whole number, got {value!r}.")

    def of_run(self, *, scratch: bool) -> TrainingSettings:
        """Return the settings of a run with or without a base."""
        if not scratch or self.scratch_log_std_init is None or self.algorithm != "ppo":
            return self
        policy = {**self.policy, "log_std_init": self.scratch_log_std_init}
        return dataclasses.replace(self, policy=policy)

    def as_json(self) -> dict[str, Any]:
        """Return the settings as JSON holds them."""
        return dataclasses.asdict(self)


def load_settings(preset: str, **changes: Any) -> TrainingSettings:
    """Return the settings of a preset: one of those in the suite by name, or a path to a file.

    `changes` are fields of `TrainingSettings` that are set in its place where they are not None.
    """
    path = FOLDER / f"{preset}.toml" if preset in known_presets() else Path(preset)
    if not path.is_file():
        raise SettingsError(
            f"Expected a preset of {', '.join(known_presets())} or a path to a TOML file, got "
            f"{preset!r}."
        )
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is no valid TOML: {error}.") from error
    if unknown := sorted(set(content) - {"training", "algorithm", "policy"}):
        raise SettingsError(
            f"Expected sections [training], [algorithm] and [policy] in {path}, got {unknown}."
        )
    fields = content.get("training", {}) | {k: v for k, v in changes.items() if v is not None}
    try:
        return TrainingSettings(
            **fields, keywords=content.get("algorithm", {}), policy=content.get("policy", {})
        )
    except TypeError as error:
        raise SettingsError(f"{path}, section [training]: {error}.") from error


def known_presets() -> tuple[str, ...]:
    """Return the names of the suite's own presets."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))
