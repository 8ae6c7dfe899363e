"""CLF-DM against finite differences, closed forms, and a motion that no SEDS can make."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from iflow_gym.baselines.clf_dm import CLFDM
from iflow_gym.baselines.clf_dm.controller import Controller
from iflow_gym.baselines.clf_dm.energy import (
    Energy,
    EnergyForm,
    learn_energies,
    learn_energy,
    objective,
)
from iflow_gym.baselines.clf_dm.selection import best_controller, reproduction_errors
from iflow_gym.baselines.seds import SEDS
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.metrics import frechet
from iflow_gym.system import ModelFileError

QUICK = {"n_components": 4, "n_initialisations": 1, "max_terms": 1, "weights": (0.1,)}


def random_energy(d, n_terms, seed=0):
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(n_terms + 1, d, d))
    return Energy(roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(d), rng.normal(size=(n_terms, d)))


def motion(shape="Angle", n=3, every=5):
    full = load_lasa(shape).subset(range(n))
    return Demonstrations.from_arrays(
        [p[::-1][::every][::-1] for p in full.positions],
        velocities=[v[::-1][::every][::-1] for v in full.velocities],
        dt=[h * every for h in full.dt],
        goal=full.goal,
    )


# V ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("n_terms", [0, 3])
def test_v_is_the_sum_of_asymmetric_quadratics(d, n_terms):
    energy = random_energy(d, n_terms)
    x = np.random.default_rng(1).normal(size=(50, d))
    for point, value in zip(x, energy.value(x), strict=True):
        expected = point @ energy.matrices[0] @ point
        for matrix, centre in zip(energy.matrices[1:], energy.centres, strict=True):
            expected += max(point @ matrix @ (point - centre), 0.0) ** 2
        assert value == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_gradient_of_v_is_finite_differences(d):
    energy = random_energy(d, 2)
    x, h = np.random.default_rng(1).normal(size=(50, d)), 1e-6
    numeric = [(energy.value(x + e) - energy.value(x - e)) / (2 * h) for e in h * np.eye(d)]
    value, gradient = energy.value_and_gradient(x)
    np.testing.assert_allclose(value, energy.value(x), rtol=1e-12)
    np.testing.assert_allclose(gradient, np.stack(numeric, axis=1), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_point_is_pulled_back_onto_the_level_along_its_ray(d):
    energy = random_energy(d, 3)
    rng = np.random.default_rng(2)
    x = 3 * rng.normal(size=(200, d))
    level = energy.value(x) * np.exp(-rng.uniform(0, 20, size=200))
    back = energy.lowered(x, level)
    np.testing.assert_allclose(energy.value(back), level, rtol=1e-9)
    np.testing.assert_allclose(
        back / np.linalg.norm(back, axis=1, keepdims=True),
        x / np.linalg.norm(x, axis=1, keepdims=True),
        atol=1e-12,
    )
    np.testing.assert_array_equal(energy.lowered(x, energy.value(x)), x)
    np.testing.assert_array_equal(energy.lowered(x, np.zeros(200)), 0 * x)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n_terms", [0, 1, 3])
def test_the_gradient_of_the_objective_is_finite_differences(d, n_terms):
    rng = np.random.default_rng(3)
    form = EnergyForm(n_terms, d)
    vector = rng.normal(size=form.size)
    x, v = rng.normal(size=(2, 50, d))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    value, gradient = objective(vector, form, x, v, 0.1)
    h = 1e-6
    numeric = [
        (objective(vector + e, form, x, v, 0.1)[0] - objective(vector - e, form, x, v, 0.1)[0])
        / (2 * h)
        for e in h * np.eye(form.size)
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-7)
    _, slope = form.energy(vector).value_and_gradient(x)
    psi = (slope * v).sum(axis=1) / np.linalg.norm(slope, axis=1)
    expected = np.where(psi > 0, psi**2, -0.1 * psi**2).mean()
    assert value == pytest.approx(expected, rel=1e-10)


def test_terms_are_added_only_while_they_gain():
    """Straight to the goal from everywhere, psi is -1 with V = |x|² and no term can gain."""
    x = np.random.default_rng(0).normal(size=(300, 2))
    rng = np.random.default_rng(0)
    found = learn_energy(x, -x, 4, 0.02, 0.1, rng)
    assert len(found) == 1
    assert found[0].value(x).mean() == pytest.approx(1.0, abs=0.05)  # slow samples are left out
    np.testing.assert_allclose(
        found[0].matrices[0], np.eye(2) * found[0].matrices[0][0, 0], atol=1e-3
    )


def test_the_v_without_terms_is_found_once_for_every_weight():
    x = np.random.default_rng(0).normal(size=(300, 2))
    found = learn_energies(x, -x, (0.01, 0.2), 3, 4, 0.02, np.random.default_rng(0))
    assert len(found) == 2


def test_more_searches_add_to_those_that_were():
    demonstrations = motion("Sshape")
    x, v = np.concatenate(demonstrations.positions), np.concatenate(demonstrations.velocities)
    x = x / np.sqrt(np.mean(x**2))
    one, two = (learn_energies(x, v, (0.2,), n, 2, 0.02, np.random.default_rng(0)) for n in (1, 2))
    assert len(two) > len(one) > 1
    for energy, same in zip(one, two, strict=False):
        np.testing.assert_array_equal(energy.matrices, same.matrices)


# The choice ---------------------------------------------------------------------------------


class Linear:
    """A regressor whose field is known."""

    def __init__(self, matrix):
        self.matrix = np.array(matrix)

    def velocity(self, x):
        return x @ self.matrix.T

    def arrays(self):
        return {"matrix": self.matrix}


def test_the_pair_that_made_the_demonstrations_is_found_again():
    energies = [
        Energy(np.array([[[1.0, c], [c, 2.0]]]), np.empty((0, 2))) for c in (0.0, 1.2, -1.2)
    ]
    regressors = [Linear([[-r, w], [-w, -r]]) for r, w in ((1.0, 0.0), (0.3, 3.0), (0.3, -3.0))]

    def controller(energy, regressor):
        return Controller(energy, regressor, 1.0, 1.0, "code", 0.05, 500.0)

    dt = np.array([0.02, 0.02])
    for energy, regressor in itertools.product(energies, regressors[1:]):
        made, x = [], np.array([[1.0, 0.5], [-0.7, 1.0]])
        for _ in range(150):
            made.append(x)
            x = controller(energy, regressor).step(x, dt)
        positions = list(np.stack(made, axis=1))
        found = best_controller(energies, regressors, controller, positions, dt)
        assert found.regressor is regressor
        assert found.energy is energy
        assert reproduction_errors(found, 1, positions, dt, 1, 250) == [0.0]


# The correction -----------------------------------------------------------------------------


@pytest.mark.parametrize("rho", ["paper", "code"])
def test_with_a_quadratic_v_the_correction_is_the_closed_form(rho):
    """f = fhat - max(2 xᵀPfhat + rho, 0) / (4 ‖Px‖²) 2 P x."""
    settings = {**QUICK, "max_terms": 0, "rho": rho, "rho0": 0.3, "kappa0": 2.0}
    system = CLFDM(**settings).fit(motion(), seed=0)
    matrix, length, time = system.energy_.matrices[0], system.length_, system.time_
    x = np.random.default_rng(0).uniform(-80, 80, size=(300, 2))
    corrected = 0
    for state, velocity in zip(x, system.velocity(x), strict=True):
        z = state / length
        raw = system.regressor_.velocity(state[None])[0] * time / length
        slope = 2 * matrix @ z
        size = np.linalg.norm(z)
        least = {
            "paper": 0.3 * (1 - np.exp(-2.0 * size)),
            "code": 0.3 * (1 - np.exp(-2.0 * size**2)) * np.linalg.norm(slope),
        }[rho]
        excess = slope @ raw + least
        corrected += excess > 0
        expected = raw - max(excess, 0.0) / (slope @ slope) * slope
        np.testing.assert_allclose(velocity, expected * length / time, rtol=1e-9, atol=1e-9)
    assert 0 < corrected < len(x)


@pytest.mark.parametrize("rho", ["paper", "code"])
@pytest.mark.parametrize("regressor", ["gmr", "gpr", "svr"])
def test_v_falls_at_every_step_of_any_dt(rho, regressor):
    settings = {**QUICK, "rho": rho, "regressor": regressor, "kernel_samples": 60}
    system = CLFDM(**settings).fit(motion(), seed=0)
    x = np.random.default_rng(0).uniform(-100, 100, size=(400, 2))
    assert (system.lyapunov_rate(x) < 0).all()
    for dt in (1e-3, 0.1, 10.0, 1e4):
        after = system.step(x, dt)
        assert np.isfinite(after).all()
        assert (system.lyapunov(after) < system.lyapunov(x)).all()


def test_the_goal_is_reached_at_a_coarse_time_step():
    """Explicit Euler of the same controller goes to and fro across the bottom of V."""
    demonstrations = motion("Sharpc")
    system = CLFDM(**QUICK).fit(demonstrations, seed=0)
    dt = 10 * demonstrations.mean_dt
    x = euler = demonstrations.starts
    for _ in range(600):
        x = system.step(x, dt)
        euler = euler + dt * system.velocity(euler)
    assert np.linalg.norm(x, axis=1).max() < 0.01 * system.length_
    assert np.linalg.norm(euler, axis=1).min() > 0.1 * system.length_


WAY = [(-12, 0), (-6, 10), (5, 13), (15, 8), (18, 0), (12, -6), (5, -4), (0, 0)]


def away_first():
    """A motion from (-12, 0) over the goal to (18, 0), farther away, before it comes back."""
    u = np.linspace(0.0, 1.0, 200)
    path = CubicSpline(np.linspace(0.0, 1.0, len(WAY)), WAY)(u)
    aside = (1 - u)[:, None] * [0.0, 1.0]
    return Demonstrations.from_arrays([path + k * aside for k in (-1, 0, 1)], dt=0.02)


def test_a_motion_that_goes_away_first_is_made_by_clf_dm_and_not_by_seds():
    """V(-1.5 x) = 2.25 V(x) for every quadratic V, SEDS's among them: none falls along it."""
    demonstrations = away_first()
    path = demonstrations.positions[1]
    np.testing.assert_allclose(path[np.abs(path - [18, 0]).sum(axis=1).argmin()], [18, 0], atol=0.4)
    size = demonstrations.bounding_box.diagonal

    def error(system):
        made = system.rollout(demonstrations.starts, len(path) - 1, 0.02)
        return np.mean([frechet(p, q) for p, q in zip(demonstrations.positions, made, strict=True)])

    seds = error(SEDS(n_initialisations=2).fit(demonstrations, seed=0))
    quadratic = error(CLFDM(n_initialisations=1, max_terms=0).fit(demonstrations, seed=0))
    asymmetric = error(CLFDM(n_initialisations=1, max_terms=2).fit(demonstrations, seed=0))
    assert seds > 0.15 * size
    assert quadratic > 0.15 * size
    assert asymmetric < 0.03 * size


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
@pytest.mark.parametrize("regressor", ["gmr", "gpr", "svr"])
def test_degenerate_demonstrations_fit(positions, regressor, tmp_path):
    demonstrations = Demonstrations.from_arrays(positions, dt=0.02)
    settings = {"regressor": regressor, "n_initialisations": 1, "max_terms": 1, "weights": (0.1,)}
    system = CLFDM(kernel_samples=60, **settings).fit(demonstrations, seed=0)
    box = demonstrations.bounding_box.diagonal
    x = np.random.default_rng(0).normal(size=(200, demonstrations.n_dims)) * box
    assert np.isfinite(system.velocity(x)).all()
    assert (system.lyapunov_rate(x) < 0).all()
    assert (system.lyapunov(system.step(x, 0.02)) < system.lyapunov(x)).all()
    again = CLFDM.load(system.save(tmp_path / "model"))
    np.testing.assert_array_equal(again.step(x, 0.02), system.step(x, 0.02))


BAD = {
    "regressor": "forest",
    "rho": "mine",
    "n_components": 0,
    "max_terms": -1,
    "weights": (),
    "rho0": 0.0,
}


@pytest.mark.parametrize(("name", "value"), BAD.items())
def test_settings_that_are_none_are_refused(name, value):
    with pytest.raises(ValueError, match=f"Expected {name}.* got"):
        CLFDM(**{name: value})


# Files --------------------------------------------------------------------------------------

APART = 1 - np.eye(2)

TAMPERED = {
    "a V that is none": ("matrices", lambda a: -a, "matrix of V > 0 on the diagonal"),
    "a lopsided V": ("matrices", lambda a: a * [[1, 1.5], [1, 1]], "symmetric matrix of V"),
    "a saddle": ("matrices", lambda a: a + 9 * np.trace(a.T)[:, None, None] * APART, "definite"),
    "a length of 0": ("scales", lambda a: a * [0.0, 1.0], "scales of length and time > 0"),
    "priors": ("regressor.priors", lambda a: 5 * a, "priors > 0 that sum to 1"),
}


@pytest.mark.parametrize(("key", "change", "message"), TAMPERED.values(), ids=TAMPERED.keys())
def test_a_file_that_proves_nothing_is_refused(tmp_path, monkeypatch, key, change, message):
    system = CLFDM(**QUICK).fit(motion(), seed=0)
    arrays = system._arrays()
    monkeypatch.setattr(system, "_arrays", lambda: {**arrays, key: change(arrays[key])})
    with pytest.raises(ModelFileError, match=message):
        CLFDM.load(system.save(tmp_path / "model"))


def test_kernels_of_length_zero_are_refused(tmp_path, monkeypatch):
    system = CLFDM(regressor="gpr", kernel_samples=40, max_terms=0).fit(motion(), seed=0)
    arrays = system._arrays()
    monkeypatch.setattr(system, "_arrays", lambda: {**arrays, "regressor.lengths": np.zeros(2)})
    with pytest.raises(ModelFileError, match="lengths > 0"):
        CLFDM.load(system.save(tmp_path / "model"))
    assert dataclasses.asdict(system.config)["regressor"] == "gpr"
