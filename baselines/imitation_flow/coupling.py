"""Affine coupling layers, with their gradients written out.

A layer behind its orthogonal transform is (Dinh et al., "Density estimation using Real NVP", 2017)

    u = R z,    y_a = u_a,    y_b = u_b exp(s(u_a, c)) + t(u_a, c),    s = b tanh(s^ / b),

with s^, t of one hidden layer of tanh units. The units saturate, so far from the demonstrations
every layer is an affine map whose scale lies between exp(-b) and exp(b): h is a diffeomorphism of
the whole space, its inverse is exact in floating point, and the field far away is calm.

Training spends its time here, in thousands of small arrays, where autograd's bookkeeping costs more
than the arithmetic. So the whole chain is one node of the graph in each direction, with the
gradients that are written out in `kernels`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from iflow_gym.baselines.imitation_flow import kernels
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.kernels import SATURATED

FEW_MODELS = 4
"""So many models are faster one by one in NumPy than as a batch in torch, on a CPU."""


class CouplingFlow(Flow):
    """Affine coupling layers between orthogonal transforms.

    Parameters
    ----------
    n_dims, n_layers, n_hidden : int
        Sizes; the conditioner sees n_dims // 2 coordinates and the context.
    n_context : int
        Size of the context, 0 for none.
    log_scale_bound : float
        The bound b.
    sharpness : float
        Initial slope of the hidden units.
    generators : list of torch.Generator
        One a model.
    """

    def __init__(
        self,
        n_dims: int,
        n_layers: int,
        n_hidden: int,
        n_context: int = 0,
        *,
        log_scale_bound: float,
        sharpness: float,
        generators: list[torch.Generator],
    ) -> None:
        super().__init__(n_dims, n_layers, generators)
        self.log_scale_bound, self.n_context = log_scale_bound, n_context
        self.n_kept = n_dims // 2
        seen, n_moved = self.n_kept + n_context, n_dims - self.n_kept
        # Units are steps with random slopes (1 to 4 times the sharpness) and places.
        slopes = sharpness * (1 + 3 * self.drawn(n_layers, n_hidden, seen))
        slopes = slopes * torch.sign(self.drawn(n_layers, n_hidden, seen) - 0.5)
        places = 1.3 * (2 * self.drawn(n_layers, n_hidden, seen) - 1)
        self.hidden_weight = nn.Parameter(slopes / math.sqrt(seen))
        self.hidden_bias = nn.Parameter(-(self.hidden_weight * places).detach().sum(-1, True))
        self.out_weight = nn.Parameter(
            0.01 * self.drawn(n_layers, 2 * n_moved, n_hidden, normal=True)
        )
        self.out_bias = nn.Parameter(self.angles.new_zeros(n_layers, self.n_models, 2 * n_moved, 1))

    def weights(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return R, hidden weights and output weights as `kernels` takes them."""
        parts = self.hidden_weight, self.hidden_bias, self.out_weight, self.out_bias
        return self.orthogonal(), *_Joined.apply(*parts, self.log_scale_bound)

    def forward(self, z: Tensor, context: Tensor | None = None, weights: Any = None) -> Tensor:
        """Return y = h(z), both (m, d, n)."""
        weights = self.weights() if weights is None else weights
        y: Tensor = _Forward.apply(z, context, *weights, self.n_kept, self.log_scale_bound)
        return y

    def inverse(
        self, y: Tensor, context: Tensor | None = None, weights: Any = None
    ) -> tuple[Tensor, Tensor]:
        """Return z = h^-1(y), (m, d, n), and log |det dz/dy|, (m, n)."""
        weights = self.weights() if weights is None else weights
        z, log_det = _Inverse.apply(y, context, *weights, self.n_kept, self.log_scale_bound)
        return z, log_det

    def arrays(self, model: int, context: Tensor | None = None) -> dict[str, NDArray[np.float64]]:
        """Return one model's arrays for `CouplingField`, a context (k,) folded in."""
        hidden_weight, hidden_bias = self.hidden_weight[:, model], self.hidden_bias[:, model, :, 0]
        hidden_weight, hidden_bias = hidden_weight.double(), hidden_bias.double()
        if self.n_context:
            if context is None:
                raise ValueError(f"expected a context of shape ({self.n_context},), got none")
            hidden_bias = hidden_bias + hidden_weight[..., self.n_kept :] @ context.double()
            hidden_weight = hidden_weight[..., : self.n_kept]
        tensors = {
            "hidden_weight": hidden_weight,
            "hidden_bias": hidden_bias,
            "out_weight": self.out_weight[:, model],
            "out_bias": self.out_bias[:, model, :, 0],
        }
        arrays = {name: t.detach().double().cpu().numpy().copy() for name, t in tensors.items()}
        return {"rotation": self.rotations(model), **arrays}


class _Joined(torch.autograd.Function):
    """Weights with their biases, (layers, m, h + 1, seen + 1) and (layers, m, 2 moved, h + 1)."""

    @staticmethod
    def forward(
        ctx: Any,
        hidden_weight: Tensor,
        hidden_bias: Tensor,
        out_weight: Tensor,
        out_bias: Tensor,
        bound: float,
    ) -> tuple[Tensor, Tensor]:
        lead, (n_hidden, n_seen) = hidden_weight.shape[:-2], hidden_weight.shape[-2:]
        hidden = hidden_weight.new_zeros(*lead, n_hidden + 1, n_seen + 1)
        hidden[..., :-1, :-1], hidden[..., :-1, -1:] = hidden_weight, hidden_bias
        hidden[..., -1, -1] = SATURATED
        out = torch.cat([out_weight, out_bias], dim=-1)
        ctx.n_scales, ctx.bound = out.shape[-2] // 2, bound
        out[..., : ctx.n_scales, :] /= bound
        return hidden, out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_hidden: Tensor, g_out: Tensor) -> tuple[Tensor | None, ...]:
        g_hidden, g_out = g_hidden[..., :-1, :], g_out.clone()
        g_out[..., : ctx.n_scales, :] /= ctx.bound
        return *(x for g in (g_hidden, g_out) for x in (g[..., :-1], g[..., -1:])), None


class _Forward(torch.autograd.Function):
    """h, with `kernels.forward_gradient` for its gradient."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, context: Tensor | None, *args: Any) -> Tensor:
        runs = _runs([z, context], args)
        results = [kernels.forward(xp, x, c, w) for xp, (x, c), w in runs]
        return _keep(ctx, runs, results, context, args)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> Any:
        return _gradients(ctx, kernels.forward_gradient, [g])


class _Inverse(torch.autograd.Function):
    """h^-1 and its log-determinant, with `kernels.inverse_gradient` for their gradient."""

    @staticmethod
    def forward(ctx: Any, y: Tensor, context: Tensor | None, *args: Any) -> tuple[Tensor, ...]:
        runs = _runs([y, context], args)
        results = [kernels.inverse(xp, x, c, w) for xp, (x, c), w in runs]
        return _keep(ctx, runs, results, context, args)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor, g_log_det: Tensor) -> Any:
        return _gradients(ctx, kernels.inverse_gradient, [g, g_log_det])


def _runs(
    tensors: Sequence[Tensor | None], args: Sequence[Any]
) -> list[tuple[Any, list[Any], kernels.Weights]]:
    """Return (library, arrays, weights) of each run: one a model in NumPy, or all in torch."""
    *weights, n_kept, bound = args
    if weights[0].device.type != "cpu" or weights[0].shape[1] > FEW_MODELS:
        rotation, hidden, out = weights
        return [(torch, list(tensors), kernels.Weights(rotation, hidden, out, n_kept, bound))]
    states = [None if t is None else t.detach().contiguous().numpy() for t in tensors]
    parts = [w.detach().movedim(1, 0).contiguous().numpy() for w in weights]
    return [
        (
            np,
            [None if s is None else s[m] for s in states],
            kernels.Weights(rotation, hidden, out, n_kept, bound),
        )
        for m, (rotation, hidden, out) in enumerate(zip(*parts, strict=True))
    ]


def _keep(
    ctx: Any,
    runs: Sequence[tuple[Any, Any, kernels.Weights]],
    results: Sequence[tuple[Any, ...]],
    context: Tensor | None,
    args: Sequence[Any],
) -> tuple[Tensor, ...]:
    """Keep weights and traces for the gradient; return the results as tensors (m, ...)."""
    ctx.weights, ctx.traces = [w for *_, w in runs], [r[-1] for r in results]
    ctx.has_context = context is not None
    return tuple(_stacked([r[i] for r in results]) for i in range(len(results[0]) - 1))


def _gradients(ctx: Any, gradient: Callable[..., Any], g: Sequence[Tensor]) -> tuple[Any, ...]:
    if isinstance(ctx.weights[0].rotation, Tensor):
        states, context, weights = gradient(torch, *g, ctx.traces[0], ctx.weights[0])
        return states, context if ctx.has_context else None, *weights, None, None
    arrays = [x.detach().contiguous().numpy() for x in g]
    results = [
        gradient(np, *(x[m] for x in arrays), trace, w)
        for m, (trace, w) in enumerate(zip(ctx.traces, ctx.weights, strict=True))
    ]
    states = _stacked([r[0] for r in results])
    context = _stacked([r[1] for r in results]) if ctx.has_context else None
    weights = [_stacked([r[2][i] for r in results]).movedim(0, 1) for i in range(3)]
    return states, context, *weights, None, None


def _stacked(arrays: Sequence[Any]) -> Tensor:
    """Join the models' arrays, or take the batch's as it is."""
    if isinstance(arrays[0], Tensor):
        return arrays[0]
    return torch.from_numpy(arrays[0][None] if len(arrays) == 1 else np.stack(arrays))
