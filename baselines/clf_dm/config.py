"""Settings of CLF-DM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

RegressorName = Literal["gmr", "gpr", "svr"]
RhoForm = Literal["paper", "code"]


@dataclass(frozen=True)
class CLFDMConfig:
    """Settings of `CLFDM`."""

    regressor: RegressorName = "gmr"
    """What estimates the velocity before it is corrected: a Gaussian mixture, a Gaussian process,
    or support vector machines."""
    n_components: int | None = None
    """Gaussians of the mixture; None tries the number of least BIC, up to four fewer, and up to
    eight more."""
    n_initialisations: int = 2
    """Starts of EM for each number of Gaussians: the first cuts every demonstration into as many
    pieces of equal time, the others are by k-means. Every mixture is tried."""
    kernel_samples: int = 400
    """Samples, evenly taken, that a Gaussian process or support vector machine is fitted on."""
    max_terms: int = 4
    """Most asymmetric terms L of V; raised from 0 until the objective gains no more. Of the V so
    found the one that reproduces the fitted demonstrations best is kept, with its regressor."""
    least_gain: float = 0.02
    """A further term is kept if it brings the objective nearer to the least that it could be, -w,
    by this fraction of the way."""
    weights: tuple[float, ...] = (0.01, 0.2)
    """Values of w, what steeper descent along the demonstrations is worth beside a violation; all
    are tried. The authors' 1e-4 leaves V so flat along the demonstrations that more is corrected
    beside them; with much more of it violations are bought."""
    n_searches: int = 2
    """Searches for V, from different starts, for each w."""
    energy_samples: int = 700
    """Samples, evenly taken, that V is learned from."""
    rho: RhoForm = "code"
    """Least rate of descent: "paper" is rho0 (1 - exp(-kappa0 |x|)), "code" is the authors' code's
    rho0 (1 - exp(-kappa0 |x|²)) |grad V|."""
    rho0: float = 0.05
    """Its greatest value, in mean V of the demonstrations, or in root mean square distances from
    the goal for "code", a unit of time: the root mean square distance over the root mean square
    speed."""
    kappa0: float = 500.0
    """How fast it gets there, with |x| in root mean square distances from the goal."""

    def __post_init__(self) -> None:
        for name, known in (("regressor", get_args(RegressorName)), ("rho", get_args(RhoForm))):
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"Expected {name} to be one of {known}, got {value!r}.")
        if self.n_components is not None and self.n_components < 1:
            raise ValueError(f"Expected n_components >= 1 or None, got {self.n_components}.")
        for name, least in (
            ("n_initialisations", 1),
            ("n_searches", 1),
            ("kernel_samples", 1),
            ("energy_samples", 1),
            ("max_terms", 0),
        ):
            if getattr(self, name) < least:
                raise ValueError(f"Expected {name} >= {least}, got {getattr(self, name)}.")
        if not self.weights or min(self.weights) <= 0:
            raise ValueError(f"Expected weights of at least one number > 0, got {self.weights}.")
        for name in ("least_gain", "rho0", "kappa0"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Expected {name} > 0, got {getattr(self, name)}.")
