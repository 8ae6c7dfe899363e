"""Random flows and mean dynamics for the tests of what runs a trained model."""

from types import SimpleNamespace

import numpy as np
import torch

from iflow_gym.baselines.imitation_flow.autoregressive import AutoregressiveFlow
from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow
from iflow_gym.baselines.imitation_flow.emissions import FIELDS
from iflow_gym.baselines.imitation_flow.fields.latents import CycleField, LinearField
from iflow_gym.baselines.imitation_flow.realtime import MeanDynamics
from iflow_gym.baselines.imitation_flow.spline import SplineFlow

BOUND = 0.3
SPLINE = {"n_bins": 8, "bound": 2.0}
EMISSIONS = ("coupling", "autoregressive", "spline")


def random_flow(d, n_layers=8, n_hidden=12, seed=0, n_context=0, emission="coupling"):
    """Return the torch flow of one model in float64."""
    generator = torch.Generator().manual_seed(seed)
    kind = {"coupling": CouplingFlow, "autoregressive": AutoregressiveFlow, "spline": SplineFlow}
    flow = kind[emission](
        d, n_layers, n_hidden, n_context, log_scale_bound=BOUND, sharpness=2.0,
        generators=[generator], **(SPLINE if emission == "spline" else {}),
    ).double()  # fmt: skip
    with torch.no_grad():
        for parameter in (flow.out_weight, flow.out_bias):
            draw = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter += 0.15 * draw
    return flow


def flow_arrays(flow):
    with torch.no_grad():
        arrays = {
            "rotation": flow.orthogonal()[:, 0],
            "hidden_weight": flow.hidden_weight[:, 0],
            "hidden_bias": flow.hidden_bias[:, 0, :, 0],
            "out_weight": flow.out_weight[:, 0],
            "out_bias": flow.out_bias[:, 0, :, 0],
        }
        return {name: value.numpy().copy() for name, value in arrays.items()}


def as_field(arrays, bound=BOUND, emission="coupling"):
    config = SimpleNamespace(log_scale_bound=bound, spline_bound=SPLINE["bound"])
    return FIELDS[emission](arrays, config)


def linear_latent(d, seed=0, drift=None):
    if drift is None:
        draw = np.random.default_rng(seed).normal(size=(d, d))
        drift = draw - draw.T - np.tril(draw) @ np.tril(draw).T - 0.5 * np.eye(d)
    return LinearField(np.asarray(drift), np.eye(d))


def cycle_latent(d):
    return CycleField(np.linspace(2, 3, d - 1), np.array([-5.0]), np.array([1.2]), np.full(d, 0.1))


def dynamics(d, latent=None, seed=0, n_layers=8, emission="coupling"):
    rng = np.random.default_rng(seed)
    flow = random_flow(d, n_layers=n_layers, seed=seed, emission=emission)
    arrays = flow_arrays(flow) if emission == "coupling" else flow.arrays(0)
    field = as_field(arrays, emission=emission)
    latent = linear_latent(d) if latent is None else latent
    cyclic = isinstance(latent, CycleField)
    attractor = np.zeros(d) if cyclic else field.inverse(np.zeros((1, d)))[0][0]
    frame = 30 * np.eye(d) + rng.normal(size=(d, d))
    return MeanDynamics(field, latent, attractor, 10 * rng.normal(size=d), frame, 5.0)


def encoded(parts, x):
    y = np.linalg.solve(parts.frame, (x - parts.origin).T).T
    return parts.flow.inverse(y)[0] - parts.attractor


def step(parts, x, dt):
    """The batched step, (n, d), for dt (n,)."""
    z = parts.latent.propagate(encoded(parts, x), dt / parts.time)
    return parts.flow.forward(z + parts.attractor) @ parts.frame.T + parts.origin


def velocity(parts, x):
    """The batched velocity, (n, d)."""
    z = encoded(parts, x)
    _, rate = parts.flow.push_forward(z + parts.attractor, parts.latent.rate(z))
    return rate @ parts.frame.T / parts.time


def states(parts, n=30, seed=1, spread=30.0):
    d = parts.flow.n_dims
    return parts.origin + spread * np.random.default_rng(seed).normal(size=(n, d))
