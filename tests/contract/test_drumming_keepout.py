"""The drums as obstacles of commands: closed forms, invariants, and what an arm does with them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iflow_gym.datasets.drums import DRUMS, LEFT, RIGHT, TIP_RADIUS
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.envs.drumming.keepout import (
    BRAKING_TIME,
    CLIMB,
    FOLLOW_THROUGH,
    REACH,
    RIM,
    RISE,
    KeepOut,
)

FACE = RIGHT.head[2] + TIP_RADIUS - FOLLOW_THROUGH
WALL = RIGHT.radius + RIM + TIP_RADIUS
OVER = np.array([RIGHT.head[0] + 0.02, RIGHT.head[1], FACE])
coordinate = st.floats(-0.5, 0.5)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)


def depth(point):
    """How deep a point is in the solid of the right drum; negative outside."""
    r = np.hypot(*(point[:2] - RIGHT.head[:2]))
    return min(FACE - point[2], WALL - r)


def test_down_onto_a_head_is_slowed_towards_the_face_and_across_it_free():
    keep = KeepOut((RIGHT,))
    above = OVER + np.array([0.0, 0.0, 0.006])
    np.testing.assert_allclose(
        keep.slid(above, np.array([0.3, -0.1, -0.5])), [0.3, -0.1, -0.006 / BRAKING_TIME]
    )
    np.testing.assert_array_equal(keep.slid(above, np.array([0.3, 0.0, -0.1])), [0.3, 0.0, -0.1])


def test_into_a_wall_a_command_slides_along_it_and_up():
    keep = KeepOut((RIGHT,))
    beside = np.array([RIGHT.head[0], RIGHT.head[1] - WALL, 0.18])
    np.testing.assert_allclose(
        keep.slid(beside, np.array([0.2, 0.04, 0.01])), [0.2, 0.0, 0.04], atol=1e-12
    )
    down = keep.slid(beside, np.array([0.2, 0.4, -0.5]))
    np.testing.assert_allclose(down, [0.2, 0.0, CLIMB], atol=1e-12)
    up = keep.slid(beside, np.array([0.2, 0.4, 0.3]))
    np.testing.assert_allclose(up, [0.2, 0.0, 0.3], atol=1e-12)
    away = np.array([0.2, -0.4, 0.1])
    np.testing.assert_array_equal(keep.slid(beside, away), away)


def test_the_stick_behind_the_tip_slides_along_a_wall_as_the_tip_does():
    """It lies along x: beside the drum it touches where the drum is widest."""
    keep = KeepOut((RIGHT,))
    ahead = np.array([RIGHT.head[0] + 0.1, RIGHT.head[1] - WALL, 0.15])
    assert depth(ahead) < -0.02  # the tip alone is far off
    slid = keep.slid(ahead, np.array([-0.05, 0.28, -0.14]))
    np.testing.assert_allclose(slid, [-0.05, 0.0, CLIMB], atol=1e-12)
    # Where the stick is above the face it is over the head, and may come down on it.
    over = ahead + np.array([0.0, 0.0, FACE - ahead[2] - 0.02 * RISE])
    free = np.array([0.0, 0.2, 0.0])
    np.testing.assert_array_equal(keep.slid(over, free), free)


def test_deep_inside_a_command_leads_out_the_nearer_way():
    keep = KeepOut((RIGHT,))
    pressed = keep.slid(OVER - np.array([0.0, 0.0, 0.003]), np.array([0.1, 0.0, -0.2]))
    assert pressed[2] == pytest.approx(0.003 / BRAKING_TIME)
    assert pressed[0] == 0.1


def test_on_the_axis_deep_inside_any_way_out_will_do():
    inside = RIGHT.head - np.array([0.0, 0.0, WALL + 0.1])
    out = KeepOut((RIGHT,)).slid(inside, np.zeros(3))
    assert np.hypot(*out[:2]) == pytest.approx(CLIMB)


@given(point=vector, velocity=vector)
def test_out_of_a_drum_leads_what_is_commanded_or_a_climb_however_deep(point, velocity):
    point = point + RIGHT.head
    slid = KeepOut((RIGHT,)).slid(point, velocity)
    most = np.linalg.norm(velocity) + CLIMB
    assert np.linalg.norm(slid[:2]) <= most + 1e-12
    assert velocity[2] <= slid[2] <= max(velocity[2], CLIMB) + 1e-12


@given(point=vector, velocity=vector)
def test_no_command_leads_deeper_in_than_the_distance_allows(point, velocity):
    point = point + RIGHT.head
    dt = 0.01
    moved = point + dt * KeepOut((RIGHT,)).slid(point, velocity)
    # A curved wall gives way to second order in the step beside it.
    assert depth(moved) <= max(depth(point), 0.0) + 1e-12 or depth(point) > 0


@given(point=vector, velocity=vector)
def test_nothing_but_a_climb_is_added_to_a_command_outside(point, velocity):
    point = point + RIGHT.head
    if max(depth_of_stick(RIGHT, point), depth_of_stick(LEFT, point)) <= 0:
        slid = KeepOut(DRUMS).slid(point, velocity)
        assert np.linalg.norm(slid[:2]) <= np.linalg.norm(velocity[:2]) + 1e-12
        assert slid[2] >= velocity[2]
        assert slid[2] <= max(velocity[2], CLIMB) + 1e-12


def depth_of_stick(drum, point):
    """How deep the stick is in a drum's solid, where it is deepest beside the wall."""
    behind = np.linspace(0.0, REACH, 4000)[:, None] * [-1.0, 0.0, RISE]
    stick = point + behind
    r = np.hypot(*(stick[:, :2] - drum.head[:2]).T)
    face = drum.head[2] + TIP_RADIUS - FOLLOW_THROUGH
    return np.minimum(face - stick[:, 2], drum.radius + RIM + TIP_RADIUS - r).max() + 1e-4


def test_an_arm_that_is_led_through_a_head_slides_off_it():
    """Straight down and across: pressed into the head it would stay there for ever."""
    env = DrummingEnv(horizon=400)
    observation, _ = env.reset(options={"start": [0.68, -0.14, 0.32]})
    velocity = np.array([0.0, -0.1, -0.15])
    depths = []
    for _ in range(300):
        observation, *_ = env.step(env.command_to_action(velocity, observation))
        depths.append(FACE - observation[2])
    over = np.hypot(*(observation[:2] - RIGHT.head[:2])) < RIGHT.radius
    assert not over
    assert depths[60] < 0.004  # of a tip that is over the head all the while


def test_a_stick_that_is_led_into_a_wall_and_down_it_climbs_over():
    """The tip in front of the drum, in the open; the stick behind it at the wall."""
    env = DrummingEnv(horizon=400)
    observation, _ = env.reset(options={"start": [0.784, -0.29, 0.15]})
    for _ in range(300):
        velocity = np.array([0.0, 0.28, -0.14])
        observation, *_ = env.step(env.command_to_action(velocity, observation))
        if observation[1] > RIGHT.head[1]:
            break
    assert observation[1] > RIGHT.head[1]


def test_a_tip_that_is_led_into_a_wall_and_down_it_climbs_over():
    env = DrummingEnv(horizon=400)
    observation, _ = env.reset(options={"start": [0.63, -0.27, 0.22]})
    for _ in range(200):
        action = env.command_to_action(np.array([0.05, 0.14, -0.1]), observation)
        observation, *_ = env.step(action)
        if observation[2] > FACE:
            break
    assert np.hypot(*(observation[:2] - RIGHT.head[:2])) < WALL + 0.001
    assert observation[2] > FACE
