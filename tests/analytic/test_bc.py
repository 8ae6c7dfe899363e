"""Behavioural cloning: what the network is, how its settings are chosen, its random numbers."""

import numpy as np
import pytest
import torch

from iflow_gym.baselines.behavioural_cloning import (
    BehaviouralCloning,
    BehaviouralCloningConfig,
    _Job,
    _Task,
    _train,
)
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations


def straight():
    """Demonstrations of dx/dt = -2 x from around (1, 1)."""
    t = np.linspace(0, 3, 150)[:, None]
    starts = np.random.default_rng(0).normal([1, 1], 0.3, size=(5, 2))
    paths = [s * np.exp(-2 * t) for s in starts]
    return Demonstrations.from_arrays(
        paths, velocities=[-2 * p for p in paths], dt=3 / 149, goal=[0, 0]
    )


def test_a_linear_field_is_learned():
    system = BehaviouralCloning(n_steps=800).fit(straight(), seed=0)
    x = np.concatenate(straight().positions)[::10]
    error = np.sqrt(np.mean((system.velocity(x) + 2 * x) ** 2))
    assert error < 0.03 * np.sqrt(np.mean((2 * x) ** 2))


def test_the_network_that_runs_is_the_one_that_was_trained():
    system = BehaviouralCloning(n_steps=50).fit(load_lasa("Angle"), seed=0)
    layers = []
    for w, b in zip(system.layers_[::2], system.layers_[1::2], strict=True):
        layer = torch.nn.Linear(*w.shape)
        layer.weight.data, layer.bias.data = torch.tensor(w.T), torch.tensor(b)
        layers += [layer, torch.nn.Tanh()]
    network = torch.nn.Sequential(*layers[:-1])
    x = load_lasa("Angle").positions[0][::50]
    scaled = torch.tensor((x - system.centre_) / system.length_)
    with torch.no_grad():
        expected = system.speed_ * network(scaled).numpy()
    np.testing.assert_allclose(system.velocity(x), expected, rtol=1e-12)


def test_steps_are_those_of_adam_with_decoupled_decay():
    """Against torch's AdamW on one network, from the same samples and first weights."""
    config = BehaviouralCloningConfig(width=8, averaging=0.0, batch_size=16)
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(40, 4)).astype(np.float32)
    (start, after) = (
        next(iter(_train([_Job(samples, 0.1, 3)], [n], config))).layers(0) for n in (1, 30)
    )
    assert not np.allclose(start[0], after[0])
    from iflow_gym.baselines.behavioural_cloning import _forward, _initial

    generator = np.random.default_rng(3)
    tensors = [torch.tensor(a)[None].requires_grad_() for a in _initial(2, 8, generator)]
    optimiser = torch.optim.AdamW(
        [
            {"params": tensors[::2], "weight_decay": 0.1},
            {"params": tensors[1::2], "weight_decay": 0.0},
        ],
        lr=config.learning_rate,
    )
    for picked in generator.integers(40, size=(30, 16)):
        x, v = torch.tensor(samples[picked])[None].chunk(2, dim=2)
        optimiser.zero_grad()
        (((_forward(tensors, x) - v) ** 2).sum() / 16).backward()
        optimiser.step()
    for ours, theirs in zip(after, tensors, strict=True):
        theirs = theirs.detach().numpy().reshape(ours.shape)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-5)


def test_what_is_left_out_is_not_trained_on():
    task = _Task(load_lasa("Angle"), np.random.default_rng(0))
    assert task.left_out(2) == [2, 4]
    assert len(task.without(2)) == 6000
    assert len(task.without(None)) == 7000
    one = _Task(load_lasa("Angle").subset([0]), np.random.default_rng(0))
    assert len(one.parts) == 5
    assert len(one.without(1)) == 800


def test_motions_train_the_same_in_company_but_for_rounding():
    shown = [load_lasa(s) for s in ("Angle", "Sshape")]
    together = BehaviouralCloning(n_steps=50).fit_many(shown, seeds=[0, 1])[1]
    alone = BehaviouralCloning(n_steps=50).fit(shown[1], seed=1)
    x = np.concatenate(shown[1].positions)[::100]
    np.testing.assert_allclose(
        together.velocity(x), alone.velocity(x), rtol=0, atol=1e-3 * shown[1].peak_speed
    )
    assert (together.decay_, together.n_steps_) == (alone.decay_, alone.n_steps_)


def test_motions_of_different_dimensions_are_fitted_in_one_call():
    flat = straight()
    space = Demonstrations.from_arrays(
        [np.column_stack([p, p[:, 0]]) for p in flat.positions], dt=flat.dt, goal=[0, 0, 0]
    )
    systems = BehaviouralCloning(n_steps=50).fit_many([flat, space, flat], seeds=[0, 0, 0])
    assert [s.n_dims_ for s in systems] == [2, 3, 2]


def test_far_away_the_velocity_stays_bounded():
    system = BehaviouralCloning(n_steps=100).fit(straight(), seed=0)
    near, far = system.velocity([1e6, 1e6]), system.velocity([1e12, 1e12])
    np.testing.assert_allclose(near, far, rtol=1e-6)


def test_settings_that_make_no_sense_are_refused():
    for settings, said in (
        ({"width": 0}, "width >= 1"),
        ({"decays": ()}, "at least one decay"),
        ({"decays": (-1.0,)}, "at least one decay"),
        ({"learning_rate": 0.0}, "learning_rate > 0"),
        ({"averaging": 1.0}, r"averaging in \[0, 1\)"),
    ):
        with pytest.raises(ValueError, match=f"Expected {said}"):
            BehaviouralCloning(**settings)
