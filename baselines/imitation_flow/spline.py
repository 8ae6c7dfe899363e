"""Rational-quadratic spline coupling layers, with the spline's gradient written out.

A layer behind its orthogonal transform is (Durkan et al., "Neural spline flows", 2019, sec. 3)

    u = R z,    y_a = u_a,    y_b = spline(u_b; widths, slopes of (u_a, c)),

where a spline is K rational-quadratic pieces on [-B, B] (eqs. 4 to 8) and the identity outside.

Deviations from the source: a bin has a width and a mean slope in place of a width and a height, and
every log-slope, of bins and of knots, is bounded by b. So a spline's slope lies between
exp(-2 b) / cosh b and exp(2 b) / cosh b, whatever the conditioner says, its inverse is exact in
floating point, and the field stays calm. The conditioner has one hidden layer of tanh units, which
saturate. A spline neither shifts nor scales the whole line: far away h is a rotation and a bounded
displacement.

The spline is one node of the graph in each direction; its gradient is below. Widths and heights are
kept before they are scaled to fill [-B, B], and so is the place in a bin, so that a point meets its
own bin's numbers and the two sums alone. tanh x is 2 sigmoid(2 x) - 1.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from iflow_gym.baselines.imitation_flow.fields.spline import row_bounds
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.kernels import SATURATED


class SplineFlow(Flow):
    """Rational-quadratic spline couplings between orthogonal transforms.

    Parameters
    ----------
    n_dims, n_layers, n_hidden : int
        Sizes; the conditioner sees n_dims // 2 coordinates and the context.
    n_context : int
        Size of the context, 0 for none.
    n_bins : int
        Pieces K of a spline.
    bound : float
        B: a spline is the identity outside [-B, B].
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
        n_bins: int,
        bound: float,
        log_scale_bound: float,
        sharpness: float,
        generators: list[torch.Generator],
    ) -> None:
        super().__init__(n_dims, n_layers, generators)
        self.log_scale_bound, self.bound, self.n_bins = log_scale_bound, bound, n_bins
        self.n_kept, self.n_context = n_dims // 2, n_context
        seen, n_moved = self.n_kept + n_context, n_dims - self.n_kept
        # Units are steps with random slopes (1 to 4 times the sharpness) and places.
        slopes = sharpness * (1 + 3 * self.drawn(n_layers, n_hidden, seen))
        slopes = slopes * torch.sign(self.drawn(n_layers, n_hidden, seen) - 0.5)
        places = 1.3 * (2 * self.drawn(n_layers, n_hidden, seen) - 1)
        self.hidden_weight = nn.Parameter(slopes / math.sqrt(seen))
        self.hidden_bias = nn.Parameter(-(self.hidden_weight * places).detach().sum(-1, True))
        rows = n_moved * (3 * n_bins - 1)
        self.out_weight = nn.Parameter(0.01 * self.drawn(n_layers, rows, n_hidden, normal=True))
        self.out_bias = nn.Parameter(self.angles.new_zeros(n_layers, self.n_models, rows, 1))

    def _row_bounds(self) -> Tensor:
        """Return `row_bounds` as a column, exact in any precision."""
        return self.out_weight.new_tensor(row_bounds(self.n_bins, self.log_scale_bound))[:, None]

    def weights(self) -> list[tuple[Tensor, ...]]:
        """Return R, hidden weights (m, h + 1, seen + 1) and output weights (.., h + 1), by layer.

        For sigmoid units in place of tanh units, and for outputs divided by half their bounds.
        Biases are the weights of an input that is 1 and of a unit that is 1.
        """
        hidden = 2 * torch.cat([self.hidden_weight, self.hidden_bias], dim=-1)
        one = torch.zeros_like(hidden[..., :1, :])
        one[..., -1] = SATURATED
        bias = self.out_bias - self.out_weight.sum(-1, keepdim=True)
        factor = (2 / self._row_bounds()).repeat(self.n_dims - self.n_kept, 1)
        out = factor * torch.cat([2 * self.out_weight, bias], dim=-1)
        weights = (self.orthogonal(), torch.cat([hidden, one], dim=-2), out)
        return list(zip(*(w.unbind(0) for w in weights), strict=True))

    def _beside(self, state: Tensor, context: Tensor | None) -> list[Tensor]:
        ones = state.new_ones(1, 1, 1).expand(len(state), 1, state.shape[2])
        return [ones] if context is None else [context, ones]

    def forward(self, z: Tensor, context: Tensor | None = None, weights: Any = None) -> Tensor:
        """Return y = h(z), both (m, d, n)."""
        weights = self.weights() if weights is None else weights
        beside, bounds = self._beside(z, context), self._row_bounds()
        for rotation, hidden_weight, out_weight in weights:
            u = torch.bmm(rotation, z)
            kept, moved = u[:, : self.n_kept], u[:, self.n_kept :]
            hidden = torch.bmm(hidden_weight, torch.cat([kept, *beside], dim=1)).sigmoid()
            out = torch.bmm(out_weight, hidden)
            z = torch.cat([kept, _Spline.apply(moved, out, bounds, self.bound)], dim=1)
        return z

    def inverse(
        self, y: Tensor, context: Tensor | None = None, weights: Any = None
    ) -> tuple[Tensor, Tensor]:
        """Return z = h^-1(y), (m, d, n), and log |det dz/dy|, (m, n)."""
        weights = self.weights() if weights is None else weights
        beside, bounds = self._beside(y, context), self._row_bounds()
        total = torch.zeros_like(y[:, self.n_kept :])
        for rotation, hidden_weight, out_weight in reversed(
            self.weights() if weights is None else weights
        ):
            kept, moved = y[:, : self.n_kept], y[:, self.n_kept :]
            hidden = torch.bmm(hidden_weight, torch.cat([kept, *beside], dim=1)).sigmoid()
            out = torch.bmm(out_weight, hidden)
            moved, log_slope = _Inverse.apply(moved, out, bounds, self.bound)
            total = total - log_slope
            y = torch.bmm(rotation.mT, torch.cat([kept, moved], dim=1))
        return y, total.sum(1)

    @torch.no_grad()
    def arrays(self, model: int, context: Tensor | None = None) -> dict[str, NDArray[np.float64]]:
        """Return one model's arrays for `SplineField`, a context (k,) folded in."""
        hidden_weight = self.hidden_weight[:, model].double()
        hidden_bias = self.hidden_bias[:, model, :, 0].double()
        if self.n_context:
            if context is None:
                raise ValueError(f"expected a context of shape ({self.n_context},), got none")
            hidden_bias = hidden_bias + hidden_weight[..., self.n_kept :] @ context.double()
            hidden_weight = hidden_weight[..., : self.n_kept]
        by_coordinate = (self.n_dims - self.n_kept, 3 * self.n_bins - 1)
        tensors = {
            "hidden_weight": hidden_weight,
            "hidden_bias": hidden_bias,
            "out_weight": self.out_weight[:, model].unflatten(1, by_coordinate),
            "out_bias": self.out_bias[:, model, :, 0].unflatten(1, by_coordinate),
        }
        arrays = {name: t.detach().double().cpu().numpy().copy() for name, t in tensors.items()}
        return {"rotation": self.rotations(model), **arrays}


class _Bins(NamedTuple):
    """Every bin, for q moved coordinates and K bins."""

    gates: Tensor
    """Sigmoids of the conditioner's output, (m, q, 3 K - 1, n)."""
    sizes: Tensor
    """Widths and heights before they are scaled, (m, q, 2, K, n)."""
    slopes: Tensor
    """Slopes at the inner knots, (m, q, K - 1, n)."""


class _Piece(NamedTuple):
    """The bin that a point is in.

    Its slopes (m, q, n) and, in pairs (m, q, 2, n) along the line and along its image, its start
    and its size, with the sum of all sizes.
    """

    start: Tensor
    size: Tensor
    total: Tensor
    left: Tensor
    right: Tensor


class _Point:
    """A point's place xi in its bin, and the terms of eqs. 4 and 5 there, all (m, q, n)."""

    def __init__(self, piece: _Piece, mean: Tensor, xi: Tensor) -> None:
        self.piece, self.mean, self.xi = piece, mean, xi
        self.rest = 1 - xi
        self.product = xi * self.rest
        self.bend = torch.sub(piece.left + piece.right, mean, alpha=2)
        self.mixed = torch.addcmul(mean, self.bend, self.product)

    def image(self) -> Tensor:
        """Return the place in the bin's image, the fraction of eq. 4."""
        return self.xi * torch.addcmul(self.mean * self.xi, self.piece.left, self.rest) / self.mixed

    def steepness(self) -> Tensor:
        """Return the second factor of eq. 5's numerator."""
        piece = self.piece
        ends = piece.left * self.rest * self.rest + piece.right * self.xi * self.xi
        return torch.addcmul(ends, self.mean, self.product, value=2)


def _bins(out: Tensor, bounds: Tensor) -> _Bins:
    """Return the bins for the conditioner's output (m, q (3 K - 1), n)."""
    k = (len(bounds) + 1) // 3
    gates = out.sigmoid().unflatten(1, (-1, len(bounds)))
    exp = torch.mul(gates, 2 * bounds)
    exp[:, :, 2 * k :].sub_(bounds[2 * k :])  # the constant of widths and heights cancels
    exp.exp_()
    sizes = out.new_empty(*exp.shape[:2], 2, k, exp.shape[3])
    sizes[:, :, 0] = exp[:, :, :k]
    torch.mul(exp[:, :, :k], exp[:, :, k : 2 * k], out=sizes[:, :, 1])
    return _Bins(gates, sizes, exp[:, :, 2 * k :])


def _locate(bins: _Bins, inside: Tensor, side: int, reach: float) -> tuple[Tensor, _Piece, Tensor]:
    """Return which knots a value in [-B, B] has passed, its piece, and its place there.

    For a value on the line (side 0) or on its image (side 1).
    """
    ends = bins.sizes.cumsum(3)
    total = ends[:, :, :, -1]
    scaled = (inside + reach).mul_(total[:, :, side]).div_(2 * reach)
    passed = scaled[:, :, None] >= ends[:, :, side, :-1]
    index = passed.sum(2, keepdim=True)
    pair = index[:, :, None].expand(-1, -1, 2, -1, -1)
    size = bins.sizes.gather(3, pair)[:, :, :, 0]
    start = ends.gather(3, pair)[:, :, :, 0].sub_(size)
    edge = torch.ones_like(scaled[:, :, None])  # the outermost knots have slope 1
    slopes = torch.cat([edge, bins.slopes, edge], dim=2)
    left, right = slopes.gather(2, torch.cat([index, index + 1], dim=2)).unbind(2)
    place = (scaled - start[:, :, side]).div_(size[:, :, side])
    return passed, _Piece(start, size, total, left, right), place


def _mean_slope(piece: _Piece) -> Tensor:
    """Return s of eq. 4, the bin's height by its width once these are scaled."""
    ratio = piece.size / piece.total
    return ratio[:, :, 1] / ratio[:, :, 0]


def _position(piece: _Piece, place: Tensor, side: int, reach: float) -> Tensor:
    """Return the value in [-B, B] at a place in the bin."""
    scaled = torch.addcmul(piece.start[:, :, side], piece.size[:, :, side], place)
    return scaled.div_(piece.total[:, :, side]).mul_(2 * reach).sub_(reach)


class _Spline(torch.autograd.Function):
    """The splines, from coordinates (m, q, n) and the conditioner's output (m, q (3 K - 1), n)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, out: Tensor, bounds: Tensor, reach: float) -> Tensor:
        bins, inside = _bins(out, bounds), x.clamp(-reach, reach)
        passed, piece, xi = _locate(bins, inside, 0, reach)
        point = _Point(piece, _mean_slope(piece), xi)
        ctx.save_for_backward(bounds, passed, xi, *bins, *piece)
        ctx.reach = reach
        return _position(piece, point.image(), 1, reach).add_(x).sub_(inside)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> Any:
        bounds, passed, xi, *rest = ctx.saved_tensors
        bins, piece = _Bins(*rest[:3]), _Piece(*rest[3:])
        point = _Point(piece, _mean_slope(piece), xi)
        steep, ratio = point.steepness(), point.mean / point.mixed
        g_out = _gradient(bounds, passed, bins, point, steep, ctx.reach, g, None)
        return g * (ratio * ratio * steep), g_out, None, None


class _Inverse(torch.autograd.Function):
    """The inverse splines, and the log-slopes of the splines at what they return."""

    @staticmethod
    def forward(
        ctx: Any, y: Tensor, out: Tensor, bounds: Tensor, reach: float
    ) -> tuple[Tensor, Tensor]:
        bins, inside = _bins(out, bounds), y.clamp(-reach, reach)
        passed, piece, image = _locate(bins, inside, 1, reach)
        mean = _mean_slope(piece)
        # Eqs. 6 to 8, divided by the bin's height; the root that does not cancel.
        b = piece.left - image * torch.sub(piece.left + piece.right, mean, alpha=2)
        c = image * mean
        root = torch.addcmul(b * b, mean - b, c, value=4).sqrt_()
        xi = 2 * c / (b + root)
        point = _Point(piece, mean, xi)
        ratio = mean / point.mixed
        slope = ratio * ratio * point.steepness()
        ctx.save_for_backward(bounds, passed, xi, slope, inside == y, *bins, *piece)
        ctx.reach = reach
        return _position(piece, xi, 0, reach).add_(y).sub_(inside), slope.log()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor, g_log_slope: Tensor) -> Any:
        bounds, passed, xi, slope, within, *rest = ctx.saved_tensors
        bins, piece = _Bins(*rest[:3]), _Piece(*rest[3:])
        point = _Point(piece, _mean_slope(piece), xi)
        steep = point.steepness()
        # x moves with the log-slope; then y = f(x) at constant y gives x's share to the weights.
        along = piece.total[:, :, 0] / piece.size[:, :, 0] / (2 * ctx.reach)
        g_x = torch.addcmul(g, g_log_slope * _turn(point, steep), along * within)
        g_y = g_x / slope
        g_out = _gradient(bounds, passed, bins, point, steep, ctx.reach, -g_y, g_log_slope)
        return g_y, g_out, None, None


def _turn(point: _Point, steep: Tensor) -> Tensor:
    """Return the derivative of the log-slope by xi."""
    piece, straight = point.piece, point.rest - point.xi
    turn = piece.right * point.xi - piece.left * point.rest + point.mean * straight
    return 2 * (turn / steep - point.bend * straight / point.mixed)


def _gradient(
    bounds: Tensor,
    passed: Tensor,
    bins: _Bins,
    point: _Point,
    steep: Tensor,
    reach: float,
    g_y: Tensor,
    g_log_slope: Tensor | None,
) -> Tensor:
    """Return the gradient by the conditioner's output, at a constant point of the line.

    From those by the spline's value and by its log-slope.
    """
    piece, xi, mean, mixed = point.piece, point.xi, point.mean, point.mixed
    k, image = bins.sizes.shape[3], point.image()
    width, height = piece.size.unbind(2)
    g_position = g_y * (2 * reach) / piece.total[:, :, 1]
    g_image = g_position * height
    g_top = g_image / mixed
    g_mixed = -g_top * image
    g_xi = g_top * mean * steep / mixed
    square = xi * xi
    if g_log_slope is None:
        g_right = g_mixed * point.product
        g_left = torch.addcmul(g_right, g_top, point.product)
        g_mean = g_top * square + torch.sub(g_mixed, g_right, alpha=2)
    else:
        g_steep = g_log_slope / steep
        g_mixed = torch.sub(g_mixed, g_log_slope / mixed, alpha=2)
        both = g_mixed * point.product
        g_right = torch.addcmul(both, g_steep, square)
        g_left = both + g_top * point.product + g_steep * point.rest * point.rest
        g_mean = g_top * square + g_mixed
        g_mean.add_(g_steep * point.product - both + g_log_slope / mean, alpha=2)
        g_xi = torch.addcmul(g_xi, g_log_slope, _turn(point, steep))
    # By the pairs: the bin's start, its size and the sum of all sizes.
    g_log_mean = g_mean * mean
    g_start = torch.stack([-g_xi / width, g_position], dim=2)
    places = torch.stack([xi, image], dim=2)
    signs = torch.stack([-g_log_mean, g_log_mean], dim=2)
    g_size = g_start * places + signs / piece.size
    g_total = -(g_start * (piece.start + piece.size * places) + signs) / piece.total
    # A start is the sum of the sizes before it.
    ones = torch.ones_like(passed[:, :, :1])
    before = torch.cat([ones, passed, ~ones], dim=2).to(xi.dtype)
    after, before = before[:, :, 1:], before[:, :, :-1]  # bins up to and before the point's own
    g_log = torch.addcmul(g_total[:, :, :, None], before[:, :, None], g_size[:, :, :, None])
    g_log.addcmul_(after[:, :, None], (g_start - g_size)[:, :, :, None]).mul_(bins.sizes)
    own = before - after
    gradient = torch.empty_like(bins.gates)
    torch.add(g_log[:, :, 0], g_log[:, :, 1], out=gradient[:, :, :k])
    gradient[:, :, k : 2 * k] = g_log[:, :, 1]
    knots = torch.addcmul(own[:, :, 1:] * g_left[:, :, None], own[:, :, :-1], g_right[:, :, None])
    torch.mul(knots, bins.slopes, out=gradient[:, :, 2 * k :])
    gates = bins.gates
    gradient.mul_(torch.addcmul(gates, gates, gates, value=-1)).mul_(2 * bounds)
    return gradient.flatten(1, 2)
