"""Masked autoregressive and spline layers against zuko, autograd and their NumPy twins."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import zuko
from torch.distributions import AffineTransform

from iflow_gym.baselines.imitation_flow import spline
from iflow_gym.baselines.imitation_flow.autoregressive import AutoregressiveFlow
from iflow_gym.baselines.imitation_flow.fields.autoregressive import (
    AutoregressiveField,
    unit_degrees,
)
from iflow_gym.baselines.imitation_flow.fields.spline import (
    LOG_WIDTH_BOUND,
    SplineField,
    row_bounds,
)
from iflow_gym.baselines.imitation_flow.spline import SplineFlow

BOUND, REACH, N_BINS = 0.3, 1.5, 5
CONFIG = SimpleNamespace(log_scale_bound=BOUND, spline_bound=REACH)
FIELDS = {AutoregressiveFlow: AutoregressiveField, SplineFlow: SplineField}

both = pytest.mark.parametrize("kind", [AutoregressiveFlow, SplineFlow])


def fresh(kind, n_dims, n_context=0, n_layers=3, n_hidden=8, seeds=(0, 1), n_bins=N_BINS):
    extra = {"n_bins": n_bins, "bound": REACH} if kind is SplineFlow else {}
    generators = [torch.Generator().manual_seed(s) for s in seeds]
    return kind(
        n_dims, n_layers, n_hidden, n_context,
        log_scale_bound=BOUND, sharpness=2.0, generators=generators, **extra,
    )  # fmt: skip


def random_flow(kind, n_dims, n_context=0, *, dtype=torch.float64, noise=0.3, **sizes):
    """Return a flow far from its start: masked weights are noise too."""
    flow = fresh(kind, n_dims, n_context, **sizes).to(dtype)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for p in flow.parameters():
            p += noise * torch.randn(p.shape, generator=generator, dtype=dtype)
    return flow


def points(flow, n=7, scale=1.0, seed=1):
    generator = torch.Generator().manual_seed(seed)
    shape, dtype = (flow.n_models, flow.n_dims, n), flow.angles.dtype
    return scale * torch.randn(*shape, generator=generator, dtype=dtype)


def contexts(flow, n=7, seed=2):
    """Return a context for each point, (m, k, n), or None."""
    if not flow.n_context:
        return None
    generator = torch.Generator().manual_seed(seed)
    shape = (flow.n_models, flow.n_context, n)
    return torch.randn(*shape, generator=generator, dtype=flow.angles.dtype)


def without_rotations(flow):
    with torch.no_grad():
        flow.angles.zero_()
    return flow


def jacobian(function, at):
    """Return the Jacobians (n, d, d) of a batched function of one model's points (d, n)."""
    full = torch.autograd.functional.jacobian(function, at)
    return full.diagonal(dim1=1, dim2=3).permute(2, 0, 1)


@both
class TestEveryLayer:
    @pytest.mark.parametrize("n_context", [0, 2])
    @pytest.mark.parametrize("n_dims", [2, 3, 6])
    def test_inverse_undoes_forward_and_log_det_is_the_jacobians(self, kind, n_dims, n_context):
        flow = random_flow(kind, n_dims, n_context)
        z, context = points(flow), contexts(flow)
        back, log_det = flow.inverse(flow(z, context), context)
        torch.testing.assert_close(back, z, rtol=0, atol=1e-11)
        assert log_det.abs().max() > 0.01

        def of_first(v):
            return flow(torch.cat([v[None], z[1:]]), context)[0]

        expected = torch.linalg.slogdet(jacobian(of_first, z[0])).logabsdet
        torch.testing.assert_close(log_det[0], -expected, rtol=0, atol=1e-10)

    @pytest.mark.parametrize(("n_dims", "n_context"), [(2, 0), (3, 2)])
    def test_written_gradients(self, kind, n_dims, n_context):
        flow = random_flow(kind, n_dims, n_context, n_layers=2, n_hidden=3, n_bins=3)
        names, parameters = zip(*flow.named_parameters(), strict=True)
        z = points(flow, n=3)
        z[..., 0] *= 20  # one is outside of every spline
        context = contexts(flow, n=3)
        arguments = (z, context, *parameters)
        for a in arguments:
            if a is not None:
                a.requires_grad_()

        def calling(method):
            def function(z, context, *parameters):
                module = Calling(flow, method)
                named = {f"flow.{n}": p for n, p in zip(names, parameters, strict=True)}
                return torch.func.functional_call(module, named, (z, context))

            return function

        assert torch.autograd.gradcheck(calling("forward"), arguments)
        assert torch.autograd.gradcheck(calling("inverse"), arguments)

    @pytest.mark.parametrize(
        ("dtype", "scale", "rtol"),
        [
            (torch.float32, 1.0, 1e-4),
            (torch.float32, 1e3, 1e-3),
            (torch.float64, 1.0, 1e-12),
            (torch.float64, 1e3, 1e-11),
        ],
    )
    def test_round_trip_of_a_deep_flow(self, kind, dtype, scale, rtol):
        """Relative to a point's size; 3 to 100 times the errors of these weights."""
        flow = random_flow(kind, 3, 1, n_layers=24, n_hidden=16, dtype=dtype, noise=0.03)
        y, context = points(flow, 200, scale).requires_grad_(), contexts(flow, 200)
        z, log_det = flow.inverse(y, context)
        back = flow(z, context)
        size = y.abs().amax(1, keepdim=True).clamp_min(1)
        assert ((back - y).abs() / size).max() < rtol
        (log_det.sum() + back.square().sum()).backward()
        for tensor in (z, log_det, y.grad, *(p.grad for p in flow.parameters())):
            assert torch.isfinite(tensor).all()

    @pytest.mark.parametrize("n_context", [0, 2])
    @pytest.mark.parametrize("n_dims", [2, 3, 6])
    def test_numpy_twin_with_the_context_folded_in(self, kind, n_dims, n_context):
        flow = random_flow(kind, n_dims, n_context, n_hidden=11)
        z = points(flow, scale=2.0)
        context = None if not n_context else contexts(flow, 1).expand(-1, -1, z.shape[2])
        with torch.no_grad():
            y = flow(z, context)
            back, log_det = flow.inverse(y, context)
        model = 1
        arrays = flow.arrays(model, None if context is None else context[model, :, 0])
        assert tuple(arrays) == FIELDS[kind].NAMES
        field = FIELDS[kind](arrays, CONFIG)
        assert field.n_dims == n_dims
        given, tangent = z[model].T.numpy(), points(flow, seed=3)[model]
        untouched = given.copy()
        np.testing.assert_allclose(field.forward(given), y[model].T, rtol=0, atol=1e-12)
        inverse, inverse_log_det = field.inverse(y[model].T.numpy())
        np.testing.assert_allclose(inverse, back[model].T, rtol=0, atol=1e-12)
        np.testing.assert_allclose(inverse_log_det, log_det[model], rtol=0, atol=1e-12)

        def of_model(v):
            one = None if context is None else context[model : model + 1]
            return subset(flow, model)(v[None], one)[0]

        expected = torch.einsum("nij,jn->ni", jacobian(of_model, z[model]), tangent)
        value, pushed = field.push_forward(given, tangent.T.numpy())
        np.testing.assert_allclose(value, y[model].T, rtol=0, atol=1e-12)
        np.testing.assert_allclose(pushed, expected, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(given, untouched)

    @pytest.mark.parametrize(("scale", "rtol"), [(1.0, 1e-12), (1e3, 1e-11)])
    def test_numpy_twin_is_exact_whatever_precision_training_had(self, kind, scale, rtol):
        flow = random_flow(kind, 3, n_layers=24, n_hidden=16, noise=0.03, dtype=torch.float32)
        field = FIELDS[kind](flow.arrays(0), CONFIG)
        y = scale * np.random.default_rng(0).normal(size=(200, 3))
        z, log_det = field.inverse(y)
        assert np.isfinite(log_det).all()
        size = np.maximum(np.abs(y).max(axis=1, keepdims=True), 1)
        assert np.abs((field.forward(z) - y) / size).max() < rtol

    def test_a_model_starts_the_same_whatever_is_beside_it(self, kind):
        two, alone = fresh(kind, 3, 2, seeds=(9, 5)), fresh(kind, 3, 2, seeds=(5,))
        for a, b in zip(alone.parameters(), two.parameters(), strict=True):
            torch.testing.assert_close(a[:, 0], b[:, 1], rtol=0, atol=0)
            assert not a.eq(0).all() or b.eq(0).all()

    def test_a_model_does_not_see_the_one_beside_it(self, kind):
        flow = random_flow(kind, 3)
        z = points(flow)
        changed = torch.cat([z[:1] + 1, z[1:]])
        torch.testing.assert_close(flow(changed)[1], flow(z)[1], rtol=0, atol=1e-14)
        assert (flow(changed)[0] - flow(z)[0]).abs().min() > 1e-3

    def test_every_layer_hears_the_context(self, kind):
        flow = random_flow(kind, 3, 2, n_layers=1)
        z, context = points(flow), contexts(flow)
        moved = (flow(z, context + 1) - flow(z, context)).abs()
        assert moved.amax(dim=(0, 2))[-2:].min() > 1e-3
        with pytest.raises(ValueError, match=r"expected a context of shape \(2,\), got none"):
            flow.arrays(0)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda a: a.pop("out_bias"), "expected arrays .* got none of"),
            (lambda a: a.update(rotation=a["rotation"][0]), "axes, got"),
            (lambda a: a.update(rotation=a["rotation"][:, :2]), "expected .* of shapes .* got"),
            (lambda a: a.update(out_bias=a["out_bias"][:-1]), "expected .* of shapes .* got"),
            (lambda a: a.update({k: v[:0] for k, v in a.items()}), "at least one layer"),
            (lambda a: a["hidden_bias"].fill(np.nan), "expected finite hidden_bias, got nan"),
        ],
    )
    def test_twin_refuses_arrays_that_do_not_fit(self, kind, change, message):
        arrays = random_flow(kind, 3).arrays(0)
        change(arrays)
        with pytest.raises(ValueError, match=message):
            FIELDS[kind](arrays, CONFIG)


class Calling(torch.nn.Module):
    """A flow whose call is one of its methods."""

    def __init__(self, flow, method):
        super().__init__()
        self.flow, self.method = flow, method

    def forward(self, *args):
        return getattr(self.flow, self.method)(*args)


def subset(flow, model):
    """Return the flow of one of the models."""
    kind = type(flow)
    hidden = flow.hidden_weight.shape[2]
    one = fresh(kind, flow.n_dims, flow.n_context, flow.n_layers, hidden, seeds=(0,)).double()
    with torch.no_grad():
        for a, b in zip(one.parameters(), flow.parameters(), strict=True):
            a.copy_(b[:, model : model + 1])
    return one


class TestAutoregressive:
    @pytest.mark.parametrize("n_dims", [2, 3, 6])
    def test_each_coordinate_depends_on_all_before_it_and_none_after(self, n_dims):
        flow = without_rotations(random_flow(AutoregressiveFlow, n_dims, n_layers=1))
        z = points(flow)
        y = flow(z).detach()
        directions = (flow, z), (lambda v: flow.inverse(v)[0], y)
        for function, at in directions:
            rows = jacobian(lambda v: function(torch.cat([v[None], at[1:]]))[0], at[0])  # noqa: B023
            upper, lower = torch.triu_indices(n_dims, n_dims, 1), torch.tril_indices(n_dims, n_dims)
            assert (rows[:, upper[0], upper[1]] == 0).all()
            assert (rows[:, lower[0], lower[1]].abs().amax(0) > 1e-4).all()

    @pytest.mark.parametrize("n_context", [0, 2])
    @pytest.mark.parametrize("n_dims", [2, 3, 6])
    def test_a_layer_is_zukos_transform_of_zukos_masked_network(self, n_dims, n_context):
        """Both are given weights without zeros, and must mask the same."""
        groups = n_dims if n_context else n_dims - 1
        flow = random_flow(AutoregressiveFlow, n_dims, n_context, n_layers=1, n_hidden=4 * groups)
        z, context, m = points(flow), contexts(flow), 1
        before = torch.arange(n_dims)[:, None] > torch.arange(n_dims - 1)
        adjacency = torch.cat([torch.ones(n_dims, n_context, dtype=torch.bool), before], dim=1)
        network = zuko.nn.MaskedMLP(
            adjacency.repeat_interleave(2, dim=0), [4 * groups], activation=torch.nn.Tanh
        ).double()
        # zuko deals units to the degrees in turn; ours are sorted by degree.
        order = torch.arange(4 * groups).reshape(groups, 4).T.flatten()
        with torch.no_grad():
            network[0].weight.copy_(flow.hidden_weight[0, m, order])
            network[0].bias.copy_(flow.hidden_bias[0, m, order, 0])
            network[2].weight.copy_(flow.out_weight[0, m][:, order])
            network[2].bias.copy_(flow.out_bias[0, m, :, 0])

        def univariate(y):
            seen = y[:, :-1] if context is None else torch.cat([context[m].T, y[:, :-1]], dim=1)
            raw, shift = network(seen).unflatten(1, (n_dims, 2)).unbind(2)
            scale = torch.exp(-BOUND * torch.tanh(raw / BOUND))
            affine = AffineTransform(-shift * scale, scale)
            return zuko.transforms.DependentTransform(affine, 1)

        oracle = zuko.transforms.AutoregressiveTransform(univariate, passes=n_dims)
        y = flow(z, context)
        back, log_det = flow.inverse(y, context)
        rotated = (flow.orthogonal()[0] @ z)[m].T
        expected, expected_log_det = oracle.call_and_ladj(y[m].T)
        tolerance = {"rtol": 0, "atol": 1e-12}
        torch.testing.assert_close(y[m].T, oracle.inv(rotated), **tolerance)
        torch.testing.assert_close((flow.orthogonal()[0] @ back)[m].T, expected, **tolerance)
        torch.testing.assert_close(log_det[m], expected_log_det, **tolerance)

    @pytest.mark.parametrize("name", ["hidden_weight", "out_weight"])
    def test_twin_refuses_a_weight_that_the_mask_forbids(self, name):
        arrays = random_flow(AutoregressiveFlow, 3).arrays(0)
        # The first unit sees y_1 alone; no unit may be seen by y_1's own coefficients.
        arrays[name][(1, 0, 1) if name == "hidden_weight" else (1, 0, 0, -1)] = 1e-3
        with pytest.raises(ValueError, match=f"expected {name} 0 where"):
            AutoregressiveField(arrays, CONFIG)

    def test_degrees(self):
        assert unit_degrees(5, 4).tolist() == [1, 1, 2, 2, 3]
        assert unit_degrees(3, 2).tolist() == [1, 1, 1]
        with pytest.raises(ValueError, match=r"expected n_hidden >= 3.* got 2"):
            fresh(AutoregressiveFlow, 4, n_hidden=2)

    def test_log_scales_are_bounded(self):
        flow = without_rotations(random_flow(AutoregressiveFlow, 3, n_layers=1))
        with torch.no_grad():
            flow.out_bias[:, :, ::2] = 1e3
        _, log_det = flow.inverse(points(flow))
        torch.testing.assert_close(log_det, torch.full_like(log_det, -3 * BOUND))


def random_splines(n=400, scale=1.0, n_bins=N_BINS):
    """Return coordinates and outputs of a conditioner, before and after its bounds."""
    generator = torch.Generator().manual_seed(4)
    raw = scale * torch.randn(1, 2, 3 * n_bins - 1, n, generator=generator, dtype=torch.float64)
    x = 2 * REACH * (2 * torch.rand(1, 2, n, generator=generator, dtype=torch.float64) - 1)
    bounds = torch.as_tensor(row_bounds(n_bins, BOUND))[:, None]
    return x, (2 * raw / bounds).flatten(1, 2), bounds, bounds * torch.tanh(raw / bounds)


class TestSpline:
    @pytest.mark.parametrize("n_bins", [2, 5, 8])
    def test_is_zukos(self, n_bins):
        x, out, bounds, squashed = random_splines(n_bins=n_bins)
        log_widths, log_slopes, knots = squashed.split([n_bins, n_bins, n_bins - 1], dim=2)
        limit = -math.log(1e-6)  # zuko's own bounds are undone

        def unbounded(value, factor):
            return (value / (1 - (factor * value / limit).abs())).movedim(2, -1)

        oracle = zuko.transforms.MonotonicRQSTransform(
            unbounded(log_widths, 2), unbounded(log_widths + log_slopes, 2), unbounded(knots, 1),
            bound=REACH, slope=1e-6,
        )  # fmt: skip
        expected, expected_log_slope = oracle.call_and_ladj(x)
        y = spline._Spline.apply(x, out, bounds, REACH)
        torch.testing.assert_close(y, expected, rtol=0, atol=1e-12)
        back, log_slope = spline._Inverse.apply(expected, out, bounds, REACH)
        torch.testing.assert_close(back, oracle.inv(expected), rtol=0, atol=1e-12)
        torch.testing.assert_close(log_slope, expected_log_slope, rtol=0, atol=1e-12)
        outside = x.abs() > REACH
        assert 0.4 < outside.double().mean() < 0.6
        assert (y == x)[outside].double().mean() > 0.5  # the others to rounding
        torch.testing.assert_close(y[outside], x[outside], rtol=0, atol=1e-14)

    @pytest.mark.parametrize("scale", [0.3, 3.0, 100.0])
    def test_slopes_are_bounded(self, scale):
        x, out, bounds, _ = random_splines(20_000, scale)
        y = spline._Spline.apply(x, out, bounds, REACH)
        _, log_slope = spline._Inverse.apply(y, out, bounds, REACH)
        peak = math.log(math.cosh(BOUND))
        assert log_slope.max() <= 2 * BOUND - peak
        assert log_slope.min() >= -2 * BOUND - peak

    def test_slope_bounds_are_those_of_the_steepest_and_flattest_pieces(self):
        """A piece of slope s between knots of slope d has 2 s^2 / (s + d) in its middle."""
        one = torch.ones((), dtype=torch.float64)
        for sign in (1, -1):
            steep, flat = math.exp(sign * BOUND), math.exp(-sign * BOUND)
            ends = torch.stack([0 * one, 0 * one])
            sizes = torch.stack([one, steep * one])
            piece = spline._Piece(ends, sizes, sizes, flat * one, flat * one)
            point = spline._Point(piece, steep * one, one / 2)
            slope = (point.mean / point.mixed) ** 2 * point.steepness()
            expected = sign * 2 * BOUND - math.log(math.cosh(BOUND))
            assert math.log(slope) == pytest.approx(expected, abs=1e-12)

    def test_no_bin_is_much_narrower_than_another(self):
        _, out, bounds, _ = random_splines(scale=100.0)
        bins = spline._bins(out, bounds)
        widths = bins.sizes[:, :, 0] / bins.sizes[:, :, 0].sum(2, keepdim=True)
        assert widths.min() >= math.exp(-2 * LOG_WIDTH_BOUND) / N_BINS

    def test_one_bin(self):
        """Its ends are fixed with slope 1: the identity."""
        x, out, bounds, _ = random_splines(n_bins=1)
        y = spline._Spline.apply(x, out, bounds, REACH)
        torch.testing.assert_close(y, x, rtol=0, atol=1e-14)

    def test_far_away_a_layer_is_a_rotation(self):
        flow = random_flow(SplineFlow, 3, n_layers=1)
        z = points(flow, scale=1e3)
        z[z.abs() < 10] = 10
        rotated = flow.orthogonal()[0] @ z
        far = rotated.abs().amin(1) > REACH
        assert far.any()
        difference = (flow(z) - rotated).abs().amax(1)
        assert difference[far].max() < 1e-12
