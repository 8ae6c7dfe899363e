"""``iflow-gym score``: the leaderboard's metrics of a model, on a motion of one's own."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from iflow_gym.cli.console import (
    UsageError,
    check_seed,
    only_one_pipe,
    print_json,
    progress,
    say,
)
from iflow_gym.recordings.columns import shown

if TYPE_CHECKING:
    from iflow_gym.evaluate import Evaluation

FAMILY_TITLES = {"accuracy": "Accuracy", "stability": "Stability", "cost": "Cost"}


@dataclass(frozen=True)
class Score:
    """Score a model by the leaderboard's metrics, in an environment made of the demonstrations.

    MOTION is a file that `iflow-gym import` wrote, or an environment of `iflow-gym envs`. Every
    trajectory is run by the environment: from each demonstration's start, from a grid of starts on
    twice the demonstrations' box, and pushed on the way. docs/metrics.md says what each number is.

        iflow-gym score policy.safetensors reach.safetensors
        iflow-gym fit reach.safetensors -o part.safetensors --protocol generalisation
        iflow-gym score part.safetensors reach.safetensors --protocol generalisation
        iflow-gym score policy.safetensors reach.safetensors --json | jq .metrics.frechet
    """

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """Model that `iflow-gym fit` wrote; - reads standard input."""
    motion: Annotated[Positional[str], arg(metavar="MOTION")]
    """What to score it on."""
    protocol: Literal["reproduction", "generalisation"] = "reproduction"
    """Score on the recordings that were fitted, or on those that were held out."""
    method: Annotated[str | None, shown("MODULE:CLASS")] = None
    """module:Class of a model whose method is one's own."""
    seed: int = 0
    """Seed of the directions of pushes."""
    control_mode: Literal["velocity", "force"] = "velocity"
    """What moves the mass: the commanded velocity, or a force that follows it."""
    stability: bool = True
    """Whether to take the metrics that need long rollouts."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """Score."""
        import gymnasium

        from iflow_gym.cli.motions import OWN, check_match, load_model_file, load_motion
        from iflow_gym.evaluate import evaluate, motion_of

        only_one_pipe(self.model, self.motion)
        check_seed(self.seed)
        method, record = load_model_file(self.model, self.method)
        demonstrations, env_id = load_motion(self.motion)
        check_match(method, record, demonstrations)
        if (method.period_ is None) != (demonstrations.period is None):
            kinds = [
                "ends" if p is None else "repeats" for p in (method.period_, demonstrations.period)
            ]
            raise UsageError(
                f"Expected a model and a motion of the same kind, got a model that {kinds[0]} and "
                f"a motion that {kinds[1]}."
            )
        seen = _seen(record, demonstrations.split(self.protocol).score)
        if self.protocol == "generalisation" and seen:
            raise UsageError(
                f"Expected a model that has not seen what it is scored on, got one that was fitted "
                f"to {seen} of the recordings: fit it with --protocol generalisation, too."
            )
        arguments: dict[str, Any] = {"control_mode": self.control_mode}
        if env_id is None:
            arguments["demonstrations"] = demonstrations
        elif "Drumming" in env_id:
            arguments = {}
        env = gymnasium.make(env_id or OWN, disable_env_checker=True, **arguments)
        with progress(f"Scoring {method.title} on {demonstrations.name}"):
            found = evaluate(
                method, env, seed=self.seed, protocol=self.protocol, stability=self.stability
            )
        env.close()
        if record and isinstance(cost := record.get("fit_cpu_seconds"), float):
            found.metrics["fit_cpu_seconds"] = cost
        motion = motion_of(env.unwrapped)
        unit = demonstrations.length_unit
        scored = len(demonstrations.split(self.protocol).score)
        guarantee = method.guarantee
        if self.json:
            print_json(
                {
                    "method": method.name,
                    "motion": demonstrations.name,
                    "environment": env_id or OWN,
                    "protocol": self.protocol,
                    "seed": self.seed,
                    "control_mode": self.control_mode,
                    "unit": unit,
                    "recordings": scored,
                    "recordings_seen_in_fit": seen,
                    "guarantee": dataclasses.asdict(guarantee),
                    "metrics": found.metrics,
                    "medians": found.medians,
                    "per_demonstration": found.per_demonstration,
                }
            )
            return 0
        print(
            f"{method.title} on {demonstrations.name}, {self.protocol}: {scored} recording"
            f"{'s' * (scored > 1)}"
        )
        if self.protocol == "generalisation" and seen is None:
            say("It is not known what the model was fitted on: `iflow-gym fit` would have said it.")
        _print_table(found, motion, unit)
        print(f"\nStability: {guarantee.kind}. {guarantee.reason}")
        return 0


def _seen(record: dict[str, Any] | None, scored: Any) -> int | None:
    """Return how many of the scored recordings the model was fitted on; None if nobody knows."""
    from iflow_gym.cli.fitting import digest

    fitted = (record or {}).get("recordings")
    if not isinstance(fitted, list):
        return None
    return sum(digest(p) in fitted for p in scored.positions)


def _print_table(found: Evaluation, motion: Any, unit: str) -> None:
    """Print the metrics that there are, with mean and median over the recordings."""
    from iflow_gym.metrics import metrics_of

    family = None
    for metric in metrics_of(motion):
        value = found.metrics.get(metric.name)
        if value is None:
            continue
        if metric.family != family:
            family = metric.family
            print(f"\n{FAMILY_TITLES[family]:<26}{'mean':>12}{'median':>12}  unit")
        own = metric.unit.replace("length", unit) if metric.unit != "-" else ""
        median = found.medians.get(metric.name)
        better = "higher is better" if metric.better == "higher" else ""
        note = ", ".join(t for t in (own, better) if t)
        print(f"{metric.title:<26}{_number(value):>12}{_number(median):>12}  {note}".rstrip())


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
