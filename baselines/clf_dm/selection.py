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
    with each other.

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
    errors: dict[tuple[int, int], float] = {}

    def ranked(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
        for i, j in pairs:
            if (i, j) not in errors:
                tried = controller(energies[i], regressors[j])
                errors[i, j] = reproduction_error(tried, positions, dt, every, COMPARED[0])
        return sorted(pairs, key=errors.__getitem__)

    last = len(energies) - 1
    followers = [j for _, j in ranked([(last, j) for j in range(len(regressors))])][:REGRESSORS]
    leaders = [i for i, _ in ranked([(i, followers[0]) for i in range(len(energies))])][:ENERGIES]
    ranked([(i, j) for i in leaders for j in followers])
    finalists = [
        controller(energies[i], regressors[j]) for i, j in ranked(list(errors))[:FINALISTS]
    ]
    return min(finalists, key=lambda c: reproduction_error(c, positions, dt, 1, COMPARED[1]))


def reproduction_error(
    controller: Controller,
    positions: Sequence[FloatArray],
    dt: FloatArray,
    every: int,
    n_compared: int,
) -> float:
    """Return the mean Fréchet distance of reproductions to demonstrations.

    Parameters
    ----------
    controller, positions, dt
        As in `best_controller`.
    every : int
        Samples that a step of the reproduction is long.
    n_compared : int
        About so many samples of the longest demonstration are compared.
    """
    longest = max(len(p) for p in positions)
    states = np.stack([p[0] for p in positions])
    path = [states]
    for _ in range((longest - 1) // every):
        states = controller.step(states, dt * every)
        path.append(states)
    thin = max(1, round(longest / every / n_compared))
    made = np.stack(path, axis=1)[:, ::thin]
    shown = [p[:: every * thin] for p in positions]
    return float(np.mean([frechet(p, q[: len(p)]) for p, q in zip(shown, made, strict=True)]))
