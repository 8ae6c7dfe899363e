"""Affine coupling layers: their hand-written gradients, autograd's Jacobians, zuko."""

import pytest
import torch
import zuko
from torch.distributions import AffineTransform

from iflow_gym.baselines.imitation_flow import coupling
from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow


def random_flow(n_dims, n_models=1, n_layers=4, n_context=0, seed=0, dtype=torch.float64):
    flow = CouplingFlow(
        n_dims, n_layers, 6, n_context, log_scale_bound=0.3, sharpness=2.0,
        generators=[torch.Generator().manual_seed(seed + i) for i in range(n_models)],
    ).to(dtype)  # fmt: skip
    noise = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in (flow.out_weight, flow.out_bias):
            p += 0.3 * torch.randn(p.shape, generator=noise, dtype=dtype)
    return flow


def drawn(*shape, seed=1):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("few", [0, 10], ids=["torch", "numpy"])
@pytest.mark.parametrize(("n_dims", "n_context"), [(2, 0), (3, 2), (5, 1)])
def test_written_gradients_are_the_derivatives(n_dims, n_context, few, monkeypatch):
    """Against finite differences: of states, context and every parameter, both ways."""
    monkeypatch.setattr(coupling, "FEW_MODELS", few)
    flow = random_flow(n_dims, n_models=2, n_layers=2, n_context=n_context)
    names = [name for name, _ in flow.named_parameters()]
    states = drawn(2, n_dims, 3).requires_grad_()
    context = drawn(2, n_context, 3, seed=2).requires_grad_() if n_context else None

    class Inverse(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.flow = flow

        def forward(self, *inputs):
            return self.flow.inverse(*inputs)

    def forward(states, context, *parameters):
        call = torch.func.functional_call
        return call(flow, dict(zip(names, parameters, strict=True)), (states, context))

    def inverse(states, context, *parameters):
        named = {f"flow.{name}": p for name, p in zip(names, parameters, strict=True)}
        return torch.func.functional_call(Inverse(), named, (states, context))

    inputs = (states, context, *flow.parameters())
    assert torch.autograd.gradcheck(forward, inputs)
    assert torch.autograd.gradcheck(inverse, inputs)


def test_one_by_one_is_as_a_batch(monkeypatch):
    flow, z = random_flow(3, n_models=3, n_context=1), drawn(3, 3, 20)
    context = drawn(3, 1, 20, seed=3)
    results = []
    for few in (0, 10):
        monkeypatch.setattr(coupling, "FEW_MODELS", few)
        results.append((flow(z, context), *flow.inverse(z, context)))
    for batch, single in zip(*results, strict=True):
        torch.testing.assert_close(batch, single, rtol=0, atol=1e-13)


@pytest.mark.parametrize("n_dims", [2, 3, 5])
def test_inverse_undoes_forward_and_log_det_is_the_jacobians(n_dims):
    flow = random_flow(n_dims)
    z = drawn(1, n_dims, 7)
    y = flow(z)
    back, log_det = flow.inverse(y)
    torch.testing.assert_close(back, z, rtol=0, atol=1e-12)
    for i in range(7):
        jacobian = torch.autograd.functional.jacobian(
            lambda v: flow.inverse(v[None, :, None])[0][0, :, 0], y[0, :, i].detach()
        )
        expected = torch.linalg.slogdet(jacobian).logabsdet
        torch.testing.assert_close(log_det[0, i], expected, rtol=0, atol=1e-10)


def test_a_layer_is_zukos_affine_coupling_behind_a_rotation():
    flow = random_flow(4, n_layers=1)
    z = drawn(1, 4, 5)

    def conditioner(kept):
        weight, bias = flow.hidden_weight[0, 0], flow.hidden_bias[0, 0, :, 0]
        hidden = torch.tanh(kept @ weight.T + bias)
        raw, shift = (hidden @ flow.out_weight[0, 0].T + flow.out_bias[0, 0, :, 0]).chunk(2, -1)
        log_scale = 0.3 * torch.tanh(raw / 0.3)
        return zuko.transforms.DependentTransform(AffineTransform(shift, torch.exp(log_scale)), 1)

    oracle = zuko.transforms.CouplingTransform(
        conditioner, torch.tensor([True, True, False, False])
    )
    rotated = (flow.orthogonal()[0] @ z)[0].T
    expected, log_det = oracle.call_and_ladj(rotated)
    y = flow(z)
    torch.testing.assert_close(y[0].T, expected)
    torch.testing.assert_close(flow.inverse(y)[1][0], -log_det)


@pytest.mark.parametrize("n_dims", [2, 3, 6])
def test_transforms_are_orthogonal(n_dims):
    rotations = random_flow(n_dims).orthogonal()
    eye = torch.eye(n_dims, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, eye, rtol=0, atol=1e-12)


def test_a_model_is_the_same_whatever_is_beside_it():
    two = random_flow(2, n_models=2, seed=4)
    generators = [torch.Generator().manual_seed(5)]
    alone = CouplingFlow(2, 4, 6, log_scale_bound=0.3, sharpness=2.0, generators=generators)
    for name in ("angles", "hidden_weight", "hidden_bias"):
        expected = getattr(alone, name)[:, 0].double()
        torch.testing.assert_close(getattr(two, name)[:, 1], expected)


def test_far_away_every_value_is_finite_and_the_inverse_holds():
    flow = random_flow(2, n_layers=24)
    y = 1e3 * drawn(1, 2, 50)
    z, log_det = flow.inverse(y)
    assert torch.isfinite(log_det).all()
    torch.testing.assert_close(flow(z), y, rtol=1e-9, atol=0)
    single = flow.float()
    z, _ = single.inverse(y.float())
    torch.testing.assert_close(single(z), y.float(), rtol=1e-4, atol=1e-2)
