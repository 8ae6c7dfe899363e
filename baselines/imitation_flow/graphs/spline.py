"""Spline couplings as ONNX: see `SplineField`. States are columns, (d, n).

A bin is found by counting the knots that a coordinate has passed. Sizes are kept as they are before
they fill [-B, B], as in training. Beyond [-B, B] a spline is the identity: the coordinate is
clipped, and what was clipped off is added again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.spline import SplineField
from iflow_gym.baselines.imitation_flow.fields.spline_point import rows_of
from iflow_gym.baselines.imitation_flow.onnx_graph import INT64, Graph
from iflow_gym.demonstrations import FloatArray


class _Bins(NamedTuple):
    """All bins of one coordinate: widths, heights (K, n) and the knots' slopes (K + 1, n)."""

    widths: str
    heights: str
    knots: str


class _Sums(NamedTuple):
    """Sums of the sizes up to each bin's end (K, n), those but the last, and the last."""

    every: str
    inner: str
    total: str


class _Piece(NamedTuple):
    """A point's bin, all (1, n): its start and size on both axes, the sums, its knots' slopes."""

    x: str
    y: str
    width: str
    height: str
    widths: str
    heights: str
    left: str
    right: str


def inverse(graph: Graph, flow: SplineField, y: str) -> str:
    """Return h^-1(y), (d, n)."""
    d, k, length = flow.n_dims, flow.n_kept, np.array(2 * flow.bound)
    for rotation, hidden, hidden_bias, out, out_bias, bounds in reversed(_weights(flow)):
        kept, *moved = graph.split(y, [k] + [1] * (d - k))
        units = graph("Tanh", graph("Gemm", hidden, kept, hidden_bias))
        squashed = graph("Tanh", graph("Gemm", out, units, out_bias))
        for j, bins in enumerate(_bins(graph, flow, graph("Exp", graph("Mul", squashed, bounds)))):
            inside, beyond = _clipped(graph, flow, moved[j])
            widths, heights = _sums(graph, flow, bins.widths), _sums(graph, flow, bins.heights)
            scaled = graph("Div", graph("Mul", inside, heights.total), length)
            index = _index(graph, scaled, heights)
            piece = _piece(graph, bins, widths, heights, index)
            mean, bend = _mean_and_bend(graph, piece)
            # Eqs. 6 to 8, divided by the bin's height; the root that does not cancel.
            image = graph("Div", graph("Sub", scaled, piece.y), piece.height)
            b = graph("Sub", piece.left, graph("Mul", image, bend))
            c = graph("Mul", image, mean)
            four = graph("Mul", graph("Mul", graph("Sub", mean, b), c), np.array(4.0))
            root = graph("Sqrt", graph("Add", graph("Mul", b, b), four))
            xi = graph("Div", graph("Mul", c, np.array(2.0)), graph("Add", b, root))
            reached = graph("Add", piece.x, graph("Mul", piece.width, xi))
            reached = graph("Div", graph("Mul", reached, length), piece.widths)
            moved[j] = graph("Add", reached, beyond)
        y = graph("MatMul", rotation.T, graph("Concat", kept, *moved, axis=0))
    return y


def forward(graph: Graph, flow: SplineField, z: str, dz: str | None) -> tuple[str, str]:
    """Return h(z) and, with a tangent, J_h(z) dz (else an empty name)."""
    d, k, length, one = flow.n_dims, flow.n_kept, np.array(2 * flow.bound), np.array(1.0)
    for rotation, hidden, hidden_bias, out, out_bias, bounds in _weights(flow):
        kept, *moved = graph.split(graph("MatMul", rotation, z), [k] + [1] * (d - k))
        units = graph("Tanh", graph("Gemm", hidden, kept, hidden_bias))
        squashed = graph("Tanh", graph("Gemm", out, units, out_bias))
        exp = graph("Exp", graph("Mul", squashed, bounds))
        every = _bins(graph, flow, exp)
        d_kept, d_moved, d_every = "", [""] * (d - k), every
        if dz is not None:
            d_kept, *d_moved = graph.split(graph("MatMul", rotation, dz), [k] + [1] * (d - k))
            slopes = graph("Sub", one, graph("Mul", units, units))
            d_units = graph("Mul", slopes, graph("MatMul", hidden, d_kept))
            slope = graph("Mul", graph("Sub", one, graph("Mul", squashed, squashed)), bounds)
            d_log = graph("Mul", slope, graph("MatMul", out, d_units))
            d_every = _d_bins(graph, flow, every, d_log)
        for j, bins in enumerate(every):
            inside, beyond = _clipped(graph, flow, moved[j])
            widths, heights = _sums(graph, flow, bins.widths), _sums(graph, flow, bins.heights)
            scaled = graph("Div", graph("Mul", inside, widths.total), length)
            index = _index(graph, scaled, widths)
            piece = _piece(graph, bins, widths, heights, index)
            mean, bend = _mean_and_bend(graph, piece)
            xi = graph("Div", graph("Sub", scaled, piece.x), piece.width)
            rest = graph("Sub", one, xi)
            product, square = graph("Mul", xi, rest), graph("Mul", xi, xi)
            mixed = graph("Add", mean, graph("Mul", bend, product))
            top = graph("Add", graph("Mul", mean, square), graph("Mul", piece.left, product))
            image = graph("Div", top, mixed)
            reached = graph("Add", piece.y, graph("Mul", piece.height, image))
            reached = graph("Div", graph("Mul", reached, length), piece.heights)
            if dz is not None:
                d_widths = _sums(graph, flow, d_every[j].widths)
                d_heights = _sums(graph, flow, d_every[j].heights)
                tangent = _piece(graph, d_every[j], d_widths, d_heights, index)
                d_mean, d_bend = _d_mean_and_bend(graph, piece, mean, tangent)
                by_value = graph("Mul", d_moved[j], widths.total)
                by_sum = graph("Mul", inside, tangent.widths)
                d_scaled = graph("Div", graph("Add", by_value, by_sum), length)
                d_scaled = graph("Sub", d_scaled, tangent.x)
                d_xi = graph("Sub", d_scaled, graph("Mul", xi, tangent.width))
                d_xi = graph("Div", d_xi, piece.width)
                d_product = graph("Mul", graph("Sub", rest, xi), d_xi)
                d_square = graph("Mul", graph("Add", xi, xi), d_xi)
                d_top = _total(
                    graph,
                    graph("Mul", d_mean, square),
                    graph("Mul", mean, d_square),
                    graph("Mul", tangent.left, product),
                    graph("Mul", piece.left, d_product),
                )
                d_mixed = _total(
                    graph, d_mean, graph("Mul", d_bend, product), graph("Mul", bend, d_product)
                )
                d_image = graph("Sub", d_top, graph("Mul", image, d_mixed))
                d_image = graph("Div", d_image, mixed)
                # Of what is reached, in [0, 2 B], the share of the sum of the heights is taken off.
                d_reached = _total(
                    graph,
                    tangent.y,
                    graph("Mul", tangent.height, image),
                    graph("Mul", piece.height, d_image),
                )
                d_sum = graph("Mul", reached, tangent.heights)
                d_reached = graph("Sub", graph("Mul", d_reached, length), d_sum)
                d_reached = graph("Div", d_reached, piece.heights)
                within = graph("Less", graph("Abs", moved[j]), np.array(flow.bound))
                d_moved[j] = graph("Where", within, d_reached, d_moved[j])
            moved[j] = graph("Add", reached, beyond)
        z = graph("Concat", kept, *moved, axis=0)
        dz = None if dz is None else graph("Concat", d_kept, *d_moved, axis=0)
    return z, dz or ""


def _bins(graph: Graph, flow: SplineField, exp: str) -> list[_Bins]:
    """Return the bins of each coordinate, from the exponentials of the conditioner's output."""
    q, n_bins = flow.n_dims - flow.n_kept, flow.n_bins
    widths, slopes, knots = graph.split(exp, [q * n_bins, q * n_bins, q * (n_bins + 1)])
    heights = graph("Mul", widths, slopes)
    sizes = [[n_bins] * q, [n_bins] * q, [n_bins + 1] * q]
    parts = [graph.split(v, s) for v, s in zip((widths, heights, knots), sizes, strict=True)]
    return [_Bins(*entries) for entries in zip(*parts, strict=True)]


def _d_bins(graph: Graph, flow: SplineField, every: list[_Bins], d_log: str) -> list[_Bins]:
    """Return the derivatives of `_bins` by that of the logarithms."""
    q, n_bins = flow.n_dims - flow.n_kept, flow.n_bins
    d_log_widths, d_log_slopes, d_log_knots = graph.split(
        d_log, [q * n_bins, q * n_bins, q * (n_bins + 1)]
    )
    d_log_heights = graph("Add", d_log_widths, d_log_slopes)
    sizes = [[n_bins] * q, [n_bins] * q, [n_bins + 1] * q]
    logs = (d_log_widths, d_log_heights, d_log_knots)
    parts = [graph.split(v, s) for v, s in zip(logs, sizes, strict=True)]
    return [
        _Bins(*(graph("Mul", value, change) for value, change in zip(bins, changes, strict=True)))
        for bins, changes in zip(every, zip(*parts, strict=True), strict=True)
    ]


def _clipped(graph: Graph, flow: SplineField, value: str) -> tuple[str, str]:
    """Return a value clipped to [-B, B], measured from -B, and the value less that."""
    bound = np.array(flow.bound)
    inside = graph("Add", graph("Clip", value, -bound, bound), bound)
    return inside, graph("Sub", value, inside)


def _sums(graph: Graph, flow: SplineField, sizes: str) -> _Sums:
    every = graph("CumSum", sizes, np.array(0))
    inner, total = graph.split(every, [flow.n_bins - 1, 1])
    return _Sums(every, inner, total)


def _index(graph: Graph, scaled: str, sums: _Sums) -> str:
    """Return which bin a value is in, (1, n)."""
    passed = graph("Cast", graph("GreaterOrEqual", scaled, sums.inner), to=INT64)
    return graph("ReduceSum", passed, np.array([0]))


def _piece(graph: Graph, bins: _Bins, widths: _Sums, heights: _Sums, index: str) -> _Piece:
    def at(values: str, place: str = index) -> str:
        return graph("GatherElements", values, place, axis=0)

    width, height = at(bins.widths), at(bins.heights)
    return _Piece(
        graph("Sub", at(widths.every), width),
        graph("Sub", at(heights.every), height),
        width,
        height,
        widths.total,
        heights.total,
        at(bins.knots),
        at(bins.knots, graph("Add", index, np.array(1))),
    )


def _mean_and_bend(graph: Graph, piece: _Piece) -> tuple[str, str]:
    """Return the bin's mean slope s, and delta_k + delta_{k+1} - 2 s of eq. 4."""
    across = graph("Mul", piece.width, piece.heights)
    mean = graph("Div", graph("Mul", piece.height, piece.widths), across)
    return mean, graph("Sub", graph("Add", piece.left, piece.right), graph("Add", mean, mean))


def _d_mean_and_bend(graph: Graph, piece: _Piece, mean: str, tangent: _Piece) -> tuple[str, str]:
    up = graph("Div", tangent.height, piece.height), graph("Div", tangent.widths, piece.widths)
    down = graph("Div", tangent.width, piece.width), graph("Div", tangent.heights, piece.heights)
    d_log_mean = graph("Sub", graph("Add", *up), graph("Add", *down))
    d_mean = graph("Mul", mean, d_log_mean)
    ends = graph("Add", tangent.left, tangent.right)
    return d_mean, graph("Sub", ends, graph("Add", d_mean, d_mean))


def _total(graph: Graph, *values: str) -> str:
    first, *others = values
    for value in others:
        first = graph("Add", first, value)
    return first


def _weights(flow: SplineField) -> list[tuple[FloatArray, ...]]:
    """Return R, W, w (h, 1), V, v (rows, 1) and the rows' bounds (rows, 1) of every layer."""
    rotation, hidden, hidden_bias, *_ = flow.arrays.values()
    bounds, out, out_bias = rows_of(flow)
    every = [bounds[:, None]] * len(rotation)
    return list(zip(rotation, hidden, hidden_bias[..., None], out, out_bias, every, strict=True))
