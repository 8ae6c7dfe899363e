"""Masked autoregressive layers as ONNX: see `AutoregressiveField`. States are columns, (d, n).

h^-1 is one pass. h takes the coordinates one by one, with the units of one degree each; the first
one's log-scale and shift are constants of the layer.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.autoregressive import AutoregressiveField
from iflow_gym.baselines.imitation_flow.onnx_graph import Graph
from iflow_gym.demonstrations import FloatArray


def inverse(graph: Graph, flow: AutoregressiveField, y: str) -> str:
    """Return h^-1(y), (d, n)."""
    d = flow.n_dims
    bound = np.array(-flow.bound)
    for rotation, hidden, hidden_bias, out, out_bias in reversed(_weights(flow)):
        seen, _ = graph.split(y, [d - 1, 1])
        units = graph("Tanh", graph("Gemm", hidden, seen, hidden_bias))
        weight, bias = np.swapaxes(out, 0, 1), np.swapaxes(out_bias, 0, 1)
        both = graph("Gemm", weight.reshape(2 * d, -1), units, bias.reshape(2 * d, 1))
        log_scale, shift = graph.split(both, [d, d])
        shrink = graph("Exp", graph("Mul", graph("Tanh", log_scale), bound))
        y = graph("MatMul", rotation.T, graph("Mul", graph("Sub", y, shift), shrink))
    return y


def forward(graph: Graph, flow: AutoregressiveField, z: str, dz: str | None) -> tuple[str, str]:
    """Return h(z) and, with a tangent, J_h(z) dz (else an empty name)."""
    d, one, bound = flow.n_dims, np.array(1.0), np.array(flow.bound)
    for rotation, hidden, hidden_bias, out, out_bias in _weights(flow):
        # The first coordinate's map is constant: a part of the rotation.
        scale = np.exp(flow.bound * np.tanh(out_bias[0, 0, 0]))
        turn, offset = rotation.copy(), np.zeros((d, 1))
        turn[0] *= scale
        offset[0] = out_bias[0, 1]
        y, *waiting = graph.split(graph("Gemm", turn, z, offset), [1] * d)
        dy, *d_waiting = [""] * d if dz is None else graph.split(graph("MatMul", turn, dz), [1] * d)
        units, d_units = "", ""
        for i, (start, end) in enumerate(pairwise(flow.ends), 1):
            weight, bias = hidden[start:end, :i], hidden_bias[start:end]
            new = graph("Tanh", graph("Gemm", weight, y, bias))
            units = graph("Concat", units, new, axis=0) if units else new
            both = graph("Gemm", out[i, :, :end], units, out_bias[i])
            log_scale, shift = graph.split(both, [1, 1])
            squashed = graph("Tanh", log_scale)
            scaled = graph("Exp", graph("Mul", squashed, bound))
            u = waiting[i - 1]
            moved = graph("Add", graph("Mul", u, scaled), shift)
            if dz is not None:
                slopes = graph("Sub", one, graph("Mul", new, new))
                d_new = graph("Mul", slopes, graph("MatMul", weight, dy))
                d_units = graph("Concat", d_units, d_new, axis=0) if d_units else d_new
                d_both = graph("MatMul", out[i, :, :end], d_units)
                d_log_scale, d_shift = graph.split(d_both, [1, 1])
                slope = graph("Mul", graph("Sub", one, graph("Mul", squashed, squashed)), bound)
                growth = graph("Mul", graph("Mul", slope, d_log_scale), u)
                grown = graph("Mul", graph("Add", d_waiting[i - 1], growth), scaled)
                dy = graph("Concat", dy, graph("Add", grown, d_shift), axis=0)
            y = graph("Concat", y, moved, axis=0)
        z, dz = y, None if dz is None else dy
    return z, dz or ""


def _weights(flow: AutoregressiveField) -> list[tuple[FloatArray, ...]]:
    """Return R, W, w (h, 1), V (d, 2, h), v (d, 2, 1) of every layer, for outputs s^ / b and t."""
    rotation, hidden, hidden_bias, out, out_bias = flow.arrays.values()
    scale = np.array([flow.bound, 1.0])[:, None]
    biases = hidden_bias[..., None], out_bias[..., None] / scale
    return list(zip(rotation, hidden, biases[0], out / scale, biases[1], strict=True))
