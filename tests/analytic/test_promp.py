"""ProMP against movement_primitives and against Gaussian conditioning written out."""

import numpy as np
import pytest
from movement_primitives.promp import ProMP as Oracle

from iflow_gym.baselines.cycles import circular_bases
from iflow_gym.baselines.promp import ProMP, bases
from iflow_gym.baselines.registry import load_method
from iflow_gym.baselines.starts import EXACTNESS, GivenStart, minimum_jerk
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.evaluate import evaluate
from iflow_gym.phases import common_phases


def fitted(shape="Sshape", **settings):
    return ProMP(**settings).fit(load_lasa(shape), seed=0)


def oracle(primitive):
    found = Oracle(2, primitive.config.n_basis)
    return found.from_weight_distribution(primitive.mean_.ravel(), primitive.covariance_)


def test_the_bases_are_the_oracles():
    s = np.linspace(0, 1, 101)
    expected = Oracle(1, 25)._rbfs_1d_sequence(s.copy()).T
    np.testing.assert_allclose(bases(s, 25), expected, atol=1e-12)


@pytest.mark.parametrize("phase", [0.0, 0.35, 1.0])
def test_conditioning_is_the_oracles(phase):
    primitive = fitted(n_basis=20)
    point, variance = np.array([-20.0, 12.0]), 0.3
    mean, covariance = primitive.condition(phase, point, variance)
    expected = oracle(primitive).condition_position(point, variance * np.eye(2), t=phase)
    np.testing.assert_allclose(mean.ravel(), expected.weight_mean, atol=1e-8)
    np.testing.assert_allclose(covariance, expected.weight_cov, atol=1e-8)


def test_the_mean_motion_is_that_of_the_oracles_em():
    """It learns by expectation-maximisation; the means agree where the samples decide."""
    shown, primitive = load_lasa("Sshape"), fitted(n_basis=20)
    every = 10
    times = np.array([np.linspace(0, 1, 100)] * 7)
    found = Oracle(2, 20)
    found.imitate(times, np.stack([p[::every] for p in shown.positions]), n_iter=50)
    s = np.arange(100) * every / 999
    expected = found.mean_trajectory(np.linspace(0, 1, 100))
    made = bases(s, 20) @ primitive.mean_.T
    size = shown.bounding_box.diagonal
    np.testing.assert_allclose(made, expected, rtol=0, atol=0.02 * size)


def test_a_demonstrated_start_is_conditioned_on():
    """The reference from a demonstrated start is the conditional mean, NIPS 2013 eq. (5)."""
    shown, primitive = load_lasa("Sshape"), fitted()
    start = shown.starts[3]
    mean, _ = primitive.condition(0.0, start)
    s = np.linspace(0, 0.9, 50)
    state = primitive.begin(start)
    made = np.concatenate([primitive._reference(state, s[k : k + 1]) for k in range(50)])
    expected = bases(s, 40) @ mean.T
    # Apart by the residual of the regression at the start, and by what the end lacks of the goal.
    np.testing.assert_allclose(made, expected, rtol=0, atol=0.01 * shown.bounding_box.diagonal)


def test_each_demonstration_is_a_weighted_sum_of_the_bases():
    shown, primitive = load_lasa("Sshape"), fitted()
    weights = primitive.mean_ + primitive.deviations_
    s = np.linspace(0, 1, 1000)
    made = np.einsum("tb,ndb->ntd", bases(s, 40), weights)
    error = np.sqrt(np.mean((made - np.stack(shown.positions)) ** 2))
    assert error < 1e-3 * shown.bounding_box.diagonal


@pytest.mark.parametrize("name", ["promp", "kmp", "dmp"])
def test_motions_at_different_phases_go_on_as_each_alone(name):
    shown = load_lasa("Sshape")
    primitive = load_method(name)().fit(shown, seed=0)
    starts = shown.starts[:3] + np.array([[0.0, 0.0], [30.0, -5.0], [1.0, 2.0]])
    first = np.array([0.2, 0.6, 1.5]) * primitive.duration(starts)  # the last is over by then

    def after(x, dt):
        x, state = primitive.advance(x, primitive.begin(x), dt)
        return primitive.advance(x + 1.0, state, 0.05)[0]

    alone = [after(starts[k : k + 1], first[k : k + 1])[0] for k in range(3)]
    np.testing.assert_allclose(after(starts, first), alone, atol=1e-10)


@pytest.mark.parametrize("name", ["promp", "kmp", "dmp"])
def test_a_caller_may_put_the_phase(name):
    """As who stops a motion and goes on from another place of it does."""
    shown = load_lasa("Sshape")
    primitive = load_method(name)().fit(shown, seed=0)
    begun = primitive.begin(shown.starts[:3])
    _, later = primitive.advance(shown.starts[:3], begun, 0.3)
    put = {**begun, "phase": later["phase"], "velocity": later.get("velocity")}
    x = shown.starts[:3] + 2.0
    found, expected = (primitive.advance(x, state, 0.1)[0] for state in (put, later))
    np.testing.assert_allclose(found, expected, atol=1e-10)


# The start ----------------------------------------------------------------------------------


def test_numbers_given_the_start_are_a_conditional_gaussian_mean():
    rng = np.random.default_rng(0)
    starts, values = rng.normal(size=(9, 2)), rng.normal(size=(9, 5))
    given = GivenStart.fit(starts, values)
    joint = np.cov(np.hstack([starts, values]).T, bias=True)
    noise = EXACTNESS * np.trace(joint[:2, :2]) / 2 * np.eye(2)
    gain = joint[2:, :2] @ np.linalg.inv(joint[:2, :2] + noise)
    expected = values.mean(axis=0) + (starts - starts.mean(axis=0)) @ gain.T
    factors, rest = given.factors(starts)
    np.testing.assert_allclose(factors @ given.coefficients, expected, atol=1e-12)
    np.testing.assert_allclose(rest, 0.0, atol=1e-12)


def test_beyond_the_demonstrated_starts_the_rest_is_given_back():
    rng = np.random.default_rng(0)
    given = GivenStart.fit(rng.normal(size=(9, 2)), rng.normal(size=(9, 5)))
    direction = np.array([[0.6, -0.8]])
    near, far = (given.factors(given.start + factor * direction) for factor in (50.0, 5000.0))
    np.testing.assert_allclose(near[0], far[0])
    np.testing.assert_allclose(far[1] - near[1], 4950 * direction)


def test_starts_in_one_place_say_nothing():
    given = GivenStart.fit(np.ones((4, 2)), np.arange(12.0).reshape(4, 3))
    factors, rest = given.factors(np.array([[5.0, 1.0]]))
    np.testing.assert_array_equal(factors @ given.coefficients, [[4.5, 5.5, 6.5]])
    np.testing.assert_array_equal(rest, [[4.0, 0.0]])


def test_minimum_jerk_is_at_rest_at_both_ends():
    s = np.array([0.0, 1e-4, 0.5, 1 - 1e-4, 1.0, 3.0])
    np.testing.assert_allclose(minimum_jerk(s), [0, 0, 0.5, 1, 1, 1], atol=1e-11)


# Cycles -------------------------------------------------------------------------------------


def test_circular_bases_sum_to_one_and_repeat():
    s = np.linspace(0, 1, 77)
    np.testing.assert_allclose(circular_bases(s, 20).sum(axis=1), 1.0)
    np.testing.assert_allclose(circular_bases(s, 20), circular_bases(s + 5, 20), atol=1e-9)
    half = circular_bases(np.array([0.5 / 20]), 20)[0]
    assert half[0] == pytest.approx(half[1])


def test_phases_are_found_wherever_recordings_begin():
    offsets, t = np.array([0.0, 0.31, 0.77]), np.arange(200) * 0.02
    angles = 2 * np.pi * (t / 1.6 + offsets[:, None])
    shown = Demonstrations.from_arrays(
        [np.column_stack([np.cos(a), np.sin(a) + 0.3 * np.cos(2 * a)]) for a in angles],
        dt=0.02,
        period=1.6,
    )
    found = common_phases(shown)
    np.testing.assert_allclose([(p[0] - found[0][0]) % 1 for p in found], offsets, atol=5e-3)


def test_rounds_are_the_samples_of_a_rhythmic_gaussian():
    """Rounds of different sizes: their mean is the orbit, their spread the covariance."""
    sizes = np.repeat([0.9, 1.0, 1.1], 60)
    angle = 2 * np.pi * np.arange(180) / 60
    path = sizes[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    shown = Demonstrations.from_arrays([path], dt=0.02, period=1.2)
    primitive = ProMP(n_basis=20).fit(shown, seed=0)
    assert primitive.deviations_.shape == (3, 2, 20)
    path = primitive.rollout(path[60], 240, 0.02)[-60:]
    # Where the size leaps from round to round the phase is off by a sample.
    np.testing.assert_allclose(np.linalg.norm(path, axis=1), 1.0, atol=0.03)
    weights = np.kron(np.eye(2)[0], circular_bases(np.full(1, 0.5), 20)[0])
    spread = np.sqrt(weights @ primitive.covariance_ @ weights)
    assert spread == pytest.approx(np.std([0.9, 1.0, 1.1]), rel=0.05)


def test_settings_that_make_no_sense_are_refused():
    for settings, said in (({"n_basis": 3}, "n_basis >= 4"), ({"feedback": 0.0}, "a finite feed")):
        with pytest.raises(ValueError, match=f"Expected {said}"):
            ProMP(**settings)


@pytest.mark.parametrize("name", ["promp", "dmp"])
@pytest.mark.parametrize(("shape", "anchor"), [("Angle", 1.8), ("Sshape", 1.8), ("Sharpc", 1.7)])
def test_recordings_are_followed_as_closely_as_by_others(name, shape, anchor):
    """As another code's ProMP, conditioned on the start, to the decimal that is known of it."""
    primitive = load_method(name)().fit(load_lasa(shape), seed=0)
    found = evaluate(primitive, f"iflow/LASA-{shape}-v0", seed=0, stability=False)
    assert round(found.metrics["frechet"], 1) <= anchor
