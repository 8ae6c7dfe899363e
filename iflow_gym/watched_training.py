"""How far a training is, without a word from the training.

`fit` makes its generator by ``np.random.default_rng(seed)``, which hands a generator through: one
that gives the numbers of the seed, and looks up whenever it is asked for some, watches a training
and changes nothing in it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from iflow_gym.demonstrations import Demonstrations
from iflow_gym.system import Method


class WatchedGenerator(np.random.Generator):
    """The numbers of ``np.random.default_rng(seed)``, and a call before each uniform draw.

    Parameters
    ----------
    seed : int
    look : callable
        Called with the rows that have been drawn so far; what it raises ends the training.
        ImitationFlow draws a row for each step, and some more after `training_steps`.
    """

    def __init__(self, seed: int, look: Callable[[int], None]) -> None:
        super().__init__(np.random.PCG64(seed))
        self._look, self._rows = look, 0

    def random(self, size: Any = None, *args: Any, **settings: Any) -> Any:
        """Draw as `numpy.random.Generator.random` does."""
        self._look(self._rows)
        if isinstance(size, tuple) and len(size) == 2:
            self._rows += size[0]
        return super().random(size, *args, **settings)


def training_steps(method: Method, demonstrations: Demonstrations) -> int | None:
    """Return the steps for which `fit` trains an ImitationFlow; None for any other method."""
    # Of a package that nobody has imported, seconds of torch, the method is none.
    package = sys.modules.get("iflow_gym.baselines.imitation_flow")
    if package is None or type(method) is not package.ImitationFlow:
        return None
    resolved = method.config.resolved(
        cyclic=demonstrations.period is not None, n_dims=demonstrations.n_dims
    )
    return int(resolved.n_steps)
