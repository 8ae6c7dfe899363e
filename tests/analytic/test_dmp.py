"""DMP against movement_primitives, and the spring against its closed form."""

import numpy as np
import pytest
from movement_primitives import dmp as movement_primitives

from iflow_gym.baselines.dmp import DMP, discrete_bases
from iflow_gym.baselines.starts import minimum_jerk
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations


def reach(n=200, duration=1.6):
    """A motion from rest to rest with a bend, and its time."""
    s = np.linspace(0, 1, n)
    done = minimum_jerk(s)
    bump = (s * (1 - s)) ** 3 * 64
    path = np.column_stack([-3 + 3 * done + bump, 1 - done + 2 * bump * s])
    return s * duration, path


def one():
    t, path = reach()
    return Demonstrations.from_arrays([path], dt=t[1], goal=[0.0, 0.0])


def oracle(n_basis, t):
    return movement_primitives.DMP(
        2, execution_time=t[-1], dt=t[1], n_weights_per_dim=n_basis, smooth_scaling=True
    )


def motion(theirs, t):
    """Run the oracle at a twentieth of the time step: it takes its forces a step too early."""
    theirs.dt_ = t[1] / 20
    return theirs.open_loop()[1][::20][: len(t)]


def test_the_bases_are_the_oracles():
    t, _ = reach()
    expected = oracle(25, t).forcing_term.design_matrix(t)
    np.testing.assert_allclose(discrete_bases(t / t[-1], 25), expected.T, atol=1e-12)


def test_with_the_same_weights_the_motion_is_the_oracles():
    t, path = reach()
    primitive = DMP(n_basis=25).fit(one(), seed=0)
    theirs = oracle(25, t)
    theirs.forcing_term.weights_[:] = primitive.weights_.T
    for start in (path[0], np.array([-2.0, 2.5])):
        theirs.configure(start_y=start, goal_y=np.zeros(2))
        expected = motion(theirs, t)
        primitive.given_start_.mean[-2:] = 0.0  # the oracle begins at rest
        made = primitive.rollout(start, len(t) - 1, t[1])
        np.testing.assert_allclose(made, expected, rtol=0, atol=4e-3)


def test_the_motion_that_is_learned_is_the_oracles():
    t, path = reach()
    theirs = oracle(25, t)
    theirs.imitate(t, path)
    expected = motion(theirs, t)
    made = DMP(n_basis=25).fit(one(), seed=0).rollout(path[0], len(t) - 1, t[1])
    np.testing.assert_allclose(made, expected, rtol=0, atol=0.01)
    np.testing.assert_allclose(made, path, rtol=0, atol=0.01)


def test_without_forces_the_spring_is_critically_damped():
    primitive = DMP(n_basis=10).fit(one(), seed=0)
    y, velocity = np.array([[2.0, -1.0]]), np.array([[0.5, 3.0]])
    s = np.linspace(0, 1, 50)
    made = [primitive._moved(y, velocity, np.zeros((1, 2)), np.array([h]))[0][0] for h in s]
    rate = 12.5
    expected = (y + s[:, None] * (velocity + rate * y)) * np.exp(-rate * s)[:, None]
    np.testing.assert_allclose(made, expected, atol=1e-12)


def test_the_velocity_of_a_step_is_its_derivative():
    primitive = DMP(n_basis=10).fit(one(), seed=0)
    state = np.array([[2.0, -1.0]]), np.array([[0.5, 3.0]]), np.array([[0.3, 0.3]])
    h = 1e-6
    (a, _), (_, v), (c, _) = (
        primitive._moved(*state, np.array([s])) for s in (0.2 - h, 0.2, 0.2 + h)
    )
    np.testing.assert_allclose(v, (c - a) / (2 * h), rtol=1e-6)


def test_after_a_push_it_goes_on_from_where_it_is():
    """The next state is the spring's own from the pushed position with its own velocity."""
    primitive = DMP(n_basis=25).fit(one(), seed=0)
    x, state = np.array([[-3.0, 1.0]]), None
    state = primitive.begin(x)
    for _ in range(60):
        x, state = primitive.advance(x, state, 0.008)
    pushed = x + np.array([[0.4, -0.2]])
    free, _ = primitive.advance(x, state, 0.008)
    made, after = primitive.advance(pushed, state, 0.008)
    s = 0.008 / primitive.duration([-3.0, 1.0])
    kept = (1 + 12.5 * s) * np.exp(-12.5 * s)
    np.testing.assert_allclose(made - free, kept * np.array([[0.4, -0.2]]), atol=1e-12)
    assert after["phase"] == pytest.approx(61 * s)


def test_on_recordings_the_motion_is_followed():
    shown = load_lasa("Sshape").subset([0])
    primitive = DMP().fit(shown, seed=0)
    path = primitive.rollout(shown.starts[0], 999, shown.dt[0])
    error = np.linalg.norm(path - shown.positions[0], axis=1)
    assert error.max() < 0.01 * shown.bounding_box.diagonal


def test_settings_that_make_no_sense_are_refused():
    for settings, said in (
        ({"n_basis": 3}, "n_basis >= 4"),
        ({"alpha": 0.0}, "a finite alpha > 0"),
        ({"ridge": np.inf}, "a finite ridge > 0"),
    ):
        with pytest.raises(ValueError, match=f"Expected {said}"):
            DMP(**settings)
