"""The optimizer's step, watched: a model whose training diverges is taken back and goes on slower.

Models that train together share nothing, so each is judged, taken back and slowed by itself. Every
`WINDOW` steps a model's mean and last loss are compared with the best window of its stage, which at
first is what the stage began with. Where they are good
the model's parameters and Adam's moments are kept; where it is far above the best, or not finite,
they are put back, and the model's rate is halved from then on. A model for which that does not help
has failed: it stays as it was last good, and the others train on.

All parameters of all models lie in one array (m, p), a row a model, of which the modules' own are
views: what is done to each is then done in one operation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

WINDOW = 25
"""Steps between two looks."""

TOLERANCE = 30.0
"""A window's loss may exceed the best by so much, or by so many times the best if that is more."""

MOST_RESTARTS = 5
"""A model that diverges more often is no fit."""

WARM_UP = 0.15
"""Share of the steps in which the learning rate rises."""

START, END = 1 / 25, 1e-4
"""The rate's first value as a fraction of the peak, and its last as a fraction of the first."""

MOMENTA = (0.85, 0.95)
"""Adam's first decay at the peak of the rate, and at its ends."""

BETA = 0.99
"""Adam's second decay."""

EPSILON = 1e-8
"""Adam's."""


class TrainingError(RuntimeError):
    """Training diverged again and again."""


class Restart(NamedTuple):
    """One return to the last good state."""

    step: int
    """The step after which divergence was noticed."""
    rate: float
    """Fraction of the learning rate from then on."""


def restarts_of(header: Mapping[str, Any]) -> list[Restart]:
    """Return the restarts that a model file's header holds; none where it does not speak of them.

    Raises ValueError for anything that training does not record.
    """
    found = [Restart(*entry) for entry in header.get("restarts", [])]
    for restart in found:
        if type(restart.step) is not int or restart.step < 0:
            raise ValueError(f"expected the step of a restart >= 0, got {restart.step!r}")
        if type(restart.rate) is not float or not 0 < restart.rate < 1:
            raise ValueError(f"expected the rate of a restart in (0, 1), got {restart.rate!r}")
    return found


def one_cycle(peak: float, n_steps: int) -> list[tuple[float, float]]:
    """Return the rate and Adam's first decay at each step: torch's one-cycle schedule.

    The rate rises along half a cosine from `START` of its peak, and falls along another to almost
    nothing; the decay goes down while the rate goes up (Smith and Topin, "Super-convergence",
    2019). Written out, since torch's takes an optimizer, whose making imports a second of compiler.
    """
    rises, ends = WARM_UP * (n_steps + 1) - 1, float(n_steps)
    found = []
    for step in range(n_steps):
        if step <= rises:
            at, points = step / rises, ((START * peak, MOMENTA[1]), (peak, MOMENTA[0]))
        else:
            at = (step - rises) / (ends - rises)
            points = ((peak, MOMENTA[0]), (START * END * peak, MOMENTA[1]))
        share = (1 + math.cos(math.pi * at)) / 2
        before, after = points
        rate, decay = (y + share * (x - y) for x, y in zip(before, after, strict=True))
        found.append((rate, decay))
    return found


class Adam:
    """Adam's moments of an array (Kingma and Ba, "Adam", 2015), and its step in place.

    A dozen small operations: torch's own takes longer to find out what it is given. The first decay
    changes from step to step, so the mean is divided by 1 less the product of all decays so far;
    torch's takes a power of the present one.
    """

    def __init__(self, parameters: Tensor) -> None:
        self.parameters = parameters
        self.mean, self.square = (torch.zeros_like(parameters) for _ in range(2))
        self._mean_share = self._square_share = 1.0

    def step(self, gradient: Tensor, rate: float, decay: float) -> None:
        """Take a step down a gradient, with a first decay of its own."""
        self._mean_share *= decay
        self._square_share *= BETA
        self.mean.lerp_(gradient, 1 - decay)
        self.square.mul_(BETA).addcmul_(gradient, gradient, value=1 - BETA)
        size = self.square.sqrt().div_(math.sqrt(1 - self._square_share)).add_(EPSILON)
        self.parameters.addcdiv_(self.mean, size, value=-rate / (1 - self._mean_share))


class GuardedAdam:
    """Adam with a one-cycle rate for m models at once, and an eye on each.

    Parameters
    ----------
    parameters : sequence of (parameter, axis)
        The axis is the dimension that counts the models. Their data become views.
    names : sequence of str
        The models' names, for errors.
    n_steps : int
    learning_rate : float
        The peak.
    max_norm : float
        Each model's gradient is scaled down to this norm.

    Attributes
    ----------
    restarts : list of m lists of Restart
    failures : dict of int to TrainingError
        Models that do not train on, and why.
    failed : Tensor of bool, shape (m,)
        Which these are.
    gradients : list of Tensor
        What `descend` goes down, in the parameters' shapes: views of one array (m, p).
    """

    def __init__(
        self,
        parameters: Sequence[tuple[nn.Parameter, int]],
        names: Sequence[str],
        *,
        n_steps: int,
        learning_rate: float,
        max_norm: float,
    ) -> None:
        self._names, self._max_norm = list(names), max_norm
        self._parameters, self._axes = zip(*parameters, strict=True)
        n_models = self._parameters[0].shape[self._axes[0]]
        size = sum(p.numel() for p in self._parameters) // n_models
        first = self._parameters[0].detach()
        self._flat, self._gradient = (first.new_empty(n_models, size) for _ in range(2))
        self.gradients = self._views(self._gradient)
        for parameter, view in zip(self._parameters, self._views(self._flat), strict=True):
            view.copy_(parameter.detach())
            parameter.data = view
        self._adam = Adam(self._flat)
        self._cycle, self._taken = one_cycle(learning_rate, n_steps), 0
        like = self._flat[:, 0]
        self._rate, self._sum = torch.ones_like(like), torch.zeros_like(like)
        self._best, self._kept = torch.full_like(like, torch.inf), torch.full_like(like, torch.inf)
        self._first = self._last = torch.zeros_like(like)
        self._count, self._stage, self._slowed = 0, 0, False
        self._begins = True
        self._good = [t.clone() for t in self._state()]
        self.restarts: list[list[Restart]] = [[] for _ in self._names]
        self.failures: dict[int, TrainingError] = {}
        self.failed = torch.zeros_like(like, dtype=torch.bool)

    def step(self, step: int, loss: Tensor, judged: Tensor | None = None) -> None:
        """Take a step down the gradients of the loss, (m,).

        Where the loss has weights that change within a stage, what is judged is one without.
        """
        gradients: Sequence[Tensor | None] = torch.autograd.grad(
            loss.sum(), self._parameters, allow_unused=True
        )
        for own, gradient in zip(self.gradients, gradients, strict=True):
            if gradient is None:
                own.zero_()
            else:
                own.copy_(gradient)
        self.descend(step, loss.detach() if judged is None else judged.detach())

    def begin(self, step: int, stage: int) -> None:
        """Judge the stage before, if this is a new one: losses are of one kind within each.

        To be called before the loss is taken: the judgement may take parameters back.
        """
        if stage != self._stage:
            self.look(step)
            self._stage, self._begins = stage, True
            self._best.fill_(torch.inf)

    def descend(self, step: int, judged: Tensor) -> None:
        """Take a step down `gradients`, which are overwritten; what is judged is the loss, (m,)."""
        gradient = self._gradient
        if self._begins:  # a stage begins: what it has to be better than
            self._first = judged.clone()
            self._best = torch.where(self._first.isfinite(), self._first, self._best)
            self._begins = bool(self._best.isinf().all())
        norm, self._last = gradient.norm(dim=1), judged
        if self.failures or not math.isfinite(norm.sum()):
            trains = norm.isfinite() & ~self.failed
            gradient.masked_fill_(~trains[:, None], 0.0)
            norm = norm.nan_to_num(0.0, 0.0)
            self._last = torch.where(trains, self._last, torch.inf)
        gradient.mul_((self._max_norm / norm.clamp_min(self._max_norm))[:, None])
        self._sum += self._last
        self._count += 1
        before = self._flat.clone() if self._slowed else None
        rate, decay = self._cycle[self._taken]
        self._taken += 1
        self._adam.step(gradient, rate, decay)
        if before is not None:
            self._flat.copy_(torch.lerp(before, self._flat, self._rate[:, None]))
        if self._count == WINDOW:
            self.look(step)

    def finish(self, step: int, tolerance: float = 1.0) -> None:
        """Look once more; a stage that ends worse than it began is a failure.

        Worse by the loss it began with, or 1 if that is less, times the tolerance.
        """
        self.look(step)
        worse = self._kept > self._first + tolerance * self._first.abs().clamp_min(1.0)
        for i in (worse & ~self.failed).nonzero()[:, 0].tolist():
            self._fail(
                i,
                f"its loss ended at {self._kept[i]:.3g} and was {self._first[i]:.3g} at the "
                "beginning",
            )

    def look(self, step: int) -> None:
        """Judge the steps since the last look and the parameters as they are."""
        if not self._count:
            return
        loss = self._sum / self._count
        allowed = self._best + TOLERANCE * self._best.abs().clamp_min(1.0)
        bad = ~loss.isfinite() | (loss > allowed) | (self._last > allowed)
        bad |= ~self._flat.isfinite().all(1)
        bad &= ~self.failed
        self._best = torch.where(bad, self._best, torch.minimum(self._best, loss))
        self._kept = torch.where(bad, self._kept, loss)
        self._begins = self._begins and bool(self._best.isinf().all())
        self._sum.zero_()
        self._count = 0
        if bool(bad.any()):
            self._take_back(step, bad)
        self._good = [t.clone() for t in self._state()]

    def _take_back(self, step: int, bad: Tensor) -> None:
        self._rate = torch.where(bad, self._rate / 2, self._rate)
        self._slowed = True
        for i in bad.nonzero()[:, 0].tolist():
            self.restarts[i].append(Restart(step, float(self._rate[i])))
            if len(self.restarts[i]) > MOST_RESTARTS:
                self._fail(
                    i,
                    f"its training diverged {len(self.restarts[i])} times, last at step {step} "
                    f"with {self._rate[i]:.2g} of the learning rate",
                )
        for now, kept in zip(self._state(), self._good, strict=True):
            now.copy_(torch.where(bad[:, None], kept, now))

    def _fail(self, model: int, why: str) -> None:
        """Leave a model as it is from now on."""
        self.failed[model], self._rate[model] = True, 0.0
        self.failures[model] = TrainingError(
            f"ImitationFlow did not converge on {self._names[model]!r}: {why}. Lower learning_rate "
            "or the weights."
        )

    def _state(self) -> list[Tensor]:
        """Return the parameters and Adam's moments."""
        return [self._flat, self._adam.mean, self._adam.square]

    def _views(self, flat: Tensor) -> list[Tensor]:
        """Return the parts of an array (m, p) in the parameters' shapes."""
        found, at = [], 0
        for parameter, axis in zip(self._parameters, self._axes, strict=True):
            shape = parameter.detach().movedim(axis, 0).shape
            size = parameter.numel() // shape[0]
            found.append(flat[:, at : at + size].view(shape).movedim(0, axis))
            at += size
        return found
