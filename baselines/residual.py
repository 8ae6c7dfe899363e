r"""Train a residual on top of a learned motion by reinforcement learning, with Stable-Baselines3.

The agent sees the environment's observation and the base's command, and adds a velocity to it.
With --stable the sum is projected so that the base's Lyapunov function falls whatever the agent
does. Settings come from TOML presets (ppo, sac, td3); what is left in the folder is the agent in
Stable-Baselines3's own format, the base model, a card of what belongs together, checkpoints, and
TensorBoard's curves.

    python baselines/residual.py train --env iflow/Disturbed-Angle-v0 --base model.safetensors \\
        --stable --seed 0 --output runs/angle
    python baselines/residual.py train --env iflow/Disturbed-Angle-v0 --output runs/scratch
    python baselines/residual.py resume --run runs/angle --total-steps 1000000
    python baselines/residual.py score --run runs/angle
    python baselines/residual.py bench --envs 'Disturbed-*' --seeds 0 1 2 3 4

`bench` writes rows of the leaderboard, on the base models that `run_all.py` left there.

Exit status: 0 when all is done, 1 when a row of `bench` failed, 2 for what is not understood.
"""

from __future__ import annotations

import os
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

if TYPE_CHECKING:
    from rich.console import Console

# What is heavy is imported where it is used, so that --help is quick.


@dataclass(frozen=True)
class Train:
    """Train a residual, or with no base an agent from scratch."""

    output: Path
    """Folder of the run; must not hold a trained residual."""
    env: str = "iflow/Disturbed-Angle-v0"
    """Id of the environment."""
    base: Path | None = None
    """Model file of the base, as its `save` wrote it; without one the agent learns from scratch."""
    base_method: str = "imitation-flow"
    """Registered name of the base's method, or package.module:Class."""
    stable: bool = False
    """Project the command so that the base's Lyapunov function falls."""
    rate_share: float | None = None
    """Required rate of --stable, as a share of the base's slowest; 0.9 by default."""
    preset: str = "ppo"
    """ppo, sac, td3, or a path to a TOML file like theirs in baselines/presets/residual."""
    seed: int = 0
    """Of the agent and of the environments."""
    total_steps: int | None = None
    """Steps of single environments; the preset's by default."""
    num_envs: int | None = None
    """Environments that step together; the preset's by default."""
    scale: float | None = None
    """Largest residual in greatest speeds; the preset's by default."""
    progress: bool = True
    """Show a progress bar."""


@dataclass(frozen=True)
class Resume:
    """Go on with a run, from its agent or its last checkpoint."""

    run: Path
    """Folder of the run."""
    total_steps: int | None = None
    """Steps in all, those done among them; those of its settings by default."""
    checkpoint: Path | None = None
    """A checkpoint to go on from, in place of the latest."""
    progress: bool = True
    """Show a progress bar."""


@dataclass(frozen=True)
class Score:
    """Score a trained residual by the metrics of its environment."""

    run: Path
    """Folder of the run, or the .safetensors file beside a record of the leaderboard."""
    env: str | None = None
    """Id to score on; an error if the residual was trained on another one."""
    seed: int = 0
    """Of the pushes."""


@dataclass(frozen=True)
class Bench:
    """Train and score the leaderboard's rows, and write their records."""

    envs: tuple[str, ...] = ("Disturbed-Angle-v0", "Disturbed-Sshape-v0")
    """Globs over environments' ids or short names."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds, of the bases too."""
    rows: tuple[str, ...] = ()
    """Names of rows; all by default."""
    preset: str = "ppo"
    """As for train."""
    total_steps: int | None = None
    """Steps of every row; the preset's by default."""
    num_envs: int | None = None
    """Environments that step together; the preset's by default."""
    output: Path | None = None
    """Folder of results; that of run_all.py by default."""
    runs: Path | None = None
    """Folder to keep whole runs in, with curves and checkpoints; not kept by default."""
    force: bool = False
    """Train anew what is up to date."""
    progress: bool = False
    """Show progress bars."""


Command = (
    Annotated[Train, "train"] | Annotated[Resume, "resume"] | Annotated[Score, "score"]
    | Annotated[Bench, "bench"]
)  # fmt: skip


def run(command: Train | Resume | Score | Bench, console: Console) -> int:
    """Do what a command says; return the exit status.

    Raises
    ------
    ValueError, FileNotFoundError, FileExistsError
        For what is not understood or not there.
    """
    if isinstance(command, Train):
        return _train(command, console)
    if isinstance(command, Resume):
        return _resume(command, console)
    if isinstance(command, Score):
        return _score(command, console)
    return _bench(command, console)


def _train(options: Train, console: Console) -> int:
    from iflow_gym.baselines.residual_learning.settings import load_settings
    from iflow_gym.baselines.residual_learning.training import train
    from iflow_gym.residual.shield import RATE_SHARE

    settings = load_settings(
        options.preset,
        total_steps=options.total_steps,
        num_envs=options.num_envs,
        scale=options.scale,
    )
    stable = (options.rate_share or RATE_SHARE) if options.stable else None
    base = None if options.base is None else (options.base_method, options.base)
    trained = train(
        options.output,
        options.env,
        settings,
        options.seed,
        base=base,
        stable=stable,
        progress=options.progress,
    )
    _report(trained, console)
    return 0


def _resume(options: Resume, console: Console) -> int:
    from iflow_gym.baselines.residual_learning.training import resume

    _report(
        resume(
            options.run,
            total_steps=options.total_steps,
            checkpoint=options.checkpoint,
            progress=options.progress,
        ),
        console,
    )
    return 0


def _score(options: Score, console: Console) -> int:
    import gymnasium
    from rich.table import Table

    from iflow_gym.baselines.residual_learning.artifacts import load_residual, read_card
    from iflow_gym.baselines.residual_learning.recorded import load_recorded
    from iflow_gym.evaluate import evaluate
    from iflow_gym.model_files import read_model_file

    if options.run.suffix == ".safetensors":
        header, _ = read_model_file(options.run)
        policy: Any = load_recorded(options.run)
        env = options.env or header["card"]["environment"]
    else:
        env = options.env or read_card(options.run).environment
        policy = load_residual(options.run, environment=env)
    found = evaluate(policy, gymnasium.make(env), seed=options.seed).metrics
    table = Table("metric", "value")
    for name, value in found.items():
        if value is not None:
            table.add_row(name, f"{value:.4g}")
    console.print(table)
    return 0


def _bench(options: Bench, console: Console) -> int:
    from itertools import product

    import iflow_gym  # noqa: F401 (registers the environments)
    from iflow_gym.baselines.residual_learning.records import (
        MissingBaseError,
        make_record,
        rows,
        with_returns,
    )
    from iflow_gym.baselines.residual_learning.settings import load_settings
    from iflow_gym.baselines.run_all import default_output
    from iflow_gym.baselines.runner.plan import select_environments

    settings = load_settings(
        options.preset, total_steps=options.total_steps, num_envs=options.num_envs
    )
    known = rows(settings.algorithm)
    if unknown := sorted(set(options.rows) - set(known)):
        raise ValueError(f"Expected rows among {', '.join(known)}, got {', '.join(unknown)}.")
    folder = (options.output or default_output("full")).resolve()
    chosen = [known[name] for name in options.rows or known]
    failed = 0
    for environment, seed in product(select_environments(options.envs), options.seeds):
        base = with_returns(folder, environment, seed)
        _line(console, f"{environment} seed {seed}, base alone", base)
        for row in chosen:
            try:
                record = make_record(
                    folder,
                    row,
                    environment,
                    seed,
                    settings,
                    progress=options.progress,
                    runs=options.runs,
                    force=options.force,
                )
            except MissingBaseError:
                raise
            except Exception:
                failed += 1
                console.print(f"FAILED {row.name} on {environment}, seed {seed}:")
                console.print(traceback.format_exc(), markup=False)
            else:
                _line(console, f"{environment} seed {seed}, {row.name}", record)
    return 1 if failed else 0


def _line(console: Console, label: str, record: Any) -> None:
    names = ("rmse", "frechet", "converged", "rhythm_f1", "orbit_distance", "attraction")
    scores = [
        f"{name} {record.metrics[name]:.3g}"
        for name in names
        if record.metrics.get(name) is not None
    ]
    mean = record.returns.get("mean")
    reward = "" if mean is None else f"reward a step {mean:.3f}, "
    console.print(f"{label}: {reward}{', '.join(scores)}", highlight=False, soft_wrap=True)


def _report(trained: Any, console: Console) -> None:
    console.print(
        f"{trained.card.steps} steps in {trained.wall_seconds:.0f} s "
        f"({trained.cpu_seconds:.0f} s of CPU, {trained.environment_share:.0%} of it in the "
        f"environment and the base), into {trained.folder}",
        highlight=False,
        soft_wrap=True,
    )


def main() -> None:
    """Run from the command line."""
    import tyro
    from rich.console import Console

    command: Any = tyro.cli(Command, description=__doc__)
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for --base-method my_module:MyMethod
    try:
        status = run(command, Console(width=None if sys.stdout.isatty() else 140))
    except KeyboardInterrupt:
        print("Stopped. Checkpoints are kept: go on with `resume`.", file=sys.stderr)
        status = 130
    except (ValueError, FileNotFoundError, FileExistsError) as error:
        print(f"residual.py: {error}", file=sys.stderr)
        status = 2
    sys.exit(status)


if __name__ == "__main__":
    main()
