"""SEDS against finite differences, closed forms and motions whose fit is known."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from iflow_gym.baselines.gmr import scaled_samples
from iflow_gym.baselines.seds import SEDS, solver
from iflow_gym.baselines.seds.model import contraction
from iflow_gym.baselines.seds.objective import Samples, likelihood, mean_square_error
from iflow_gym.baselines.seds.parameters import Parametrisation
from iflow_gym.baselines.seds.solver import made_feasible
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.system import ModelFileError

QUICK = {"n_components": 3, "n_initialisations": 1, "max_iterations": 100}


def random_samples(d, n=60, seed=0):
    return Samples.of(*np.random.default_rng(seed).normal(size=(2, n, d)))


def random_vector(form, seed=1):
    return 0.7 * np.random.default_rng(seed).normal(size=form.size)


# Objectives ---------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("by_construction", [True, False])
@pytest.mark.parametrize(
    "objective",
    [lambda t, f, s: likelihood(t, f, s, 1e-2), mean_square_error],
    ids=["likelihood", "mse"],
)
def test_gradients_are_finite_differences(d, by_construction, objective):
    form, samples = Parametrisation(3, d, 0.1, by_construction), random_samples(d)
    vector, h = random_vector(form), 1e-6
    _, gradient = objective(vector, form, samples)
    steps = h * np.eye(form.size)
    numeric = [
        (objective(vector + e, form, samples)[0] - objective(vector - e, form, samples)[0])
        / (2 * h)
        for e in steps
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-7)


def test_the_likelihood_is_that_of_the_joint_mixture():
    """Written out with scipy's densities of (x, v), whose blocks the parameters stand for."""
    form, samples = Parametrisation(3, 2, 0.1), random_samples(2)
    vector = random_vector(form)
    mixture = form.mixture(vector)
    density = 0.0
    both = np.concatenate([samples.x, samples.v], axis=1)
    for k, prior in enumerate(np.exp(mixture.normalised)):
        spread = np.linalg.inv(mixture.whitening[k].T @ mixture.whitening[k])
        left = np.linalg.inv(mixture.precision_roots[k].T @ mixture.precision_roots[k])
        gain, centre = mixture.gains[k], mixture.centres[k]
        joint = np.block(
            [[spread, spread @ gain.T], [gain @ spread, left + gain @ spread @ gain.T]]
        )
        mean = np.concatenate([centre, gain @ centre])
        density = density + prior * multivariate_normal(mean, joint).pdf(both)
    value, _ = likelihood(vector, form, samples, 0.0)
    assert value == pytest.approx(-np.log(density).mean(), rel=1e-10)


def test_the_mean_square_error_is_that_of_the_fitted_field():
    motion = load_lasa("Angle")
    system = SEDS(objective="mse", **QUICK).fit(motion, seed=0)
    x = np.concatenate(motion.positions)
    velocities = np.concatenate(motion.velocities)
    both, scale = scaled_samples(x, velocities)
    form = Parametrisation(3, 2, 0.0, by_construction=False)
    white = np.linalg.inv(np.linalg.cholesky(system.spreads_)) * scale[0]
    # Any root of the precisions will do: V with Vᵀ V = Sigma^-1 that is lower triangular.
    vector = np.concatenate(
        [
            np.log(system.priors_),
            (system.centres_ / scale[0]).ravel(),
            form._flattened(_lower(white)).ravel(),
            np.zeros(9),
            (system.gains_ * scale[0] / scale[-1]).ravel(),
        ]
    )
    value, _ = mean_square_error(vector, form, Samples.of(both[:, :2], both[:, 2:]))
    error = (system.velocity(x) - velocities) / scale[-1]
    assert value == pytest.approx(0.5 * np.mean((error**2).sum(axis=1)), rel=1e-8)


def _lower(roots):
    precisions = np.swapaxes(roots, 1, 2) @ roots
    flipped = np.linalg.cholesky(precisions[:, ::-1, ::-1])
    return np.swapaxes(flipped[:, ::-1, ::-1], 1, 2)


# Constraints --------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 2, 3])
def test_every_vector_keeps_the_margin_by_construction(d):
    form = Parametrisation(4, d, 0.25)
    for seed in range(5):
        gains = form.mixture(3 * random_vector(form, seed)).gains
        assert contraction(gains).max() <= -0.5 + 1e-9


def test_the_constraints_jacobian_is_finite_differences():
    form = Parametrisation(2, 2, 0.1, by_construction=False)
    vector, h = random_vector(form), 1e-6
    numeric = np.stack(
        [
            (form.constraint(vector + e) - form.constraint(vector - e)) / (2 * h)
            for e in h * np.eye(form.size)
        ],
        axis=1,
    )
    np.testing.assert_allclose(form.constraint_jacobian(vector), numeric, atol=1e-7)


def test_a_vector_comes_back_from_its_mixture():
    form = Parametrisation(3, 2, 0.1)
    mixture = form.mixture(random_vector(form))
    again = form.mixture(form.vector(mixture))
    np.testing.assert_allclose(again.gains, mixture.gains, atol=1e-12)
    np.testing.assert_allclose(again.whitening, mixture.whitening, rtol=1e-12)


def test_what_a_solver_leaves_infeasible_is_made_feasible():
    form = Parametrisation(3, 2, 0.1, by_construction=False)
    mixture = form.mixture(random_vector(form))
    assert form.constraint(form.vector(mixture)).min() < 0
    mended = made_feasible(mixture, 0.1)
    assert contraction(mended.gains).max() == pytest.approx(-0.2)
    assert made_feasible(mended, 0.1) is mended


@pytest.mark.parametrize("name", ["L-BFGS-B", "SLSQP"])
@pytest.mark.parametrize("objective", ["likelihood", "mse"])
def test_every_solver_ends_strictly_inside(name, objective):
    settings = {**QUICK, "max_iterations": 30, "trial_iterations": 10, "fit_samples": 300}
    system = SEDS(solver=name, objective=objective, **settings).fit(load_lasa("Sshape"), seed=0)
    assert (system.eigenvalues_ < 0).all()
    symmetric = system.gains_ + np.swapaxes(system.gains_, 1, 2)
    np.testing.assert_allclose(system.eigenvalues_, np.linalg.eigvalsh(symmetric))


@pytest.mark.parametrize("objective", ["likelihood", "mse"])
def test_a_solver_that_ends_worse_off_inside_the_constraints_is_not_followed(
    monkeypatch, objective
):
    """It reports a great value at gains that push away: cut to the margin, they are worth less."""
    settings = {**QUICK, "objective": objective}
    honest = solver.solve

    def outside(vector, form, *rest):
        if form.by_construction:
            return honest(vector, form, *rest)
        mixture = form.mixture(vector)
        pushing = dataclasses.replace(mixture, gains=mixture.gains + 20 * np.eye(2))
        return -1e9, form.vector(pushing)

    monkeypatch.setattr(solver, "solve", outside)
    kept = SEDS(**settings).fit(load_lasa("Angle"), seed=0)

    def nowhere(vector, form, *rest):
        return honest(vector, form, *rest) if form.by_construction else (0.0, vector)

    monkeypatch.setattr(solver, "solve", nowhere)
    trial = SEDS(**settings).fit(load_lasa("Angle"), seed=0)
    np.testing.assert_allclose(kept.gains_, trial.gains_)


# Known answers ------------------------------------------------------------------------------


def linear_motion(matrix, n=300, starts=((40.0, 10.0), (-10.0, 35.0), (25.0, -30.0))):
    """Noise-free trajectories of dx/dt = A x with their exact velocities, to 1e-4 of the start."""
    slowest = -np.linalg.eigvals(matrix).real.max()
    times = np.linspace(0.0, 9.2 / slowest, n)
    paths = [np.stack([expm(matrix * t) @ np.array(s) for t in times]) for s in starts]
    return Demonstrations.from_arrays(
        paths, velocities=[p @ matrix.T for p in paths], dt=times[1], goal=np.zeros(2)
    )


@pytest.mark.parametrize(
    ("objective", "n_components"), [("likelihood", 1), ("likelihood", 3), ("mse", 1)]
)
def test_a_stable_linear_system_is_recovered(objective, n_components):
    matrix = np.array([[-1.0, 2.0], [-1.5, -0.8]])  # A + Aᵀ < 0, and it turns
    system = SEDS(objective=objective, n_components=n_components).fit(linear_motion(matrix), seed=0)
    # Where one Gaussian has all the weight its gain is A; where several share it their mean is.
    x = np.array([[30.0, 5.0], [-5.0, 20.0], [2.0, -3.0]])
    np.testing.assert_allclose(system.field_.gain(x), np.stack([matrix] * 3), atol=1e-3)


def test_a_linear_system_that_no_seds_can_have_is_cut_to_the_margin():
    """A is Hurwitz and A + Aᵀ is not negative: distances from the goal grow along the way."""
    matrix = np.array([[-0.2, 4.0], [-0.25, -0.2]])
    system = SEDS(n_components=1, margin=0.05).fit(linear_motion(matrix), seed=0)
    scale = system.eigenvalues_.max()
    assert scale < 0
    assert np.linalg.norm(system.gains_[0] - matrix) > 1.0


def test_v_falls_at_every_step_of_any_dt():
    system = SEDS(**QUICK).fit(load_lasa("Sshape"), seed=0)
    x = np.random.default_rng(0).uniform(-100, 100, size=(500, 2))
    for dt in (1e-3, 0.1, 10.0, 1e4):
        assert (system.lyapunov(system.step(x, dt)) < system.lyapunov(x)).all()


def test_the_step_is_the_exact_one_of_a_linear_system_to_second_order():
    matrix = np.array([[-1.0, 2.0], [-1.5, -0.8]])
    system = SEDS(n_components=1).fit(linear_motion(matrix), seed=0)
    x = np.array([10.0, -4.0])
    errors = [np.abs(system.step(x, h) - expm(system.gains_[0] * h) @ x).max() for h in (0.1, 0.05)]
    assert errors[0] / errors[1] == pytest.approx(8.0, rel=0.15)


# Degenerate data ----------------------------------------------------------------------------


def line(n=60):
    s = np.linspace(1.0, 0.0, n)[:, None] ** 2
    return s * np.array([[30.0, -20.0]])


def in_space(n=60):
    s = np.linspace(1.0, 0.0, n) ** 2
    return np.stack([30 * s, 20 * s * np.cos(3 * s), 10 * s**2], axis=1)


DEGENERATE = {
    "one demonstration": [in_space()[:, :2]],
    "a straight line": [line(), 0.8 * line()],
    "a line along an axis": [line() * [1.0, 0.0]],
    "30 samples": [line(10), in_space(10)[:, :2], -line(10)],
    "10 000 samples": [line(5000), in_space(5000)[:, :2]],
    "all equal": [in_space()[:, :2]] * 4,
    "1-D": [line()[:, :1], -line()[:, :1]],
    "3-D": [in_space(), 0.7 * in_space()],
}


@pytest.mark.parametrize("positions", DEGENERATE.values(), ids=DEGENERATE.keys())
@pytest.mark.parametrize("objective", ["likelihood", "mse"])
def test_degenerate_demonstrations_fit(positions, objective, tmp_path):
    motion = Demonstrations.from_arrays(positions, dt=0.02)
    system = SEDS(objective=objective, n_initialisations=1, max_iterations=60).fit(motion, seed=0)
    box = motion.bounding_box.diagonal
    x = np.random.default_rng(0).normal(size=(200, motion.n_dims)) * box
    assert np.isfinite(system.velocity(x)).all()
    assert (system.eigenvalues_ < 0).all()
    assert (system.lyapunov_rate(x) < 0).all()
    again = SEDS.load(system.save(tmp_path / "model"))
    np.testing.assert_array_equal(again.velocity(x), system.velocity(x))


def test_more_gaussians_than_samples_are_refused():
    short = Demonstrations.from_arrays([line(5)], dt=0.1)
    with pytest.raises(ValueError, match="as many Gaussians as samples, 5, got 6"):
        SEDS(n_components=6).fit(short, seed=0)


BAD = {
    "objective": "direction",
    "solver": "Newton",
    "n_components": 0,
    "fit_samples": 0,
    "margin": 0.0,
    "regularisation": 0.0,
}


@pytest.mark.parametrize(("name", "value"), BAD.items())
def test_settings_that_are_none_are_refused(name, value):
    with pytest.raises(ValueError, match=f"Expected .*{name.split('_')[0]}.* got"):
        SEDS(**{name: value})


# Files --------------------------------------------------------------------------------------

TAMPERED = {
    "gains that push away": ("gains_", lambda a: -a, "A \\+ Aᵀ to be negative definite"),
    "eigenvalues of others": ("eigenvalues_", lambda a: 2 * a, "those of the gains"),
    "priors that sum to 5": ("priors_", lambda a: 5 * a, "priors > 0 that sum to 1"),
    "a lopsided spread": ("spreads_", lambda a: a + np.eye(2)[[1, 1]], "symmetric spread"),
    "a negative covariance": ("covariances_", lambda a: -a, "covariance > 0 on the diagonal"),
}


@pytest.mark.parametrize(("field", "change", "message"), TAMPERED.values(), ids=TAMPERED.keys())
def test_a_file_that_proves_nothing_is_refused(tmp_path, field, change, message):
    system = SEDS(**QUICK).fit(load_lasa("Angle"), seed=0)
    setattr(system, field, change(getattr(system, field)))
    with pytest.raises(ModelFileError, match=message):
        SEDS.load(system.save(tmp_path / "model"))
