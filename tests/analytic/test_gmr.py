"""GMR against conditional Gaussians written out, scikit-learn's densities and quadrature."""

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from sklearn.mixture import GaussianMixture

from iflow_gym.baselines.gmr import GMR, MixtureField, conditional
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.model_files import ModelFileError


def random_mixture(d, n_components=4, seed=0):
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(n_components, 2 * d, 2 * d))
    covariances = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(2 * d)
    return (
        rng.dirichlet(np.ones(n_components)),
        3 * rng.normal(size=(n_components, 2 * d)),
        covariances,
    )


def naive_conditional(priors, means, covariances, x):
    """E and Cov of v given x, one Gaussian and one state at a time."""
    d = len(x)
    weights, moments = [], []
    for prior, mean, cov in zip(priors, means, covariances, strict=True):
        weights.append(prior * multivariate_normal(mean[:d], cov[:d, :d]).pdf(x))
        gain = cov[d:, :d] @ np.linalg.inv(cov[:d, :d])
        moments.append((mean[d:] + gain @ (x - mean[:d]), cov[d:, d:] - gain @ cov[:d, d:]))
    weights = np.array(weights) / sum(weights)
    mean = sum(h * m for h, (m, _) in zip(weights, moments, strict=True))
    second = sum(h * (c + np.outer(m, m)) for h, (m, c) in zip(weights, moments, strict=True))
    return weights, mean, second - np.outer(mean, mean)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_field_is_the_conditional_expectation(d):
    mixture = random_mixture(d)
    field = MixtureField.of_joint(*mixture)
    x = 3 * np.random.default_rng(1).normal(size=(20, d))
    for i, point in enumerate(x):
        weights, mean, covariance = naive_conditional(*mixture, point)
        np.testing.assert_allclose(field.weights(x)[i], weights, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(field.velocity(x)[i], mean, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(field.covariance(x)[i], covariance, rtol=1e-8, atol=1e-9)


def test_the_field_is_the_integral_of_the_joint_density():
    """d = 1: E[v | x] and p(v | x) from p(x, v) by a sum over v, without conditional formulas."""
    priors, means, covariances = random_mixture(1)
    field = MixtureField.of_joint(priors, means, covariances)
    v = np.linspace(-60, 60, 60_001)
    for x in (-2.0, 0.5, 4.0):
        grid = np.stack([np.full_like(v, x), v], axis=1)
        joint = sum(
            p * multivariate_normal(m, c).pdf(grid)
            for p, m, c in zip(priors, means, covariances, strict=True)
        )
        density = joint / trapezoid(joint, v)
        point = np.array([[x]])
        assert field.velocity(point).item() == pytest.approx(trapezoid(v * density, v), rel=1e-8)
        states = np.full((len(v), 1), x)
        np.testing.assert_allclose(np.exp(field.log_prob(states, v[:, None])), density, atol=1e-9)


def test_densities_are_those_of_scikit_learn():
    system = GMR(n_components=5).fit(load_lasa("Sshape"), seed=0)
    d = system.n_dims_
    oracle = GaussianMixture(5)
    oracle.weights_, oracle.means_ = system.priors_, system.means_[:, :d]
    oracle.covariances_ = system.covariances_[:, :d, :d]
    oracle.precisions_cholesky_ = np.linalg.cholesky(np.linalg.inv(oracle.covariances_))
    x = np.random.default_rng(0).normal(size=(200, 2)) * 30
    np.testing.assert_allclose(
        logsumexp(system.field_.log_densities(x), axis=1), oracle.score_samples(x), rtol=1e-9
    )
    np.testing.assert_allclose(system.field_.weights(x), oracle.predict_proba(x), atol=1e-9)


def test_conditional_gains_of_independent_blocks_are_zero():
    covariances = np.eye(4)[None] * 2.0
    gains, offsets, remaining = conditional(np.array([[1.0, 2.0, 3.0, 4.0]]), covariances)
    np.testing.assert_array_equal(gains, np.zeros((1, 2, 2)))
    np.testing.assert_array_equal(offsets, [[3.0, 4.0]])
    np.testing.assert_array_equal(remaining, [2.0 * np.eye(2)])


@pytest.mark.parametrize("distance", [1e3, 1e8, 1e20, 1e100, 1e200])
def test_far_away_one_affine_piece_rules(distance):
    system = GMR(n_components=4).fit(load_lasa("Angle"), seed=0)
    directions = np.array([[1.0, 0.3], [-0.5, 1.0], [-1.0, -1.0], [0.2, -1.0]])
    x = distance * directions
    weights = system.field_.weights(x)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    assert (weights.max(axis=1) > 1 - 1e-9).all()
    winner = weights.argmax(axis=1)
    expected = np.einsum("nij,nj->ni", system.field_.gains[winner], x)
    expected += system.field_.offsets[winner]
    np.testing.assert_allclose(system.velocity(x), expected, rtol=1e-9)


def test_a_batch_with_a_far_state_does_not_disturb_the_others():
    system = GMR(n_components=4).fit(load_lasa("Angle"), seed=0)
    near = np.array([[-20.0, 10.0]])
    np.testing.assert_allclose(
        system.velocity(np.vstack([near, [[1e300, 1.0]]]))[:1], system.velocity(near), rtol=1e-13
    )


def test_a_linear_motion_is_found_with_one_gaussian():
    """The conditional mean of one Gaussian is affine regression: exact on an affine field."""
    matrix = np.array([[-1.0, 2.0], [-2.0, -1.5]])
    x = np.random.default_rng(0).normal(size=(400, 2)) * 10
    x[-1] = 0.0
    demonstrations = Demonstrations.from_arrays(
        [x + 5.0], velocities=[x @ matrix.T], dt=0.01, goal=[5.0, 5.0]
    )
    system = GMR(n_components=1, regularisation=1e-12).fit(demonstrations, seed=0)
    np.testing.assert_allclose(system.field_.gains[0], matrix, rtol=1e-6)
    np.testing.assert_allclose(system.velocity([5.0, 5.0]), 0.0, atol=1e-6)


def test_units_do_not_matter():
    shape = load_lasa("Sshape")
    metres = Demonstrations.from_arrays(
        [p / 1000 for p in shape.positions],
        velocities=[v / 1000 for v in shape.velocities],
        dt=shape.dt,
        goal=np.zeros(2),
    )
    a, b = (GMR(n_components=4).fit(d, seed=3) for d in (shape, metres))
    x = np.random.default_rng(0).normal(size=(50, 2)) * 20
    np.testing.assert_allclose(a.velocity(x), 1000 * b.velocity(x / 1000), rtol=1e-4, atol=1e-3)


DEGENERATE = {
    "one demonstration": [np.linspace([10.0, 5.0], [0.0, 0.0], 100) ** 2],
    "a straight line": [np.linspace([10.0, 5.0], [0.0, 0.0], 100)] * 2,
    "along an axis": [np.linspace([10.0, 0.0], [0.0, 0.0], 100)],
    "30 samples": [np.linspace([10.0, 5.0], [0.0, 0.0], 30) ** 3],
    "3 samples": [np.array([[10.0, 5.0], [4.0, 1.0], [0.0, 0.0]])],
    "identical": [np.linspace([10.0, 5.0], [0.0, 0.0], 50) ** 2] * 4,
}


@pytest.mark.parametrize("positions", DEGENERATE.values(), ids=DEGENERATE.keys())
def test_degenerate_demonstrations_give_a_finite_field(positions):
    system = GMR().fit(Demonstrations.from_arrays(positions, dt=0.1), seed=0)
    x = np.concatenate(positions)
    assert np.isfinite(system.velocity(x)).all()
    assert np.isfinite(system.velocity(x + np.array([100.0, -50.0]))).all()
    assert np.isfinite(system.log_prob(x[:-1], x[1:], 0.1)).all()


def test_bic_finds_the_number_of_clusters():
    """Three clusters far apart, each with its own affine field: more Gaussians buy nothing."""
    from iflow_gym.baselines.gmr import GMRConfig, choose_components

    rng = np.random.default_rng(0)
    centres = np.array([[0, 0, 0, 0], [9, 0, 5, 0], [0, 9, 0, -5.0]])
    samples = np.concatenate([c + rng.normal(size=(300, 4)) for c in centres])
    assert choose_components(samples, GMRConfig(), seed=0) == 3


def test_em_may_start_from_labels():
    """Three clusters far apart, labelled: the Gaussians keep the labels' order."""
    from iflow_gym.baselines.gmr import expectation_maximisation

    rng = np.random.default_rng(0)
    labels = rng.integers(3, size=600)
    samples = np.array([[0, 0], [9, 0], [0, 9.0]])[labels] + rng.normal(size=(600, 2))
    mixture = expectation_maximisation(samples, 3, 1, 1e-6, 0, labels)
    for k in range(3):
        np.testing.assert_allclose(mixture.means_[k], samples[labels == k].mean(axis=0), atol=0.02)
    np.testing.assert_allclose(mixture.weights_, np.bincount(labels) / 600, atol=0.005)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_components": 0}, "n_components >= 1 or None, got 0"),
        ({"n_initialisations": 0}, "n_initialisations >= 1"),
        ({"fit_samples": 0}, "fit_samples >= 1"),
        ({"regularisation": 0.0}, "regularisation > 0"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        GMR(**settings)


def test_more_gaussians_than_samples_are_refused():
    short = Demonstrations.from_arrays([np.linspace([1.0, 1.0], [0.0, 0.0], 5)], dt=0.1)
    with pytest.raises(ValueError, match="as many Gaussians as samples, 5, got 6"):
        GMR(n_components=6).fit(short, seed=0)


def lopsided(covariances):
    changed = covariances.copy()
    changed[0, 0, 1] *= 1.5
    return changed


TAMPERED = {
    "priors that sum to 5": ("priors_", lambda a: 5 * a, r"priors > 0 that sum to 1, got \["),
    "a prior of 0": ("priors_", lambda a: np.array([0.0, *a[1:-1], a[-1] + a[0]]), "priors > 0"),
    "a negative prior": ("priors_", lambda a: np.array([-a[0], *a[1:]]), "priors > 0"),
    "lopsided": ("covariances_", lopsided, "a symmetric covariance"),
    "negative": ("covariances_", lambda a: -a, "covariance > 0 on the diagonal"),
    "indefinite": ("covariances_", lambda a: a + 2 * np.abs(a).max() * (1 - np.eye(4)), "definite"),
}


@pytest.mark.parametrize(("field", "change", "message"), TAMPERED.values(), ids=TAMPERED.keys())
def test_a_file_of_no_mixture_is_refused(tmp_path, field, change, message):
    system = GMR(n_components=4).fit(load_lasa("Angle"), seed=0)
    setattr(system, field, change(getattr(system, field)))
    with pytest.raises(ModelFileError, match=message):
        GMR.load(system.save(tmp_path / "model"))


@pytest.mark.parametrize("positions", DEGENERATE.values(), ids=DEGENERATE.keys())
@pytest.mark.parametrize("dt", [1e-6, 0.1, 1e6])
def test_degenerate_fits_come_back_from_files(tmp_path, positions, dt):
    """Velocities of any unit beside the positions: what is positive definite stays so."""
    system = GMR().fit(Demonstrations.from_arrays(positions, dt=dt), seed=0)
    again = GMR.load(system.save(tmp_path / "model"))
    np.testing.assert_array_equal(again.covariances_, system.covariances_)
