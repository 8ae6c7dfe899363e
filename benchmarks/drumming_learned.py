"""What ImitationFlow learns of drumming: `python benchmarks/drumming_learned.py`, half an hour.

By itself, and told when its strokes are due (`iflow_gym.baselines.imitation_flow.in_time`), by the
environment's own metrics, on the tip that the physics moves. With coupling layers, the default, the
models are the leaderboard's; with autoregressive ones, the paper's for the robot, or on the
authors' recording (`--recorded`), they are fitted here, on all six demonstrations as well.

- *by itself*: from each demonstration's start, eight periods; a hundred starts; pushes.
- *to the score*: from the same starts, each to its demonstration's score.
- *to a beat*: a round of the first demonstration's score again and again, 0.7 to 1.5 times as fast,
  which no recording did; from its start. At its own pace also from the hundred starts, and pushed.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import iflow_gym  # noqa: F401  registers the environments
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.in_time import InTimePolicy, rehearsed
from iflow_gym.evaluate import evaluate
from iflow_gym.evaluation.rollouts import rollouts
from iflow_gym.metrics.drumming import hit_f1, timing_error

RESULTS = Path(__file__).resolve().parents[1] / "leaderboard/results/imitation-flow"
PACES = (0.7, 0.85, 1.0, 1.2, 1.5)
"""Of a beat, in the first demonstration's."""
BEATS = 24
"""Notes of a beat: of more rounds than any rollout that is scored."""

ACCURACY = (
    "hit_f1", "timing_error", "rhythm_f1", "sequence_f1", "tempo_error", "period_error",
    "orbit_distance", "tracking_rmse",
)  # fmt: skip
STABILITY = ("attraction", "diverged", "perturbation_recovery")


def beat(times: Any, notes: Any, pace: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the first round of a score again and again, faster by a factor."""
    second = np.flatnonzero(notes == notes[0])[1]
    shifts = (times[second] - times[0]) * np.arange(BEATS // second)
    due = (times[:second] + shifts[:, None]).ravel() - times[0]
    return times[0] + due / pace, np.tile(notes[:second], len(shifts))


def to_beats(
    env: Any, model: ImitationFlow, phases: Any, score: tuple[Any, Any]
) -> list[tuple[float, float]]:
    """Return F1 and timing error in ms of the hits at each of the `PACES`, over six rounds."""
    beats = [beat(*score, pace) for pace in PACES]
    longest = max(times[12] for times, _ in beats)
    arms = env.like(len(beats), horizon=round(longest / env.dt))
    first, _ = arms.reset(seed=0, options={"demonstration": np.zeros(len(beats), dtype=int)})
    rollouts(InTimePolicy(model, beats, phases), [arms], first, round(longest / env.dt))
    found = []
    for (times, notes), hits in zip(beats, arms.hits, strict=True):
        end = (times[11] + times[12]) / 2
        due = times < end
        heard = [hit for hit in hits if hit.time < end]
        at, on = np.array([h.time for h in heard]), np.array([h.drum for h in heard], dtype=int)
        played = times[due], notes[due], at, on
        found.append((hit_f1(*played), timing_error(*played)))
    return found


def table(found: Any, names: tuple[str, ...]) -> str:
    """Return metrics in a line."""
    return ", ".join(f"{name} {found[name]:.3g}" for name in names)


def main() -> None:
    """Print what each seed's model does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--emission", choices=["coupling", "autoregressive"], default="coupling")
    parser.add_argument("--recorded", action="store_true", help="on iflow/DrummingRecorded-v0")
    parser.add_argument("--stability", action=argparse.BooleanOptionalAction, default=True)
    options = parser.parse_args()
    name = "DrummingRecorded-v0" if options.recorded else "Drumming-v0"
    env: Any = gymnasium.make(f"iflow/{name}").unwrapped
    scores = [env.score_of(index) for index in range(len(env.demonstrations))]
    own = (*ACCURACY, *STABILITY) if options.stability else ACCURACY
    for seed in options.seeds:
        if options.emission == "coupling" and not options.recorded:
            model = ImitationFlow.load(RESULTS / f"{name}.reproduction.seed{seed}.safetensors")
        else:
            model = ImitationFlow(emission=options.emission).fit(env.demonstrations, seed=seed)
        label = f"{name}, {options.emission}, seed {seed}"
        found = evaluate(model, env, seed=seed, stability=options.stability).metrics
        print(f"{label}, by itself: {table(found, own)}", flush=True)
        try:
            phases = rehearsed(model, env)
        except ValueError as error:
            print(f"{label}: {error}", flush=True)
            continue
        policy = InTimePolicy(model, scores, phases)
        found = evaluate(policy, env, seed=seed, stability=False).metrics
        print(f"{label}, to the score: {table(found, ACCURACY)}", flush=True)
        beats = zip(PACES, to_beats(env, model, phases, scores[0]), strict=True)
        row = "; ".join(f"{pace}: F1 {f1:.3g}, {error:.3g} ms" for pace, (f1, error) in beats)
        print(f"{label}, to a beat at pace {row}", flush=True)
        if options.stability:
            policy = InTimePolicy(model, [beat(*scores[0], 1.0)], phases)
            found = evaluate(policy, env, seed=seed).metrics
            print(f"{label}, to a beat: {table(found, STABILITY)}", flush=True)


if __name__ == "__main__":
    main()
