"""One flow for several motions: the conditioning that the paper leaves to future work (sec. VI).

A context c is an input of every layer's conditioner beside the coordinates that it sees,

    dz = A z dt + K dB,    y = h(z, c),

so that for each c, one that was shown or any other, h(., c) is a diffeomorphism, and what is proved
of ImitationFlow is proved of every context. With c fixed, its share of a conditioner's argument is
a constant: `ConditionalImitationFlow.at` adds it to the biases and returns an ordinary
`ImitationFlow`, which runs, scores, saves and exports as any other.

The latent system is shared. So that motions of different lengths can share it, the unit of time
depends on the context: its logarithm is the affine function of c that is nearest to the logarithms
of the motions' mean durations.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from iflow_gym.baselines.imitation_flow.calm import Calmness, calmness_of
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.data import Frame, Task
from iflow_gym.baselines.imitation_flow.emissions import make_flow
from iflow_gym.baselines.imitation_flow.guard import Restart, restarts_of
from iflow_gym.baselines.imitation_flow.latent import LinearLatent
from iflow_gym.baselines.imitation_flow.model import ImitationFlow
from iflow_gym.baselines.imitation_flow.training import Trained, train_one
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.model_files import (
    ModelFileError,
    model_file_errors,
    read_model_file,
    write_model_file,
)
from iflow_gym.system import NotFittedError


class ConditionalImitationFlow:
    """One ImitationFlow for several motions that end, told apart by a context vector.

    Parameters
    ----------
    config : ImitationFlowConfig, optional
    **settings
        Its fields by name.

    Attributes
    ----------
    contexts_ : array, shape (motions, k)
        The contexts that were fitted.
    goals_ : array, shape (motions, d)
        The goal in each.
    calm_ : Calmness or None
        How calm the fitted contexts are together.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> motions = [load_lasa("Angle"), load_lasa("Sshape")]
    >>> model = ConditionalImitationFlow(n_steps=20).fit(motions, seed=0)
    >>> model.at([1.0, 0.0]).guarantee.kind
    'proved'
    """

    name = "conditional-imitation-flow"

    def __init__(self, config: ImitationFlowConfig | None = None, **settings: Any) -> None:
        self.config: ImitationFlowConfig = ImitationFlow(config, **settings).config
        if self.config.noise != "additive":
            raise ValueError(
                f"Expected noise='additive' for several motions in one model, got "
                f"{self.config.noise!r}: its scale is fitted to one motion."
            )

    def fit(
        self,
        motions: Sequence[Demonstrations],
        contexts: ArrayLike | None = None,
        *,
        seed: int,
    ) -> Self:
        """Learn all motions as one model; the same seed gives the same fit on the same machine.

        Parameters
        ----------
        motions : sequence of Demonstrations
            All in d dimensions and with a goal of their own, or all with the same.
        contexts : array, shape (motions, k), optional
            A vector for each motion, all different. Left out, motion i has the i-th unit vector.
        seed : int

        Raises
        ------
        TypeError
            For a single motion.
        ValueError
            For motions that repeat or differ in dimension, and for contexts that do not tell them
            apart.
        """
        if isinstance(motions, Demonstrations):
            raise TypeError(
                f"Expected a sequence of motions, got {motions.name!r} alone: give a list of them, "
                "or fit an ImitationFlow to one."
            )
        if not motions:
            raise ValueError("Expected at least one motion, got none.")
        probe = ImitationFlow(self.config)
        for motion in motions:
            probe._check_demonstrations(motion)
            if motion.goal is None:
                raise ValueError(f"Expected motions that end at a goal, got {motion.name!r}.")
        if len(dims := {motion.n_dims for motion in motions}) > 1:
            raise ValueError(f"Expected motions of one dimension, got dimensions {sorted(dims)}.")
        given = np.eye(len(motions)) if contexts is None else np.array(contexts, dtype=np.float64)
        if given.ndim != 2 or len(given) != len(motions) or given.shape[1] < 1:
            raise ValueError(
                f"Expected a context for each of {len(motions)} motions, shape ({len(motions)}, k) "
                f"with k >= 1, got {given.shape}."
            )
        if not np.isfinite(given).all() or len(np.unique(given, axis=0)) < len(given):
            raise ValueError(f"Expected finite contexts, no two the same, got {given.tolist()}.")
        low, high = given.min(axis=0), given.max(axis=0)
        arrays = {
            "contexts": given,
            "goals": np.array([motion.attractor for motion in motions]),
            "context_centre": (low + high) / 2,
            "context_scale": np.where(high > low, (high - low) / 2, 1.0),
        }
        inputs = np.column_stack([np.ones(len(given)), self._scaled(given, arrays)])
        durations = np.log([motion.durations.mean() for motion in motions])
        arrays["log_time"] = np.linalg.lstsq(inputs, durations, rcond=None)[0]
        times = np.exp(inputs @ arrays["log_time"]).tolist()
        task = Task(list(motions), inputs[:, 1:], times)
        trained = train_one(self.config, task, np.random.default_rng(seed))
        arrays["frame"] = Frame.of(task).matrix
        self._take(trained, arrays)
        return self

    def at(self, context: ArrayLike, goal: ArrayLike | None = None) -> ImitationFlow:
        """Return the motion of a context, an ordinary fitted `ImitationFlow`.

        Parameters
        ----------
        context : array, shape (k,)
            One that was fitted, or any other: between two motions the field is between theirs, and
            ends where the nearer one does.
        goal : array, shape (d,), optional
            Where the motion ends: the field is shifted there. Left out, it is the goal of the
            fitted context that is nearest.

        Raises
        ------
        NotFittedError
            Before `fit`.
        ValueError
            For what is no context or no goal.
        """
        if not hasattr(self, "_arrays"):
            raise NotFittedError("ConditionalImitationFlow has not been fitted: call fit first.")
        fitted = self._arrays["contexts"]
        try:
            wanted = np.asarray(context, dtype=np.float64)
        except (TypeError, ValueError):
            wanted = np.empty(0)
        if wanted.shape != fitted.shape[1:] or not np.isfinite(wanted).all():
            raise ValueError(
                f"Expected a finite context of shape {fitted.shape[1:]}, got {context!r}."
            )
        scaled = self._scaled(wanted, self._arrays)
        others = self._scaled(fitted, self._arrays)
        nearest = int(np.argmin(np.linalg.norm(others - scaled, axis=1)))
        end = self._arrays["goals"][nearest] if goal is None else np.asarray(goal, dtype=np.float64)
        if end.shape != self._arrays["goals"].shape[1:] or not np.isfinite(end).all():
            raise ValueError(
                f"Expected a finite goal of shape {self._arrays['goals'].shape[1:]}, got {goal!r}."
            )
        time = np.exp(self._arrays["log_time"] @ np.append(1.0, scaled))
        system = ImitationFlow(self.config)
        system.n_dims_, system.goal_, system.period_ = len(end), end, None
        system.restarts_ = self._trained.restarts
        system.calm_ = None  # that is of all contexts together
        system._adopt(
            {
                **self._trained.arrays(torch.as_tensor(scaled)),
                "frame": self._arrays["frame"],
                "time": np.array([time]),
            },
            end,
            cyclic=False,
        )
        return system

    @property
    def contexts_(self) -> FloatArray:
        """The contexts that were fitted, shape (motions, k)."""
        return np.array(self._arrays["contexts"])

    @property
    def goals_(self) -> FloatArray:
        """The goal in each of them, shape (motions, d)."""
        return np.array(self._arrays["goals"])

    @property
    def calm_(self) -> Calmness | None:
        """How calm the contexts that were fitted are together, as `ImitationFlow.calm_`."""
        return self._trained.calm

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a safetensors file whose header holds the settings as JSON; replace atomically."""
        if not hasattr(self, "_arrays"):
            raise NotFittedError("ConditionalImitationFlow has not been fitted: call fit first.")
        header = {
            "method": self.name,
            "config": dataclasses.asdict(self.config),
            "n_dims": self._arrays["goals"].shape[1],
            "restarts": self._trained.restarts,
        }
        weights = {
            f"{part}.{name}": tensor.numpy()
            for part in ("flow", "latent")
            for name, tensor in getattr(self._trained, part).state_dict().items()
        }
        if self.calm_ is not None:
            header["calm"] = self.calm_
        return write_model_file(path, header, {**self._arrays, **weights})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `save` wrote; raise ModelFileError if it is anything else."""
        header, arrays = read_model_file(path)
        if header["method"] != cls.name:
            raise ModelFileError(
                f"Expected {path} to hold a {cls.name!r} model, got {header['method']!r}."
            )
        with model_file_errors(path, cls.name):
            model = cls(ImitationFlowConfig(**header["config"]))
            n_dims = header["n_dims"]
            if type(n_dims) is not int:
                raise ValueError(f"expected n_dims to be a whole number, got {n_dims!r}")
            model._restore(n_dims, arrays, restarts_of(header), calmness_of(header))
        return model

    def _restore(
        self,
        n_dims: int,
        arrays: dict[str, NDArray[Any]],
        restarts: list[Restart],
        calm: Calmness | None,
    ) -> None:
        weights = {k: arrays.pop(k) for k in list(arrays) if k.startswith(("flow.", "latent."))}
        n, k = arrays["contexts"].shape
        expected = {
            "contexts": (n, k), "goals": (n, n_dims), "context_centre": (k,),
            "context_scale": (k,), "log_time": (k + 1,), "frame": (n_dims, n_dims),
        }  # fmt: skip
        if (shapes := {name: array.shape for name, array in arrays.items()}) != expected:
            raise ValueError(f"expected arrays of shapes {expected}, got {shapes}")
        if not (arrays["context_scale"] > 0).all():
            raise ValueError(f"expected context_scale > 0, got {arrays['context_scale']}")
        # Before memory is taken for them: the settings of a file may say anything.
        n_angles, n_layers = n_dims * (n_dims - 1) // 2, self.config.n_layers
        rows = 2 * n_dims
        if self.config.emission != "autoregressive":
            rows = 2 * (n_dims - n_dims // 2)
        if self.config.emission == "spline":
            rows = (n_dims - n_dims // 2) * (3 * self.config.n_bins - 1)
        settings = [(n_layers, 1, n_angles), (n_layers, 1, rows, self.config.n_hidden)]
        found = [weights["flow.angles"].shape, weights["flow.out_weight"].shape]
        if settings != found or n_dims < 2:
            raise ValueError(f"expected angles and out_weight of shapes {settings}, got {found}")
        generators = [torch.Generator().manual_seed(0)]
        flow = make_flow(self.config, n_dims, k, generators)
        min_decay = self.config.resolved(cyclic=False, n_dims=n_dims).min_decay
        latent = LinearLatent(1, n_dims, min_decay=min_decay)
        for part, module in (("flow", flow), ("latent", latent)):
            named = {
                name.removeprefix(f"{part}."): torch.as_tensor(np.array(array))
                for name, array in weights.items()
                if name.startswith(f"{part}.")
            }
            module.load_state_dict(named)
        self._take(Trained(flow, latent, 0, restarts, calm), arrays)
        self.at(arrays["contexts"][0])  # checks all that Lemma 1 needs

    def _take(self, trained: Trained, arrays: dict[str, NDArray[Any]]) -> None:
        self._trained, self._arrays = trained, arrays

    @staticmethod
    def _scaled(contexts: FloatArray, arrays: dict[str, NDArray[Any]]) -> FloatArray:
        return np.asarray((contexts - arrays["context_centre"]) / arrays["context_scale"])
