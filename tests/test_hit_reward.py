"""The reward that hears the drums: its kernels by hand, its order, a real stroke."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from iflow_gym.envs.hit_reward import FORCE, HitReward
from iflow_gym.metrics.drumming import TOLERANCE, Hit


@pytest.fixture(scope="module")
def env():
    return HitReward(gymnasium.make("iflow/Drumming-v0"))


def heard(env, hits, demonstration=-1):
    """Return what a sequence of hits is worth, in strokes' worths, and their errors."""
    env._last, env._index = None, demonstration
    strokes = [env._heard(hit) for hit in hits]
    return [s.worth / env.worth for s in strokes], [s.error for s in strokes]


def test_intervals_are_the_means_of_the_recordings_and_a_stroke_is_worth_half_its_steps(env):
    task = env.unwrapped
    right, left = [], []
    for i in range(6):
        times, drums = task.score_of(i)
        assert drums.tolist() == [0, 1, 0, 1]
        right.append(times[2] - times[1])
        left += [times[1] - times[0], times[3] - times[2]]
    assert env.intervals == pytest.approx({(0, 1): np.mean(left), (1, 0): np.mean(right)})
    assert sum(env.intervals.values()) == pytest.approx(task.demonstrations.period, rel=0.01)
    # Three strokes in as many intervals pay half a step's worth for each of their steps.
    total = 3 * np.mean([*left, *right]) / task.dt
    assert 3 * env.worth == pytest.approx(0.5 * total)


def test_a_stroke_in_time_and_as_loud_pays_all_and_less_on_either_side(env):
    to_left, to_right = env.intervals[0, 1], env.intervals[1, 0]
    times = np.cumsum([3.0, to_left, to_right, to_left + TOLERANCE, to_right - TOLERANCE])
    hits = [Hit(t, k % 2, FORCE) for k, t in enumerate(times)]
    worths, errors = heard(env, hits)
    assert worths == pytest.approx([1, 1, 1, 0.5, 0.5])
    assert errors[0] is None
    assert errors[1:] == pytest.approx([0, 0, TOLERANCE, -TOLERANCE], abs=1e-12)
    for force, worth in ((0.5 * FORCE, 0.5), (1.5 * FORCE, 0.5), (2 * FORCE, 0.2)):
        assert heard(env, [Hit(1.0, 0, force)])[0] == pytest.approx([worth])


def test_the_same_drum_twice_costs_and_the_next_interval_counts_from_there(env):
    hits = [Hit(1.0, 0, FORCE), Hit(1.5, 0, FORCE), Hit(1.5 + env.intervals[0, 1], 1, FORCE)]
    worths, errors = heard(env, hits)
    assert worths == pytest.approx([1, -1, 1])
    assert errors[1] is None


def test_a_recordings_first_stroke_is_due_when_it_has_it(env):
    note = float(env.unwrapped.score_of(2)[0][0])
    assert heard(env, [Hit(note + TOLERANCE, 0, FORCE)], 2)[0] == pytest.approx([0.5])
    assert heard(env, [Hit(note + 1.0, 0, FORCE)])[0] == pytest.approx([1.0])


def test_a_replay_is_kept_and_heard_and_what_stands_still_is_not(env):
    """The first note of a recording, played by the arm; its force is near the recordings'."""
    task = env.unwrapped
    path = task.demonstrations.positions[5]
    x, info = env.reset(options={"demonstration": 5})
    assert info["strokes"] == ()
    rewards, strokes = [], []
    for following in path[1:140]:
        x, reward, _, _, info = env.step(task.command_to_action((following - x) / task.dt, x))
        rewards.append(reward)
        strokes += info["strokes"]
    (stroke,) = strokes
    assert stroke.error == pytest.approx(0.0, abs=0.005)
    assert 0.5 * FORCE < stroke.hit.force < 2 * FORCE
    kept = np.array(rewards)
    kept = kept[kept < 1]  # all but the stroke's step
    assert len(kept) == len(rewards) - 1
    assert 0.4 < kept.mean() <= 0.5
    env.reset(options={"demonstration": 5})
    still = [env.step(np.zeros(3))[1] for _ in range(100)]
    assert np.mean(still[50:]) < 0.2


def test_keeping_is_a_mean_of_two_kernels_and_ends_with_the_recording(env):
    demos = env.unwrapped.demonstrations
    env.reset(options={"demonstration": 0})
    env._count = 10
    p, v = demos.positions[0][10], demos.velocities[0][10]
    width, pace = 0.1 * demos.bounding_box.diagonal, 0.1 * demos.peak_speed
    e = np.array([0.0, 0.6, 0.8])
    own = env._task
    for far, fast, worth in ((0, 0, 1.0), (1, 0, 0.75), (0, 1, 0.75), (2, 3, 0.15)):
        env._task = SimpleNamespace(
            demonstrations=demos, simulation=SimpleNamespace(tip_velocity=v + fast * pace * e)
        )
        assert env._kept(p + far * width * e, -7.0) == pytest.approx(worth)
    env._task = own
    env._count = len(demos.positions[0])
    assert env._kept(p, -7.0) == -7.0


def test_what_has_no_drums_is_refused():
    with pytest.raises(TypeError, match="with drums, got LASAEnv"):
        HitReward(gymnasium.make("iflow/LASA-Angle-v0"))
    with pytest.raises(ValueError, match="force > 0"):
        HitReward(gymnasium.make("iflow/Drumming-v0"), force=0.0)
