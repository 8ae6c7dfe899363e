"""Settings of SEDS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Objective = Literal["likelihood", "mse"]
Solver = Literal["L-BFGS-B", "SLSQP", "trust-constr"]


@dataclass(frozen=True)
class SEDSConfig:
    """Settings of `SEDS`."""

    objective: Objective = "likelihood"
    """What is minimised: minus the log-likelihood of positions and velocities, eq. (17), or the
    mean square error of the velocities, eq. (19)."""
    n_components: int | None = None
    """Gaussians in the mixture; None chooses by BIC between 2 and 10."""
    n_initialisations: int = 5
    """Starts of EM, by k-means, each of which gives two starts of the solver; the best is kept."""
    solver: Solver = "SLSQP"
    """scipy's name. SLSQP, an SQP as the paper's is, and trust-constr take the constraint on the
    gains; L-BFGS-B searches over gains that are stable by construction."""
    max_iterations: int = 500
    """Iterations of the solver, from where the best trial ended."""
    trial_iterations: int = 60
    """Iterations of L-BFGS-B from every start, and for every number of Gaussians."""
    selection_samples: int = 500
    """Samples, evenly taken, on which BIC compares the numbers of Gaussians."""
    fit_samples: int = 2000
    """Samples, evenly taken, on which the chosen mixture is fitted."""
    margin: float = 0.01
    """Eigenvalues of (A + Aᵀ) / 2 are at most minus this, in root mean square speeds a root mean
    square distance from the goal."""
    regularisation: float = 1e-6
    """Variance that a sample is uncertain by, with positions and velocities scaled to a mean square
    of 1: what keeps covariances from vanishing."""

    def __post_init__(self) -> None:
        for name, known in (("objective", get_args(Objective)), ("solver", get_args(Solver))):
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"Expected {name} to be one of {known}, got {value!r}.")
        if self.n_components is not None and self.n_components < 1:
            raise ValueError(f"Expected n_components >= 1 or None, got {self.n_components}.")
        for name in (
            "n_initialisations",
            "max_iterations",
            "trial_iterations",
            "selection_samples",
            "fit_samples",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"Expected {name} >= 1, got {getattr(self, name)}.")
        if not 0 < self.margin < 1:
            raise ValueError(
                f"Expected a margin between 0 and 1, got {self.margin}: at 0 nothing is proved, "
                "and at 1 a motion could hardly turn."
            )
        if not self.regularisation > 0:
            raise ValueError(
                f"Expected regularisation > 0, got {self.regularisation}: on a straight line the "
                "covariances would be singular."
            )
