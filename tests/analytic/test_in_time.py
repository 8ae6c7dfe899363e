"""A cycle played in time: its phase, the orbits that it keeps to, and when its notes come."""

import gymnasium
import numpy as np
import pytest

from iflow_gym import Demonstrations, load_lasa
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.in_time import (
    InTimePolicy,
    latent_phase,
    phases_of_notes,
    rehearsed,
)
from iflow_gym.evaluate import evaluate
from iflow_gym.metrics.drumming import hit_f1, timing_error

PERIOD = 2.0
NOTES = (0.25, 0.6)
"""When in a round, from 0 to 1."""


def rounds(turn=1):
    """Return two recordings of two and a half rounds of an egg, turned one way or the other."""
    time = np.arange(0, 5.0, 0.02)
    angle = turn * 2 * np.pi * time / PERIOD
    egg = np.stack([40 * np.cos(angle), 25 * np.sin(angle) + 8 * np.cos(2 * angle)], axis=-1)
    return Demonstrations.from_arrays([egg, 1.05 * egg], dt=0.02, period=PERIOD)


@pytest.fixture(scope="module", params=[1, -1], ids=["anticlockwise", "clockwise"])
def learned(request):
    """Return demonstrations, a model of them, and its phases at the notes."""
    demos = rounds(request.param)
    model = ImitationFlow(n_steps=150).fit(demos, seed=0)
    times = np.sort(np.add.outer(PERIOD * np.arange(2), PERIOD * np.array(NOTES)).ravel())
    scores = [(times, np.array([0, 1, 0, 1]))] * 2
    return demos, model, phases_of_notes(model, demos.positions, 0.02, scores)


def arm(demos, **settings):
    return gymnasium.make("iflow/PointMass-v0", demonstrations=demos, **settings).unwrapped


def played(env, policy, n_steps, start):
    """Return where a policy goes, shape (n_steps + 1, d)."""
    observation, _ = env.reset(seed=0, options={"start": start})
    path, state = [observation], None
    for _ in range(n_steps):
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
        path.append(observation)
    return np.array(path)


def apart(a, b):
    """Return the difference of two phases, from 0 to pi."""
    return np.abs((np.asarray(a) - b + np.pi) % (2 * np.pi) - np.pi)


def test_the_phase_grows_at_one_rate_on_the_cycle_and_off_it(learned):
    demos, model, _ = learned
    starts = np.array([demos.positions[0][0], [90.0, -60.0], [10.0, 15.0]])
    psi = np.unwrap(latent_phase(model, model.rollout(starts, 200, 0.02)), axis=1)
    steps = np.diff(psi, axis=1)
    np.testing.assert_allclose(steps, steps[0, 0], rtol=1e-6)
    # The learned period is the latent one.
    assert 2 * np.pi / abs(steps[0, 0]) * 0.02 == pytest.approx(PERIOD, rel=0.1)


def test_notes_come_when_they_are_due(learned):
    demos, model, phases = learned
    # Uneven, and slower than the model on the whole.
    times, notes = np.array([0.7, 1.45, 2.8, 3.6, 4.9]), np.array([0, 1, 0, 1, 0])
    env = arm(demos, horizon=260)
    policy = InTimePolicy(model, [(times, notes)], phases, env)
    path = played(env, policy, 250, demos.positions[0][0])
    psi = latent_phase(model, path)
    at = np.round(times / env.dt).astype(int)
    rate = 2 * np.pi / PERIOD
    assert apart(psi[at], phases[notes]).max() / rate < 0.02  # one sample
    # By itself it is not in time.
    own = latent_phase(model, model.rollout(path[:1], 250, env.dt)[0])
    assert apart(own[at], phases[notes]).max() / rate > 0.1


def test_every_step_is_one_of_the_models_own_of_another_duration(learned):
    demos, model, phases = learned
    env = arm(demos, horizon=200)
    policy = InTimePolicy(model, [([0.6, 1.9], [0, 1])], phases, env, slowest=0.6, fastest=1.3)
    path = played(env, policy, 150, np.array([70.0, 40.0]))
    before, after = path[:-1], path[1:]
    turned = np.diff(np.unwrap(latent_phase(model, path)))
    rate = np.diff(latent_phase(model, model.rollout(path[:1], 1, 1e-3)[0]))[0] / 1e-3
    pace = turned / rate / env.dt
    assert pace.min() > 0.6 - 1e-6
    assert pace.max() < 1.3 + 1e-6
    assert np.ptp(pace) > 0.2
    np.testing.assert_allclose(model.step(before, pace * env.dt), after, atol=1e-6)
    assert (np.diff(model.lyapunov(path)) <= 1e-12).all()


def test_where_the_speed_limit_slows_it_it_keeps_to_the_orbit(learned):
    _, model, phases = learned
    dt, limit = 0.02, 60.0  # the egg is drawn at up to twice that
    policy = InTimePolicy(model, [([0.3, 0.9], [0, 1])], phases, max_speed=limit, dt=dt)
    path, state, limited = [np.array([70.0, 40.0])], None, 0
    for _ in range(100):
        action, state = policy.predict(path[-1], state)
        assert np.abs(action).max() <= 1 + 1e-9
        limited += np.abs(action).max() > 1 - 1e-6
        path.append(path[-1] + dt * limit * action)
    path = np.array(path)
    turned = np.diff(np.unwrap(latent_phase(model, path)))
    rate = np.diff(latent_phase(model, model.rollout(path[:1], 1, 1e-3)[0]))[0] / 1e-3
    np.testing.assert_allclose(model.step(path[:-1], turned / rate), path[1:], atol=1e-6)
    assert limited > 30
    assert (np.diff(model.lyapunov(path)) <= 1e-12).all()


@pytest.mark.parametrize("shift", np.linspace(-3.1, 3.1, 12))
def test_a_note_after_itself_is_a_whole_turn_ahead(learned, shift):
    demos, model, _ = learned
    times = [0.4, 2.4, 4.4, 6.4]
    policy = InTimePolicy(model, [(times, [0] * 4)], [shift], max_speed=1000.0, dt=0.02)
    x, state = demos.positions[0][0], None
    turned = []
    for _ in range(330):
        action, state = policy.predict(x, state)
        x = x + 0.02 * 1000.0 * action
        turned.append(state["turned"][0])
    assert np.ptp(np.interp(times, 0.02 * np.arange(330), turned)) > 2.9 * 2 * np.pi


def test_a_state_that_is_lost_takes_no_other_with_it(learned):
    demos, model, phases = learned
    scores = [([0.5, 1.4], [0, 1])]
    policy = InTimePolicy(model, scores, phases, max_speed=1000.0, dt=0.02)
    x = demos.positions[0][:2].copy()
    alone, _ = policy.predict(x[1])
    x[0] = np.nan
    both, state = policy.predict(x)
    assert np.isnan(both[0]).all()
    np.testing.assert_allclose(both[1], alone, rtol=1e-12)
    found = x + 0.0
    found[0] = demos.positions[0][1]
    again, _ = policy.predict(found, state)
    assert np.isfinite(again).all()


def test_after_the_last_note_it_goes_at_its_own_pace(learned):
    demos, model, phases = learned
    env = arm(demos, horizon=200)
    policy = InTimePolicy(model, [([0.5], [0])], phases, env)
    path = played(env, policy, 60, demos.positions[0][0])
    np.testing.assert_allclose(model.step(path[30:59], env.dt), path[31:60], atol=1e-9)


def test_a_batch_is_its_rows_and_an_episode_starts_its_clock_again(learned):
    demos, model, phases = learned
    scores = [([0.5, 1.4], [0, 1]), ([0.7, 1.2], [0, 1])]
    free = {"max_speed": 1000.0, "dt": 0.02}
    both = InTimePolicy(model, scores, phases, **free)
    alone = [InTimePolicy(model, [score], phases, **free) for score in scores]
    x = np.array([demos.positions[0][0], demos.positions[1][5]])
    first, state = both.predict(x)
    second, state = both.predict(x, state, episode_start=[False, False])
    again, state = both.predict(x, state, episode_start=[True, False])
    for i, policy in enumerate(alone):
        a, own = policy.predict(x[i])
        b, own = policy.predict(x[i], own)
        c, own = policy.predict(x[i], own, episode_start=[i == 0])
        assert a.shape == (2,)
        for joined, single in ((first, a), (second, b), (again, c)):
            np.testing.assert_allclose(joined[i], single, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(again[0], first[0])
    assert state["time"].tolist() == pytest.approx([0.02, 0.06])


def test_evaluate_takes_it_as_a_policy(learned):
    demos, model, phases = learned
    scores = [([0.5, 1.2, 2.5], [0, 1, 0])] * 2
    found = evaluate(
        InTimePolicy(model, scores, phases), arm(demos), seed=0, stability=False
    ).metrics
    assert np.isfinite(found["orbit_distance"])
    assert found["step_us"] > 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scores": []}, "at least one score"),
        ({"scores": [([0.5, 0.4], [0, 1])]}, "increase from 0"),
        ({"scores": [([-0.1], [0])]}, "increase from 0"),
        ({"scores": [([np.nan], [0])]}, "increase from 0"),
        ({"scores": [([0.5], [2])]}, "notes from 0 to 1"),
        ({"scores": [([0.5], [0.0])]}, "notes from 0 to 1"),
        ({"scores": [([0.5, 1.0], [0])]}, "one shape"),
        ({"phases": [[0.0, 1.0]]}, "finite phases"),
        ({"phases": [0.0, np.inf]}, "finite phases"),
        ({"phases": []}, "finite phases"),
        ({"scores": [[3, 4, 5]]}, "Expected times and notes in score 0"),
        ({"gain": np.inf}, "finite gain"),
        ({"gain": 0.0}, "gain > 0"),
        ({"slowest": 0.0}, "0 < slowest < 1"),
        ({"fastest": 1.0}, "0 < slowest < 1"),
    ],
)
def test_what_cannot_be_played_is_refused(learned, change, said):
    _, model, phases = learned
    given = {"scores": [([0.5], [0])], "phases": phases} | change
    with pytest.raises(ValueError, match=said):
        InTimePolicy(model, **given)


def test_it_says_what_is_missing(learned):
    demos, model, phases = learned
    policy = InTimePolicy(model, [([0.5], [0])] * 2, phases)
    with pytest.raises(ValueError, match="an environment, or max_speed and dt"):
        policy.predict([0.0, 0.0])
    policy = InTimePolicy(model, [([0.5], [0])] * 3, phases, max_speed=1.0, dt=0.1)
    for n in (2, 4):
        with pytest.raises(ValueError, match=f"3 scores and {n} rows"):
            policy.predict(np.ones((n, 2)))
    with pytest.raises(ValueError, match=r"shape \(..., 2\), got \(3,\)"):
        policy.predict(np.ones(3))
    with pytest.raises(ValueError, match=r"\(d,\) or \(n, d\), got \(3, 1, 2\)"):
        policy.predict(np.ones((3, 1, 2)))
    paths = demos.positions
    with pytest.raises(ValueError, match="a score for each of 2"):
        phases_of_notes(model, paths, 0.02, [([0.5], [0])])
    with pytest.raises(ValueError, match=r"notes 0, 1, ... in the scores, got \[1\]"):
        phases_of_notes(model, paths, 0.02, [([0.5], [1])] * 2)
    reaching = ImitationFlow(n_steps=2).fit(load_lasa("Angle"), seed=0)
    with pytest.raises(ValueError, match="has no phase"):
        latent_phase(reaching, [[0.0, 0.0]])


class TestTheArm:
    def test_it_hits_the_notes_of_a_demonstration(self):
        env = gymnasium.make("iflow/Drumming-v0").unwrapped
        model = ImitationFlow(n_steps=200).fit(env.demonstrations, seed=0)
        phases = rehearsed(model, env)
        times, drums = env.score_of(3)  # the fastest: by itself, the model is late by half a second
        policy = InTimePolicy(model, [(times, drums)], phases, env)
        observation, _ = env.reset(seed=0, options={"demonstration": 3})
        state, truncated, hits = None, False, []
        while not truncated:
            action, state = policy.predict(observation, state)
            observation, _, _, truncated, info = env.step(action)
            hits += info["hits"]
        played = [hit.time for hit in hits], [hit.drum for hit in hits]
        by_itself = model.rollout(env.demonstrations.positions[3][:1], 999, env.dt)[0]
        away = latent_phase(model, by_itself)[np.round(times / env.dt).astype(int)] - phases[drums]
        assert np.abs((away + np.pi) % (2 * np.pi) - np.pi).max() > 0.2  # it is not in time
        assert hit_f1(times, drums, *played) == 1.0
        assert timing_error(times, drums, *played) < 15.0

    def test_a_model_that_misses_a_drum_has_nothing_to_play(self):
        env = gymnasium.make("iflow/Drumming-v0").unwrapped
        model = ImitationFlow(n_steps=1).fit(env.demonstrations, seed=0)
        with pytest.raises(ValueError, match=r"not so drum \d: what this model"):
            rehearsed(model, env, n_rounds=1)
        with pytest.raises(ValueError, match="n_rounds >= 1, got 0"):
            rehearsed(model, env, n_rounds=0)
        with pytest.raises(TypeError, match=r"one arm at its drums.*got LASAEnv"):
            rehearsed(model, gymnasium.make("iflow/LASA-Line-v0"))
