"""Trained residuals as rows of the leaderboard: the same metrics as any method's, and the return.

The base of every row is the leaderboard's own: the model beside the record of ImitationFlow on the
same environment with the same seed, made by ``run_all.py`` before. A record's key hashes what
decides its scores, the base's key among it, so that what is up to date is not trained again.
"""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import gymnasium

from iflow_gym.baselines.imitation_flow.lyapunov import TUBE
from iflow_gym.baselines.registry import load_method
from iflow_gym.baselines.residual_learning.artifacts import load_residual, settings_of
from iflow_gym.baselines.residual_learning.recorded import write_recorded
from iflow_gym.baselines.residual_learning.settings import TrainingSettings
from iflow_gym.baselines.residual_learning.tasks import performance
from iflow_gym.baselines.residual_learning.training import Trained, train
from iflow_gym.baselines.runner.fingerprint import (
    CORE_LIBRARIES,
    MOTION_LIBRARIES,
    core_hash,
    hardware,
    method_code,
    sha256_of,
    versions,
)
from iflow_gym.baselines.runner.plan import entry_points, family
from iflow_gym.evaluate import evaluate, motion_of
from iflow_gym.metrics import metrics_hash, metrics_of
from iflow_gym.residual.policy import ResidualPolicy, Zero
from iflow_gym.residual.shield import RATE_SHARE, SLACK
from iflow_gym.results import Result, check_metrics, read_result, result_path, write_result
from iflow_gym.system import Guarantee

BASE = "imitation-flow"
"""Method whose models are corrected."""

PROTOCOL = "reproduction"
"""A reward is of all recordings, so that nothing is held out."""

MODULE = "iflow_gym.baselines.residual_learning.training"
"""Module whose code, and what it imports, decides what is learned."""

REWARDS = ("iflow_gym.envs.guide", "iflow_gym.envs.hit_reward")
"""Modules of rewards: no part of what scores a method, but of what these learn from."""


@dataclass(frozen=True)
class Row:
    """A row of the leaderboard."""

    name: str
    title: str
    stable: float | None
    """The shield's required rate as a share of the base's slowest."""
    scratch: bool = False
    """Whether there is no base."""

    def guarantee(self, velocity_mode: bool, cyclic: bool) -> Guarantee:
        """Return what is known about its stability."""
        if self.stable is None:
            what = "nothing is under the agent" if self.scratch else "the agent may oppose the base"
            return Guarantee("none", f"Learned by reinforcement: {what}.")
        plant = (
            "The environment carries commands out exactly."
            if velocity_mode
            else "How closely the plant follows its command is measured, not proved."
        )
        falls = (
            f"V(x + dt u) <= exp(-rho dt) V(x) with rho {self.stable:g} of the base's slowest rate"
        )
        if cyclic:
            falls = (
                f"outside a tube of {TUBE:.0%} of the latent radius round the cycle {falls}; "
                "inside V stays below the tube's level"
            )
        elif not velocity_mode:
            plant += (
                f" The agent has no say while V, measured, is above {SLACK:g} exp(-rho t / 2) of "
                "its start's."
            )
        return Guarantee(
            "proved",
            f"Of the commanded velocity u, V the base's squared latent distance: {falls}; or u is "
            f"the base's own, whatever the agent wants. {plant}",
        )


def rows(algorithm: str) -> dict[str, Row]:
    """Return the rows that reinforcement learning adds, by name."""
    found = (
        Row(f"{BASE}+residual", "ImitationFlow + residual", None),
        Row(f"{BASE}+stable-residual", "ImitationFlow + stable residual", RATE_SHARE),
        Row(algorithm, f"{algorithm.upper()} from scratch", None, scratch=True),
    )
    return {row.name: row for row in found}


class MissingBaseError(FileNotFoundError):
    """The base of a row has not been run."""


def base_record(folder: Path, environment: str, seed: int) -> tuple[Result, Path]:
    """Return the record of the base on an environment and the path of its model."""
    path = folder / result_path(BASE, environment, PROTOCOL, seed)
    model = path.with_suffix(".safetensors")
    if not (path.is_file() and model.is_file()):
        raise MissingBaseError(
            f"Expected the base's record and model at {path} and {model.name}, got none: run "
            f"`python baselines/run_all.py --methods {BASE} --envs <environments> --protocol "
            f"{PROTOCOL} --seeds <seeds> --output {folder}` first."
        )
    return read_result(path), model


def with_returns(folder: Path, environment: str, seed: int) -> Result:
    """Write the return of the base into its record, which stays as it is otherwise."""
    record, model = base_record(folder, environment, seed)
    if record.returns:
        return record
    system: Any = load_method(BASE).load(model)
    found = performance(Zero(system.n_dims_), environment, system, 1.0, False)
    record = dataclasses.replace(record, returns=found)
    write_result(folder, record)
    return record


def make_record(
    folder: Path,
    row: Row,
    environment: str,
    seed: int,
    settings: TrainingSettings,
    *,
    progress: bool = False,
    runs: Path | None = None,
    force: bool = False,
) -> Result:
    """Train and score a row on an environment, and write its record and what was trained.

    Beside the record lies the agent (`recorded`), whose base is the model beside the record of the
    base; `runs` keeps the whole folder of the training, its curves and checkpoints.
    """
    task: Any = gymnasium.make(environment).unwrapped
    base, model = base_record(folder, environment, seed)
    target = folder / result_path(row.name, environment, PROTOCOL, seed)
    hashes, used, key = _identity(row, environment, task, seed, settings, base)
    if target.is_file() and not force:
        found = read_result(target)
        if found.ok and found.key == key:
            return found
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch) if runs is None else runs / target.relative_to(folder).stem / row.name
        shutil.rmtree(place, ignore_errors=True)
        trained = train(
            place,
            environment,
            settings,
            seed,
            base=None if row.scratch else (BASE, model),
            stable=row.stable,
            progress=progress,
            tensorboard=runs is not None,
        )
        policy = load_residual(place)
        record = _scored(policy, row, environment, task, seed, trained, hashes, used, key)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_recorded(target.with_suffix(".safetensors"), row.name, policy, trained.card)
    write_result(folder, record)
    return record


def _identity(
    row: Row,
    environment: str,
    task: Any,
    seed: int,
    settings: TrainingSettings,
    base: Result,
) -> tuple[dict[str, str], dict[str, str], str]:
    """Return hashes of what decides the scores, the libraries' versions, and the key of both."""
    motion = motion_of(task)
    code = method_code(MODULE)
    config = _config(row, settings)
    hashes = {
        "data": task.demonstrations.sha256,
        "metrics": metrics_hash(motion),
        "code": sha256_of([code.sha256, *(method_code(name).sha256 for name in REWARDS)]),
        "core": core_hash(entry_points(environment), motion),
        "config": sha256_of(config),
    }
    used = versions((*code.libraries, "stable-baselines3"))
    names = (*CORE_LIBRARIES, *MOTION_LIBRARIES[motion], *code.libraries)
    needed = {name: used.get(name) for name in names}
    below = None if row.scratch else base.key
    decisive = [row.name, environment, PROTOCOL, seed, hashes, needed, below]
    return hashes, used, sha256_of(decisive)


def _config(row: Row, settings: TrainingSettings) -> dict[str, Any]:
    return {**settings.as_json(), "stable": row.stable, "base": None if row.scratch else BASE}


def _scored(
    policy: ResidualPolicy,
    row: Row,
    environment: str,
    task: Any,
    seed: int,
    trained: Trained,
    hashes: dict[str, str],
    used: dict[str, str],
    key: str,
) -> Result:
    card = trained.card
    place = result_path(row.name, environment, PROTOCOL, seed)
    began = time.perf_counter()
    found = evaluate(policy, task, seed=seed, protocol=PROTOCOL)
    seconds = time.perf_counter() - began
    returns = performance(policy.agent, environment, policy.base_policy, card.scale, card.shield)
    values = found.metrics | {
        "fit_seconds": trained.wall_seconds,
        "fit_cpu_seconds": trained.cpu_seconds,
        "n_parameters": float(sum(p.numel() for p in policy.agent.policy.parameters())),
    }
    metrics = {m.name: values.get(m.name) for m in metrics_of(motion_of(task))}
    check_metrics(metrics)
    mode = getattr(task, "control_mode", "velocity")
    exact = mode == "velocity" and motion_of(task) != "drumming"
    return Result(
        method=row.name,
        title=row.title,
        environment=environment,
        family=family(environment),
        protocol=PROTOCOL,
        seed=seed,
        preset="residual",
        status="ok",
        key=key,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        metrics=metrics,
        medians=found.medians,
        per_demonstration=found.per_demonstration,
        returns=returns,
        guarantee=row.guarantee(exact, task.demonstrations.period is not None),
        target="iflow_gym.baselines.residual_learning.recorded:load_recorded",
        config=_config(row, settings_of(card)),
        model=place.with_suffix(".safetensors").name,
        integrator="its base's command and the agent's",
        dt=task.demonstrations.mean_dt,
        fit={
            "batch_size": 1.0,
            "batch_wall_seconds": trained.wall_seconds,
            "batch_cpu_seconds": trained.cpu_seconds,
            "evaluate_seconds": seconds,
            "environment_share": trained.environment_share,
            "steps": float(card.steps),
        },
        hashes=hashes,
        versions=used,
        hardware=hardware(1),
    )
