"""Settings of ImitationFlow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

Objective = Literal["reproduction", "paper"]
Emission = Literal["coupling", "autoregressive", "spline"]
MOST_LOG_SCALE = 2.0
"""With 2 the inverse has been seen to be off by more than the motion's size in single precision."""

MOST_ERROR_POWER = 4.0
"""With more the powers of small errors are below single precision."""

Noise = Literal["additive", "vanishing"]


class Resolved(NamedTuple):
    """Settings whose defaults depend on the kind of motion."""

    n_steps: int
    sharpness: float
    calm_weight: float
    orbit_weight: float
    inward_weight: float
    min_decay: float


ENDS: Final = Resolved(
    n_steps=4500,
    sharpness=3.0,
    calm_weight=2.5,
    orbit_weight=0.0,
    inward_weight=0.0,
    min_decay=0.05,
)
"""Where motions end."""
IN_PLANE: Final = Resolved(
    n_steps=1500,
    sharpness=1.5,
    calm_weight=0.3,
    orbit_weight=0.0,
    inward_weight=0.0,
    min_decay=0.05,
)
"""Where motions repeat in the plane."""
IN_SPACE: Final = IN_PLANE._replace(
    calm_weight=4.0, orbit_weight=0.2, inward_weight=1.0, min_decay=4.0
)
"""Where motions repeat in three dimensions and more."""


@dataclass(frozen=True)
class ImitationFlowConfig:
    """Settings of `ImitationFlow`; lengths are in units of the motion, times in its duration."""

    objective: Objective = "reproduction"
    """"reproduction": forward likelihood, then the squared error of whole reproductions; where
    motions repeat forward likelihood and stationary density, and in space the orbit's likelihood.
    "paper": Algorithm 1, the backward likelihood and the stationary density at the last sample.
    Penalties on the field beside the recordings belong to the first."""
    emission: Emission = "coupling"
    """Layers of the flow: "coupling" (affine), "autoregressive" (masked, for three dimensions and
    more: the paper's for the robot), or "spline" (rational-quadratic couplings)."""
    n_layers: int = 16
    """Layers of the flow, each behind an orthogonal transform."""
    n_hidden: int = 16
    """tanh units in each layer's conditioner, which has one hidden layer."""
    n_bins: int = 8
    """Pieces of a spline ("spline" only)."""
    spline_bound: float = 2.0
    """A spline is the identity outside [-bound, bound], in units of the motion ("spline" only)."""
    log_scale_bound: float = 0.35
    """Bound c of a layer's log-scale, c tanh(s / c): small enough that the inverse is exact in
    floating point, see the method's page."""
    sharpness: float | None = None
    """Slope of the conditioners' units at the start, in the inverse of half the motion's size:
    larger bends sharper corners and generalises less. None takes 3 where motions end and 1.5 where
    they repeat: recorded cycles are followed as well, and the field around them waves less."""
    n_steps: int | None = None
    """Steps of Adam. None takes 4500 where motions end and 1500 where they repeat, which is one
    stage instead of two."""
    likelihood_fraction: float = 0.1
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
    error_power: float = 3.0
    """The squared errors e of a reproduction over time count as (mean e^p)^(1/p): with p = 1 as
    their mean, with more, up to `MOST_ERROR_POWER`, as the worst of them."""
    timing_weight: float = 0.7
    """Weight of the squared error along the recording, beside 1 across it: to be early or late
    counts less than to be elsewhere."""
    end_weight: float = 0.7
    """Weight of the squared error at the last sample, beside the mean over times."""
    tube_weight: float = 0.05
    """Weight of the tube: a reproduction from beside a demonstration's start should run beside it
    and close in at constant speed. 0 leaves it out."""
    tube_width: float = 0.05
    """Standard deviation of the distance to the start, in half the motion's size."""
    calm_weight: float | None = None
    """Weight of the penalty on speed away from the demonstrations. 0 leaves it out. None takes
    2.5 where motions end, 0.3 where they repeat in the plane and 4 where they repeat in three
    dimensions and more. Where motions end the weight of a model that is still fast somewhere grows
    until it is not, see `calm`."""
    calm_speed: float = 1.5
    """Speeds up to this multiple of the demonstrations' peak cost nothing."""
    orbit_weight: float | None = None
    """Weight of the likelihood of the whole orbit for motions that repeat, in a second stage: see
    `mean_orbit`. 0 leaves it out. None takes 0, and 0.2 in three dimensions and more. Needs the
    objective "reproduction"."""
    inward_weight: float | None = None
    """Weight of the penalty on motion away from the recordings, beside the orbit's likelihood: see
    `inward`. 0 leaves it out. None takes 0, and 1 for motions that repeat in three dimensions and
    more. Needs an `orbit_weight`."""
    orbit_resolution: float = 0.02
    """Standard deviation to which the orbit is held where all recordings agree."""
    min_decay: float | None = None
    """Slowest decay of the latent system, per duration: eps in A = -(L L^T + eps I) + S - S^T. None
    takes 0.05, and 4 for motions that repeat in three dimensions and more: recordings of them lie
    beside one another from beginning to end, which by itself reads as if nothing came back to the
    orbit within a round."""
    noise: Noise = "additive"
    """"additive": K dB, the state is bounded around the attractor in distribution. "vanishing":
    noise in proportion to the distance from the attractor, the state comes to rest there."""
    n_jobs: int = 1
    """Processes of one thread that models trained together are dealt out to: those of as many
    recordings and dimensions, as a batch has to be. Motions of which no two are alike train one
    after the other all the same. What trains beside a model changes its rounding, see
    `ImitationFlow`."""
    device: str = "auto"
    """Where training runs: "auto" takes a GPU where torch has one; or a torch device."""

    def __post_init__(self) -> None:
        for name, known in (("objective", Objective), ("emission", Emission), ("noise", Noise)):
            if getattr(self, name) not in get_args(known):
                choices = ", ".join(map(repr, get_args(known)))
                raise ValueError(f"Expected {name} among {choices}, got {getattr(self, name)!r}.")
        for name in (
            "n_layers",
            "n_hidden",
            "n_steps",
            "n_pairs",
            "n_times",
            "n_jobs",
            "n_bins",
        ):
            value, least = getattr(self, name), 2 if name == "n_bins" else 1
            if name == "n_steps" and value is None:
                continue
            if type(value) is not int or value < least:
                raise ValueError(f"Expected a whole number {name} >= {least}, got {value!r}.")
        if not isinstance(self.device, str):
            raise ValueError(f"Expected the name of a device, got {self.device!r}.")
        for name in (
            "log_scale_bound", "sharpness", "learning_rate", "max_gradient_norm", "min_decay",
            "calm_speed", "tube_width", "spline_bound", "orbit_resolution",
        ):  # fmt: skip
            value = getattr(self, name)
            open_ = name in ("sharpness", "min_decay") and value is None
            if not open_ and not 0 < value < math.inf:
                raise ValueError(f"Expected a finite {name} > 0, got {value}.")
        if not 1 <= self.error_power <= MOST_ERROR_POWER:
            raise ValueError(
                f"Expected error_power in [1, {MOST_ERROR_POWER:g}], got {self.error_power}."
            )
        if self.objective == "paper" and self.orbit_weight:
            raise ValueError(
                f"Expected no orbit_weight with objective='paper', got {self.orbit_weight}: the "
                "orbit's likelihood is a part of objective='reproduction'."
            )
        if self.log_scale_bound > MOST_LOG_SCALE:
            raise ValueError(
                f"Expected log_scale_bound <= {MOST_LOG_SCALE}, got {self.log_scale_bound}: the "
                "inverse would not be exact in floating point."
            )
        if not 0 <= self.likelihood_fraction <= 1:
            raise ValueError(
                f"Expected likelihood_fraction in [0, 1], got {self.likelihood_fraction}."
            )
        for name in (
            "likelihood_weight", "tube_weight", "calm_weight", "end_weight", "orbit_weight",
            "timing_weight", "inward_weight",
        ):  # fmt: skip
            value = getattr(self, name)
            open_ = name in ("calm_weight", "orbit_weight", "inward_weight") and value is None
            if not open_ and not 0 <= value < math.inf:
                raise ValueError(f"Expected a finite {name} >= 0, got {value}.")

    def resolved(self, *, cyclic: bool, n_dims: int) -> Resolved:
        """Return what the settings that are None by default are for a kind of motion."""
        in_space = n_dims > 2 and self.objective == "reproduction"
        usual = (IN_SPACE if in_space else IN_PLANE) if cyclic else ENDS
        given = {name: getattr(self, name) for name in Resolved._fields}
        found = usual._replace(**{name: v for name, v in given.items() if v is not None})
        if found.orbit_weight > 0:
            return found
        if self.inward_weight:
            raise ValueError(
                f"Expected an orbit_weight > 0 with inward_weight={self.inward_weight}, got none: "
                "the penalty belongs to the stage in which the orbit counts."
            )
        return found._replace(inward_weight=0.0)
