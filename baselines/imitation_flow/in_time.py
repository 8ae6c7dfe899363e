"""ImitationFlow plays in time: along its own cycle, at the pace that a score asks for.

A policy of the state alone has a tempo of its own. Told when its strokes are due, it can hurry or
linger without leaving its way: the latent cycle (paper, sec. III-D) has a phase psi that grows at a
constant rate b, whatever the flow has bent the circle into. `InTimePolicy` steps the model over

    s dt,    s = (psi*(t + dt) - psi*(t) + (1 - exp(-g dt)) (psi* - psi)) / (b dt),

with s_min <= s <= s_max, in place of dt. psi*(t) is the phase that is due: a monotone curve (PCHIP)
through the phases of the notes at their times, each the next of its kind after the note before.

As s_min > 0, time alone is bent: every command leads along the model's own orbit through the state
that it is given in. So where the mass follows its commands exactly (a point mass, by velocities),
what is proved of the orbits - that they come to the cycle, and how V decreases along them - holds
at any pace; it is s_min b at least, unless the greatest speed slows it further. A mass or an arm
that lags is near the orbits as far as it follows, as with the model by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from iflow_gym.baselines.imitation_flow.fields.latents import CycleField
from iflow_gym.baselines.imitation_flow.model import ImitationFlow
from iflow_gym.demonstrations import FloatArray
from iflow_gym.policy import DynamicalSystemPolicy

TURN = 2 * np.pi

SLOWEST, FASTEST = 0.1, 1.6
"""s_min and s_max: how much slower and faster than the model goes by itself."""

GAIN = 3.0
"""g in 1/s: within the limits of s, a wrong phase falls to 1/e in a third of a second."""

SAME = 1e-6
"""Phases in rad that are one: a note after itself is a whole turn ahead, whatever rounding says."""


Score = tuple[ArrayLike, ArrayLike]
"""What is to be played: times in s from the episode's beginning, increasing, and indices of notes
(for drumming, drums), shape (n,) each."""


class InTimePolicy:
    """Plays scores on a model's cycle (see the module).

    Notes that come too fast are played one after another, late; one that is due later than at s_min
    comes too early. What lies on the way from one note to the next is passed through, asked for or
    not. A note at 0 s is none: one is where one is. After the last one the model goes on at its own
    pace.

    Its state is its clock and how far it has turned: give the one that `predict` returns back to
    the next call.

    Parameters
    ----------
    model : ImitationFlow
        Fitted on motions that repeat.
    scores : sequence of Score
        Row i of a batch plays the i-th; of a single one, every row plays it. `evaluate` rolls out
        the scored demonstrations, in their order, for accuracy alone with ``stability=False``: give
        a score for each, or one.
    phases : array, shape (n_notes,)
        psi of the model at each note, in rad, as `rehearsed` finds them for the drumming arm, and
        `phases_of_notes` wherever one knows when the model played them.
    env, max_speed, dt
        As for `iflow_gym.DynamicalSystemPolicy`. Without any, the policy is for `evaluate`, which
        binds it to its own environment.
    gain : float, 1/s
        g > 0.
    slowest, fastest : float
        0 < s_min < 1 < s_max.

    Raises
    ------
    ValueError
        If the model has no cycle, a score has other notes than the phases or times that do not
        increase, or a number is out of its range.
    """

    def __init__(
        self,
        model: ImitationFlow,
        scores: Sequence[Score],
        phases: ArrayLike,
        env: Any = None,
        *,
        max_speed: float | None = None,
        dt: float | None = None,
        gain: float = GAIN,
        slowest: float = SLOWEST,
        fastest: float = FASTEST,
    ) -> None:
        self._rate = _rate(model)
        self.model = model
        self.phases = np.asarray(phases, dtype=np.float64)
        if self.phases.ndim != 1 or not self.phases.size or not np.isfinite(self.phases).all():
            raise ValueError(f"Expected finite phases of shape (n_notes,), got {phases!r}.")
        if not 0 < gain < np.inf:
            raise ValueError(f"Expected a finite gain > 0 in 1/s, got {gain}.")
        if not 0 < slowest < 1 < fastest < np.inf:
            raise ValueError(f"Expected 0 < slowest < 1 < fastest, got {slowest} and {fastest}.")
        if not len(scores):
            raise ValueError("Expected at least one score, got none.")
        self.scores: list[Score] = list(scores)
        self._notes = [self._checked(score, i) for i, score in enumerate(scores)]
        self.gain, self.slowest, self.fastest = gain, slowest, fastest
        self._policy: _Paced | None = None
        if env is not None or max_speed is not None or dt is not None:
            self._policy = _Paced(model, env, max_speed=max_speed, dt=dt)

    def for_environment(self, env: Any) -> InTimePolicy:
        """Return the same policy for an environment, or a batch of them."""
        return InTimePolicy(
            self.model,
            self.scores,
            self.phases,
            env,
            gain=self.gain,
            slowest=self.slowest,
            fastest=self.fastest,
        )

    def predict(
        self,
        observation: ArrayLike,
        state: dict[str, Any] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Return actions in [-1, 1], float64, and the state for the next step.

        Parameters
        ----------
        observation : array, shape (d,) or (n, d)
            The position comes first.
        state : dict or None
            What the last call returned; None starts the clocks.
        episode_start : array of bool, shape (n,), optional
            Where an episode begins, and its clock with it.
        deterministic
            Stable-Baselines3's argument; the policy has no noise.
        """
        if self._policy is None:
            raise ValueError("Expected an environment, or max_speed and dt, to give actions for.")
        values, dt = self._policy.checked(observation)
        if values.ndim > 2:
            raise ValueError(f"Expected observations of shape (d,) or (n, d), got {values.shape}.")
        x = np.atleast_2d(values[..., : self._policy.n_dims])
        steps = np.broadcast_to(np.asarray(dt, dtype=np.float64), len(x))
        psi = np.sign(self._rate) * latent_phase(self.model, x)
        lost = ~np.isfinite(psi)  # a state that is not finite: its action is not, either
        psi[lost] = 0.0
        if state is None:
            begun = np.ones(len(x), dtype=np.bool_)
            state = {"time": np.zeros(len(x)), "turned": psi, "due": [None] * len(x)}
        else:
            begun = np.zeros(len(x), dtype=np.bool_)
            if episode_start is not None:
                begun |= np.asarray(episode_start, dtype=np.bool_).reshape(-1)
        time = np.where(begun, 0.0, state["time"])
        # Whole turns count: who is a turn behind has its notes still to play.
        on = np.where(lost, 0.0, (psi - state["turned"] + np.pi) % TURN - np.pi)
        turned = np.where(begun, psi, state["turned"] + on)
        due = [
            self._due(self._of_row(i, len(x)), psi[i]) if begun[i] else state["due"][i]
            for i in range(len(x))
        ]
        pace = np.array([self._pace(*row) for row in zip(due, time, turned, steps, strict=True)])
        action = self._policy.paced(values, pace.reshape(values.shape[:-1]))
        return action, {"time": time + steps, "turned": turned, "due": due}

    def _of_row(self, row: int, n_rows: int) -> list[tuple[float, int]]:
        if len(self._notes) == 1:
            return self._notes[0]
        if 1 < n_rows != len(self._notes):
            raise ValueError(
                f"Expected as many scores as rows, or one for all, got {len(self._notes)} scores "
                f"and {n_rows} rows."
            )
        return self._notes[row]

    def _due(self, score: list[tuple[float, int]], start: float) -> PchipInterpolator:
        """Return psi*(t), which begins at a state's own phase; turned so that it grows."""
        sign, rate = np.sign(self._rate), abs(self._rate)
        times, due = [0.0], [start]
        for time, note in score:
            if time == 0.0:  # played from where one is
                continue
            ahead = (sign * self.phases[note] - due[-1]) % TURN
            times.append(time)
            due.append(due[-1] + (ahead if ahead > SAME else ahead + TURN))
        # As far again at the model's own pace, which gives the curve's end its slope.
        times.append(times[-1] + TURN / rate)
        due.append(due[-1] + TURN)
        return PchipInterpolator(times, due)

    def _pace(self, due: PchipInterpolator, time: float, turned: float, dt: float) -> float:
        """Return s of a step that begins at a time, with a phase that has grown since the start."""
        rate, end = abs(self._rate), due.x[-2]
        last = float(due(end))
        if time >= end and turned >= last:
            return 1.0

        def wanted(t: float) -> float:
            return float(due(t)) if t < end else last + rate * (t - end)

        late = -np.expm1(-self.gain * dt) * (wanted(time) - turned)
        pace = (wanted(time + dt) - wanted(time) + late) / (rate * dt)
        return float(np.clip(pace, self.slowest, self.fastest))

    def _checked(self, score: Score, index: int) -> list[tuple[float, int]]:
        """Return a score's notes, each with its time."""
        if len(score) != 2:
            raise ValueError(f"Expected times and notes in score {index}, got {score!r}.")
        times, notes = (np.asarray(part) for part in score)
        if times.ndim != 1 or times.shape != notes.shape or not len(times):
            raise ValueError(
                f"Expected times and notes of one shape (n,), n >= 1, in score {index}, got "
                f"{times.shape} and {notes.shape}."
            )
        if not (np.isfinite(times).all() and times[0] >= 0 and (np.diff(times) > 0).all()):
            raise ValueError(
                f"Expected times in s that increase from 0 on in score {index}, got {times}."
            )
        if notes.dtype.kind not in "iu" or notes.min() < 0 or notes.max() >= len(self.phases):
            raise ValueError(
                f"Expected notes from 0 to {len(self.phases) - 1}, as many as there are phases, in "
                f"score {index}, got {notes}."
            )
        return list(zip(times.astype(np.float64).tolist(), notes.tolist(), strict=True))


class _Paced(DynamicalSystemPolicy):
    """The system's policy, over a share of dt of one's own for each row."""

    @property
    def n_dims(self) -> int:
        return self._n_dims

    def checked(self, observation: ArrayLike) -> tuple[FloatArray, Any]:
        """Return observations, shape (..., observation), and their dt."""
        return self._checked(observation)

    def paced(self, observation: FloatArray, pace: FloatArray) -> FloatArray:
        """Return actions for a step of `pace` dt of the system within dt."""
        values, dt = self._checked(observation)
        x = values[..., : self._n_dims]
        points = x.reshape(-1, self._n_dims)
        steps = np.broadcast_to(np.asarray(dt, dtype=np.float64), x.shape[:-1]).reshape(-1)
        limits = self.max_speed * steps
        bent = pace.reshape(-1) * steps
        moves = self.system.step(points, bent) - points
        fast = np.flatnonzero(np.abs(moves).max(axis=-1) > limits)
        if len(fast):
            moves[fast] = self._slowed(points[fast], bent[fast], moves[fast], limits[fast])
        return self._action((moves / steps[:, None]).reshape(x.shape), values, dt)


def latent_phase(model: ImitationFlow, x: ArrayLike) -> FloatArray:
    """Return psi in rad, from -pi to pi: at which phase of the latent cycle states are.

    Along the model's mean dynamics it grows at a constant rate, on the cycle and off it: states of
    one phase come together (an isochron).

    Parameters
    ----------
    model : ImitationFlow
        Fitted on motions that repeat.
    x : array, shape (..., d)

    Raises
    ------
    ValueError
        If the model has no cycle.
    """
    _rate(model)
    states = np.asarray(x, dtype=np.float64)
    z, _ = model._encode(states.reshape(-1, states.shape[-1]))
    return np.asarray(np.arctan2(z[:, 1], z[:, 0]).reshape(states.shape[:-1]))


def phases_of_notes(
    model: ImitationFlow,
    paths: Sequence[ArrayLike],
    dt: float,
    scores: Sequence[Score],
) -> FloatArray:
    """Return the model's phase at each note of paths along which it is known when they came.

    Parameters
    ----------
    model : ImitationFlow
        Fitted on motions that repeat.
    paths : sequence of arrays, shape (T, d)
        The model's own: a recording of another way through the same notes is at other phases there.
    dt : float
        Seconds a sample.
    scores
        One for each path: when it played what, in s from its first sample.

    Returns
    -------
    array, shape (n_notes,)
        In rad, from -pi to pi: circular means.

    Raises
    ------
    ValueError
        If there are not as many scores as paths, or a note up to the highest is in none.
    """
    if len(scores) != len(paths):
        raise ValueError(f"Expected a score for each of {len(paths)} paths, got {len(scores)}.")
    found: dict[int, list[complex]] = {}
    for path, (times, notes) in zip(paths, scores, strict=True):
        psi = np.unwrap(latent_phase(model, path))
        at = np.asarray(times, dtype=np.float64)
        turns = np.exp(1j * np.interp(at, dt * np.arange(len(psi)), psi))
        for note, turn in zip(np.asarray(notes).tolist(), turns.tolist(), strict=True):
            found.setdefault(note, []).append(turn)
    if not found or set(found) != set(range(len(found))):
        raise ValueError(f"Expected notes 0, 1, ... in the scores, got {sorted(found)}.")
    return np.array([np.angle(np.mean(found[note])) for note in range(len(found))])


def rehearsed(model: ImitationFlow, env: Any, *, n_rounds: int = 3) -> FloatArray:
    """Return the model's phase at the stroke on each drum, from rounds that it drums by itself.

    Parameters
    ----------
    model : ImitationFlow
        Fitted on demonstrations of the environment.
    env : DrummingEnv
        Another arm like it is moved.
    n_rounds : int
        That are heard, after one in which the cycle is reached.

    Raises
    ------
    TypeError
        If the environment is no arm with drums, or many of them.
    ValueError
        If a drum is not hit, or no round is to be heard.
    """
    if n_rounds < 1:
        raise ValueError(f"Expected n_rounds >= 1, got {n_rounds}.")
    task = env.unwrapped
    if not (hasattr(task, "drums") and hasattr(task, "like")):
        raise TypeError(
            "Expected one arm at its drums, as gymnasium.make('iflow/Drumming-v0') makes it, got "
            f"{type(task).__name__}."
        )
    lead, heard = (round(n * task.demonstrations.period / task.dt) for n in (1, n_rounds))
    arm = task.like(horizon=lead + heard)
    policy = DynamicalSystemPolicy(model, arm)
    observation, _ = arm.reset(seed=0, options={"demonstration": 0})
    path, hits = [observation], []
    for _ in range(lead + heard):
        observation, _, _, _, info = arm.step(policy.predict(observation)[0])
        path.append(observation)
        hits += [hit for hit in info["hits"] if hit.time >= lead * task.dt]
    missed = set(range(len(task.drums))) - {hit.drum for hit in hits}
    if missed:
        raise ValueError(
            f"Expected every drum to be hit within {n_rounds} rounds, not so drum {min(missed)}: "
            "what this model has learned passes it by."
        )
    played = np.array([hit.time for hit in hits]), np.array([hit.drum for hit in hits])
    positions = np.array(path)[:, : task.n_dims]
    return phases_of_notes(model, [positions], task.dt, [played])


def _rate(model: ImitationFlow) -> float:
    """Return b of the latent cycle in rad/s."""
    if getattr(model, "period_", None) is None:
        raise ValueError(
            "Expected a model fitted on motions that repeat: one that comes to a goal has no phase."
        )
    assert isinstance(model._latent, CycleField)
    if model._latent.turn == 0.0:
        raise ValueError(
            "Expected a model that goes round, got one whose latent cycle stands still."
        )
    return model._latent.turn / model._time
