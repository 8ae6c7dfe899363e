"""One flow for several motions, chosen by a context."""

import json

import numpy as np
import pytest
import safetensors.numpy

from iflow_gym.baselines.imitation_flow import ConditionalImitationFlow, ImitationFlow
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.metrics import rmse, start_grid
from iflow_gym.model_files import ModelFileError, read_model_file
from iflow_gym.system import NotFittedError

SMALL = {"n_steps": 250, "n_layers": 8, "sharpness": 2.0}


@pytest.fixture(scope="module")
def two():
    full = load_lasa("Multi_Models_4")
    return [full.subset(range(4)), full.subset(range(4, 7))]


@pytest.fixture(scope="module")
def model(two):
    return ConditionalImitationFlow(**SMALL).fit(two, [[0.0, 3.0], [2.0, 3.0]], seed=0)


def error(system, motion):
    recordings = zip(motion.positions, motion.dt, strict=True)
    return np.mean([rmse(p, system.rollout(p[0], len(p) - 1, h)) for p, h in recordings])


def test_each_context_is_its_own_motion(two, model):
    """3.5 mm after a short training, on motions 40 mm across; the other context is far off."""
    for i, motion in enumerate(two):
        own, other = (model.at(c) for c in (model.contexts_[i], model.contexts_[1 - i]))
        assert error(own, motion) < 3.5
        assert error(other, motion) > 2 * error(own, motion)


@pytest.mark.parametrize("context", [[0.0, 3.0], [2.0, 3.0], [0.7, 3.0], [-5.0, 40.0]])
def test_every_context_is_stable(two, model, context):
    system = model.at(context)
    assert system.guarantee.kind == "proved"
    low, high = two[0].bounding_box
    starts = start_grid(low, high)
    assert (system.lyapunov_rate(starts) < 0).all()
    path = system.rollout(starts, 40, 0.1)
    assert (np.diff(system.lyapunov(path), axis=1) < 0).all()
    # Far outside what was fitted the field may be fast or slow; it still ends at the goal.
    end = system.rollout(starts, 1, 2000.0)[:, -1]
    np.testing.assert_allclose(end, np.zeros_like(end), atol=1e-3)


def test_a_goal_shifts_the_field(two, model):
    goal = np.array([7.0, -3.0])
    here, there = model.at([0.0, 3.0]), model.at([0.0, 3.0], goal=goal)
    np.testing.assert_allclose(there.velocity(goal), 0, atol=1e-10)
    x = two[0].starts
    np.testing.assert_allclose(there.velocity(x + goal), here.velocity(x), rtol=1e-9, atol=1e-9)


def test_time_follows_the_context(two, model):
    """With as many contexts as directions the fitted durations are met exactly."""
    for motion, context in zip(two, model.contexts_, strict=True):
        assert model.at(context)._time == pytest.approx(motion.durations.mean())


@pytest.mark.parametrize("n_dims", [2, 3, 6])
def test_in_any_dimension_the_inverse_is_exact(n_dims):
    time = np.linspace(1, 0, 60)[:, None]
    shape = np.arange(1, n_dims + 1)
    motions = [
        Demonstrations.from_arrays([time**2 * np.cos(k * shape), 1.1 * time**2 * np.cos(k * shape)],
                                   dt=0.02) for k in (1, 2)
    ]  # fmt: skip
    model = ConditionalImitationFlow(n_steps=5).fit(motions, seed=0)
    for context in ([1.0, 0.0], [0.3, 0.3]):
        system = model.at(context)
        x = np.random.default_rng(0).uniform(-2, 2, size=(50, n_dims))
        np.testing.assert_allclose(system._decode(system._encode(x)[0]), x, rtol=0, atol=1e-11)


def test_motions_are_told_apart_by_unit_vectors(two):
    model = ConditionalImitationFlow(n_steps=3, n_layers=2).fit(two, seed=0)
    np.testing.assert_array_equal(model.contexts_, np.eye(2))
    again = ConditionalImitationFlow(n_steps=3, n_layers=2).fit(two, seed=0)
    x = two[0].starts
    np.testing.assert_array_equal(again.at([1, 0]).velocity(x), model.at([1, 0]).velocity(x))


@pytest.mark.parametrize("emission", ["coupling", "autoregressive", "spline"])
def test_a_file_gives_the_same_fields(two, tmp_path, emission):
    model = ConditionalImitationFlow(n_steps=3, n_layers=2, emission=emission).fit(two, seed=0)
    again = ConditionalImitationFlow.load(model.save(tmp_path / "model"))
    for context in ([1.0, 0.0], [0.3, 0.4]):
        x = two[1].starts
        np.testing.assert_array_equal(again.at(context).velocity(x), model.at(context).velocity(x))
    with pytest.raises(ModelFileError, match="to hold a 'imitation-flow' model"):
        ImitationFlow.load(tmp_path / "model")


@pytest.mark.parametrize(
    "change",
    [
        lambda h, a: a.pop("goals"),
        lambda h, a: a.pop("flow.angles"),
        lambda h, a: a.update(contexts=a["contexts"][:, :1]),
        lambda h, a: a.update(context_scale=-a["context_scale"]),
        lambda h, a: a.update(frame=0 * a["frame"]),
        lambda h, a: a.update({"flow.out_bias": a["flow.out_bias"][:1]}),
        lambda h, a: h.update(n_dims=-1),
        lambda h, a: h.update(config={"n_layers": 10**9}),
    ],
)
def test_a_broken_file_is_refused(two, tmp_path, change):
    path = ConditionalImitationFlow(n_steps=1, n_layers=2).fit(two, seed=0).save(tmp_path / "m")
    header, arrays = read_model_file(path)
    change(header, arrays)
    safetensors.numpy.save_file(
        {k: np.ascontiguousarray(a) for k, a in arrays.items()},
        path,
        metadata={"iflow_gym": json.dumps(header)},
    )
    with pytest.raises(ModelFileError):
        ConditionalImitationFlow.load(path)


def test_what_cannot_be_told_apart_is_refused(two, model):
    fit = ConditionalImitationFlow(n_steps=1).fit
    with pytest.raises(ValueError, match="no two the same"):
        fit(two, [[1.0], [1.0]], seed=0)
    with pytest.raises(ValueError, match=r"a context for each of 2 motions, shape \(2, k\)"):
        fit(two, [[1.0]], seed=0)
    with pytest.raises(ValueError, match="at least one motion"):
        fit([], seed=0)
    time = np.linspace(0, 4 * np.pi, 100)[:, None]
    circle = np.hstack([np.cos(time), np.sin(time)])
    cycle = Demonstrations.from_arrays([circle], dt=0.1, period=5.0)
    with pytest.raises(ValueError, match="motions that end"):
        fit([cycle, two[0]], seed=0)
    with pytest.raises(TypeError, match="a sequence of motions, got 'LASA-Multi_Models_4' alone"):
        fit(two[0], seed=0)
    for wrong in ([1.0], "Angle"):
        with pytest.raises(ValueError, match=r"context of shape \(2,\)"):
            model.at(wrong)
    with pytest.raises(ValueError, match=r"goal of shape \(2,\)"):
        model.at([0.0, 3.0], goal=[1.0])
    with pytest.raises(ValueError, match="noise='additive' for several motions"):
        ConditionalImitationFlow(noise="vanishing")
    with pytest.raises(NotFittedError):
        ConditionalImitationFlow().at([1.0])
