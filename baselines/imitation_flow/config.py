"""Settings of ImitationFlow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Objective = Literal["reproduction", "paper"]


@dataclass(frozen=True)
class ImitationFlowConfig:
    """Settings of `ImitationFlow`; lengths are in units of the motion, times in its duration."""

    objective: Objective = "reproduction"
    """"reproduction": forward likelihood, then the squared error of whole reproductions.
    "paper": the backward likelihood of Algorithm 1 and nothing else."""
    n_layers: int = 24
    """Coupling layers, each behind an orthogonal transform."""
    n_hidden: int = 16
    """tanh units in each layer's conditioner, which has one hidden layer."""
    log_scale_bound: float = 0.3
    """Bound c of a layer's log-scale, c tanh(s / c): small enough that the inverse is exact in
    floating point, see the method's page."""
    sharpness: float = 2.0
    """Slope of the conditioners' units at the start, in the inverse of half the motion's size:
    larger bends sharper corners and generalises less."""
    n_steps: int = 2400
    """Steps of Adam."""
    likelihood_fraction: float = 0.2
    """Share of the steps that maximise the likelihood before the reproduction error is minimised
    ("reproduction" only)."""
    likelihood_weight: float = 0.1
    """Weight of the likelihood while the reproduction error is minimised. 0 leaves it out."""
    learning_rate: float = 3e-3
    """Peak of the one-cycle learning rate."""
    max_gradient_norm: float = 1.0
    """Each model's gradient is scaled down to this norm."""
    n_pairs: int = 150
    """Transitions in a step's likelihood."""
    n_times: int = 40
    """Times of each demonstration in a step's reproduction error."""
    tube_weight: float = 0.05
    """Weight of the tube: a reproduction from beside a demonstration's start should run beside it
    and close in at constant speed. 0 leaves it out."""
    tube_width: float = 0.05
    """Standard deviation of the distance to the start, in half the motion's size."""
    calm_weight: float = 0.05
    """Weight of the penalty on speed away from the demonstrations. 0 leaves it out."""
    calm_speed: float = 1.5
    """Speeds up to this multiple of the demonstrations' peak cost nothing."""
    min_decay: float = 0.05
    """Slowest decay of the latent system, per duration: eps in A = -(L L^T + eps I) + S - S^T."""
    device: str = "auto"
    """Where training runs: "auto" takes a GPU where torch has one; or a torch device."""

    def __post_init__(self) -> None:
        if self.objective not in ("reproduction", "paper"):
            raise ValueError(
                f"Expected objective 'reproduction' or 'paper', got {self.objective!r}."
            )
        for name in ("n_layers", "n_hidden", "n_steps", "n_pairs", "n_times"):
            if getattr(self, name) < 1:
                raise ValueError(f"Expected {name} >= 1, got {getattr(self, name)}.")
        for name in (
            "log_scale_bound", "sharpness", "learning_rate", "max_gradient_norm", "min_decay",
            "calm_speed", "tube_width",
        ):  # fmt: skip
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Expected a finite {name} > 0, got {getattr(self, name)}.")
        if not 0 <= self.likelihood_fraction <= 1:
            raise ValueError(
                f"Expected likelihood_fraction in [0, 1], got {self.likelihood_fraction}."
            )
        for name in ("likelihood_weight", "tube_weight", "calm_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"Expected a finite {name} >= 0, got {getattr(self, name)}.")
