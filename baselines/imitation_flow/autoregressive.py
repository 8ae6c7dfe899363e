"""Masked autoregressive affine layers (MAF), with their gradients written out.

A layer behind its orthogonal transform is (Papamakarios et al., "Masked autoregressive flow for
density estimation", 2017, eq. 4)

    u = R z,    y_i = u_i exp(s_i) + t_i,    s_i, t_i = functions of y_1 .. y_{i-1} and c,

with s = b tanh(s^ / b), and all s^ and t from one network with one hidden layer of tanh units whose
weights are masked (MADE, Germain et al. 2015, sec. 3). A unit of degree k sees y_1 .. y_k and the
context, and is seen by the outputs of the coordinates after k; with a context there are units of
degree 0, which see it alone.

The density's direction, z = h^-1(y), is the single pass: all of y is known. y = h(z) takes d
passes, one a coordinate, since each needs those before it. Units are sorted by degree, so pass i
computes the units of degree i - 1 and no other: d passes are many small products and no more
arithmetic than one.

As in `coupling`, the whole chain is one node of the graph in each direction; its gradient is below,
and tanh x is 2 sigmoid(2 x) - 1.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from iflow_gym.baselines.imitation_flow.fields.autoregressive import unit_degrees
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.kernels import SATURATED


class AutoregressiveFlow(Flow):
    """Masked autoregressive layers between orthogonal transforms.

    Parameters
    ----------
    n_dims, n_layers, n_hidden : int
        Sizes; n_hidden >= n_dims - 1, and n_hidden >= n_dims with a context.
    n_context : int
        Size of the context, 0 for none.
    log_scale_bound : float
        The bound b.
    sharpness : float
        Initial slope of the hidden units.
    generators : list of torch.Generator
        One a model.
    """

    hidden_mask: Tensor
    out_mask: Tensor

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
        self.n_blind = n_hidden // n_dims if n_context else 0  # units of degree 0
        degrees = np.append(
            np.zeros(self.n_blind, int), unit_degrees(n_hidden - self.n_blind, n_dims)
        )
        self._ends = np.searchsorted(degrees, np.arange(n_dims), side="right").tolist()
        sees = np.arange(n_dims - 1) < degrees[:, None]
        sees = np.hstack([np.ones((n_hidden, n_context), bool), sees])
        seen_by = np.repeat(degrees <= np.arange(n_dims)[:, None], 2, axis=0)
        self.register_buffer("hidden_mask", torch.as_tensor(sees, dtype=self.angles.dtype))
        self.register_buffer("out_mask", torch.as_tensor(seen_by, dtype=self.angles.dtype))
        # Units are steps with random slopes (1 to 4 times the sharpness) and places.
        shape = (n_layers, *self.hidden_mask.shape)
        slopes = sharpness * (1 + 3 * self.drawn(*shape))
        slopes = slopes * torch.sign(self.drawn(*shape) - 0.5) * self.hidden_mask
        places = 1.3 * (2 * self.drawn(*shape) - 1)
        self.hidden_weight = nn.Parameter(slopes / self.hidden_mask.sum(-1, True).sqrt())
        self.hidden_bias = nn.Parameter(-(self.hidden_weight * places).detach().sum(-1, True))
        # Rows are s^_1, t_1, s^_2, t_2, ..: what a coordinate needs is together.
        out_weight = 0.01 * self.drawn(n_layers, 2 * n_dims, n_hidden, normal=True)
        self.out_weight = nn.Parameter(out_weight * self.out_mask)
        self.out_bias = nn.Parameter(self.angles.new_zeros(n_layers, self.n_models, 2 * n_dims, 1))

    def weights(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return R, hidden weights (layers, m, 1 + h, 1 + k + d - 1), output weights (.., 1 + h).

        For sigmoid units in place of tanh units, and for an output 2 s^ / b in place of s^. Biases
        are the weights of a first input that is 1 and of a first unit that is 1.
        """
        factor = self.out_weight.new_ones(self.n_dims, 2)
        factor[:, 0] = 2 / self.log_scale_bound
        hidden = 2 * torch.cat([self.hidden_bias, self.hidden_weight * self.hidden_mask], dim=-1)
        one = torch.zeros_like(hidden[..., :1, :])
        one[..., 0] = SATURATED
        weight = self.out_weight * self.out_mask
        bias = self.out_bias - weight.sum(-1, keepdim=True)
        out = factor.reshape(-1, 1) * torch.cat([bias, 2 * weight], dim=-1)
        return self.orthogonal(), torch.cat([one, hidden], dim=-2), out

    def forward(self, z: Tensor, context: Tensor | None = None, weights: Any = None) -> Tensor:
        """Return y = h(z), both (m, d, n)."""
        weights = self.weights() if weights is None else weights
        y: Tensor = _Forward.apply(
            z,
            context,
            *weights,
            self._ends,
            self.log_scale_bound,
        )
        return y

    def inverse(
        self, y: Tensor, context: Tensor | None = None, weights: Any = None
    ) -> tuple[Tensor, Tensor]:
        """Return z = h^-1(y), (m, d, n), and log |det dz/dy|, (m, n)."""
        weights = self.weights() if weights is None else weights
        z, log_det = _Inverse.apply(y, context, *weights, self.log_scale_bound)
        return z, log_det

    @torch.no_grad()
    def arrays(self, model: int, context: Tensor | None = None) -> dict[str, NDArray[np.float64]]:
        """Return one model's arrays for `AutoregressiveField`, a context (k,) folded in."""
        hidden_weight, hidden_bias, out_weight, out_bias = (
            p[:, model].double()
            for p in (
                self.hidden_weight * self.hidden_mask,
                self.hidden_bias[..., 0],
                self.out_weight * self.out_mask,
                self.out_bias[..., 0],
            )
        )
        if self.n_context:
            if context is None:
                raise ValueError(f"expected a context of shape ({self.n_context},), got none")
            hidden_bias = hidden_bias + hidden_weight[..., : self.n_context] @ context.double()
            hidden_weight = hidden_weight[..., self.n_context :]
        # What sees the context alone is constant now.
        blind, rest = hidden_bias.split([self.n_blind, hidden_bias.shape[1] - self.n_blind], dim=1)
        constant = (out_weight[..., : self.n_blind] @ torch.tanh(blind)[..., None])[..., 0]
        tensors = {
            "hidden_weight": hidden_weight[:, self.n_blind :],
            "hidden_bias": rest,
            "out_weight": out_weight[..., self.n_blind :].unflatten(1, (self.n_dims, 2)),
            "out_bias": (out_bias + constant).unflatten(1, (self.n_dims, 2)),
        }
        arrays = {name: t.detach().cpu().numpy().copy() for name, t in tensors.items()}
        return {"rotation": self.rotations(model), **arrays}


def _given(state: Tensor, context: Tensor | None) -> Tensor:
    """Return what every unit sees: a one and the context, (m, 1 + k, n)."""
    ones = state.new_ones(1, 1, 1).expand(len(state), 1, state.shape[2])
    return ones if context is None else torch.cat([ones, context], dim=1)


def _slope(squashed: Tensor, bound: float) -> Tensor:
    """Return the derivative of s by its argument 2 s^ / b: b (1 - squashed^2) / 2."""
    return torch.addcmul(squashed.new_full((), bound / 2), squashed, squashed, value=-bound / 2)


class _Forward(torch.autograd.Function):
    """h, from the first layer to the last, coordinate by coordinate in each."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, context: Tensor | None, *args: Any) -> Tensor:
        *weights, ends, bound = args
        given = _given(z, context)
        first, m, n = given.shape[1], len(z), z.shape[2]
        saved = []
        for rotation, hidden_weight, out_weight in zip(
            *(w.unbind(0) for w in weights), strict=True
        ):
            u = torch.bmm(rotation, z)
            seen = torch.cat([given, u], dim=1)  # y takes the place of u from the front
            hidden, scale = u.new_ones(m, hidden_weight.shape[1], n), torch.empty_like(u)
            squashed = torch.empty_like(u)
            for i, (start, end) in enumerate(pairwise([1, *(1 + e for e in ends)])):
                if end > start:
                    units = hidden_weight[:, start:end, : first + i]
                    hidden[:, start:end] = torch.bmm(units, seen[:, : first + i]).sigmoid_()
                out = torch.bmm(out_weight[:, 2 * i : 2 * i + 2, :end], hidden[:, :end])
                torch.sigmoid(out[:, 0], out=squashed[:, i]).mul_(2).sub_(1)
                torch.exp(bound * squashed[:, i], out=scale[:, i])
                torch.addcmul(out[:, 1], u[:, i], scale[:, i], out=seen[:, first + i])
            saved += [z, u, seen, hidden, squashed, scale]
            z = seen[:, first:]
        ctx.save_for_backward(*weights, *saved)
        ctx.ends, ctx.bound, ctx.first = ends, bound, first
        return z.contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> Any:
        weights, saved = ctx.saved_tensors[:3], ctx.saved_tensors[3:]
        gradients = [torch.empty_like(w) for w in weights]
        first, d = ctx.first, g.shape[1]
        g_given = g.new_zeros(len(g), first, g.shape[2])
        for layer in reversed(range(len(weights[0]))):
            rotation, hidden_weight, out_weight = (w[layer] for w in weights)
            z, u, seen, hidden, squashed, scale = saved[6 * layer : 6 * layer + 6]
            inner = scale * u * _slope(squashed, ctx.bound)
            slopes = torch.addcmul(hidden, hidden, hidden, value=-1)
            g_seen = torch.cat([g_given, g], dim=1)
            g_out, g_hidden = g.new_empty(len(g), 2 * d, g.shape[2]), torch.zeros_like(hidden)
            ends = [1, *(1 + e for e in ctx.ends)]
            for i in reversed(range(d)):
                g_y = g_seen[:, first + i]
                torch.mul(g_y, inner[:, i], out=g_out[:, 2 * i])
                g_out[:, 2 * i + 1] = g_y
                start, end = ends[i], ends[i + 1]
                if end > start:  # every output that sees these units is done
                    back = torch.bmm(out_weight[:, 2 * i :, start:end].mT, g_out[:, 2 * i :])
                    back.mul_(slopes[:, start:end])
                    g_hidden[:, start:end] = back
                    units = hidden_weight[:, start:end, : first + i]
                    g_seen[:, : first + i].baddbmm_(units.mT, back)
            torch.bmm(g_out, hidden.mT, out=gradients[2][layer])
            torch.bmm(g_hidden, seen[:, :-1].mT, out=gradients[1][layer])
            g_u = g_seen[:, first:] * scale
            torch.bmm(g_u, z.mT, out=gradients[0][layer])
            g, g_given = torch.bmm(rotation.mT, g_u), g_seen[:, :first]
        return g, g_given[:, 1:] if first > 1 else None, *gradients, None, None


class _Inverse(torch.autograd.Function):
    """h^-1 and its log-determinant, from the last layer to the first."""

    @staticmethod
    def forward(ctx: Any, y: Tensor, context: Tensor | None, *args: Any) -> tuple[Tensor, Tensor]:
        *weights, bound = args
        given, d = _given(y, context), y.shape[1]
        saved, total = [], torch.zeros_like(y)
        for layer in reversed(range(len(weights[0]))):
            rotation, hidden_weight, out_weight = (w[layer] for w in weights)
            seen = torch.cat([given, y[:, :-1]], dim=1)
            hidden = torch.bmm(hidden_weight, seen).sigmoid_()
            out = torch.bmm(out_weight, hidden).unflatten(1, (d, 2))
            squashed = torch.sigmoid(out[:, :, 0]).mul_(2).sub_(1)
            shrink = torch.exp(-bound * squashed)
            u = (y - out[:, :, 1]).mul_(shrink)
            total.sub_(squashed)
            saved += [u, seen, hidden, squashed, shrink]
            y = torch.bmm(rotation.mT, u)
        ctx.save_for_backward(*weights, *saved)
        ctx.bound, ctx.first = bound, given.shape[1]
        return y, bound * total.sum(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor, g_log_det: Tensor) -> Any:
        weights, saved = ctx.saved_tensors[:3], ctx.saved_tensors[3:]
        gradients = [torch.empty_like(w) for w in weights]
        first, n_layers = ctx.first, len(weights[0])
        g_given = g.new_zeros(len(g), first, g.shape[2])
        g = g.contiguous()
        for layer in range(n_layers):
            rotation, hidden_weight, out_weight = (w[layer] for w in weights)
            at = 5 * (n_layers - 1 - layer)
            u, seen, hidden, squashed, shrink = saved[at : at + 5]
            torch.bmm(u, g.mT, out=gradients[0][layer])
            g_u = torch.bmm(rotation, g)
            g = g_u * shrink
            g_s = torch.addcmul(g_log_det[:, None], g_u, u).mul_(_slope(squashed, ctx.bound))
            g_out = torch.stack([g_s, g], dim=2).flatten(1, 2).neg_()
            torch.bmm(g_out, hidden.mT, out=gradients[2][layer])
            g_hidden = torch.bmm(out_weight.mT, g_out)
            g_hidden.mul_(torch.addcmul(hidden, hidden, hidden, value=-1))
            torch.bmm(g_hidden, seen.mT, out=gradients[1][layer])
            g_seen = torch.bmm(hidden_weight.mT, g_hidden)
            g_given.add_(g_seen[:, :first])
            g[:, :-1].add_(g_seen[:, first:])
        return g, g_given[:, 1:] if first > 1 else None, *gradients, None
