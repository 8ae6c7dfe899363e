"""Many arms in processes: the bits of `SyncVectorEnv`, whatever the number of processes."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from iflow_gym.datasets.drums import DRUMS, RIGHT, Drum
from iflow_gym.envs.drumming.arguments import ForcePush
from iflow_gym.envs.drumming.crew import Crew, end
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.envs.drumming.vector import DrummingVectorEnv
from iflow_gym.policy import DynamicalSystemPolicy
from iflow_gym.registration import DRUMMING_ID

N = 5
FIELDS = ("tip", "joints", "force")


@pytest.fixture
def make():
    made = []

    def one(num_envs=N, **settings):
        made.append(DrummingVectorEnv(num_envs, **settings))
        return made[-1]

    yield one
    for envs in made:
        envs.close()


def one_by_one(n=N, mode=AutoresetMode.NEXT_STEP, **settings):
    return SyncVectorEnv([lambda: DrummingEnv(**settings)] * n, autoreset_mode=mode)


def assert_same(ours, theirs):
    """Observations, rewards, flags and infos are the same to the last bit, and of the same kind."""
    *arrays, info = ours
    *expected, other = theirs
    for array, value in zip(arrays, expected, strict=True):
        np.testing.assert_array_equal(array, value)
        assert array.dtype == value.dtype
    assert set(info) == set(other)
    for key, value in other.items():
        assert info[key].dtype == value.dtype, key
        np.testing.assert_array_equal(info[key], value, err_msg=key)


def strokes(envs, k, rng):
    """Down onto the head below, then anywhere: some arms hit, some are pressed against a drum."""
    down = np.zeros(envs.action_space.shape)
    down[:, 2] = -0.25
    return down if k < 40 else rng.uniform(-1.0, 1.0, down.shape)


@pytest.mark.parametrize("processes", [1, 2, 3, 8])
def test_the_same_bits_as_one_arm_after_the_other(make, processes):
    settings = {"horizon": 60, "observe": FIELDS, "perturbation": ForcePush(0.02)}
    ours, theirs = make(processes=processes, **settings), one_by_one(**settings)
    assert ours.processes == min(processes, N)
    over = {"start": np.add(RIGHT.head, [0.0, 0.0, 0.06])}
    assert_same(ours.reset(seed=3, options=over), theirs.reset(seed=3, options=over))
    rng, heard = np.random.default_rng(0), 0
    for k in range(130):  # episodes end twice, and begin anew
        actions = strokes(ours, k % 61, rng)
        found = ours.step(actions)
        assert_same(found, theirs.step(actions))
        heard += sum(map(len, found[-1]["hits"]))
    assert heard > 0
    assert ours.np_random_seed == theirs.np_random_seed
    for mine, other in zip(ours.np_random, theirs.np_random, strict=True):
        assert mine.bit_generator.state == other.bit_generator.state


def test_torques_are_of_each_arms_own_joints(make):
    settings = {"control_mode": "torque", "horizon": 40}
    ours, theirs = make(processes=2, **settings), one_by_one(**settings)
    seen, _ = ours.reset(seed=0)
    theirs.reset(seed=0)
    commands = np.random.default_rng(0).uniform(-0.3, 0.3, (N, 3))
    for _ in range(20):
        actions = ours.command_to_action(commands, seen)
        expected = [
            env.command_to_action(command, state)
            for env, command, state in zip(theirs.envs, commands, seen, strict=True)
        ]
        np.testing.assert_array_equal(actions, expected)
        found = ours.step(actions)
        assert_same(found, theirs.step(actions))
        seen = found[0]


def test_some_begin_anew_and_the_others_go_on(make):
    settings = {"horizon": 20}
    ours, theirs = make(processes=2, **settings), one_by_one(**settings)
    ours.reset(seed=1)
    theirs.reset(seed=1)
    actions = np.full((N, 3), 0.1)
    for _ in range(4):
        assert_same(ours.step(actions), theirs.step(actions))
    mask = np.array([True, False, False, True, False])
    options = [{"reset_mask": mask.copy(), "demonstration": 1} for _ in range(2)]
    begun = ours.reset(seed=5, options=options[0])
    assert_same(begun, theirs.reset(seed=5, options=options[1]))
    assert begun[1]["_hits"].tolist() == mask.tolist()
    for _ in range(25):
        assert_same(ours.step(actions), theirs.step(actions))


def test_each_arm_has_its_own_start_and_demonstration(make):
    ours = make(processes=2)
    starts = np.array([0.68, 0.0, 0.42]) + 0.01 * np.arange(N)[:, None]
    indices = np.arange(N)
    seen, info = ours.reset(options={"start": starts, "demonstration": indices})
    np.testing.assert_allclose(seen, starts, atol=1e-6)
    assert info["demonstration"].tolist() == indices.tolist()
    seen, info = ours.reset(options={"demonstration": 2})
    first = [ours.demonstrations.positions[2][0]] * N
    np.testing.assert_allclose(seen, first, atol=1e-6)


def test_what_make_vec_makes_is_what_a_policy_drives():
    envs = gymnasium.make_vec(DRUMMING_ID, num_envs=2, processes=1)
    assert isinstance(envs, DrummingVectorEnv)
    assert envs.dt.tolist() == [0.01, 0.01]
    assert len(envs.drums) == 2

    class Down:
        n_dims_ = 3

        def step(self, x, dt):
            return np.asarray(x) - [0.0, 0.0, 0.1 * np.max(dt)]

    policy = DynamicalSystemPolicy(Down(), envs)
    seen, _ = envs.reset(seed=0)
    actions, _ = policy.predict(seen)
    np.testing.assert_allclose(actions, [[0.0, 0.0, -0.1]] * 2, atol=1e-12)
    np.testing.assert_allclose(envs.action_to_velocity(actions), [[0.0, 0.0, -0.1]] * 2)
    np.testing.assert_allclose(envs.velocity_to_action(actions), actions)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"demonstration": [0, 1]}, ValueError, r"shape \(\) or \(5,\), got \(2,\)"),
        ({"demonstration": [0, 1, 2, 3, 7]}, ValueError, "from 0 to 5"),
        ({"start": np.zeros((2, 3))}, ValueError, r"shape \(3,\) or \(5, 3\), got \(2, 3\)"),
        ({"start": [0.0, 0.0, 3.0]}, ValueError, "within the arm's reach"),
        ({"reset_mask": [True] * N}, TypeError, "boolean array"),
        ({"reset_mask": np.zeros(N, dtype=bool)}, ValueError, "true at least once"),
        ({"nothing": 1}, ValueError, "Expected reset options among"),
        ({"strat": [0.68, 0.0, 0.42]}, ValueError, r"Expected reset options among.*\['strat'\]"),
    ],
)
def test_a_bad_option_is_refused_and_the_arms_go_on(make, options, error, match):
    envs = make(processes=2)
    envs.reset(seed=0)
    with pytest.raises(error, match=match):
        envs.reset(options=options)
    envs.step(np.zeros((N, 3)))


def test_other_errors(make):
    envs = make(2, processes=2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((2, 3)))
    with pytest.raises(gymnasium.error.ResetNeeded, match="all arms before some"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match="one for each of 2 arms"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"one for each of 2 arms, got 1\.5"):
        envs.reset(seed=1.5)
    with pytest.raises(NotImplementedError, match="does not render: use"):
        envs.render()
    with pytest.raises(ValueError, match="whole numbers >= 0, got -1"):
        envs.reset(seed=[1, -1])
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(2, 3\), got \(3, 2\)"):
        envs.step(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"NaN or infinity for the arms \[1\]"):
        envs.step(np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]))
    envs.step(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="num_envs to be a whole number >= 1"):
        DrummingVectorEnv(0)
    with pytest.raises(ValueError, match="processes to be a whole number >= 1"):
        DrummingVectorEnv(2, processes=0)
    with pytest.raises(ValueError, match="vectorization_mode='sync'"):
        DrummingVectorEnv(2, render_mode="rgb_array")
    torque = make(2, processes=2, control_mode="torque")
    with pytest.raises(gymnasium.error.ResetNeeded):
        torque.command_to_action(np.zeros((2, 3)), np.zeros((2, 3)))
    torque.reset(seed=0)
    with pytest.raises(ValueError, match="depend on each arm's joints"):
        torque.command_to_action(np.zeros(3), np.zeros(3))


def test_after_an_error_or_an_interrupt_all_arms_begin_anew(make, monkeypatch):
    """Whatever had been done: the next reset gives what a new batch gives."""
    ours, theirs = make(4, processes=3), one_by_one(4)
    actions = np.full((4, 3), 0.1)
    ours.reset(seed=0)
    for raised in (KeyboardInterrupt, ZeroDivisionError):

        def interrupted(raised=raised):
            raise raised

        with monkeypatch.context() as patch:
            patch.setattr(ours._own, "step", interrupted)  # while the others are at it
            with pytest.raises(raised):
                ours.step(actions)
        with pytest.raises(gymnasium.error.ResetNeeded):
            ours.step(actions)
        with pytest.raises(gymnasium.error.ResetNeeded, match="all arms before some"):
            ours.reset(options={"reset_mask": np.array([True, False, True, True])})
        assert_same(ours.reset(seed=7), theirs.reset(seed=7))
        for _ in range(3):
            assert_same(ours.step(actions), theirs.step(actions))


def test_interrupts_at_any_time(make):
    ours, theirs = make(4, processes=2), one_by_one(4)
    actions = np.full((4, 3), 0.1)
    ours.reset(seed=0)
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for delay in np.random.default_rng(0).uniform(1e-4, 3e-3, 40):
            with contextlib.suppress(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, delay)
                for _ in range(1000):
                    ours.step(actions)
            assert_same(ours.reset(seed=7), theirs.reset(seed=7))
            assert_same(ours.step(actions), theirs.step(actions))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def interrupt(*_):
    raise KeyboardInterrupt


def test_a_process_that_was_killed_is_named_and_the_next_reset_has_another(make):
    ours, theirs = make(4, processes=2), one_by_one(4)
    ours.reset(seed=0)
    process = ours._others[0].process
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with pytest.raises(RuntimeError, match=r"arms 2 to 3.*exit code -9 \(it was killed.*anew"):
        ours.step(np.zeros((4, 3)))
    assert_same(ours.reset(seed=0), theirs.reset(seed=0))


class OddError(Exception):
    """An error that does not travel."""

    def __init__(self, text):
        super().__init__(text)
        self.kept = lambda: None


def test_what_is_raised_in_a_process_is_raised_here(make, monkeypatch):
    def strange(self):
        if self._share.start:
            raise OddError(1) if self._share.start == 2 else ZeroDivisionError("by nothing")

    monkeypatch.setattr(Crew, "step", strange)
    envs = make(2, processes=2)
    envs.reset(seed=0)
    with pytest.raises(ZeroDivisionError, match="by nothing") as caught:
        envs.step(np.zeros((2, 3)))
    assert "in the process of arm 1:" in str(caught.value.__cause__)
    assert "in strange" in str(caught.value.__cause__)
    envs = make(4, processes=2)
    envs.reset(seed=0)
    with pytest.raises(RuntimeError, match="OddError: 1"):
        envs.step(np.zeros((4, 3)))


def processes_of(envs):
    return [crew.process for crew in envs._others]


@pytest.mark.parametrize("way", ["close", "drop"])
def test_processes_end_with_it(way):
    kept = DrummingVectorEnv(2, processes=2)
    kept.reset(seed=0)
    envs = DrummingVectorEnv(4, processes=3)
    envs.reset(seed=0)
    later = DrummingVectorEnv(2, processes=2)  # its processes know of the others' pipes
    later.reset(seed=0)
    processes = processes_of(envs)
    assert len(processes) == 2
    assert all(process.is_alive() for process in processes)
    if way == "close":
        envs.close()
        envs.close()
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            envs.step(np.zeros((4, 3)))
    else:
        del envs
        gc.collect()
    assert not any(process.is_alive() for process in processes)
    for other in (kept, later):
        other.step(np.zeros((2, 3)))
        other.close()


def test_a_fork_does_not_end_what_it_has_not_begun(make):
    ours, theirs = make(2, processes=2), one_by_one(2)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    fork = os.fork()
    if not fork:
        failed = 1
        try:
            end(ours._others)
            failed = 0
        finally:
            os._exit(failed)
    assert os.waitpid(fork, 0)[1] == 0
    assert_same(ours.step(np.zeros((2, 3))), theirs.step(np.zeros((2, 3))))


def test_processes_end_when_that_of_the_batch_is_killed():
    code = """
import os, signal
from iflow_gym.envs.drumming.vector import DrummingVectorEnv
batches = [DrummingVectorEnv(3, processes=3) for _ in range(2)]
for envs in batches:
    envs.reset(seed=0)
print(*(crew.process.pid for envs in batches for crew in envs._others), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL
    left = set(map(int, done.stdout.split()))
    assert len(left) == 4
    until = time.monotonic() + 10
    while left and time.monotonic() < until:
        left = {pid for pid in left if is_running(pid)}
        time.sleep(0.02)
    assert not left


def is_running(pid):
    """Whether a process is there, and not only its entry in the table."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_in_a_daemon_all_arms_move_in_its_own_process():
    context = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()
    daemon = context.Process(target=batch_in_daemon, args=(answers,), daemon=True)
    daemon.start()
    daemon.join(60)
    assert answers.get() == (1, (3, 3))


def batch_in_daemon(answers):
    envs = DrummingVectorEnv(3)
    seen, _ = envs.reset(seed=0)
    answers.put((envs.processes, seen.shape))


def test_generators_are_copies(make):
    ours, theirs = make(3, processes=2), one_by_one(3)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for generator in ours.np_random:
        generator.random(5)
    assert_same(ours.reset(), theirs.reset())


def test_another_kit(make):
    drums = (*DRUMS, Drum("far", (0.8, 0.0, 0.2), 0.08))
    settings = {"drums": drums, "observe": ("tip", "force", "phase")}
    ours, theirs = make(np.int64(2), processes=2, **settings), one_by_one(2, **settings)
    assert_same(ours.reset(seed=0), theirs.reset(seed=0))
    found = ours.step(np.zeros((2, 3), dtype=np.float32))
    assert_same(found, theirs.step(np.zeros((2, 3), dtype=np.float32)))
    assert found[-1]["forces"].shape == (2, 3)


def test_spawned_processes_give_the_same(make):
    ours, theirs = make(2, processes=2, context="spawn"), one_by_one(2)
    assert_same(ours.reset(seed=0), theirs.reset(seed=0))
    assert_same(ours.step(np.zeros((2, 3))), theirs.step(np.zeros((2, 3))))
