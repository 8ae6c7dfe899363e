"""The NumPy flow against its torch twin, and against autograd."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from imitation_flow_parts import as_field, flow_arrays, random_flow

from iflow_gym.baselines.imitation_flow.fields import coupling
from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField

DIMENSIONS = [2, 3, 6]


def columns(states):
    return torch.as_tensor(states.T[None].copy())


@pytest.mark.parametrize("d", DIMENSIONS)
class TestAgainstTorch:
    def test_forward_inverse_and_log_det(self, d):
        flow = random_flow(d)
        field = as_field(flow_arrays(flow))
        z = np.random.default_rng(0).normal(size=(40, d))
        with torch.no_grad():
            y = flow(columns(z))
            back, log_det = flow.inverse(y)
        expected = y[0].T.numpy()
        np.testing.assert_allclose(field.forward(z), expected, rtol=0, atol=1e-12)
        got, got_log_det = field.inverse(expected)
        np.testing.assert_allclose(got, back[0].T.numpy(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(got_log_det, log_det[0].numpy(), rtol=0, atol=1e-12)

    def test_push_forward_is_the_jacobian_of_autograd(self, d):
        flow = random_flow(d)
        field = as_field(flow_arrays(flow))
        rng = np.random.default_rng(0)
        z, dz = rng.normal(size=(2, 20, d))
        point = columns(z).requires_grad_()
        y = flow(point)
        rows = [torch.autograd.grad(y[0, i].sum(), point, retain_graph=True)[0] for i in range(d)]
        expected = [(row[0].T.numpy() * dz).sum(1) for row in rows]
        got, tangent = field.push_forward(z, dz)
        np.testing.assert_allclose(got, y[0].T.detach().numpy(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(tangent, np.stack(expected, axis=1), rtol=0, atol=1e-11)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_far_away_every_value_is_finite_and_the_inverse_holds(d):
    field = as_field(flow_arrays(random_flow(d, n_layers=24)))
    y = 1e3 * np.random.default_rng(0).normal(size=(50, d))
    with np.errstate(all="raise", under="ignore"):
        z, log_det = field.inverse(y)
        back, tangent = field.push_forward(z, np.ones_like(z))
    assert np.isfinite(log_det).all()
    assert np.isfinite(tangent).all()
    tolerance = 1e-10 * np.abs(y).max()
    np.testing.assert_allclose(back, y, rtol=0, atol=tolerance)
    np.testing.assert_allclose(field.forward(z), y, rtol=0, atol=tolerance)


def test_a_batch_in_blocks_is_the_batch(monkeypatch):
    field = as_field(flow_arrays(random_flow(3)))
    z, dz = np.random.default_rng(0).normal(size=(2, 25, 3))
    whole = [field.forward(z), *field.inverse(z), *field.push_forward(z, dz)]
    monkeypatch.setattr(coupling, "BLOCK", 10)
    blocks = [field.forward(z), *field.inverse(z), *field.push_forward(z, dz)]
    for a, b in zip(blocks, whole, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)
    assert field.forward(z[:0]).shape == (0, 3)
    assert [a.shape for a in field.inverse(z[:0])] == [(0, 3), (0,)]


def test_inputs_stay_as_they_are():
    field = as_field(flow_arrays(random_flow(2)))
    z = np.random.default_rng(0).normal(size=(5, 2))
    before = z.copy()
    field.forward(z), field.inverse(z), field.push_forward(z, z)
    np.testing.assert_array_equal(z, before)


@pytest.mark.parametrize("d", [2, 5])
def test_threads_do_not_meet(d):
    """By tables, which the first of them make, and by units."""
    field, fresh = (as_field(flow_arrays(random_flow(d))) for _ in range(2))
    batches = np.random.default_rng(0).normal(size=(16, 800, d))
    alone = [fresh.forward(z) for z in batches]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(field.forward, batches))
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize("d", [2, 3])
def test_a_context_is_a_bias(d):
    flow = random_flow(d, n_context=2)
    context = np.array([0.4, -0.7])
    field = as_field(flow.arrays(0, torch.as_tensor(context)))
    z = np.random.default_rng(0).normal(size=(9, d))
    with torch.no_grad():
        expected = flow(columns(z), torch.as_tensor(context)[None, :, None].expand(1, 2, 9))
    np.testing.assert_allclose(field.forward(z), expected[0].T.numpy(), rtol=0, atol=1e-12)


class TestArraysFromAnywhere:
    @pytest.mark.parametrize("name", CouplingField.NAMES)
    def test_shapes(self, name):
        arrays = flow_arrays(random_flow(3))
        arrays[name] = arrays[name][..., :-1]
        with pytest.raises(ValueError, match=r"expected .* of shapes .*, got"):
            as_field(arrays)

    def test_axes(self):
        arrays = flow_arrays(random_flow(3))
        arrays["hidden_bias"] = arrays["hidden_bias"][..., None]
        with pytest.raises(ValueError, match="with 3, 3, 2, 3, 2 axes, got"):
            as_field(arrays)

    def test_numbers(self):
        arrays = flow_arrays(random_flow(2))
        arrays["out_bias"][0, 0] = np.nan
        with pytest.raises(ValueError, match="expected finite numbers in out_bias"):
            as_field(arrays)

    def test_rotations(self):
        arrays = flow_arrays(random_flow(2))
        arrays["rotation"][1] *= 1.001
        with pytest.raises(ValueError, match="expected orthogonal rotations, got"):
            as_field(arrays)

    def test_one_dimension(self):
        arrays = flow_arrays(random_flow(2))
        arrays["rotation"] = np.ones((8, 1, 1))
        with pytest.raises(ValueError, match="at least 2 dimensions, got 1"):
            as_field(arrays)

    def test_bound(self):
        with pytest.raises(ValueError, match="expected log_scale_bound > 0, got 0"):
            as_field(flow_arrays(random_flow(2)), bound=0)

    def test_a_missing_array(self):
        arrays = flow_arrays(random_flow(2))
        del arrays["out_bias"]
        with pytest.raises(KeyError, match="out_bias"):
            as_field(arrays)
