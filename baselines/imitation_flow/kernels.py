"""A chain of affine coupling layers and its gradients, written once for NumPy and for torch.

Arrays are (..., d, n) with the points last; the layers' weights lead with the layer. On a CPU a few
models run in NumPy, together in `whole_step` and one after the other under `coupling`: these are
thousands of operations on a few kilobytes each, which torch takes several times as long to start.
Many models under `coupling`, and a GPU, run in torch as a batch. The functions are the same, `xp`
is the library.

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


class LayerWeights(NamedTuple):
    """A layer's weights, and views of them on their sides."""

    rotation: Array
    rotation_t: Array
    hidden: Array
    hidden_t: Array
    out: Array
    out_t: Array


class Weights:
    """What the chain is made of, and how it is cut.

    Parameters
    ----------
    rotation, hidden, out : arrays
        R, W1 and W2.
    n_kept : int
        Size of u_a.
    bound : float
        b.
    """

    def __init__(
        self, rotation: Array, hidden: Array, out: Array, n_kept: int, bound: float
    ) -> None:
        self.rotation, self.hidden, self.out = rotation, hidden, out
        self.n_kept, self.bound = n_kept, bound
        sides = [(w, w.swapaxes(-1, -2)) for w in (rotation, hidden, out)]
        self.layers = [
            LayerWeights(*w) for w in zip(*(x for pair in sides for x in pair), strict=True)
        ]


class Layer(NamedTuple):
    """What a pass leaves of one layer; those that are parts of others are views of them."""

    before: Array
    """(..., d, n), and so are the next two."""
    turned: Array
    """Between the transform and the coupling."""
    after: Array
    turned_kept: Array
    turned_moved: Array
    after_kept: Array
    after_moved: Array
    seen: Array
    """(..., seen + 1, n): the conditioner's input."""
    seen_kept: Array
    units: Array
    """(..., h + 1, n)."""
    squashed: Array
    """(..., moved, n): tanh(s^ / b)."""
    scales: Array
    """(..., moved, n): exp(s), or exp(-s) of the inverse."""


class Trace:
    """What a pass leaves for its gradient, in arrays that lead with the layer."""

    def __init__(self, xp: Any, like: Array, w: Weights) -> None:
        n_layers, (d, _) = len(w.layers), like.shape[-2:]
        lead, k = (n_layers, *like.shape[:-2]), w.n_kept
        h, n_seen = w.hidden.shape[-2:]
        self.states = _empty(xp, like, (n_layers + 1, *like.shape[:-2], d))
        self.turned = _empty(xp, like, (*lead, d))
        self.seen = _empty(xp, like, (*lead, n_seen))
        self.seen[..., -1, :] = 1
        self.units = _empty(xp, like, (*lead, h))
        self.squashed, self.scales = (_empty(xp, like, (*lead, d - k)) for _ in range(2))
        # The conditioner's output: what goes into tanh, and t.
        out = _empty(xp, like, (*like.shape[:-2], 2 * (d - k)))
        self.out, self.narrowed, self.shift = out, out[..., : d - k, :], out[..., d - k :, :]
        before, after = self.states[:-1], self.states[1:]
        parts = (
            before, self.turned, after,
            self.turned[..., :k, :], self.turned[..., k:, :],
            after[..., :k, :], after[..., k:, :],
            self.seen, self.seen[..., :k, :], self.units, self.squashed, self.scales,
        )  # fmt: skip
        self.layers = [Layer(*layer) for layer in zip(*parts, strict=True)]


class Memory:
    """Arrays that are used again, step by step: new ones cost the kernel's pages every time.

    What a pass returns with a memory is overwritten by the next pass of its shapes with it.
    """

    def __init__(self) -> None:
        self._kept: dict[Any, Any] = {}

    def take(self, key: tuple[str, Array], make: Callable[[], Any]) -> Any:
        """Return what was made for a key's name and shape before, or make it.

        A memory belongs to one `Weights`: the key does not say whose arrays they are.
        """
        name, like = key
        known = name, tuple(like.shape)
        if known not in self._kept:
            self._kept[known] = make()
        return self._kept[known]


def forward(
    xp: Any, z: Array, context: Array | None, w: Weights, memory: Memory | None = None
) -> tuple[Array, Trace]:
    """Return y = h(z), (..., d, n), and the trace."""
    trace = _begun("forward", xp, z, context, w, memory)
    trace.states[0] = z
    for layer, weights in zip(trace.layers, w.layers, strict=True):
        _matmul(xp, weights.rotation, layer.before, layer.turned)
        layer.seen_kept[...] = layer.turned_kept
        _conditioned(xp, trace, layer, weights, w.bound)
        layer.after_kept[...] = layer.turned_kept
        xp.multiply(layer.turned_moved, layer.scales, out=layer.after_moved)
        xp.add(layer.after_moved, trace.shift, out=layer.after_moved)
    return trace.states[-1], trace


def forward_gradient(
    xp: Any, g: Array, trace: Trace, w: Weights, memory: Memory | None = None
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return the gradients of z, of the context and of R, W1, W2, from that of y."""
    work = _working("forward gradient", xp, g, trace, w, memory)
    work.states[-1] = g
    for layer, own, weights in zip(
        trace.layers[::-1], work.layers[::-1], w.layers[::-1], strict=True
    ):
        xp.multiply(own.after_moved, layer.scales, out=own.turned_moved)
        xp.multiply(own.turned_moved, layer.turned_moved, out=own.log_scale)
        own.shift[...] = own.after_moved
        work.conditioner(own, weights)
        xp.add(own.after_kept, work.seen_kept, out=own.turned_kept)
        _matmul(xp, weights.rotation_t, own.turned, own.before)
    return work.states[0], work.context, work.weights(work.turned, trace.states[:-1], trace)


def inverse(
    xp: Any, y: Array, context: Array | None, w: Weights, memory: Memory | None = None
) -> tuple[Array, Array, Trace]:
    """Return z = h^-1(y), (..., d, n), log |det dz/dy|, (..., n), and the trace."""
    trace = _begun("inverse", xp, y, context, w, memory)
    trace.states[-1] = y
    for layer, weights in zip(trace.layers[::-1], w.layers[::-1], strict=True):
        layer.seen_kept[...] = layer.after_kept
        _conditioned(xp, trace, layer, weights, -w.bound)
        layer.turned_kept[...] = layer.after_kept
        xp.subtract(layer.after_moved, trace.shift, out=layer.turned_moved)
        xp.multiply(layer.turned_moved, layer.scales, out=layer.turned_moved)
        _matmul(xp, weights.rotation_t, layer.turned, layer.before)
    return trace.states[0], -w.bound * trace.squashed.sum(0).sum(-2), trace


def inverse_gradient(
    xp: Any, g: Array, g_log_det: Array, trace: Trace, w: Weights, memory: Memory | None = None
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return the gradients of y, of the context and of R, W1, W2, from those of z and log |det|."""
    work = _working("inverse gradient", xp, g, trace, w, memory)
    work.states[0] = g
    log_det = g_log_det[..., None, :]
    for layer, own, weights in zip(trace.layers, work.layers, w.layers, strict=True):
        _matmul(xp, weights.rotation, own.before, own.turned)
        xp.multiply(own.turned_moved, layer.turned_moved, out=own.log_scale)
        xp.add(own.log_scale, log_det, out=own.log_scale)
        xp.negative(own.log_scale, out=own.log_scale)
        xp.multiply(own.turned_moved, layer.scales, out=own.after_moved)
        xp.negative(own.after_moved, out=own.shift)
        work.conditioner(own, weights)
        xp.add(own.turned_kept, work.seen_kept, out=own.after_kept)
    return work.states[-1], work.context, work.weights(trace.turned, work.states[:-1], trace)


class LayerWork(NamedTuple):
    """Gradients of what a `Layer` has, and slopes."""

    before: Array
    turned: Array
    turned_kept: Array
    turned_moved: Array
    after_kept: Array
    after_moved: Array
    both: Array
    """Of what the conditioner returns: the next two."""
    log_scale: Array
    shift: Array
    units: Array
    slope: Array
    """1 - tanh^2 of the units."""
    narrow: Array
    """b (1 - tanh^2) of the log-scales."""


class _Work:
    """Arrays that a gradient works in; what all layers need is computed for all at once."""

    def __init__(self, xp: Any, g: Array, trace: Trace, w: Weights) -> None:
        self.xp = xp
        n_layers, n_seen, k = len(w.layers), w.hidden.shape[-1], w.n_kept
        lead, d = g.shape[:-2], g.shape[-2]
        self.states = _empty(xp, g, (n_layers + 1, *lead, d))
        self.turned = _empty(xp, g, (n_layers, *lead, d))
        self.both = _empty(xp, g, (n_layers, *lead, 2 * (d - k)))
        self.units, self.slopes = (xp.empty_like(trace.units) for _ in range(2))
        self.narrows = xp.empty_like(trace.squashed)
        self.seen = _empty(xp, g, (*lead, n_seen))
        self.seen_kept, self.seen_context = self.seen[..., :k, :], self.seen[..., k:-1, :]
        self.context = xp.zeros_like(self.seen_context)
        self.g_weights = tuple(xp.empty_like(x) for x in (w.rotation, w.hidden, w.out))
        before, after = self.states[:-1], self.states[1:]
        parts = (
            before, self.turned,
            self.turned[..., :k, :], self.turned[..., k:, :],
            after[..., :k, :], after[..., k:, :],
            self.both, self.both[..., : d - k, :], self.both[..., d - k :, :],
            self.units, self.slopes, self.narrows,
        )  # fmt: skip
        self.layers = [LayerWork(*layer) for layer in zip(*parts, strict=True)]

    def begin(self, trace: Trace, w: Weights) -> None:
        """Take in what a pass left."""
        self.context[...] = 0
        for squares, slopes, factor in (
            (trace.units, self.slopes, 1.0),
            (trace.squashed, self.narrows, w.bound),
        ):
            self.xp.multiply(squares, squares, out=slopes)
            slopes *= -factor
            slopes += factor

    def conditioner(self, own: LayerWork, weights: LayerWeights) -> None:
        """Take the gradients of s and t on to what was seen."""
        xp = self.xp
        xp.multiply(own.log_scale, own.narrow, out=own.log_scale)
        _matmul(xp, weights.out_t, own.both, own.units)
        xp.multiply(own.units, own.slope, out=own.units)
        _matmul(xp, weights.hidden_t, own.units, self.seen)
        if self.context.shape[-2]:
            self.context += self.seen_context

    def weights(self, turned: Array, still: Array, trace: Trace) -> tuple[Array, Array, Array]:
        """Return the gradients of R, from what is (..., d, n) behind it and before, W1 and W2."""
        g_rotation, g_hidden, g_out = self.g_weights
        self.xp.matmul(turned, still.swapaxes(-1, -2), out=g_rotation)
        self.xp.matmul(self.units, trace.seen.swapaxes(-1, -2), out=g_hidden)
        self.xp.matmul(self.both, trace.units.swapaxes(-1, -2), out=g_out)
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
) -> Trace:
    """Return a pass's trace, with nothing but its context in it."""
    memory = Memory() if memory is None else memory
    trace: Trace = memory.take((name, state), lambda: Trace(xp, state, w))
    if context is not None:
        trace.seen[..., w.n_kept : -1, :] = context
    return trace


def _conditioned(xp: Any, trace: Trace, layer: Layer, weights: LayerWeights, bound: float) -> None:
    """Fill in what a layer's conditioner makes of what it sees: exp(+-s) and t."""
    _matmul(xp, weights.hidden, layer.seen, layer.units)
    _tanh(xp, layer.units, layer.units)
    _matmul(xp, weights.out, layer.units, trace.out)
    _tanh(xp, trace.narrowed, layer.squashed)
    xp.multiply(layer.squashed, bound, out=layer.scales)
    xp.exp(layer.scales, out=layer.scales)


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
