"""StableLinear against closed forms, an ODE solver and brute force."""

import numpy as np
import pytest
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import approx_fprime, minimize

from iflow_gym.baselines.linear import (
    StableLinear,
    fit_stable_matrix,
    lyapunov_matrix,
    stable_objective,
)
from iflow_gym.baselines.ornstein_uhlenbeck import transition
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.model_files import ModelFileError

SPIRAL = np.array([[-1.5, 4.0], [-3.0, -2.0]])
GOAL = np.array([30.0, -7.0])


def flows_of(matrix, goal=GOAL, n=3, samples=200, duration=4.0, scale=50.0):
    """Recordings of x' = A (x - goal) itself, with its own velocities."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, duration, samples)
    flows = np.stack([expm(s * matrix) for s in t])
    offsets = [flows @ x0 for x0 in scale * rng.normal(size=(n, len(matrix)))]
    return Demonstrations.from_arrays(
        [goal + x for x in offsets],
        velocities=[x @ matrix.T for x in offsets],
        dt=duration / (samples - 1),
        goal=goal,
        goal_tolerance=1e6,
    )


@pytest.mark.parametrize(
    "matrix",
    [
        SPIRAL,
        np.diag([-1.0, -20.0]),
        np.array([[-1.0, 0.0, 5.0], [0.0, -3.0, 1.0], [-5.0, 0.0, -2.0]]),
    ],
    ids=["spiral", "stiff", "3-D"],
)
def test_recovers_the_matrix_of_a_linear_motion(matrix):
    goal = np.arange(len(matrix)) * 10.0
    system = StableLinear().fit(flows_of(matrix, goal), seed=0)
    np.testing.assert_allclose(system.matrix_, matrix, rtol=0, atol=1e-6)


def test_an_unstable_motion_gives_the_nearest_stable_matrix():
    unstable = np.array([[0.4, 2.0], [-2.0, 0.1]])
    demonstrations = flows_of(unstable)
    free = StableLinear(margin=1.0).fit(demonstrations, seed=0)
    margin = 1.0 / demonstrations.durations.mean()
    values = np.linalg.eigvals(free.matrix_)
    assert values.real.max() <= -margin * (1 - 1e-9)
    # The constraint binds: what least squares wants is on its other side.
    assert values.real.max() == pytest.approx(-margin, rel=1e-3)


@pytest.mark.parametrize("shape", ["Sshape", "NShape", "BendedLine", "Zshape"])
def test_no_random_start_finds_a_better_matrix(shape):
    """On these shapes least squares keeps no margin; 25 random starts are the brute force."""
    demonstrations = load_lasa(shape)
    x = np.concatenate(demonstrations.positions)[::5] / 30.0
    v = np.concatenate(demonstrations.velocities)[::5] / 30.0 * demonstrations.durations.mean()
    second, cross = x.T @ x / len(x), v.T @ x / len(x)
    found = fit_stable_matrix(x, v, 1.5)
    assert np.linalg.eigvals(found).real.max() <= -1.5 + 1e-9

    def cost(a):
        return 0.5 * np.sum(a * (a @ second - 2 * cross))

    rng = np.random.default_rng(0)
    best = min(
        minimize(
            stable_objective,
            rng.normal(size=7),
            args=(second, cross, 1.5),
            jac=True,
            method="L-BFGS-B",
        ).fun
        for _ in range(25)
    )
    assert cost(found) <= best + 1e-6 * abs(best)


def test_no_grid_point_is_better_where_the_optimum_is_on_the_boundary():
    """In the plane stable means trace < 0 < det: a check that does not know the factors."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(300, 2))
    v = x @ np.array([[0.5, 1.5], [-1.0, 0.2]]).T
    found = fit_stable_matrix(x, v, 0.5)
    cost = np.mean((x @ found.T - v) ** 2)
    shifts = rng.normal(size=(200_000, 2, 2)) * 0.3
    tried = found + shifts
    shifted = tried + 0.5 * np.eye(2)
    stable = (np.trace(shifted, axis1=1, axis2=2) < 0) & (np.linalg.det(shifted) > 0)
    second = x.T @ x / len(x)
    target = np.array([[0.5, 1.5], [-1.0, 0.2]])
    apart = tried[stable] - target
    costs = np.einsum("nij,jk,nik->n", apart, second, apart) / 2
    assert stable.sum() > 1000
    assert costs.min() >= cost * (1 - 1e-6)


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_the_gradient_is_the_derivative(d):
    rng = np.random.default_rng(d)
    x, v = rng.normal(size=(2, 40, d))
    arguments = (x.T @ x / 40, v.T @ x / 40, 0.7)
    parameters = rng.normal(size=d * (d - 1) // 2 + d * (d + 1))
    _, gradient = stable_objective(parameters, *arguments)
    numeric = approx_fprime(parameters, lambda p: stable_objective(p, *arguments)[0], 1e-7)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())


def test_step_is_the_flow():
    system = StableLinear().fit(load_lasa("GShape"), seed=0)
    x0 = np.array([[-40.0, 30.0], [100.0, 5.0], [1.0, -1.0]])
    times = np.array([0.01, 2.0, 0.3])
    stepped = system.step(x0, times)
    for start, t, end in zip(x0, times, stepped, strict=True):
        path = solve_ivp(lambda _, x: system.velocity(x), (0, t), start, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(end, path.y[:, -1], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(system.step(x0, 0.3)[2], stepped[2], rtol=1e-13)
    np.testing.assert_allclose(system.rollout(x0, 50, 0.04)[1, -1], stepped[1], rtol=1e-10)


def test_the_lyapunov_function_decreases_at_its_stated_rate():
    system = StableLinear().fit(load_lasa("Sshape"), seed=0)
    x = np.random.default_rng(0).normal(size=(500, 2)) * 60
    assert (system.lyapunov(x) > 0).all()
    rate = system.lyapunov_rate(x)
    assert (rate < 0).all()
    h = 1e-6
    numeric = (system.lyapunov(system.step(x, h)) - system.lyapunov(x)) / h
    np.testing.assert_allclose(rate, numeric, rtol=1e-4)


def test_lyapunov_matrix_refuses_what_is_not_stable():
    with pytest.raises(ValueError, match="negative real parts beyond rounding, got 0"):
        lyapunov_matrix(np.array([[0.0, 1.0], [-1.0, 0.0]]))


@pytest.mark.parametrize("dt", [1e-3, 0.7, 40.0])
def test_transition_covariance_is_the_integral(dt):
    diffusion = np.array([[2.0, 0.3], [0.3, 1.0]])
    flow, found = transition(SPIRAL, diffusion, dt)
    np.testing.assert_allclose(flow, expm(dt * SPIRAL), rtol=1e-10, atol=1e-300)
    exact, _ = quad_vec(
        lambda s: expm(s * SPIRAL) @ diffusion @ expm(s * SPIRAL).T, 0, dt, epsrel=1e-10, limit=2000
    )
    np.testing.assert_allclose(found, exact, rtol=1e-7)


DRIFTS = {
    "spiral": SPIRAL,
    "stiff": np.diag([-0.05, -300.0]),
    "far from normal": np.array([[-1.0, 500.0], [0.0, -2.0]]),
    "3-D": np.array([[-1.0, 0.0, 5.0], [0.0, -3.0, 1.0], [-5.0, 0.0, -2.0]]),
}


@pytest.mark.parametrize("drift", DRIFTS.values(), ids=DRIFTS.keys())
@pytest.mark.parametrize("size", [1e-14, 1.0, 1e8])
@pytest.mark.parametrize("time", [1e-4, 1e-2, 1.0, 10.0, 100.0, 1e4, 1e300])
def test_transitions_of_any_horizon_are_p_less_what_is_left_of_it(drift, size, time):
    """Q = P - F P Fᵀ with A P + P Aᵀ + D = 0, whose cancellation costs 1e-4 / |A| digits here."""
    d = len(drift)
    diffusion = size * (np.eye(d) + 0.5 * np.ones((d, d)))
    stationary = solve_continuous_lyapunov(drift, -diffusion)
    flow = expm(min(time, 1e5) * drift)
    expected = stationary - flow @ stationary @ flow.T
    found_flow, found = transition(drift, diffusion, time)
    np.testing.assert_allclose(found_flow, flow, rtol=0, atol=1e-11 * max(1, np.abs(flow).max()))
    roots = np.sqrt(np.diag(expected))
    scaled = (found - expected) / np.outer(roots, roots)
    np.testing.assert_allclose(scaled, 0, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(found, found.T)
    assert np.linalg.eigvalsh(found / np.outer(roots, roots)).min() > 0


def test_a_density_of_a_long_horizon_forgets_the_start():
    system = StableLinear().fit(load_lasa("Angle"), seed=0)
    far = 100 * load_lasa("Angle").durations.mean()
    x, x_next = np.array([[-40.0, 10.0], [3.0, 9.0]]), np.array([[0.1, -0.2]] * 2)
    value = system.log_prob(x, x_next, far)
    assert value[0] == pytest.approx(value[1], rel=1e-12)
    assert value[0] == pytest.approx(system.log_prob(x, x_next, 2 * far)[0], rel=1e-12)


def test_a_horizon_beyond_a_recording_is_its_longest():
    demonstrations = flows_of(SPIRAL, n=2, samples=20)
    noisy = Demonstrations.from_arrays(
        [p + np.random.default_rng(1).normal(size=p.shape) for p in demonstrations.positions],
        dt=demonstrations.dt,
        goal=GOAL,
        goal_tolerance=1e6,
    )
    cut, longest, twice = (
        StableLinear(noise_horizons=h).fit(noisy, seed=0).diffusion_
        for h in ((1, 1000), (1, 19), (1, 19, 1000))
    )
    np.testing.assert_array_equal(cut, longest)
    np.testing.assert_array_equal(cut, twice)
    shorter = StableLinear(noise_horizons=(1,)).fit(noisy, seed=0).diffusion_
    assert np.abs(cut - shorter).max() > 1e-3 * np.abs(shorter).max()


def test_noise_of_a_simulated_process_is_found():
    """Exact transitions of a process with a known D; 20 000 of them leave about 1 %."""
    rng = np.random.default_rng(0)
    diffusion, dt, n = np.array([[4.0, 1.0], [1.0, 2.0]]), 0.01, 20_000
    flow = expm(dt * SPIRAL)
    root = np.linalg.cholesky(transition(SPIRAL, diffusion, dt)[1])
    noise = rng.normal(size=(n, 2)) @ root.T
    x = np.empty((n, 2))
    x[0] = 20.0, 10.0
    for i in range(1, n):
        x[i] = flow @ x[i - 1] + noise[i]
    demonstrations = Demonstrations.from_arrays(
        [x], velocities=[x @ SPIRAL.T], dt=dt, goal=np.zeros(2), goal_tolerance=100.0
    )
    system = StableLinear(noise_horizons=(1,)).fit(demonstrations, seed=0)
    np.testing.assert_allclose(system.matrix_, SPIRAL, atol=1e-6)
    np.testing.assert_allclose(system.diffusion_, diffusion, rtol=0, atol=0.1)


DEGENERATE = {
    "one demonstration": [np.linspace([10.0, 5.0], [0.0, 0.0], 100) ** 2],
    "a straight line": [np.linspace([10.0, 5.0], [0.0, 0.0], 100)] * 2,
    "along an axis": [np.linspace([10.0, 0.0], [0.0, 0.0], 100)],
    "30 samples": [np.linspace([10.0, 5.0], [0.0, 0.0], 30) ** 3],
    "3 samples": [np.array([[10.0, 5.0], [4.0, 1.0], [0.0, 0.0]])],
    "identical": [np.linspace([10.0, 5.0], [0.0, 0.0], 50) ** 2] * 4,
    "away from the goal and back": [np.array([[0.0, 0.0], [5.0, 9.0], [9.0, 1.0], [0.0, 0.0]])],
    "metres at night": [1e-9 * np.linspace([10.0, 5.0], [0.0, 0.0], 50) ** 2],
}


@pytest.mark.parametrize("positions", DEGENERATE.values(), ids=DEGENERATE.keys())
def test_degenerate_demonstrations_give_a_stable_system(positions):
    system = StableLinear().fit(Demonstrations.from_arrays(positions, dt=0.1), seed=0)
    x = np.concatenate(positions)
    assert np.linalg.eigvals(system.matrix_).real.max() < 0
    assert np.isfinite(system.velocity(x)).all()
    assert np.isfinite(system.log_prob(x[:-1], x[1:], 0.1)).all()
    assert np.linalg.norm(system.step(x, 1e6) - system.goal_, axis=1).max() <= 1e-6 * np.ptp(x)


def test_the_unit_of_length_does_not_matter():
    shape = load_lasa("Zshape")
    metres = Demonstrations.from_arrays(
        [p / 1000 for p in shape.positions],
        velocities=[v / 1000 for v in shape.velocities],
        dt=shape.dt,
        goal=np.zeros(2),
    )
    a, b = (StableLinear().fit(d, seed=0).matrix_ for d in (shape, metres))
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"margin": 0.0}, "margin > 0, got 0.0"),
        ({"margin": np.nan}, "margin > 0, got nan"),
        ({"noise_horizons": ()}, "noise_horizons of at least one"),
        ({"noise_horizons": (0,)}, "noise_horizons of at least one"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        StableLinear(**settings)


TAMPERED = {
    "unstable": ("matrix_", lambda a: -a, "negative real parts"),
    "all zero": ("matrix_", np.zeros_like, "negative real parts beyond rounding, got 0"),
    "negative noise": ("diffusion_", lambda a: -a, "diffusion > 0 on the diagonal, got -"),
    "no noise": ("diffusion_", np.zeros_like, "diffusion > 0 on the diagonal, got 0"),
    "lopsided noise": ("diffusion_", lambda a: a + np.diag([a[0, 0]], 1), "a symmetric diffusion"),
    "indefinite noise": (
        "diffusion_",
        lambda a: a[0, 0] * np.array([[1.0, 2.0], [2.0, 1.0]]),
        "a positive definite diffusion, got the scaled eigenvalue -1",
    ),
}


@pytest.mark.parametrize(("field", "change", "message"), TAMPERED.values(), ids=TAMPERED.keys())
def test_a_file_whose_claims_fail_is_refused(tmp_path, field, change, message):
    system = StableLinear().fit(load_lasa("Line"), seed=0)
    setattr(system, field, change(getattr(system, field)))
    with pytest.raises(ModelFileError, match=message):
        StableLinear.load(system.save(tmp_path / "model"))


@pytest.mark.parametrize("positions", DEGENERATE.values(), ids=DEGENERATE.keys())
def test_degenerate_fits_come_back_from_files(tmp_path, positions):
    system = StableLinear().fit(Demonstrations.from_arrays(positions, dt=0.1), seed=0)
    again = StableLinear.load(system.save(tmp_path / "model"))
    np.testing.assert_array_equal(again.matrix_, system.matrix_)
