"""Training a residual: from a base model and settings to a folder that `artifacts` reads."""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback

from iflow_gym.baselines.residual_learning.agents import (
    AgentFileError,
    make_agent,
    one_thread,
    set_parameters,
)
from iflow_gym.baselines.residual_learning.artifacts import (
    AGENT,
    BASE,
    LAST,
    Card,
    load_base,
    read_card,
    settings_of,
    sha256_of_file,
    write_card,
)
from iflow_gym.baselines.residual_learning.settings import TrainingSettings
from iflow_gym.baselines.residual_learning.tasks import residual_vec_env, returns_of
from iflow_gym.baselines.residual_learning.vec_env import ArrayVecEnv


@dataclass(frozen=True)
class Trained:
    """What a training run took."""

    folder: Path
    card: Card
    cpu_seconds: float
    """Of this process, evaluations on the way included."""
    wall_seconds: float
    environment_share: float
    """Share of the CPU seconds that the environment took, the base and the shield within it."""


def train(
    folder: Path,
    environment: str,
    settings: TrainingSettings,
    seed: int,
    *,
    base: tuple[str, Path] | None,
    stable: float | None = None,
    progress: bool = False,
    tensorboard: bool = True,
) -> Trained:
    """Train a residual from the start and write it into a folder.

    Parameters
    ----------
    folder : Path
        Must not hold a trained residual.
    environment : str
        Id.
    settings : TrainingSettings
    seed : int
        Of the agent and of the environments.
    base : (name of the method, model file), optional
        None learns from scratch, with residuals of `settings.scratch_scale`.
    stable : float, optional
        The shield's required rate as a share of the base's slowest.
    progress : bool
        Whether to show a progress bar.
    tensorboard : bool
        Whether to write curves for TensorBoard.
    """
    if (folder / AGENT).exists():
        raise FileExistsError(
            f"Expected a folder without a trained residual, got {folder}: resume it, or choose "
            "another one."
        )
    if base is None and stable is not None:
        raise ValueError("Expected a base for a stable residual, got none: its V is what falls.")
    folder.mkdir(parents=True, exist_ok=True)
    if base is not None:
        shutil.copyfile(base[1], folder / BASE)
    task: Any = gymnasium.make(environment).unwrapped
    card = Card(
        environment=environment,
        demonstrations=task.demonstrations.sha256,
        base=None if base is None else base[0],
        base_sha256=None if base is None else sha256_of_file(folder / BASE),
        scale=settings.scratch_scale if base is None else settings.scale,
        stable=stable,
        settings=settings.as_json(),
        seed=seed,
    )
    write_card(folder, card)
    return _learn(folder, card, settings.total_steps, None, progress, tensorboard)


def resume(
    folder: Path,
    *,
    environment: str | None = None,
    total_steps: int | None = None,
    checkpoint: Path | None = None,
    progress: bool = False,
    tensorboard: bool = True,
) -> Trained:
    """Go on with a training run, up to `total_steps` in all (by default those of its settings).

    From the agent of the folder, or from one of its checkpoints where it has been interrupted
    before. The optimizer and the count of steps go on; environments are seeded anew and a replay
    buffer fills anew, so that the outcome is not that of a run without interruption.
    """
    card = read_card(folder)
    if environment is not None and environment != card.environment:
        raise AgentFileError(
            f"Expected the environment that the run in {folder} was begun on, {card.environment!r},"
            f" got {environment!r}."
        )
    start, steps = _latest(folder, card) if checkpoint is None else (checkpoint, _steps(checkpoint))
    total = settings_of(card).total_steps if total_steps is None else total_steps
    if total <= steps:
        raise ValueError(
            f"Expected more than the {steps} steps that the run in {folder} has, got {total}: give "
            "total_steps."
        )
    card = dataclasses.replace(card, steps=steps)
    return _learn(folder, card, total, start, progress, tensorboard)


def _latest(folder: Path, card: Card) -> tuple[Path, int]:
    """Return the agent with the most steps in a folder, and how many they are."""
    found = [(path, _steps(path)) for path in (folder / "checkpoints").glob("agent_*_steps.zip")]
    if (folder / LAST).is_file():
        found.append((folder / LAST, card.steps))
    if not found:
        raise FileNotFoundError(f"Expected an agent or a checkpoint in {folder}, got none.")
    return max(found, key=lambda entry: entry[1])


def _steps(checkpoint: Path) -> int:
    parts = checkpoint.stem.split("_")
    if len(parts) != 3 or not parts[1].isdigit():
        raise ValueError(
            f"Expected a checkpoint named agent_<steps>_steps.zip, got {checkpoint.name}."
        )
    return int(parts[1])


def _learn(
    folder: Path, card: Card, total: int, start: Path | None, progress: bool, tensorboard: bool
) -> Trained:
    one_thread()
    settings = settings_of(card).of_run(scratch=card.base is None)
    base = load_base(folder, card)
    env = residual_vec_env(
        card.environment,
        settings.num_envs,
        base,
        card.scale,
        card.shield,
        settings.reward_scale,
        settings.reward,
    )
    curves = folder / "tensorboard" if tensorboard else None
    agent = make_agent(settings, env, card.seed + card.steps, curves)
    if start is not None:
        set_parameters(agent, start)
        agent.num_timesteps = card.steps
    every = max(1, total // settings.n_checkpoints // settings.num_envs)
    evaluate = EvaluateCallback(
        folder, card, base, max(1, total // settings.n_evaluations), keep=start is not None
    )
    annealing = []
    if settings.algorithm == "ppo" and settings.last_log_std is not None:
        first = float(settings.policy.get("log_std_init", 0.0))
        annealing = [AnnealExploration(first, settings.last_log_std, total)]
    callbacks = CallbackList(
        [
            evaluate,
            CheckpointCallback(every, str(folder / "checkpoints"), name_prefix="agent"),
            EnvironmentShare(env),
            *annealing,
        ]
    )
    cpu, wall = time.process_time(), time.perf_counter()
    agent.learn(
        total - card.steps,
        callback=callbacks,
        reset_num_timesteps=start is None,
        progress_bar=progress,
        tb_log_name="run",
        log_interval=10,
    )
    evaluate.run()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    agent.save(folder / LAST)
    card = dataclasses.replace(card, steps=int(agent.num_timesteps))
    write_card(folder, card)
    env.close()
    return Trained(folder, card, cpu, wall, env.cpu_seconds / cpu)


class EvaluateCallback(BaseCallback):
    """Measures the mean reward a step from every recording's start, and keeps the best agent.

    `evaluations.json` has a line for each: steps and the mean over the recordings. The agent of the
    greatest mean is the run's: what exploration learns is not always better without its noise.
    """

    def __init__(self, folder: Path, card: Card, base: Any, every: int, *, keep: bool) -> None:
        super().__init__()
        self._folder, self._path = folder, folder / "evaluations.json"
        self._card, self._base, self._every = card, base, every
        self._next = card.steps
        self.found: list[dict[str, float]] = []
        if keep and self._path.is_file():
            earlier = json.loads(self._path.read_text(encoding="utf-8"))
            self.found = [entry for entry in earlier if entry["steps"] <= card.steps]

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = self.num_timesteps + self._every
            self.run()
        return True

    def run(self) -> None:
        """Evaluate now."""
        card = self._card
        assert self.model is not None
        returns = returns_of(
            self.model,
            card.environment,
            self._base,
            card.scale,
            card.shield,
            settings_of(card).reward,
        )
        mean = float(returns.mean())
        self.found.append({"steps": int(self.model.num_timesteps), "mean_reward": mean})
        if mean >= max(entry["mean_reward"] for entry in self.found):
            self.model.save(self._folder / AGENT)
        self._path.write_text(json.dumps(self.found, indent=1) + "\n", encoding="utf-8")
        self.logger.record("eval/mean_reward_a_step", mean)


class AnnealExploration(BaseCallback):
    """Lets the logarithm of PPO's standard deviation go linearly from one number to another."""

    def __init__(self, first: float, last: float, total: int) -> None:
        super().__init__()
        self._first, self._last, self._total = first, last, total

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        assert self.model is not None
        done = min(self.model.num_timesteps / self._total, 1.0)
        spread: Any = self.model.policy.log_std
        spread.requires_grad_(False)
        spread.fill_((1 - done) * self._first + done * self._last)


class EnvironmentShare(BaseCallback):
    """Logs the share of the time that the environment takes."""

    def __init__(self, env: ArrayVecEnv) -> None:
        super().__init__()
        self._env = env

    def _on_training_start(self) -> None:
        self._began = time.process_time() - self._env.cpu_seconds

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        share = self._env.cpu_seconds / max(time.process_time() - self._began, 1e-9)
        self.logger.record("time/environment_share", share)
