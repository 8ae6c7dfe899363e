"""What every method with a phase keeps, whichever it is: the registry's, one after another."""

import functools

import gymnasium
import numpy as np
import pytest

from iflow_gym import MovementPrimitivePolicy
from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.evaluate import evaluate
from iflow_gym.policy import DynamicalSystemPolicy, policy_of
from iflow_gym.primitive import MovementPrimitive
from iflow_gym.system import NotFittedError

PRIMITIVES = [name for name in METHODS if issubclass(load_method(name), MovementPrimitive)]
RHYTHMIC = [name for name in PRIMITIVES if load_method(name).learns_cycles]

every_primitive = pytest.mark.parametrize("name", PRIMITIVES)
every_rhythmic = pytest.mark.parametrize("name", RHYTHMIC)


@functools.cache
def fitted(name, shape="Angle"):
    return load_method(name)().fit(load_lasa(shape), seed=0)


def ring(n=3, rounds=3, dt=0.02, period=1.5, shape="circle", noise=0.0):
    """Recordings of a circle or a figure eight that begin anywhere on it."""
    rng = np.random.default_rng(0)
    t = np.arange(round(rounds * period / dt)) * dt
    recordings = []
    for offset in rng.uniform(0, 1, size=n):
        angle = 2 * np.pi * (t / period + offset)
        y = np.sin(angle) if shape == "circle" else 0.5 * np.sin(2 * angle)
        path = np.column_stack([3 + np.cos(angle), y - 1])
        recordings.append(path + noise * rng.normal(size=path.shape))
    return Demonstrations.from_arrays(recordings, dt=dt, period=period, name=shape)


def starts(n=12):
    box = load_lasa("Angle").bounding_box
    return np.random.default_rng(1).uniform(*box, size=(n, 2))


# The clock ----------------------------------------------------------------------------------


@every_primitive
def test_shapes_agree(name):
    primitive, x = fitted(name), starts()
    state = primitive.begin(x)
    assert state["phase"].shape == state["rate"].shape == (12,)
    batch, after = primitive.advance(x, state, 0.01)
    folded, _ = primitive.advance(x.reshape(3, 4, 2), primitive.begin(x.reshape(3, 4, 2)), 0.01)
    one, _ = primitive.advance(x[0], primitive.begin(x[0]), 0.01)
    assert batch.shape == (12, 2)
    assert batch.dtype == np.float64
    np.testing.assert_allclose(folded.reshape(12, 2), batch, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one, batch[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(after["phase"], state["rate"] * 0.01)
    assert primitive.advance(np.empty((0, 2)), primitive.begin(np.empty((0, 2))), 0.1)[0].size == 0


@every_primitive
def test_a_step_leaves_its_input_alone(name):
    primitive, x = fitted(name), starts()
    state = primitive.begin(x)
    kept = {k: v.copy() for k, v in state.items()}
    primitive.advance(x, state, 0.01)
    for key, value in kept.items():
        np.testing.assert_array_equal(state[key], value)
    np.testing.assert_array_equal(x, starts())


@every_primitive
def test_arguments_that_do_not_fit_are_refused(name):
    primitive, x = fitted(name), starts()
    with pytest.raises(ValueError, match=r"Expected the 12 states .* got 5: call begin"):
        primitive.advance(x[:5], primitive.begin(x), 0.01)
    with pytest.raises(ValueError, match="Expected a finite dt > 0"):
        primitive.advance(x, primitive.begin(x), 0.0)
    with pytest.raises(ValueError, match=r"Expected states of shape \(..., 2\)"):
        primitive.begin(np.zeros(3))
    with pytest.raises(NotFittedError, match="call fit"):
        load_method(name)().begin(x)


@every_primitive
def test_a_motion_takes_as_long_as_the_demonstration_that_began_there(name):
    primitive, shown = fitted(name), load_lasa("Angle")
    np.testing.assert_allclose(primitive.duration(shown.starts), shown.durations)
    far = primitive.duration(shown.starts[0] + 1e6)
    assert far == pytest.approx(shown.durations.mean(), rel=1e-3)


@every_primitive
def test_a_motion_ends_at_its_goal_and_stays_there(name):
    primitive, shown = fitted(name), load_lasa("Angle")
    dt = shown.mean_dt
    from_anywhere = np.concatenate([shown.starts, starts()])
    path = primitive.rollout(from_anywhere, 3000, dt)
    size = shown.bounding_box.diagonal
    away = np.linalg.norm(path - shown.goal, axis=-1)
    assert away[:, 1400:].max() < 0.02 * size
    assert away[:, -1].max() < 1e-3 * size


@every_primitive
def test_the_clock_goes_on_when_the_motion_is_pushed(name):
    """The push is forgotten: the path closes in on what it would have been, at the same time."""
    primitive, shown = fitted(name), load_lasa("Angle")
    x0, dt = shown.starts[:1], shown.dt[0]
    free = primitive.rollout(x0, 1200, dt)[0]
    x, state = x0, primitive.begin(x0)
    for k in range(1200):
        x, state = primitive.advance(x, state, dt)
        if k == 400:
            x = x + 0.25 * shown.bounding_box.diagonal
    assert state["phase"][0] == pytest.approx(1200 * dt / shown.durations[0])
    assert np.linalg.norm(x - free[-1]) < 1e-2 * shown.bounding_box.diagonal


@every_primitive
@pytest.mark.parametrize("halves", [2, 4])
def test_a_finer_step_gives_the_same_motion(name, halves):
    primitive, shown = fitted(name), load_lasa("Sshape")
    primitive = fitted(name, "Sshape")
    coarse = primitive.rollout(shown.starts[0], 500, 2 * shown.dt[0])
    fine = primitive.rollout(shown.starts[0], 500 * halves, 2 * shown.dt[0] / halves)[::halves]
    np.testing.assert_allclose(coarse, fine, rtol=0, atol=5e-3 * shown.bounding_box.diagonal)


# The policy ---------------------------------------------------------------------------------


@every_primitive
def test_in_the_environment_the_mass_is_where_the_primitive_is(name):
    primitive = fitted(name)
    env = gymnasium.make("iflow/LASA-Angle-v0")
    policy = policy_of(primitive, env)
    assert isinstance(policy, MovementPrimitivePolicy)
    observation, _ = env.reset(seed=0, options={"demonstration": 2})
    expected = primitive.rollout(observation, 100, env.unwrapped.dt)
    state, start = None, True
    for k in range(100):
        action, state = policy.predict(observation, state, np.array([start]))
        observation, *_ = env.step(action)
        start = False
        np.testing.assert_allclose(observation, expected[k + 1], rtol=0, atol=1e-9)


@every_primitive
def test_an_episode_that_begins_starts_its_own_clock_anew(name):
    primitive, x = fitted(name), starts(3)
    policy = MovementPrimitivePolicy(primitive, max_speed=1e6, dt=0.01)
    _, first = policy.predict(x)
    _, again = policy.predict(x, first, np.array([False, True, False]))
    np.testing.assert_allclose(again["phase"], 0.01 * first["rate"] * [2, 1, 2])
    with pytest.raises(ValueError, match="Expected a fitted system"):
        MovementPrimitivePolicy(load_method(name)(), max_speed=1.0, dt=0.1)


@every_primitive
def test_what_is_asked_of_a_field_is_null_and_the_rest_is_not(name):
    found = evaluate(fitted(name), "iflow/LASA-Angle-v0", seed=0, stability=False)
    none = ("seds_error", "direction_error", "velocity_rmse", "nll_1", "nll_10")
    assert all(found.metrics[m] is None for m in (*none, "lyapunov_violation"))
    assert not set(none) & set(found.per_demonstration)
    for some in ("rmse", "frechet", "dtw", "swept_area", "step_us", "n_parameters"):
        assert found.metrics[some] > 0
    assert found.metrics["frechet"] < 5
    bound = MovementPrimitivePolicy(fitted(name), gymnasium.make("iflow/LASA-Angle-v0"))
    again = evaluate(bound, "iflow/LASA-Angle-v0", seed=0, stability=False)
    assert again.metrics["frechet"] == found.metrics["frechet"]


def test_policies_are_for_methods():
    with pytest.raises(TypeError, match="Expected a DynamicalSystem or a MovementPrimitive"):
        policy_of(object(), None)
    system = load_method("linear")().fit(load_lasa("Angle"), seed=0)
    policy = policy_of(system, gymnasium.make("iflow/LASA-Angle-v0"))
    assert isinstance(policy, DynamicalSystemPolicy)


# Cycles -------------------------------------------------------------------------------------


@every_primitive
def test_motions_that_repeat_are_learned_or_refused(name):
    if name in RHYTHMIC:
        assert load_method(name)().fit(ring(), seed=0).period_ == 1.5
        return
    with pytest.raises(ValueError, match="learns motions that end at a goal"):
        load_method(name)().fit(ring(), seed=0)


@every_rhythmic
@pytest.mark.parametrize("shape", ["circle", "figure-eight"])
def test_a_cycle_goes_round_on_what_was_shown(name, shape):
    shown = ring(shape=shape)
    primitive = load_method(name)().fit(shown, seed=0)
    period = round(1.5 / 0.02)
    path = primitive.rollout(shown.starts, 4 * period, 0.02)
    np.testing.assert_allclose(path[:, -1 - period :], path[:, -1 - 2 * period : -period],
                               rtol=0, atol=1e-3)  # fmt: skip
    orbit = np.concatenate(shown.positions)
    for made in path[:, -period:]:
        nearest = np.linalg.norm(made[:, None] - orbit, axis=-1).min(axis=1)
        assert nearest.max() < 0.1
        assert nearest.mean() < 0.03


@every_rhythmic
def test_a_cycle_is_reached_from_beside_it_and_kept_after_a_push(name):
    shown = ring()
    primitive = load_method(name)().fit(shown, seed=0)
    x = np.array([[3.0, -1.0], [6.0, 1.0], [3.0, -0.9]])
    state = primitive.begin(x)
    for k in range(450):
        x, state = primitive.advance(x, state, 0.02)
        if k == 200:
            x = x + np.array([1.0, 1.0])
    radius = np.linalg.norm(x - [3, -1], axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=0.03)


@every_rhythmic
def test_a_cycle_of_its_own_phase_begins_where_it_is(name):
    """From a start on the circle the motion goes on from there, without a detour."""
    shown = ring()
    primitive = load_method(name)().fit(shown, seed=0)
    path = primitive.rollout(shown.starts, 37, 0.02)  # half a round
    np.testing.assert_allclose(np.linalg.norm(path - [3, -1], axis=-1), 1.0, atol=0.06)
    np.testing.assert_allclose(path[:, -1] - [3, -1], -(shown.starts - [3, -1]), rtol=0, atol=0.12)


@every_rhythmic
def test_a_cycle_comes_back_from_its_file(name, tmp_path):
    primitive = load_method(name)().fit(ring(), seed=0)
    again = load_method(name).load(primitive.save(tmp_path / "model"))
    assert again.period_ == 1.5
    x = np.array([[4.0, -1.0], [2.0, 0.0]])
    np.testing.assert_array_equal(again.rollout(x, 50, 0.02), primitive.rollout(x, 50, 0.02))


@every_rhythmic
def test_a_period_in_another_unit_is_told(name):
    shown = ring()
    for period in (0.0015, 1500.0):
        with pytest.raises(ValueError, match="check the units of period and dt"):
            Demonstrations.from_arrays(list(shown.positions), dt=0.02, period=period)
    coarse = Demonstrations.from_arrays([p[::15] for p in shown.positions], dt=0.3, period=1.5)
    with pytest.raises(ValueError, match="at least 8 samples a period"):
        load_method(name)().fit(coarse, seed=0)
