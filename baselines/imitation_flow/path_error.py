"""How far reproductions are from recordings, as one node that finds its gradient along the way."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from iflow_gym.baselines.imitation_flow.planar import Array, arrays_of, tensors_of

LEAST = 1e-16
"""Added to the mean power of a recording's errors, whose root has no slope at 0."""


def path_error(
    xp: Any, error: Array, along: Array, power: float, timing_weight: float, end_weight: float
) -> tuple[Array, Array]:
    """Return the error of n recordings at q times and at the end, (m,), and its gradient.

    `error` and the recordings' steps `along` are (m, d, n, q + 1). The part of the error along the
    recording counts `timing_weight`; a recording's squared errors e over the times count as
    (mean e^p)^(1/p), and the square at the end `end_weight`.
    """
    n, q = error.shape[2], error.shape[3] - 1
    squares = (error * error).sum(1)
    shift = (error * along).sum(1) / (along * along).sum(1).clip(1e-12)
    less = (1 - timing_weight) * shift[:, None] * along
    across = ((error - less) * error).sum(1)[..., :-1].clip(0.0)
    mean = (across**power).mean(-1) + LEAST
    loss = (mean ** (1 / power)).mean(-1) + end_weight * squares[..., -1].mean(-1)
    slope = mean[..., None] ** (1 / power - 1) * across ** (power - 1)
    gradient = error - less
    gradient[..., :-1] *= 2 / (n * q) * slope[:, None]
    gradient[..., -1] = 2 * end_weight / n * error[..., -1]
    return loss, gradient


class PathError(torch.autograd.Function):
    """`path_error` of what is made, (m, d, n (q + 1)), against targets and steps of its shape."""

    @staticmethod
    def forward(
        ctx: Any, made: Tensor, target: Tensor, along: Tensor, n: int, *settings: float
    ) -> Tensor:
        """Return the error, (m,)."""
        xp, arrays = arrays_of(made, target, along)
        made_, target_, along_ = (x.reshape(*x.shape[:2], n, -1) for x in arrays)
        loss, gradient = path_error(xp, made_ - target_, along_, *settings)
        loss, ctx.gradient = tensors_of(loss, gradient.reshape(made.shape))
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of what is made."""
        return ctx.gradient * g[:, None, None], *[None] * 6
