"""The shield: its projection against a solver, its propositions against the worst agent."""

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize

from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.lyapunov import FlowLyapunov
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.evaluate import evaluate
from iflow_gym.evaluation import goals
from iflow_gym.policy import DynamicalSystemPolicy
from iflow_gym.registration import POINT_MASS_ID
from iflow_gym.residual import LyapunovShield, ResidualActionWrapper, ResidualPolicy
from iflow_gym.residual.composition import Composition, lyapunov_of
from iflow_gym.residual.policy import Hostile, Zero
from iflow_gym.residual.shield import SLACK, projected, within_speed

finite = st.floats(-3, 3, allow_nan=False).map(lambda v: round(v, 3))


def vectors(d):
    return arrays(np.float64, (1, d), elements=finite)


@pytest.fixture(scope="module")
def angle():
    return ImitationFlow(n_steps=60).fit(load_lasa("Angle"), seed=0)


@pytest.fixture(scope="module")
def letter():
    return ImitationFlow(n_steps=60).fit(load_letter("O"), seed=0)


# The gradient -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["angle", "letter"])
def test_the_gradient_is_that_of_finite_differences(kind, request):
    system = request.getfixturevalue(kind)
    lyapunov = FlowLyapunov(system)
    box = (load_lasa("Angle") if kind == "angle" else load_letter("O")).bounding_box
    x = np.random.default_rng(0).uniform(box.low - 5, box.high + 5, (200, 2))
    value, gradient = lyapunov.value_and_gradient(x)
    np.testing.assert_allclose(value, system.lyapunov(x), rtol=1e-12)
    step = 1e-5 * box.diagonal
    for i in range(2):
        e = step * np.eye(2)[i]
        slope = (system.lyapunov(x + e) - system.lyapunov(x - e)) / (2 * step)
        np.testing.assert_allclose(gradient[:, i], slope, rtol=1e-4, atol=1e-6)
    rate = (gradient * system.velocity(x)).sum(axis=1)
    np.testing.assert_allclose(rate, system.lyapunov_rate(x), rtol=1e-8, atol=1e-10)
    assert (rate <= -lyapunov.decay * value * (1 - 1e-9)).all()


# The projection -----------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
def test_the_projection_is_the_solution_of_its_quadratic_program(d):
    rng = np.random.default_rng(d)
    changed = 0
    for _ in range(40):
        c, r, g = rng.normal(size=(3, d))
        b = rng.normal()
        limit = max(b, g @ c)
        solved = minimize(
            lambda u, r=r: ((u - r) ** 2).sum(),
            np.zeros(d),
            jac=lambda u, r=r: 2 * (u - r),
            constraints={"type": "ineq", "fun": lambda u, c=c, g=g, m=limit: m - g @ (c + u)},
            method="SLSQP",
            options={"ftol": 1e-14},
        )
        found = projected(c[None], r[None], g[None], np.array([b]))[0]
        np.testing.assert_allclose(found, solved.x, atol=1e-6)
        changed += not np.allclose(found, r)
    assert 5 < changed < 35


@given(vectors(3), vectors(3), vectors(3), st.floats(-3, 3))
@settings(max_examples=200, deadline=None)
def test_the_projection_is_feasible_idempotent_and_along_the_gradient(c, r, g, b):
    kept = projected(c, r, g, np.array([b]))
    limit = max(b, float((g * c).sum()))
    assert float((g * (c + kept)).sum()) <= limit + 1e-9
    np.testing.assert_allclose(projected(c, kept, g, np.array([b])), kept, atol=1e-9)
    off = kept - r
    np.testing.assert_allclose(np.linalg.norm(np.cross(off, g)), 0, atol=1e-9)
    if float((g * (c + r)).sum()) <= limit:
        np.testing.assert_array_equal(kept, r)


@given(vectors(2), vectors(2))
@settings(max_examples=200, deadline=None)
def test_the_speed_limit_shortens_and_does_not_bend(c, r):
    c = np.clip(c, -1, 1)
    kept = within_speed(c, r, 1.0)
    assert np.abs(c + kept).max() <= 1.0
    share = np.linalg.norm(kept) / max(np.linalg.norm(r), 1e-300)
    assert share <= 1.0
    np.testing.assert_allclose(kept, share * r, atol=1e-12)
    if np.abs(c + r).max() <= 0.999:
        np.testing.assert_array_equal(kept, r)


# The guarantee at dt ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["angle", "letter"])
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_v_falls_at_every_step_for_every_agent(kind, data, request):
    """From anywhere, at any residual and any dt: at the required rate, or as the base's own."""
    system = request.getfixturevalue(kind)
    env_id = "iflow/LASA-Angle-v0" if kind == "angle" else "iflow/Letter-O-v0"
    task = gymnasium.make(env_id).unwrapped
    lyapunov = FlowLyapunov(system)
    shield = LyapunovShield(lyapunov, task.max_speed, 0.3)
    policy = DynamicalSystemPolicy(system, max_speed=task.max_speed, dt=1.0)
    box = task.demonstrations.bounding_box
    rng = np.random.default_rng(data.draw(st.integers(0, 2**31)))
    n = 50
    x = rng.uniform(box.low - 0.5 * box.diagonal, box.high + 0.5 * box.diagonal, (n, 2))
    dt = np.full(n, data.draw(st.sampled_from([0.1, 1.0, 10.0]))) * task.demonstrations.mean_dt
    c = policy.command(x, dt)
    r = rng.normal(size=(n, 2)) * data.draw(st.sampled_from([0.01, 0.3, 3.0])) * task.max_speed
    kept = shield.kept(x, c, r, dt)
    assert np.abs(c + kept).max() <= task.max_speed
    before, after = lyapunov.value(x), lyapunov.value(x + dt[:, None] * (c + kept))
    as_base = (kept == 0).all(axis=1)
    bound = np.maximum(np.exp(-shield.rate * dt) * before, lyapunov.floor)
    assert (after[~as_base] <= bound[~as_base] * (1 + 1e-12)).all()
    assert (after[as_base] < before[as_base]).all()
    assert (~as_base).mean() > 0.3


@pytest.mark.parametrize("kind", ["angle", "letter"])
def test_v_falls_along_the_environment_under_the_worst_agent(kind, request):
    """What the proposition says of the environment itself, step by step, from states to states."""
    system = request.getfixturevalue(kind)
    env_id = "iflow/LASA-Angle-v0" if kind == "angle" else "iflow/Letter-O-v0"
    envs = gymnasium.make_vec(env_id, num_envs=32, vectorization_mode="vector_entry_point")
    wrapped = ResidualActionWrapper(envs, system, scale=1.0, stable=0.5)
    lyapunov = FlowLyapunov(system)
    hostile = Hostile(wrapped.composition, lyapunov)
    demos = envs.unwrapped.demonstrations
    rng = np.random.default_rng(3)
    box = demos.bounding_box
    starts = rng.uniform(box.low - 0.3 * box.diagonal, box.high + 0.3 * box.diagonal, (32, 2))
    wrapped.reset(seed=0, options={"start": starts})
    value = system.lyapunov(starts)
    floor = 1e-12 * system.lyapunov(np.array(box.high)[None])[0]
    rate = wrapped.composition.shield.rate
    for _ in range(150):
        x = np.stack(envs.unwrapped._state, axis=-1)
        _, _, _, _, info = wrapped.step(hostile.at(x))
        after = system.lyapunov(np.stack(envs.unwrapped._state, axis=-1))
        bound = np.maximum(np.exp(-rate * info["dt"]) * value, lyapunov.floor)
        as_base = (info["command"] == info["base_command"]).all(axis=1)
        assert (after <= np.where(as_base, value, bound) * (1 + 1e-9) + floor).all()
        value = after


def test_the_worst_agent_keeps_no_start_from_the_goal_with_the_shield_and_all_without():
    """On every 20th sample of the recordings: the guarantee does not hang on a small dt."""
    fine = load_lasa("Angle")
    coarse = Demonstrations.from_arrays(
        [p[::20] for p in fine.positions], dt=[20 * dt for dt in fine.dt], name="Angle"
    )
    system = ImitationFlow(n_steps=60).fit(coarse, seed=0)
    env = gymnasium.make(POINT_MASS_ID, demonstrations=coarse).unwrapped
    converged = {}
    for stable in (False, 0.5):
        agent = Hostile(Composition(env, system, 0.1, stable), lyapunov_of(system))
        policy = ResidualPolicy(agent, system, 0.1, stable=stable)
        converged[stable] = goals.stability(policy, env, [0], [1])[0]["converged"]
    base = goals.stability(ResidualPolicy(Zero(2), system), env, [0], [1])[0]["converged"]
    assert base == converged[0.5] == 1.0
    assert converged[False] < 0.5


def test_round_a_cycle_only_what_leads_away_is_taken_off(letter):
    """Tempo is free: along the level sets of V, however long, nothing is changed."""
    lyapunov = FlowLyapunov(letter)
    task = gymnasium.make("iflow/Letter-O-v0").unwrapped
    shield = LyapunovShield(lyapunov, task.max_speed)
    x = np.concatenate(task.demonstrations.positions)[::50]
    dt = np.full(len(x), 1e-3 * task.demonstrations.mean_dt)
    policy = DynamicalSystemPolicy(letter, max_speed=task.max_speed, dt=1.0)
    c = policy.command(x, dt)
    _, gradient = lyapunov.value_and_gradient(x)
    along = np.stack([-gradient[:, 1], gradient[:, 0]], axis=1)
    along *= 0.1 * task.max_speed / np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(shield.kept(x, c, along, dt), along, rtol=1e-6)
    outward = 0.1 * task.max_speed * gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    kept = shield.kept(x, c, along + outward, dt)
    off = lyapunov.value(x) > lyapunov.floor
    assert off.sum() > 5
    assert ((kept * gradient).sum(axis=1) < (outward * gradient).sum(axis=1))[off].all()


def test_on_the_cycle_the_tempo_is_the_agents_at_the_environments_dt(letter):
    """Faster and slower round the orbit from the orbit itself, and never out of the tube."""
    lyapunov = FlowLyapunov(letter)
    envs = gymnasium.make_vec("iflow/Letter-O-v0", 8, "vector_entry_point", horizon=1000)
    on_it = letter.rollout(load_letter("O").positions[0][0], 4000, 0.01)[-1]
    way = {}
    for faster in (-0.5, 0.0, 0.5):
        wrapped = ResidualActionWrapper(envs, letter, scale=0.2, stable=True)
        _, info = wrapped.reset(seed=0, options={"start": on_it})
        base, angles = info["base_command"], [_angle(letter, on_it)]
        for _ in range(20):
            action = faster * base / (0.2 * envs.unwrapped.max_speed)
            _, _, _, _, info = wrapped.step(action)
            x = np.stack(envs.unwrapped._state, axis=-1)
            assert lyapunov.value(x).max() <= lyapunov.floor * (1 + 1e-9)
            angles.append(_angle(letter, x[0]))
            base = wrapped._command
        # Steps are far shorter than half a round, and so are told from what is beyond it.
        way[faster] = float(np.unwrap(angles)[-1] - angles[0])
    expected = 2 * np.pi * 20 * float(info["dt"][0]) / letter.period_
    assert abs(way[0.0]) == pytest.approx(expected, rel=0.02)
    assert 0.4 < way[-0.5] / way[0.0] < 0.6
    assert way[0.5] / way[0.0] > 1.2


def _angle(system, x):
    """Return the angle of a state round the latent cycle, in radians."""
    z = system._encode(x[None])[0][0]
    return np.arctan2(z[1], z[0])


def test_bad_arguments_say_what_was_expected(angle):
    lyapunov = FlowLyapunov(angle)
    with pytest.raises(ValueError, match=r"rate_share in \(0, 1\], got 0"):
        LyapunovShield(lyapunov, 1.0, 0.0)
    with pytest.raises(ValueError, match="max_speed > 0"):
        LyapunovShield(lyapunov, np.inf)
    with pytest.raises(ValueError, match="use ImitationFlow"):
        lyapunov_of(Zero(2))


def test_evaluation_of_the_base_alone_is_that_of_the_base(angle):
    env = gymnasium.make("iflow/LASA-Angle-v0")
    with_nothing = ResidualPolicy(Zero(2), angle, stable=True)
    ours = evaluate(with_nothing, env, seed=0, stability=False).per_demonstration
    theirs = evaluate(angle, env, seed=0, stability=False).per_demonstration
    for name in ("rmse", "frechet", "dtw", "swept_area"):
        assert ours[name] == theirs[name]


# A plant that does not follow ---------------------------------------------------------------


def test_an_agent_has_no_say_where_the_plant_does_not_follow(angle):
    """A mass too heavy to move: V stays, and after ln(S) / (rho / 2) the base is alone."""
    envs = gymnasium.make_vec(
        "iflow/Disturbed-Angle-v0", 3, "vector_entry_point", mass_ratio=1e9, horizon=10**6
    )
    wrapped = ResidualActionWrapper(envs, angle, scale=0.1, stable=True)
    shield = wrapped.composition.shield
    until = np.log(SLACK) / (shield.rate / 2)
    wrapped.reset(seed=0)
    value = shield.lyapunov.value
    first, dt = value(positions(wrapped)), envs.unwrapped.dt
    n_steps = int(1.5 * np.max(until / dt))
    may = np.empty((n_steps, 3), dtype=bool)
    said = np.empty_like(may)
    for k in range(n_steps):
        may[k] = value(positions(wrapped)) <= SLACK * np.exp(-shield.rate / 2 * k * dt) * first
        said[k] = heard(wrapped)
    np.testing.assert_array_equal(said, may)
    assert said[20].all()
    assert not said[-1].any()
    wrapped.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(heard(wrapped), [False, True, False])


def positions(wrapped):
    return np.stack(wrapped.env.unwrapped._state, axis=-1)[:, :2]


def heard(wrapped):
    """Where an action that the projection lets through is kept, in a step."""
    inward = -np.sign(wrapped.composition.shield.lyapunov.value_and_gradient(positions(wrapped))[1])
    _, _, _, _, info = wrapped.step(inward)
    return (info["command"] != info["base_command"]).any(axis=1)


@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_where_commands_are_carried_out_the_measured_v_never_silences_an_agent(data, angle):
    """Without a speed limit that slows the base."""
    lyapunov = FlowLyapunov(angle)
    task = gymnasium.make("iflow/LASA-Angle-v0").unwrapped
    shield = LyapunovShield(lyapunov, 1e3 * task.max_speed)
    policy = DynamicalSystemPolicy(angle, max_speed=1e3 * task.max_speed, dt=1.0)
    box, rng = (
        task.demonstrations.bounding_box,
        np.random.default_rng(data.draw(st.integers(0, 99))),
    )
    x = rng.uniform(box.low - box.diagonal / 2, box.high + box.diagonal / 2, (20, 2))
    dt = np.full(20, 5 * task.demonstrations.mean_dt)
    allowance, begun = None, np.ones(20, dtype=bool)
    for _ in range(20):
        allowance = shield.allowance(x, dt, allowance, begun)
        begun = ~begun & False
        assert (lyapunov.value(x) <= allowance).all()
        c, r = policy.command(x, dt), rng.normal(size=(20, 2)) * task.max_speed
        kept = shield.kept(x, c, r, dt, allowance)
        np.testing.assert_array_equal(kept, shield.kept(x, c, r, dt))
        x = x + dt[:, None] * (c + kept)


def test_an_agent_of_a_motion_that_repeats_is_never_silenced(letter):
    shield = LyapunovShield(FlowLyapunov(letter), 1.0)
    x, begun = np.ones((2, 2)), np.array([True, False])
    assert np.isinf(shield.allowance(x, np.ones(2), None, begun)).all()
