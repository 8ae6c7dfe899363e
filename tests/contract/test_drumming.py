"""The drumming arm: interface, the controller's promises, demonstrations, scores, pictures."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import iflow_gym  # noqa: F401  (registers the ids)
from iflow_gym.baselines.references import ReplayPolicy
from iflow_gym.datasets.drums import DRUMS, RIGHT, TIP_RADIUS, load_drums
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.envs.drumming import recorded
from iflow_gym.envs.drumming.arguments import OBSERVABLES, ForcePush
from iflow_gym.envs.drumming.control import BRAKING_TIME, JOINT_MARGIN, Workspace
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.envs.drumming.scene import (
    SPEED_LIMITS,
    TORQUE_LIMITS,
    assets_folder,
    drawn_model,
    load_scene,
)
from iflow_gym.envs.drumming.simulation import UnreachableError
from iflow_gym.envs.task import Push
from iflow_gym.evaluate import FIT_COSTS, evaluate
from iflow_gym.evaluation import drumming
from iflow_gym.metrics import drumming as metrics
from iflow_gym.metrics import metrics_of
from iflow_gym.metrics.stability import start_grid
from iflow_gym.registration import DRUMMING_ID, DRUMMING_RECORDED_ID

both_modes = pytest.mark.parametrize("mode", ["velocity", "torque"])
GOLDEN = Path(__file__).parents[1] / "golden" / "drumming.py"
MID_AIR = np.array([0.68, 0.0, 0.42])


def load_golden():
    spec = importlib.util.spec_from_file_location("golden_drumming", GOLDEN)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make(**settings):
    return gymnasium.make(DRUMMING_ID, **settings)


def replay(env, index):
    """Play a demonstration; return the tip's path, the hits and the infos."""
    path = env.demonstrations.positions[index]
    observation, info = env.reset(options={"demonstration": index})
    reached, hits, infos = [observation[:3]], [], [info]
    for following in path[1:]:
        velocity = (following - observation[:3]) / env.dt
        observation, _, _, _, info = env.step(env.command_to_action(velocity, observation))
        reached.append(observation[:3])
        hits += info["hits"]
        infos.append(info)
    return np.array(reached), hits, infos


@pytest.fixture(scope="module")
def env():
    return DrummingEnv()


# The interface ------------------------------------------------------------------------------


@both_modes
@pytest.mark.parametrize("observe", [("tip",), OBSERVABLES])
def test_gymnasium_check_env(mode, observe):
    check_env(make(control_mode=mode, observe=observe).unwrapped, skip_render_check=True)


@both_modes
def test_stable_baselines_check_env(mode):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    sb3.check_env(make(control_mode=mode), warn=True, skip_render_check=True)


def test_ids_are_registered_and_importing_the_package_does_not_load_mujoco():
    assert {DRUMMING_ID, DRUMMING_RECORDED_ID} <= set(gymnasium.registry)
    code = "import sys, iflow_gym; print('mujoco' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"


def test_info_has_the_same_keys_after_reset_and_step(env):
    _, first = env.reset(seed=0)
    *_, then = env.step(np.zeros(3))
    assert list(first) == list(then)
    assert first["hits"] == ()
    assert first["command_scale"] == 1.0


def test_an_episode_is_as_long_as_its_demonstration_and_ends_by_truncation():
    env = make(horizon=None).unwrapped
    env.reset(options={"demonstration": 2})
    ends = [env.step(np.zeros(3))[2:4] for _ in range(999)]
    assert ends[-1] == (False, True)
    assert not any(terminated or truncated for terminated, truncated in ends[:-1])
    short = make(horizon=3)
    short.reset(seed=0)
    assert [short.step(np.zeros(3))[3] for _ in range(3)] == [False, False, True]


def test_observations_are_made_of_the_parts_that_are_asked_for():
    env = DrummingEnv(observe=OBSERVABLES)
    env.reset(options={"start": MID_AIR})
    velocity = np.array([0.1, -0.2, 0.05])
    for _ in range(5):
        observation, *_ = env.step(env.velocity_to_action(velocity))
    tip, speed, joints, rates, force, phase = np.split(observation, [3, 6, 13, 20, 22])
    data, period = env.simulation.data, env.demonstrations.period
    np.testing.assert_array_equal(tip, env.simulation.tip)
    np.testing.assert_allclose(speed, velocity, atol=0.02)
    np.testing.assert_array_equal(joints, data.qpos)
    np.testing.assert_array_equal(rates, data.qvel)
    assert force.tolist() == [0.0, 0.0]
    angle = 2 * np.pi * 0.05 / period
    np.testing.assert_allclose(phase, [np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(
    ("settings", "error", "match"),
    [
        ({"control_mode": "force"}, ValueError, "control_mode 'velocity' or 'torque'"),
        ({"observe": ("joints",)}, ValueError, "begin with 'tip'"),
        ({"observe": ("tip", "smell")}, ValueError, "Expected observe among"),
        ({"horizon": 0}, ValueError, "horizon"),
        ({"start_noise": -1}, ValueError, "start_noise"),
        ({"perturbation": 0.3}, TypeError, "Push, a ForcePush or None"),
        ({"perturbation": Push(direction=(1.0, 0.0))}, ValueError, "3 finite components"),
        ({"render_mode": "ansi"}, ValueError, "render_mode"),
        ({"demonstrations": "drums"}, TypeError, "Expected Demonstrations"),
    ],
)
def test_arguments_are_checked(settings, error, match):
    with pytest.raises(error, match=match):
        DrummingEnv(**settings)


def test_other_demonstrations_are_checked():
    demos = load_drums()
    paths = [np.array(p) for p in demos.positions]
    with pytest.raises(ValueError, match="a cycle in 3-D"):
        DrummingEnv(Demonstrations.from_arrays([p[:, :2] for p in paths], dt=0.01, period=5))
    with pytest.raises(ValueError, match=r"dt = 0\.01"):
        DrummingEnv(Demonstrations.from_arrays(paths, dt=0.02, period=5))
    with pytest.raises(ValueError, match="within the arm's workspace"):
        DrummingEnv(Demonstrations.from_arrays([p + 0.3 for p in paths], dt=0.01, period=5))


@pytest.mark.parametrize(
    ("action", "match"),
    [
        ([np.nan, 0, 0], "the policy gave NaN or infinity"),
        ([np.inf, 0, 0], "the policy gave NaN or infinity"),
        ([0.0, 0.0], "Expected an action of shape"),
    ],
)
def test_an_action_that_is_none_raises_and_changes_nothing(env, action, match):
    env.reset(options={"start": MID_AIR})
    before = env.simulation.data.qpos.copy()
    with pytest.raises(ValueError, match=match):
        env.step(np.array(action))
    np.testing.assert_array_equal(env.simulation.data.qpos, before)
    env.step(np.zeros(3))


def test_a_step_needs_a_reset():
    with pytest.raises(gymnasium.error.ResetNeeded):
        DrummingEnv().step(np.zeros(3))


@pytest.mark.parametrize(
    ("start", "match"),
    [
        ([1.5, 0.0, 0.4], "within the arm's reach"),
        ([0.87, 0.39, 0.69], "within the arm's reach"),
        ([0.68, 0.14, 0.20], "clear of the drums"),
        ([0.68, 0.14], "shape \\(3,\\)"),
        ([0.68, 0.14, np.nan], "finite position"),
    ],
)
def test_a_start_that_cannot_be(env, start, match):
    with pytest.raises(ValueError, match=match):
        env.reset(options={"start": start})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(3))


def test_reset_options_are_checked(env):
    with pytest.raises(ValueError, match="reset options among"):
        env.reset(options={"begin": 1})
    with pytest.raises(ValueError, match="from 0 to 5"):
        env.reset(options={"demonstration": 6})
    with pytest.raises(TypeError, match="whole number"):
        env.reset(options={"demonstration": 0.5})


def test_starts(env):
    demos = env.demonstrations
    observation, info = env.reset(options={"demonstration": 3})
    np.testing.assert_allclose(observation, demos.positions[3][0], atol=1e-5)
    assert info["demonstration"] == 3
    np.testing.assert_allclose(env.simulation.tip_velocity, demos.velocities[3][0], atol=1e-6)
    observation, info = env.reset(options={"start": MID_AIR})
    np.testing.assert_allclose(observation, MID_AIR, atol=1e-5)
    assert info["demonstration"] == -1
    assert np.abs(env.simulation.data.qvel).max() == 0
    drawn = np.array([env.reset(seed=s)[0] for s in range(20)])
    assert len(np.unique(drawn, axis=0)) == 20
    near = np.linalg.norm(drawn[:, None] - demos.starts, axis=2).min(axis=1)
    assert 0 < near.max() < 6 * env.start_noise * env.diagonal


def test_reachable_says_what_reset_accepts(env):
    points = np.array([MID_AIR, [1.5, 0.0, 0.4], [0.68, 0.14, 0.20], [0.68, 0.14, 0.27]])
    assert env.reachable(points).tolist() == [True, False, False, True]


# The controller's promises --------------------------------------------------------------------


def test_the_workspace_above_the_drums_is_reachable_and_holds_the_demonstrations(env):
    """Of the metrics' grid of starts, what lies in the workspace and clear of the drums."""
    grid = start_grid(*env.demonstrations.bounding_box, n_per_axis=5)
    found = env.reachable(grid)
    above = grid[:, 2] > DRUMS[0].head[2] + 0.05
    np.testing.assert_array_equal(found[above], Workspace.contains(grid[above]))
    assert found[above].mean() > 0.75
    samples = np.concatenate(env.demonstrations.positions)[::250]
    assert env.reachable(samples).all()


@pytest.mark.parametrize("direction", np.vstack([np.eye(3), -np.eye(3)[2:], [[0.6, -0.5, 0.6]]]))
def test_the_tip_moves_as_commanded(env, direction):
    """From rest to the command, then in a straight line at its speed, upright all the while."""
    env.reset(options={"start": MID_AIR})
    velocity = 0.25 * direction / np.linalg.norm(direction)
    path = np.array([env.step(env.velocity_to_action(velocity))[0] for _ in range(30)])
    steps = np.diff(path, axis=0) / env.dt
    np.testing.assert_allclose(steps[3:], np.broadcast_to(velocity, steps[3:].shape), atol=0.006)
    assert np.abs(env.simulation.controller.rotation_error()).max() < 2e-3


def test_commands_out_of_the_workspace_end_at_its_border_and_let_go(env):
    """Pushed against the border for 3 s the tip stays inside; one step back frees it."""
    for direction in np.vstack([np.eye(3), -np.eye(3), [[1.0, 1.0, 1.0]]]):
        env.reset(options={"start": MID_AIR})
        for _ in range(300):
            observation, *_, info = env.step(direction)
        assert Workspace.contains(observation + 0.02 * (MID_AIR - observation))
        assert info["command_scale"] < 0.5
        assert np.linalg.norm(env.simulation.tip_velocity) < 0.2
        before = observation
        for _ in range(10):
            observation, *_ = env.step(-0.3 * direction)
        assert (observation - before) @ -direction > 0.01


def test_along_the_border_a_command_slides(env):
    """Out and aside at once: the way out ends at the border, the way aside goes on."""
    start = np.array([Workspace.low[0] + 0.01, 0.0, 0.42])
    env.reset(options={"start": start})
    velocity = np.array([-0.1, 0.1, 0.0])
    path = np.array([env.step(env.velocity_to_action(velocity))[0] for _ in range(100)])
    assert (path[:, 0] >= Workspace.low[0] - 1e-4).all()
    assert path[-1, 0] < Workspace.low[0] + 0.002
    np.testing.assert_allclose(np.diff(path[5:, 1]) / env.dt, 0.1, atol=0.005)
    np.testing.assert_allclose(path[:, 2], start[2], atol=2e-3)


def test_where_two_borders_meet_the_tip_stays_inside(env):
    """The edge of the reach and of the near face: a command into it, for 3 s."""
    beside = np.array([0.585 - Workspace.centre[0], 0.3])
    height = Workspace.centre[2] + np.sqrt(Workspace.radius**2 - beside @ beside) - 0.01
    env.reset(options={"start": np.array([0.585, 0.3, height])})
    command = env.velocity_to_action(0.5 * np.array([-0.129, 0.542, 0.830]))
    path = np.array([env.step(command)[0] for _ in range(300)])
    reach = np.linalg.norm(path - Workspace.centre, axis=1)
    assert reach.max() < Workspace.radius + 0.003
    assert path[:, 0].min() > Workspace.low[0] - 0.003


def test_what_slides_is_cut_by_no_more_than_leads_out():
    rng = np.random.default_rng(0)
    size = Workspace.high - Workspace.low
    points = Workspace.low + size * rng.uniform(0.0, 1.0, (400, 3))
    cut = 0
    for point in points[Workspace.contains(points)]:
        velocity = rng.normal(size=3)
        allowed = Workspace.slid(point, velocity)
        after = point + BRAKING_TIME * allowed
        assert (after >= Workspace.low - 1e-9).all()
        assert (after <= Workspace.high + 1e-9).all()
        arm = point - Workspace.centre
        length = np.linalg.norm(arm)
        assert length + BRAKING_TIME * (allowed @ arm) / length <= Workspace.radius + 1e-9
        if (allowed == velocity).all():
            continue
        cut += 1
        assert np.linalg.norm(allowed) < np.linalg.norm(velocity)
    assert 100 < cut < 300
    middle = np.array([0.72, 0.0, 0.40])
    np.testing.assert_array_equal(Workspace.slid(middle, np.full(3, 0.3)), np.full(3, 0.3))


@both_modes
@pytest.mark.parametrize("hold", [1, 20, 150])
def test_hostile_actions_keep_the_joints_limits(mode, hold):
    """Bang-bang actions, held for a while: no joint reaches its stop, nothing explodes."""
    env = DrummingEnv(control_mode=mode, observe=OBSERVABLES)
    scene, rng = env.simulation.scene, np.random.default_rng(hold)
    env.reset(seed=hold)
    for k in range(900):
        if k % hold == 0:
            action = rng.choice([-1.0, 1.0], env.action_space.shape) * rng.uniform(0.3, 1)
        observation, *_, info = env.step(action)
        q, speed = env.simulation.data.qpos, np.abs(env.simulation.data.qvel)
        assert (q > scene.lower).all()
        assert (q < scene.upper).all()
        assert (np.abs(env.simulation.data.ctrl) <= TORQUE_LIMITS).all()
        assert (speed < 3 * SPEED_LIMITS).all()  # a collision may exceed them for an instant
        assert env.observation_space.contains(observation)
        assert info["forces"].max() < 500
        if mode == "velocity":
            assert np.abs(env.simulation.controller.rotation_error()).max() < 0.15
            assert (speed < 1.5 * SPEED_LIMITS).all()
            assert (q > scene.lower + JOINT_MARGIN / 2).all()
            assert (q < scene.upper - JOINT_MARGIN / 2).all()


def test_pressing_on_a_head_is_gentle(env):
    """Full speed into the head, held for 0.8 s: one hit, a bounded force, the stick stays put."""
    first, _ = env.reset(options={"start": [0.62, 0.14, 0.30]})
    forces, hits = [], []
    for _ in range(80):
        observation, *_, info = env.step(np.array([0.0, 0.0, -1.0]))
        forces.append(info["forces"][1])
        hits += info["hits"]
    assert [hit.drum for hit in hits] == [1]
    assert 10 < np.median(forces[20:]) < 40
    assert max(forces) < 120
    assert np.abs(env.simulation.controller.rotation_error()).max() < 0.05
    assert np.linalg.norm((observation - first)[:2]) < 0.1  # it creeps


def test_a_head_gives_way_as_a_spring_and_the_arm_goes_on_as_commanded(env):
    """Down at 0.05 m/s from 2 mm above: the tip keeps its speed while the head pushes back."""
    start = np.array([*DRUMS[0].head[:2], DRUMS[0].head[2] + TIP_RADIUS + 0.002])
    env.reset(options={"start": start})
    depths, forces = [], []
    for _ in range(26):
        observation, *_, info = env.step(env.velocity_to_action([0.0, 0.0, -0.05]))
        depths.append(DRUMS[0].head[2] + TIP_RADIUS - observation[2])
        forces.append(info["forces"][0])
    depth, force = np.array(depths), np.array(forces)
    assert depth[-1] > 0.010
    np.testing.assert_allclose(np.diff(depth)[2:], 0.05 * env.dt, rtol=0.1)
    assert (force[depth < 0] == 0).all()
    deep = (depth > 0.001) & (depth < 0.005)  # the bead alone touches
    stiffness, damping = np.polyfit(depth[deep], force[deep], 1)
    assert stiffness == pytest.approx(450, rel=0.2)  # N/m
    assert 0.5 < damping < 2.5  # N, of 0.05 m/s


def test_resting_on_a_head_the_arm_holds_its_place(env):
    """Pressed 8 mm in and told to stand still, the stick is not lifted out."""
    start = np.array([*DRUMS[1].head[:2], DRUMS[1].head[2] + TIP_RADIUS + 0.002])
    env.reset(options={"start": start})
    for _ in range(20):
        before, *_ = env.step(env.velocity_to_action([0.0, 0.0, -0.05]))
    for _ in range(50):
        after, *_, info = env.step(np.zeros(3))
    assert info["forces"][1] > 2.0
    assert abs(after[2] - before[2]) < 0.001


def test_torque_mode_does_what_velocity_mode_does():
    """Until the stick meets a head, and nearly so from then on."""
    one, other = DrummingEnv(), DrummingEnv(control_mode="torque")
    starts = [e.reset(options={"demonstration": 0})[0] for e in (one, other)]
    path = one.demonstrations.positions[0]
    a, b = starts
    met = False
    for following in path[1:200]:
        a, *_, info = one.step(one.command_to_action((following - a) / one.dt, a))
        b, *_ = other.step(other.command_to_action((following - b) / other.dt, b))
        met = met or info["forces"].max() > 0
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-3 if met else 1e-6)
    assert met


def test_no_torque_lets_the_arm_hang_in_the_air():
    env = DrummingEnv(control_mode="torque")
    first, _ = env.reset(options={"start": MID_AIR})
    for _ in range(100):
        observation, *_ = env.step(np.zeros(7))
    np.testing.assert_allclose(observation, first, atol=1e-5)


def test_conversions(env):
    fast = np.array([2.0, -1.0, 0.5])
    np.testing.assert_allclose(env.velocity_to_action(fast), [1.0, -0.5, 0.25])
    np.testing.assert_allclose(env.action_to_velocity([0.5, 0, 0]), [0.5 * env.max_speed, 0, 0])
    batch = np.ones((4, 3)) * 0.1
    np.testing.assert_allclose(env.command_to_action(batch, batch), batch / env.max_speed)
    torque = DrummingEnv(control_mode="torque")
    with pytest.raises(ValueError, match="control_mode='velocity'"):
        torque.velocity_to_action(fast)
    with pytest.raises(ValueError, match="one velocity command"):
        torque.command_to_action(batch, batch)
    with pytest.raises(ValueError, match="observations of shape"):
        env.command_to_action(fast, np.zeros(5))


# Pushes ---------------------------------------------------------------------------------------


def test_a_push_displaces_the_tip_once():
    push = Push(fraction=0.2, size=0.2, direction=(0.0, 0.0, 1.0))
    env = DrummingEnv(perturbation=push, horizon=400)
    observation, _ = env.reset(options={"demonstration": 0})
    at = round(0.2 * 999)
    for k in range(1, at + 2):
        before = observation
        observation, *_, info = env.step(np.zeros(3))
        assert info["pushed"] == (k >= at)
        if k == at:
            jump = observation - before
    np.testing.assert_allclose(jump, [0, 0, 0.2 * env.diagonal], atol=2e-3)
    np.testing.assert_allclose(observation, before, atol=2e-3)


def test_a_push_into_a_drum_ends_above_it():
    env = DrummingEnv(perturbation=Push(fraction=0.001, size=1.0, direction=(0, 0, -1)))
    env.reset(options={"start": [0.68, 0.14, 0.35]})
    observation, *_ = env.step(np.zeros(3))
    assert DRUMS[1].head[2] < observation[2] - 0.5 * TIP_RADIUS < 0.33


def test_a_force_moves_the_tip_its_way_and_the_arm_comes_to_rest():
    push = ForcePush(fraction=0.1, impulse=4.0, direction=(0.0, 1.0, 0.0))
    env = DrummingEnv(perturbation=push)
    first, _ = env.reset(options={"start": MID_AIR})
    for _ in range(200):
        observation, *_, info = env.step(np.zeros(3))
    assert info["pushed"]
    moved = observation - first
    assert 0.05 < moved[1] < 0.2
    assert np.abs(moved[[0, 2]]).max() < 0.5 * moved[1]
    assert np.linalg.norm(env.simulation.tip_velocity) < 1e-3


# Demonstrations -------------------------------------------------------------------------------


def test_the_demonstrations_have_the_recordings_dimensions():
    """Those of the authors' recording, but for where it is."""
    demos = load_drums()
    assert [p.shape for p in demos.positions] == [(1000, 3)] * 6
    assert set(demos.dt) == {0.01}
    assert demos.period == pytest.approx(5.0, abs=0.1)
    side = demos.bounding_box.high - demos.bounding_box.low
    np.testing.assert_allclose(side, [0.083, 0.31, 0.25], atol=0.02)
    tops = [p[:, 2].max() for p in demos.positions]
    assert 0.005 < np.std(tops) < 0.03
    with pytest.raises(ValueError, match="read-only"):
        demos.positions[0][0] = 0


def test_a_demonstration_implies_a_score_of_alternate_strokes(env):
    rounds = []
    for index in range(6):
        times, drums = env.score_of(index)
        assert drums.tolist() == [0, 1, 0, 1]
        intervals = np.diff(times)
        assert ((intervals > 1.8) & (intervals < 3.2)).all()
        assert intervals[1] > max(intervals[0], intervals[2])  # the high arch takes longer
        rounds.append(times[2] - times[0])
    assert 0.01 < np.std(rounds) / np.mean(rounds) < 0.06


@pytest.mark.parametrize("index", range(6))
def test_a_replay_plays_the_score(env, index):
    path, hits, infos = replay(env, index)
    played = ([h.time for h in hits], [h.drum for h in hits])
    score = env.score_of(index)
    assert metrics.hit_f1(*score, *played) == 1.0
    assert metrics.timing_error(*score, *played) < 5.0
    assert min(h.force for h in hits) > 1.5 * metrics.FORCE_THRESHOLD
    assert metrics.tracking_rmse(env.demonstrations.positions[index], path) < 0.5
    assert all(info["is_success"] for info in infos)
    assert all(info["command_scale"] > 0.9 for info in infos)


def test_the_teacher_makes_the_demonstrations():
    mujoco = pytest.importorskip("mujoco")
    if mujoco.__version__ != json.loads(GOLDEN.with_suffix(".json").read_text())["mujoco"]:
        pytest.skip(f"the recordings are of another MuJoCo than {mujoco.__version__}")
    from iflow_gym.envs.drumming import teacher

    path, rounds = teacher.record(4)
    np.testing.assert_allclose(path, load_drums().positions[4], rtol=0, atol=1e-4)
    assert np.mean(rounds) == pytest.approx(5.05, abs=0.4)


def test_get_dataset():
    env = DrummingEnv()
    data = env.get_dataset("generalisation", "score")
    n = 999 * len(env.demonstrations.split("generalisation").score)
    assert {k: v.shape for k, v in data.items()} == {
        "observations": (n, 3),
        "actions": (n, 3),
        "next_observations": (n, 3),
        "rewards": (n,),
        "terminals": (n,),
        "timeouts": (n,),
    }
    np.testing.assert_array_equal(data["observations"][1:999], data["next_observations"][:998])
    assert np.flatnonzero(data["timeouts"]).tolist() == list(range(998, n, 999))
    assert np.abs(data["actions"]).max() <= 1
    assert data["rewards"].mean() > 0.9
    with pytest.raises(ValueError, match="Expected part"):
        env.get_dataset(part="test")


# Scores ---------------------------------------------------------------------------------------


def test_the_replay_scores_as_a_perfect_drummer(env):
    scores = evaluate(ReplayPolicy(env.demonstrations), env, seed=0, stability=False).metrics
    assert set(scores) == {m.name for m in metrics_of("drumming")} - set(FIT_COSTS)
    assert scores["hit_f1"] == scores["sequence_f1"] == 1.0
    assert scores["missed"] == scores["extra"] == 0.0
    assert scores["timing_error"] < 5
    assert scores["orbit_distance"] < 0.001
    assert scores["tracking_rmse"] < 2
    assert scores["attraction"] is None


def test_a_policy_that_stands_still_or_runs_away_misses_everything():
    env = DrummingEnv(load_drums().subset([0, 1]))

    class Fixed:
        def __init__(self, action):
            self.action = np.array(action)

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tile(self.action, (*np.shape(observation)[:-1], 1)), state

    for action in (0.0, np.nan):
        policy = Fixed([action] * 3)
        scores = evaluate(policy, env, seed=0, stability=False).metrics
        assert scores["hit_f1"] == scores["sequence_f1"] == scores["rhythm_f1"] == 0.0
        assert scores["missed"] == 4.0
        assert scores["timing_error"] == scores["tempo_error"] == np.inf
        assert (scores["orbit_distance"] == np.inf) == bool(np.isnan(action))
    with pytest.raises(TypeError, match="Expected a fitted method or a policy"):
        env.score(3, seed=0)


def test_arms_side_by_side_do_what_each_does_alone(env):
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (60, 2, 3))
    arms = env.like(2, horizon=60)
    first, _ = arms.reset(seed=5, options={"demonstration": np.array([1, 3])})
    paths = np.stack([first, *[arms.step(a)[0] for a in actions]])
    for i, index in enumerate((1, 3)):
        alone = env.like()
        observation, _ = alone.reset(options={"demonstration": index})
        np.testing.assert_array_equal(paths[0, i], observation)
        for k, action in enumerate(actions[:, i]):
            np.testing.assert_array_equal(paths[k + 1, i], alone.step(action)[0])


def test_what_is_pushed_and_started_elsewhere_is_judged_by_its_last_period(env, monkeypatch):
    monkeypatch.setattr(drumming, "STARTS", 3)
    monkeypatch.setattr(drumming, "START_PERIODS", 3)
    player = ReplayPolicy(env.demonstrations)  # goes to the nearest recording from anywhere
    found, recovered = drumming.stability(player, env, [0], [7])
    assert found["attraction"] == 1.0
    assert found["diverged"] == 0.0
    assert recovered == [1.0]
    assert len(drumming.reachable_starts(env)) == 3


# The authors' recording -------------------------------------------------------------------------


def load_recording(monkeypatch):
    """Return the authors' recording from the mirror that the environment variable names."""
    mirror = os.environ.get("IFLOW_GYM_RECORDED")
    if not mirror:
        pytest.skip("IFLOW_GYM_RECORDED names no folder with the authors' recordings")
    positions = np.load(Path(mirror) / "drums_recorded" / "Drums.npy")[:, :, :3]
    return Demonstrations.from_arrays(list(positions), dt=0.01, period=5.03, name="recorded")


def test_the_recording_before_the_arm(monkeypatch):
    demos = recorded.placed(load_recording(monkeypatch))
    drums = recorded.drums_under(demos)
    env = DrummingEnv(demos, drums)
    for index in (0, 3):
        _, hits, _ = replay(env, index)
        score = env.score_of(index)
        assert score[1].tolist() == [0, 1, 0, 1]
        played = ([h.time for h in hits], [h.drum for h in hits])
        assert metrics.hit_f1(*score, *played) == 1.0
        assert metrics.timing_error(*score, *played) < 10


def test_placing_moves_and_neither_turns_nor_scales():
    t = np.linspace(0, 4 * np.pi, 500)
    y, z = -0.33 - 0.14 * np.cos(t / 2), 1.12 + 0.1 * np.abs(np.sin(t / 2))
    way = np.stack([np.full_like(t, 0.56), y, z], axis=1)
    demos = Demonstrations.from_arrays([way], dt=0.01, period=2.5)
    moved = recorded.placed(demos)
    np.testing.assert_allclose(moved.positions[0] - demos.positions[0], [recorded.SHIFT] * 500)
    np.testing.assert_array_equal(moved.velocities[0], demos.velocities[0])


# Reproducibility --------------------------------------------------------------------------------


def test_golden_rollouts_here_and_in_another_process():
    """Numbers that move mean that scores may move: bump the id's -vN (see golden/)."""
    golden = load_golden()
    here = golden.rollout_hash()
    code = (
        "import importlib.util as u\n"
        f"s = u.spec_from_file_location('golden', {str(GOLDEN)!r})\n"
        "g = u.module_from_spec(s); s.loader.exec_module(g)\n"
        "print(g.rollout_hash())\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == here
    wanted = json.loads(golden.PATH.read_text())
    if wanted["mujoco"] != golden.mujoco.__version__:
        pytest.skip(
            f"the numbers are of MuJoCo {wanted['mujoco']}, here is {golden.mujoco.__version__}"
        )
    np.testing.assert_allclose(golden.positions(), wanted["tip"], rtol=0, atol=golden.TOLERANCE)


def test_an_episode_does_not_depend_on_the_one_before():
    env = DrummingEnv()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (60, 3))
    runs = []
    for _ in range(2):
        env.reset(seed=3)
        runs.append([env.step(action)[0] for action in actions])
    fresh = DrummingEnv()
    fresh.reset(seed=3)
    runs.append([fresh.step(action)[0] for action in actions])
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])


def test_arms_in_processes_of_their_own_do_what_one_here_does():
    envs = gymnasium.make_vec(f"iflow_gym:{DRUMMING_ID}", num_envs=2, vectorization_mode="async")
    try:
        first, _ = envs.reset(seed=[4, 5])
        actions = np.random.default_rng(0).uniform(-1, 1, (30, 2, 3)).astype(np.float32)
        for action in actions:
            together, _, _, _, infos = envs.step(action)
        assert len(infos["hits"]) == 2
    finally:
        envs.close()
    for index in range(2):
        alone = make()
        observation, _ = alone.reset(seed=4 + index)
        np.testing.assert_array_equal(observation, first[index])
        for action in actions:
            observation, *_ = alone.step(action[index])
        np.testing.assert_array_equal(observation, together[index])


# Pictures and what is missing -------------------------------------------------------------------


def run_python(code, **variables):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | variables
    )


PICTURE = """
import gymnasium, iflow_gym, sys
from gymnasium.error import DependencyNotInstalled
env = gymnasium.make("iflow/Drumming-v0", render_mode="rgb_array", width=160, height=120)
env.reset(seed=0)
try:
    first = env.render()
    for _ in range(20):
        env.step([0.5, 0.5, 0.5])
    then = env.render()
except DependencyNotInstalled as error:
    print(error)
    sys.exit(3)
print(first.shape, first.dtype, first.std() > 20, (first != then).any())
"""


def test_what_is_drawn_moves_as_what_is_simulated():
    """Physics leave out the meshes that are only drawn: to the last bit the motion is the same."""
    mujoco = pytest.importorskip("mujoco")
    simulated, drawn = load_scene(DRUMS).model, drawn_model(DRUMS)
    assert simulated.nbvh < 0.02 * drawn.nbvh
    env = DrummingEnv()
    env.reset(options={"start": np.add(RIGHT.head, [0.0, 0.0, 0.03])})
    ends, touched = [], []
    for model in (simulated, drawn):
        data = mujoco.MjData(model)
        data.qpos[:] = env.simulation.data.qpos
        for k in range(400):
            data.ctrl[:] = [0.0, 6.0, 0.0, 2.0, 0.0, 0.5 * np.sin(0.05 * k), 0.0]
            mujoco.mj_step(model, data)
            touched.append(data.ncon > 0)
        ends.append([data.qpos, data.qvel, data.site_xpos[model.site("tip").id]])
    assert sum(touched) > 20
    for mine, other in zip(*ends, strict=True):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_pictures(backend):
    done = run_python(PICTURE, MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend)
    if done.returncode == 3:
        pytest.skip(f"no OpenGL by {backend}: {done.stdout.strip()}")
    assert done.stdout.strip() == "(120, 160, 3) uint8 True True"
    assert done.stderr == ""


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_an_arm_that_was_never_closed_leaves_without_a_word(backend):
    """Also where something else asked to be called at the end before OpenGL was there."""
    before = "import weakref\nclass Thing: pass\nthing = Thing()\nweakref.finalize(thing, print)\n"
    after = "\nkept = env  # until the end"
    done = run_python(before + PICTURE + after, MUJOCO_GL=backend,
                      PYOPENGL_PLATFORM=backend)  # fmt: skip
    if done.returncode == 3:
        pytest.skip(f"no OpenGL by {backend}: {done.stdout.strip()}")
    assert done.returncode == 0
    assert done.stderr == ""


def test_without_opengl_the_error_says_what_to_install():
    done = run_python(PICTURE, MUJOCO_GL="disable")
    assert done.returncode == 3, done.stderr
    assert "install libegl1" in done.stdout
    assert "MUJOCO_GL=egl" in done.stdout


HIDE = """
import ctypes
open_library = ctypes._dlopen
def open_others(name, *args):
    if any(part in str(name) for part in ("GL", "Mesa")):
        raise OSError(name)
    return open_library(name, *args)
ctypes._dlopen = open_others
"""


def test_a_library_that_is_missing_hinders_pictures_only():
    """As on a machine where MUJOCO_GL names a library that is not there."""
    steps = PICTURE.replace("try:", "env.step([0.0, 0.0, 0.1])\nprint('stepped')\ntry:")
    for variables in ({"MUJOCO_GL": "egl"}, {"MUJOCO_GL": ""}):
        done = run_python(HIDE + steps, **variables)
        assert done.returncode == 3, done.stderr
        assert done.stdout.startswith("stepped")
        assert "install libegl1" in done.stdout


def test_a_missing_model_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="pip install gymnasium-robotics"):
        assets_folder()


def test_unreachable_is_a_value_error(env):
    with pytest.raises(UnreachableError):
        env.simulation.place(np.array([2.0, 0.0, 0.0]))
