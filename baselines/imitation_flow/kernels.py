"""A chain of affine coupling layers and its gradients, written once for NumPy and for torch.

Arrays are (..., d, n) with the points last; the layers' weights lead with the layer. A few models
on a CPU run in NumPy, one after the other: these are thousands of operations on a few kilobytes
each, which torch takes several times as long to start. Many models, and a GPU, run in torch as a
batch. The functions are the same, `xp` is the library.

Weights are R (layers, ..., d, d), W1 (layers, ..., h + 1, seen + 1) and W2 (layers, ..., 2 moved,
h + 1). Biases are the weights of an input that is 1 and of a unit that is 1: its argument is
`SATURATED`. The first rows of W2 give s^ / b, the others t, of

    u = R z,    y_a = u_a,    y_b = u_b exp(b tanh(s^ / b)) + t.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

SATURATED = 50.0
"""An argument for which tanh is 1 and its slope 0, in any precision."""

Array = Any
"""A NumPy array or a torch tensor."""


class Weights(NamedTuple):
    """What the chain is made of, and how it is cut."""

    rotation: Array
    hidden: Array
    out: Array
    n_kept: int
    bound: float


class Trace(NamedTuple):
    """What a pass leaves for its gradient, by layer."""

    states: Array
    """(layers + 1, ..., d, n): before and after each layer."""
    turned: Array
    """(layers, ..., d, n): between the transform and the coupling."""
    seen: Array
    """(layers, ..., seen + 1, n): the conditioner's input."""
    units: Array
    """(layers, ..., h + 1, n)."""
    squashed: Array
    """(layers, ..., moved, n): tanh(s^ / b)."""
    scales: Array
    """(layers, ..., moved, n): exp(s), or exp(-s) of the inverse."""


class Memory:
    """Arrays that are used again, step by step: new ones cost the kernel's pages every time.

    What a pass returns with a memory is overwritten by the next pass of its shapes with it.
    """

    def __init__(self) -> None:
        self._kept: dict[Any, Any] = {}

    def take(self, key: tuple[str, Array], make: Callable[[], Any]) -> Any:
        """Return what was made for a key's name and shape before, or make it."""
        name, like = key
        known = name, tuple(like.shape)
        if known not in self._kept:
            self._kept[known] = make()
        return self._kept[known]


def forward(
    xp: Any, z: Array, context: Array | None, w: Weights, memory: Memory | None = None
) -> tuple[Array, Trace]:
    """Return y = h(z), (..., d, n), and the trace."""
    k, trace, out = w.n_kept, *_begun("forward", xp, z, context, w, memory)
    trace.states[0] = z
    for layer in range(len(w.rotation)):
        u, y = trace.turned[layer], trace.states[layer + 1]
        _matmul(xp, w.rotation[layer], trace.states[layer], u)
        shift, scale = _coefficients(xp, trace, w, layer, u, out, 1.0)
        y[..., :k, :] = u[..., :k, :]
        moved = y[..., k:, :]
        xp.multiply(u[..., k:, :], scale, out=moved)
        moved += shift
    return trace.states[-1], trace


def forward_gradient(
    xp: Any, g: Array, trace: Trace, w: Weights, memory: Memory | None = None
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return the gradients of z, of the context and of R, W1, W2, from that of y."""
    k, work = w.n_kept, _working("forward gradient", xp, g, trace, w, memory)
    work.g[-1] = g
    for layer in reversed(range(len(w.rotation))):
        u, g_y, g_u = trace.turned[layer], work.g[layer + 1], work.g_u[layer]
        g_b, g_moved = g_y[..., k:, :], g_u[..., k:, :]
        xp.multiply(g_b, trace.scales[layer], out=g_moved)
        xp.multiply(g_moved, u[..., k:, :], out=work.g_s[layer])
        work.g_shift[layer] = g_b
        g_seen = work.conditioner(w, layer)
        xp.add(g_y[..., :k, :], g_seen[..., :k, :], out=g_u[..., :k, :])
        _matmul(xp, w.rotation[layer].swapaxes(-1, -2), g_u, work.g[layer])
    return work.g[0], work.g_context, work.weights(work.g_u, trace.states[:-1], trace)


def inverse(
    xp: Any, y: Array, context: Array | None, w: Weights, memory: Memory | None = None
) -> tuple[Array, Array, Trace]:
    """Return z = h^-1(y), (..., d, n), log |det dz/dy|, (..., n), and the trace."""
    k, trace, out = w.n_kept, *_begun("inverse", xp, y, context, w, memory)
    trace.states[-1] = y
    for layer in reversed(range(len(w.rotation))):
        u, y = trace.turned[layer], trace.states[layer + 1]
        shift, shrink = _coefficients(xp, trace, w, layer, y, out, -1.0)
        u[..., :k, :] = y[..., :k, :]
        moved = u[..., k:, :]
        xp.subtract(y[..., k:, :], shift, out=moved)
        moved *= shrink
        _matmul(xp, w.rotation[layer].swapaxes(-1, -2), u, trace.states[layer])
    return trace.states[0], -w.bound * trace.squashed.sum(0).sum(-2), trace


def inverse_gradient(
    xp: Any, g: Array, g_log_det: Array, trace: Trace, w: Weights, memory: Memory | None = None
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return the gradients of y, of the context and of R, W1, W2, from those of z and log |det|."""
    k, work = w.n_kept, _working("inverse gradient", xp, g, trace, w, memory)
    work.g[0] = g
    for layer in range(len(w.rotation)):
        u, g_y, g_u, g_s = trace.turned[layer], work.g[layer + 1], work.g_u[layer], work.g_s[layer]
        _matmul(xp, w.rotation[layer], work.g[layer], g_u)
        g_b, g_moved = g_u[..., k:, :], g_y[..., k:, :]
        xp.multiply(g_b, u[..., k:, :], out=g_s)
        g_s += g_log_det[..., None, :]
        g_s *= -1.0
        xp.multiply(g_b, trace.scales[layer], out=g_moved)
        xp.multiply(g_moved, -1.0, out=work.g_shift[layer])
        g_seen = work.conditioner(w, layer)
        xp.add(g_u[..., :k, :], g_seen[..., :k, :], out=g_y[..., :k, :])
    return work.g[-1], work.g_context, work.weights(trace.turned, work.g[:-1], trace)


class _Work:
    """Arrays that a gradient works in; what all layers need is computed for all at once."""

    def __init__(self, xp: Any, g: Array, trace: Trace, w: Weights) -> None:
        self.xp = xp
        n_layers, seen = len(w.rotation), w.hidden.shape[-1]
        lead, d = g.shape[:-2], g.shape[-2]
        n_moved = d - w.n_kept
        self.g = _empty(xp, g, (n_layers + 1, *lead, d))
        self.g_u = _empty(xp, g, (n_layers, *lead, d))
        self.g_both = _empty(xp, g, (n_layers, *lead, 2 * n_moved))
        self.g_s, self.g_shift = self.g_both[..., :n_moved, :], self.g_both[..., n_moved:, :]
        self.g_units, self.g_seen = xp.empty_like(trace.units), _empty(xp, g, (*lead, seen))
        self.g_context = _empty(xp, g, (*lead, seen - 1 - w.n_kept))
        self.slopes, self.narrows = xp.empty_like(trace.units), xp.empty_like(trace.squashed)
        self.g_weights = tuple(xp.empty_like(x) for x in (w.rotation, w.hidden, w.out))

    def begin(self, trace: Trace, w: Weights) -> None:
        """Take in what a pass left."""
        self.g_context[...] = 0
        # 1 - tanh^2 of the units and, with the bound, of the log-scales.
        for squares, slopes, factor in (
            (trace.units, self.slopes, 1.0),
            (trace.squashed, self.narrows, w.bound),
        ):
            self.xp.multiply(squares, squares, out=slopes)
            slopes *= -factor
            slopes += factor

    def conditioner(self, w: Weights, layer: int) -> Array:
        """Return the gradient of what was seen from those of s and t."""
        xp, g_units = self.xp, self.g_units[layer]
        self.g_s[layer] *= self.narrows[layer]
        _matmul(xp, w.out[layer].swapaxes(-1, -2), self.g_both[layer], g_units)
        g_units *= self.slopes[layer]
        _matmul(xp, w.hidden[layer].swapaxes(-1, -2), g_units, self.g_seen)
        if self.g_context.shape[-2]:
            self.g_context += self.g_seen[..., w.n_kept : -1, :]
        return self.g_seen

    def weights(self, turned: Array, still: Array, trace: Trace) -> tuple[Array, Array, Array]:
        """Return the gradients of R, from what is (..., d, n) behind it and before, W1 and W2."""
        g_rotation, g_hidden, g_out = self.g_weights
        self.xp.matmul(turned, still.swapaxes(-1, -2), out=g_rotation)
        self.xp.matmul(self.g_units, trace.seen.swapaxes(-1, -2), out=g_hidden)
        self.xp.matmul(self.g_both, trace.units.swapaxes(-1, -2), out=g_out)
        return g_rotation, g_hidden, g_out


def _working(
    name: str, xp: Any, g: Array, trace: Trace, w: Weights, memory: Memory | None
) -> _Work:
    memory = Memory() if memory is None else memory
    work: _Work = memory.take((name, g), lambda: _Work(xp, g, trace, w))
    work.begin(trace, w)
    return work


def _begun(
    name: str, xp: Any, state: Array, context: Array | None, w: Weights, memory: Memory | None
) -> tuple[Trace, Array]:
    """Return an empty trace of a pass, and what the conditioners' outputs go to."""
    memory = Memory() if memory is None else memory
    made: tuple[Trace, Array] = memory.take(
        (name, state),
        lambda: (_empty_trace(xp, state, w), _empty(xp, state, w.out.shape[1:-1])),
    )
    if context is not None:
        made[0].seen[..., w.n_kept : -1, :] = context
    return made


def _coefficients(
    xp: Any, trace: Trace, w: Weights, layer: int, state: Array, out: Array, sign: float
) -> tuple[Array, Array]:
    """Fill in the trace of a layer's conditioner; return t and exp(sign s)."""
    k, units, scale = w.n_kept, trace.units[layer], trace.scales[layer]
    trace.seen[layer][..., :k, :] = state[..., :k, :]
    _matmul(xp, w.hidden[layer], trace.seen[layer], units)
    _tanh(xp, units, units)
    _matmul(xp, w.out[layer], units, out)
    n_moved = scale.shape[-2]
    _tanh(xp, out[..., :n_moved, :], trace.squashed[layer])
    xp.multiply(trace.squashed[layer], sign * w.bound, out=scale)
    xp.exp(scale, out=scale)
    return out[..., n_moved:, :], scale


def _matmul(xp: Any, left: Array, right: Array, out: Array) -> None:
    if xp is np and right.ndim == 2:  # the same product, with less before it
        np.dot(left, right, out=out)
    else:
        xp.matmul(left, right, out=out)


def _tanh(xp: Any, x: Array, out: Array) -> None:
    if xp is np:
        np.tanh(x, out=out)
        return
    # torch has a fast sigmoid on a CPU, and a slow tanh: tanh x = 2 sigmoid(2 x) - 1.
    xp.multiply(x, 2.0, out=out)
    out.sigmoid_().mul_(2.0).sub_(1.0)


def _empty(xp: Any, like: Array, lead: tuple[int, ...]) -> Array:
    """Return an uninitialised array (*lead, n)."""
    shape = (*lead, like.shape[-1])
    if xp is np:
        return np.empty(shape, dtype=like.dtype)
    return xp.empty(shape, dtype=like.dtype, device=like.device)


def _empty_trace(xp: Any, z: Array, w: Weights) -> Trace:
    n_layers, (d, _) = len(w.rotation), z.shape[-2:]
    lead, (h, n_seen) = (n_layers, *z.shape[:-2]), w.hidden.shape[-2:]
    n_moved = d - w.n_kept
    seen = _empty(xp, z, (*lead, n_seen))
    seen[..., -1, :] = 1
    return Trace(
        _empty(xp, z, (n_layers + 1, *z.shape[:-2], d)),
        _empty(xp, z, (*lead, d)),
        seen,
        _empty(xp, z, (*lead, h)),
        _empty(xp, z, (*lead, n_moved)),
        _empty(xp, z, (*lead, n_moved)),
    )
