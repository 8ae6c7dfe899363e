"""Nodes with gradients of their own against matrix exponentials, linear solves and autograd."""

import numpy as np
import pytest
import torch

from iflow_gym.baselines.imitation_flow import planar
from iflow_gym.baselines.imitation_flow.latent import LinearLatent
from iflow_gym.baselines.imitation_flow.path_error import PathError, path_error
from iflow_gym.baselines.imitation_flow.planar import Propagate, TransitionLogProb

MODELS = pytest.mark.parametrize("n_models", [1, 3])
LIBRARIES = pytest.mark.parametrize("library", [np, torch])
DRIFTS = {
    "real": [[-3.0, 1.0], [0.5, -2.0]],
    "complex": [[-1.0, 4.0], [-3.0, -0.5]],
    "nearly equal": [[-2.0, 1e-3], [-1e-3, -2.0]],
}


@pytest.fixture
def in_library(monkeypatch, library):
    """Run nodes in NumPy or in torch, as on a GPU."""

    def arrays_of(*tensors):
        if library is np:
            return np, [t.detach().numpy() for t in tensors]
        return torch, [t.detach() for t in tensors]

    monkeypatch.setattr(planar, "arrays_of", arrays_of)
    monkeypatch.setattr("iflow_gym.baselines.imitation_flow.path_error.arrays_of", arrays_of)


def inputs(kind, n_models, q=6, p=4):
    generator = torch.Generator().manual_seed(1)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    drift = torch.tensor(DRIFTS[kind], dtype=torch.float64) + 0.0 * normal(n_models, 1, 1)
    if n_models > 1:  # models of both kinds side by side
        drift[1] = torch.tensor(DRIFTS["real" if kind == "complex" else "complex"])
    noise = torch.diag_embed(0.1 + torch.rand(n_models, 2, generator=generator).double())
    times = 0.003 + torch.rand(n_models, q, generator=generator).double() ** 3
    z0, z1 = normal(n_models, 2, q, p), normal(n_models, 2, q, p)
    return [t.requires_grad_() for t in (drift, noise, z0, z1)], times, normal(n_models, q, p)


def reached(drift, z, times):
    forward = torch.linalg.matrix_exp(drift[:, None] * times[..., None, None])
    return forward, torch.einsum("mqij,mjqp->miqp", forward, z)


def log_prob(drift, noise, z0, z1, times):
    """By the vectorised Lyapunov equation and torch's normal distribution."""
    eye = torch.eye(2, dtype=torch.float64)
    sums = torch.stack([torch.kron(a, eye) + torch.kron(eye, a) for a in drift])
    stationary = torch.linalg.solve(sums, -noise.reshape(-1, 4, 1)).reshape(-1, 1, 2, 2)
    forward, mean = reached(drift, z0, times)
    covariance = stationary - forward @ stationary @ forward.mT
    covariance = (covariance + covariance.mT) / 2
    normal = torch.distributions.MultivariateNormal(
        torch.zeros(2, dtype=torch.float64), covariance[:, :, None]
    )
    return normal.log_prob((z1 - mean).permute(0, 2, 3, 1))


@MODELS
@LIBRARIES
@pytest.mark.parametrize("kind", DRIFTS)
def test_propagation_and_its_gradient(kind, n_models, library, in_library):
    (drift, _, z, _), times, weights = inputs(kind, n_models)
    made, expected = Propagate.apply(drift, z, times), reached(drift, z, times)[1]
    torch.testing.assert_close(made, expected, rtol=1e-9, atol=1e-11)
    weights = torch.stack([weights, 1 - weights], 1)
    found = torch.autograd.grad((made * weights).sum(), [drift, z])
    wanted = torch.autograd.grad((expected * weights).sum(), [drift, z])
    torch.testing.assert_close(found, wanted, rtol=1e-8, atol=1e-9)


@MODELS
@LIBRARIES
@pytest.mark.parametrize("kind", DRIFTS)
def test_transition_densities_and_their_gradient(kind, n_models, library, in_library):
    (drift, noise, z0, z1), times, weights = inputs(kind, n_models)
    made = TransitionLogProb.apply(drift, noise, z0, z1, times)
    expected = log_prob(drift, noise, z0, z1, times)
    torch.testing.assert_close(made, expected, rtol=1e-8, atol=1e-8)
    variables = [drift, noise, z0, z1]
    found = list(torch.autograd.grad((made * weights).sum(), variables))
    wanted = list(torch.autograd.grad((expected * weights).sum(), variables))
    found[1], wanted[1] = (g.diagonal(dim1=1, dim2=2) for g in (found[1], wanted[1]))
    for mine, autograds in zip(found, wanted, strict=True):
        scale = float(autograds.abs().max())
        torch.testing.assert_close(mine, autograds, rtol=1e-6, atol=1e-8 * scale)


def test_the_drift_and_its_gradient():
    latent = LinearLatent(3, 3, min_decay=0.05).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in latent.parameters():
            p += torch.randn(p.shape, generator=generator, dtype=torch.float64)
    lower, skew = torch.tril(latent.factor), latent.skew
    expected = -(lower @ lower.mT + 0.05 * torch.eye(3, dtype=torch.float64)) + skew - skew.mT
    torch.testing.assert_close(latent.drift(), expected, rtol=1e-12, atol=1e-12)
    weights = torch.randn(3, 3, 3, generator=generator, dtype=torch.float64)
    variables = [latent.factor, latent.skew]
    found = torch.autograd.grad((latent.drift() * weights).sum(), variables)
    wanted = torch.autograd.grad((expected * weights).sum(), variables)
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)


@LIBRARIES
@pytest.mark.parametrize(("power", "timing", "end"), [(1.0, 1.0, 0.0), (3.0, 0.7, 0.7)])
def test_the_error_of_a_path_and_its_gradient(power, timing, end, library, in_library):
    generator = torch.Generator().manual_seed(2)
    made, target, along = (
        torch.randn(2, 3, 5 * 8, generator=generator, dtype=torch.float64) for _ in range(3)
    )
    made.requires_grad_()
    loss = PathError.apply(made, target, along, 5, power, timing, end)
    error, step = (x.unflatten(-1, (5, 8)) for x in (made - target, along))
    unit = step / step.norm(dim=1, keepdim=True)
    late = (error * unit).sum(1).square()
    squares = error.square().sum(1)
    beside = squares - late
    mean = (beside + timing * late)[..., :-1].pow(power).mean(-1).pow(1 / power)
    expected = mean.mean(-1) + end * squares[..., -1].mean(-1)
    torch.testing.assert_close(loss, expected, rtol=1e-9, atol=0)
    weights = torch.tensor([1.0, -2.0], dtype=torch.float64)
    (found,) = torch.autograd.grad((loss * weights).sum(), [made])
    (wanted,) = torch.autograd.grad((expected * weights).sum(), [made])
    torch.testing.assert_close(found, wanted, rtol=1e-8, atol=1e-12)


def test_a_perfect_path_has_no_slope():
    error = np.zeros((1, 2, 3, 5))
    loss, gradient = path_error(np, error, np.ones_like(error), 3.0, 0.7, 0.7)
    assert loss[0] < 1e-5
    np.testing.assert_array_equal(gradient, 0.0)
