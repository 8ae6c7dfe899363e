"""Affine coupling layers as ONNX: see `CouplingField`. States are columns, (d, n)."""

from __future__ import annotations

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.baselines.imitation_flow.onnx_graph import Graph
from iflow_gym.demonstrations import FloatArray


def inverse(graph: Graph, flow: CouplingField, y: str) -> str:
    """Return h^-1(y), (d, n)."""
    d, k = flow.n_dims, flow.n_kept
    a, b = graph.split(y, [k, d - k])
    for rotation, hidden, hidden_bias, out, out_bias in reversed(_weights(flow)):
        units = graph("Tanh", graph("Gemm", hidden, a, hidden_bias))
        log_scale, shift = graph.split(graph("Gemm", out, units, out_bias), [d - k, d - k])
        shrink = graph("Exp", graph("Mul", graph("Tanh", log_scale), np.array(-flow.bound)))
        moved = graph("Mul", graph("Sub", b, shift), shrink)
        turned = graph("MatMul", rotation.T, graph("Concat", a, moved, axis=0))
        a, b = graph.split(turned, [k, d - k])
    return turned


def forward(graph: Graph, flow: CouplingField, z: str, dz: str | None) -> tuple[str, str]:
    """Return h(z) and, with a tangent, J_h(z) dz (else an empty name)."""
    d, k = flow.n_dims, flow.n_kept
    one, bound = np.array(1.0), np.array(flow.bound)
    for rotation, hidden, hidden_bias, out, out_bias in _weights(flow):
        a, b = graph.split(graph("MatMul", rotation, z), [k, d - k])
        units = graph("Tanh", graph("Gemm", hidden, a, hidden_bias))
        log_scale, shift = graph.split(graph("Gemm", out, units, out_bias), [d - k, d - k])
        squashed = graph("Tanh", log_scale)
        scale = graph("Exp", graph("Mul", squashed, bound))
        z = graph("Concat", a, graph("Add", graph("Mul", b, scale), shift), axis=0)
        if dz is None:
            continue
        da, db = graph.split(graph("MatMul", rotation, dz), [k, d - k])
        slopes = graph("Sub", one, graph("Mul", units, units))
        d_units = graph("Mul", slopes, graph("MatMul", hidden, da))
        d_log_scale, d_shift = graph.split(graph("MatMul", out, d_units), [d - k, d - k])
        slope = graph("Mul", graph("Sub", one, graph("Mul", squashed, squashed)), bound)
        growth = graph("Mul", graph("Mul", slope, d_log_scale), b)
        moved = graph("Add", graph("Mul", graph("Add", db, growth), scale), d_shift)
        dz = graph("Concat", da, moved, axis=0)
    return z, dz or ""


def _weights(flow: CouplingField) -> list[tuple[FloatArray, ...]]:
    """Return R, W, w (h, 1), V, v (2 moved, 1) of every layer, for outputs s^ / b and t."""
    rotation, hidden, hidden_bias, out, out_bias = flow.arrays.values()
    scale = np.ones((out.shape[1], 1))
    scale[: flow.n_dims - flow.n_kept] = flow.bound
    biases = hidden_bias[..., None], out_bias[..., None] / scale
    return list(zip(rotation, hidden, biases[0], out / scale, biases[1], strict=True))
