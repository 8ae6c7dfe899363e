"""Which V goes with which regressor: the pair that reproduces the fitted demonstrations best.

The objective of V says nothing of how a regressor follows a motion under it, nor does a mixture's
likelihood. Reproductions do, and where one slides along a level set they depend on the time step: a
first pass takes about `STEPS` steps, and of the best pairs the one is kept that is best at the
demonstrations' own sample times.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from iflow_gym.baselines.clf_dm.controller import Controller
from iflow_gym.baselines.clf_dm.energy import Energy
from iflow_gym.baselines.clf_dm.regressors import Regressor
from iflow_gym.demonstrations import FloatArray
from iflow_gym.metrics import frechet

Pair = tuple[int, int]
"""Indices of a V and a regressor."""

STEPS = 333
"""About so many steps has a reproduction in the first pass."""

COMPARED = 125, 250
"""About so many samples of it are compared, in the first pass and in the last."""

REGRESSORS, ENERGIES = 4, 3
"""How many of the best are tried with each other."""

FINALISTS = 6
"""Pairs that are tried at the demonstrations' own sample times."""


def best_controller(
    energies: Sequence[Energy],
    regressors: Sequence[Regressor],
    controller: Callable[[Energy, Regressor], Controller],
    positions: Sequence[FloatArray],
    dt: FloatArray,
) -> Controller:
    """Return the controller whose reproductions have the least Fréchet distance.

    All regressors are tried with the last V, every V with the best of them, and the best of both
    with each other. Regressors that are tried with one V run side by side.

    Parameters
    ----------
    energies, regressors : sequences
    controller : callable
        Makes a controller of a V and a regressor.
    positions : sequence of arrays, shape (T_i, d)
        The fitted demonstrations, as offsets from the goal in the controller's units.
    dt : array, shape (number of demonstrations,)
        Their sample times, likewise.
    """
    if len(energies) * len(regressors) == 1:
        return controller(energies[0], regressors[0])
    every = max(1, max(len(p) for p in positions) // STEPS)

    def tried(pairs: Sequence[Pair], every: int, n_compared: int) -> dict[Pair, float]:
        found: dict[Pair, float] = {}
        for i in sorted({i for i, _ in pairs}):
            members = [j for k, j in pairs if k == i]
            together = SideBySide([regressors[j] for j in members])
            made = reproduction_errors(
                controller(energies[i], together), len(members), positions, dt, every, n_compared
            )
            found |= {(i, j): error for j, error in zip(members, made, strict=True)}
        return found

    errors: dict[Pair, float] = {}

    def ranked(pairs: list[Pair]) -> list[Pair]:
        errors.update(tried([p for p in pairs if p not in errors], every, COMPARED[0]))
        return sorted(pairs, key=errors.__getitem__)

    last = len(energies) - 1
    followers = [j for _, j in ranked([(last, j) for j in range(len(regressors))])][:REGRESSORS]
    leaders = [i for i, _ in ranked([(i, followers[0]) for i in range(len(energies))])][:ENERGIES]
    ranked([(i, j) for i in leaders for j in followers])
    finalists = ranked(list(errors))[:FINALISTS]
    i, j = min(finalists, key=tried(finalists, 1, COMPARED[1]).__getitem__)
    return controller(energies[i], regressors[j])


class SideBySide:
    """Regressors as one, which takes as many states for each of them in turn."""

    def __init__(self, regressors: Sequence[Regressor]) -> None:
        self.regressors = regressors

    def velocity(self, x: FloatArray) -> FloatArray:
        """Return each regressor's velocities at its own states."""
        shares = x.reshape(len(self.regressors), -1, x.shape[1])
        return np.concatenate(
            [r.velocity(share) for r, share in zip(self.regressors, shares, strict=True)]
        )

    def arrays(self) -> dict[str, FloatArray]:
        """Return all of the regressors' arrays."""
        return {f"{i}.{k}": a for i, r in enumerate(self.regressors) for k, a in r.arrays().items()}


def reproduction_errors(
    controller: Controller,
    n_regressors: int,
    positions: Sequence[FloatArray],
    dt: FloatArray,
    every: int,
    n_compared: int,
) -> list[float]:
    """Return each regressor's mean Fréchet distance of reproductions to demonstrations.

    Parameters
    ----------
    controller : Controller
        Its regressor is `n_regressors` side by side, or is one.
    positions, dt
        As in `best_controller`.
    every : int
        Samples that a step of the reproduction is long.
    n_compared : int
        About so many samples of the longest demonstration are compared.
    """
    longest = max(len(p) for p in positions)
    states = np.tile(np.stack([p[0] for p in positions]), (n_regressors, 1))
    times = np.tile(dt * every, n_regressors)
    path = [states]
    for _ in range((longest - 1) // every):
        states = controller.step(states, times)
        path.append(states)
    thin = max(1, round(longest / every / n_compared))
    made = np.stack(path, axis=1)[:, ::thin]
    shown = [p[:: every * thin] for p in positions]
    return [
        float(np.mean([frechet(p, q[: len(p)]) for p, q in zip(shown, of_one, strict=True)]))
        for of_one in np.split(made, n_regressors)
    ]
