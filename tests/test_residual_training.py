"""Training, files and the command line of residuals, in a few steps each."""

import dataclasses
import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from rich.console import Console

from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.model_files import ModelFileError
from iflow_gym.residual import ResidualVectorWrapper
from iflow_gym.residual.policy import Zero

pytest.importorskip("stable_baselines3")

from iflow_gym.baselines.residual_learning import recorded, records, training
from iflow_gym.baselines.residual_learning.agents import AgentFileError
from iflow_gym.baselines.residual_learning.artifacts import (
    AGENT,
    BASE,
    CARD,
    LAST,
    load_residual,
    read_card,
)
from iflow_gym.baselines.residual_learning.settings import (
    ALGORITHMS,
    SettingsError,
    TrainingSettings,
    known_presets,
    load_settings,
)
from iflow_gym.baselines.residual_learning.tasks import batch_of, residual_vec_env, returns_of
from iflow_gym.baselines.residual_learning.training import resume, train
from iflow_gym.baselines.residual_learning.vec_env import ArrayVecEnv
from iflow_gym.envs.lasa import LASAVectorEnv
from iflow_gym.results import Result, result_path, write_result

ENV = "iflow/Disturbed-Angle-v0"
ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def _short_evaluations(monkeypatch, request):
    """Evaluations on the way take thousands of steps: what they measure has a test of its own."""
    if "returns" not in request.node.name:
        monkeypatch.setattr(training, "returns_of", lambda *_: np.full(7, 0.5))
        spread = {"mean": 0.4, "least": 0.1, "greatest": 0.7}
        monkeypatch.setattr(records, "performance", lambda *_: dict(spread))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("base") / "angle.safetensors"
    return ImitationFlow(n_steps=40).fit(load_lasa("Angle"), seed=0).save(path)


def few(algorithm="ppo", **changes):
    """A preset's settings, cut down to a second."""
    settings = load_settings(algorithm)
    small = {"batch_size": 32}
    small |= {"n_steps": 16, "n_epochs": 1} if algorithm == "ppo" else {"learning_starts": 32}
    return dataclasses.replace(
        settings,
        **{
            "total_steps": 128,
            "num_envs": 4,
            "n_evaluations": 1,
            "n_checkpoints": 2,
            "keywords": {**settings.keywords, **small},
            "policy": {**settings.policy, "net_arch": [8]},
            **changes,
        },
    )


@pytest.fixture(scope="module")
def trained(model, tmp_path_factory):
    """A run with the evaluations that it makes."""
    folder = tmp_path_factory.mktemp("runs") / "stable"
    train(folder, ENV, few(), 0, base=("imitation-flow", model), stable=0.25, tensorboard=True)
    return folder


# The adapter --------------------------------------------------------------------------------


def test_the_adapter_begins_anew_within_the_step_and_keeps_the_last_observation():
    """Episodes are those of the environment itself, whatever the adapter does around them."""
    env = ArrayVecEnv(LASAVectorEnv("Angle", 3, horizon=4), reward_scale=0.5)
    plain = LASAVectorEnv("Angle", 3, horizon=4)
    env.seed(7)
    first, (expected, _) = env.reset(), plain.reset(seed=7)
    np.testing.assert_allclose(first, expected, rtol=1e-6)
    assert first.dtype == np.float32
    rng, total = np.random.default_rng(0), np.zeros(3)
    for k in range(1, 9):
        action = rng.uniform(-0.1, 0.1, (3, 2))
        seen, rewards, done, infos = env.step(action)
        expected, own, _, truncated, _ = plain.step(action)
        np.testing.assert_allclose(rewards, 0.5 * own, rtol=1e-6)
        total += own
        np.testing.assert_array_equal(done, truncated)
        if k % 4:
            np.testing.assert_allclose(seen, expected, rtol=1e-5)
            assert infos == [{}, {}, {}]
            continue
        assert done.all()
        following, *_ = plain.step(action)  # begins anew in the step after; its action is ignored
        np.testing.assert_allclose(seen, following, rtol=1e-5)
        for i, info in enumerate(infos):
            np.testing.assert_allclose(info["terminal_observation"], expected[i], rtol=1e-5)
            assert info["TimeLimit.truncated"]
            assert info["episode"]["r"] == pytest.approx(total[i], rel=1e-5)
            assert info["episode"]["l"] == 4
        total[:] = 0
    assert env.n_steps == 24
    assert env.cpu_seconds > 0


def test_the_adapter_resets_only_what_ended():
    env = ArrayVecEnv(LASAVectorEnv("Angle", 2))
    env.seed(0)
    env.reset()
    env.env._horizon[:] = [2, 5]
    for k in range(1, 4):
        seen, _, done, _ = env.step(np.zeros((2, 2)))
        assert done.tolist() == [k == 2, False]
        if k == 2:
            env.env._horizon[0] = 9
            np.testing.assert_allclose(seen[0], env.env._observation()[0], rtol=1e-6)
    assert env.env._count.tolist() == [1, 3]


def test_what_cannot_be_adapted_is_refused():
    with pytest.raises(TypeError, match="gymnasium VectorEnv"):
        ArrayVecEnv(gymnasium.make("CartPole-v1"))
    with pytest.raises(ValueError, match="resets under a mask"):
        ArrayVecEnv(gymnasium.make_vec("CartPole-v1", 2, "sync"))
    env = ArrayVecEnv(LASAVectorEnv("Angle", 2))
    assert env.get_attr("n_dims") == [2, 2]
    assert env.env_is_wrapped(ResidualVectorWrapper) == [False, False]
    for refused in (lambda: env.set_attr("x", 1), lambda: env.env_method("reset")):
        with pytest.raises(NotImplementedError, match="one array"):
            refused()


def test_arms_are_trained_one_after_the_other_and_begin_anew():
    env = residual_vec_env("iflow/Drumming-v0", 2, None, 0.4, False)
    env.seed(0)
    env.reset()
    for arm in env.env.unwrapped.envs:
        arm.unwrapped._length = 3
    for k in range(1, 5):
        seen, _, done, _ = env.step(np.zeros((2, 3), dtype=np.float32))
        assert done.tolist() == [k == 3] * 2
    assert seen.shape == (2, 6)
    env.close()


# Training -----------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_trains_from_its_preset_and_is_read_back(algorithm, model, tmp_path):
    done = train(
        tmp_path, ENV, few(algorithm), 3, base=("imitation-flow", model), tensorboard=False
    )
    assert done.card.steps >= 128
    assert 0 < done.environment_share <= 1
    policy = load_residual(tmp_path, environment=ENV, base=model)
    features = np.zeros((2, 8), dtype=np.float32)
    actions, _ = policy.agent.predict(features, deterministic=True)
    assert actions.shape == (2, 2)
    assert np.abs(actions).max() <= 1
    assert (policy.agent.predict(features + 0.5, deterministic=True)[0] != actions).any()


def test_a_run_leaves_checkpoints_curves_and_evaluations(trained, model):
    assert (trained / BASE).read_bytes() == model.read_bytes()
    card = read_card(trained)
    assert (card.environment, card.stable, card.seed) == (ENV, 0.25, 0)
    assert card.demonstrations == load_lasa("Angle").sha256
    assert len(list((trained / "checkpoints").glob("agent_*_steps.zip"))) == 2
    assert list((trained / "tensorboard").rglob("events.out.tfevents.*"))
    curve = json.loads((trained / "evaluations.json").read_text())
    assert [entry["steps"] for entry in curve] == sorted({entry["steps"] for entry in curve})
    assert curve[-1]["steps"] == card.steps


def test_the_same_seed_gives_the_same_agent(model, tmp_path):
    base, features = ("imitation-flow", model), np.random.default_rng(0).normal(size=(5, 8))
    found = []
    for name, seed in (("one", 0), ("same", 0), ("other", 1)):
        train(tmp_path / name, ENV, few(), seed, base=base, stable=0.25, tensorboard=False)
        agent = load_residual(tmp_path / name).agent
        found.append(agent.predict(features.astype(np.float32), deterministic=True)[0])
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[0] != found[2]).any()


def test_a_run_is_resumed_where_it_was(trained, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(trained, folder)
    before = read_card(folder).steps
    with pytest.raises(ValueError, match="Expected more than the 128 steps"):
        resume(folder)
    with pytest.raises(AgentFileError, match="begun on"):
        resume(folder, environment="iflow/Disturbed-Sshape-v0", total_steps=999)
    done = resume(folder, total_steps=256)
    assert done.card.steps == 256 > before
    assert read_card(folder).steps == 256
    curve = [e["steps"] for e in json.loads((folder / "evaluations.json").read_text())]
    assert curve[0] < before < curve[-1] == 256
    # An interrupted run has no agent yet: its last checkpoint is taken.
    (folder / AGENT).unlink()
    (folder / LAST).unlink()
    for later in (folder / "checkpoints").glob("agent_*_steps.zip"):
        if int(later.stem.split("_")[1]) > 64:
            later.unlink()
    assert resume(folder, total_steps=192).card.steps == 192


def test_the_agent_of_the_best_evaluation_is_kept(model, tmp_path, monkeypatch):
    """The means come in this order; ties go to the later one."""
    means, seen = iter([0.2, 0.7, 0.7, 0.3]), []

    def evaluated(agent, *_):
        seen.append([p.detach().clone() for p in agent.policy.parameters()])
        return np.full(7, next(means))

    monkeypatch.setattr(training, "returns_of", evaluated)
    settings = few(total_steps=192, n_evaluations=3)
    train(tmp_path, ENV, settings, 0, base=("imitation-flow", model), tensorboard=False)
    kept = list(load_residual(tmp_path).agent.policy.parameters())
    assert len(seen) == 4
    assert all((ours == theirs).all() for ours, theirs in zip(kept, seen[2], strict=True))
    assert any((ours != theirs).any() for ours, theirs in zip(kept, seen[1], strict=True))


def test_resuming_keeps_what_was_learned(trained, tmp_path, monkeypatch):
    """The optimizer goes on too: a step from there is not a first step of Adam."""
    folder = tmp_path / "copy"
    shutil.copytree(trained, folder)
    shutil.copyfile(folder / LAST, folder / AGENT)  # in place of the best one
    before = load_residual(folder).agent
    kept = {}
    original = training.set_parameters

    def spy(agent, path):
        original(agent, path)
        kept["weights"] = [p.detach().clone() for p in agent.policy.parameters()]
        kept["optimizer"] = len(agent.policy.optimizer.state_dict()["state"])

    monkeypatch.setattr(training, "set_parameters", spy)
    resume(folder, total_steps=192)
    for ours, theirs in zip(kept["weights"], before.policy.parameters(), strict=True):
        assert (ours == theirs).all()
    assert kept["optimizer"] > 0


def test_another_environment_another_base_and_other_files_are_refused(trained, model, tmp_path):
    with pytest.raises(AgentFileError, match=r"trained on, 'iflow/Disturbed-Angle-v0', got"):
        load_residual(trained, environment="iflow/LASA-Angle-v0")
    other = (
        ImitationFlow(n_steps=2).fit(load_lasa("Angle"), seed=1).save(tmp_path / "o.safetensors")
    )
    with pytest.raises(AgentFileError, match="belong to that base alone"):
        load_residual(trained, base=other)
    policy = load_residual(trained)
    with pytest.raises(ValueError, match="the motion that the residual was trained on"):
        policy.for_environment(gymnasium.make("iflow/Disturbed-Sshape-v0"))
    folder = tmp_path / "copy"
    shutil.copytree(trained, folder)
    shutil.copyfile(other, folder / BASE)
    with pytest.raises(AgentFileError, match="Put the base back"):
        load_residual(folder)
    shutil.copyfile(model, folder / BASE)
    (folder / AGENT).write_bytes(b"no zip")
    with pytest.raises(AgentFileError, match=r"Expected .*agent.zip to be an agent"):
        load_residual(folder)
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps({**card, "settings": {"algorithm": "dqn"}}))
    with pytest.raises(AgentFileError, match="ppo, sac, td3"):
        load_residual(folder)
    (folder / CARD).write_text(json.dumps({**card, "version": 99}))
    with pytest.raises(AgentFileError, match="upgrade"):
        load_residual(folder)
    (folder / CARD).unlink()
    with pytest.raises(FileNotFoundError, match="train one with"):
        load_residual(folder)
    with pytest.raises(FileExistsError, match="resume it"):
        train(trained, ENV, few(), 0, base=None)
    with pytest.raises(ValueError, match="Expected a base for a stable residual"):
        train(tmp_path / "x", ENV, few(), 0, base=None, stable=0.25)


def test_reading_an_agent_unpickles_nothing(trained, tmp_path, monkeypatch):
    """What a stranger's zip holds beside tensors is not run."""
    import cloudpickle
    from stable_baselines3.common import save_util

    def refuse(*_args, **_kwargs):
        raise AssertionError("unpickled")

    monkeypatch.setattr(cloudpickle, "loads", refuse)
    monkeypatch.setattr(save_util.cloudpickle, "loads", refuse)
    load_residual(trained)


def test_returns_are_of_the_recordings_own_episodes(model):
    """Against the environments one by one, with the base alone."""
    base = ImitationFlow.load(model)
    found = returns_of(Zero(2), ENV, base, 0.1, False)
    env, total = gymnasium.make(ENV), []
    from iflow_gym.policy import DynamicalSystemPolicy

    policy = DynamicalSystemPolicy(base, env)
    observation, _ = env.reset(options={"demonstration": 2})
    for _ in range(len(load_lasa("Angle").positions[2]) - 1):
        observation, reward, _, truncated, _ = env.step(policy.predict(observation)[0])
        total.append(reward)
    assert truncated
    assert found[2] == pytest.approx(np.mean(total), rel=1e-9)
    assert len(found) == 7


# Settings -----------------------------------------------------------------------------------


def test_presets_and_settings_say_what_is_wrong(tmp_path):
    assert set(known_presets()) == {*ALGORITHMS, "drumming"}
    assert load_settings("ppo", total_steps=7, scale=None).total_steps == 7
    with pytest.raises(SettingsError, match="drumming, ppo, sac, td3 or a path"):
        load_settings("dqn")
    path = tmp_path / "own.toml"
    path.write_text('[training]\nalgorithm = "ppo"\nsteps = 3\n')
    with pytest.raises(SettingsError, match="steps"):
        load_settings(str(path))
    path.write_text("[agent]\n")
    with pytest.raises(SettingsError, match=r"\[training\], \[algorithm\] and \[policy\]"):
        load_settings(str(path))
    path.write_text("[")
    with pytest.raises(SettingsError, match="no valid TOML"):
        load_settings(str(path))
    with pytest.raises(SettingsError, match="total_steps >= 1"):
        TrainingSettings(total_steps=0)


def test_learning_from_scratch_explores_as_its_own_setting_says():
    settings = load_settings("ppo")
    assert settings.of_run(scratch=False) is settings
    scratch = settings.of_run(scratch=True)
    assert scratch.policy["log_std_init"] == settings.scratch_log_std_init
    assert scratch.policy["log_std_init"] > settings.policy["log_std_init"]
    assert dataclasses.replace(scratch, policy=settings.policy) == settings
    assert load_settings("sac").of_run(scratch=True) == load_settings("sac")


def test_hits_are_heard_where_there_are_drums_and_asked_for_nowhere_else():
    env = residual_vec_env("iflow/Drumming-v0", 1, None, 0.4, False, 1.0, "hits")
    env.seed(0)
    env.reset()
    assert "strokes" in env.env.step(np.zeros((1, 3)))[4]
    with pytest.raises(ValueError, match="with drums for reward='hits', got 'iflow/Disturbed"):
        batch_of(ENV, 2, "hits")
    with pytest.raises(SettingsError, match="reward of environment, hits, got 'noise'"):
        TrainingSettings(reward="noise")


# Records ------------------------------------------------------------------------------------


def test_rows_become_records_on_the_bases_of_the_leaderboard(model, tmp_path, monkeypatch):
    """Trained once: the second time the record is up to date."""
    from iflow_gym.evaluate import Evaluation
    from iflow_gym.metrics import metrics_of

    scores = {m.name: None for m in metrics_of("goal")} | {"converged": 1.0}
    monkeypatch.setattr(records, "evaluate", lambda *_, **__: Evaluation(dict(scores), {}, {}))
    row = records.rows("ppo")["imitation-flow+stable-residual"]
    with pytest.raises(FileNotFoundError, match=r"run_all.py --methods imitation-flow"):
        records.make_record(tmp_path, row, ENV, 0, few())
    path = result_path("imitation-flow", ENV, "reproduction", 0)
    base = Result(
        "imitation-flow", "ImitationFlow", ENV, "Disturbed", "reproduction", 0, "full", "ok",
        "k" * 64, "2026-01-01T00:00:00+00:00", metrics=scores,
    )  # fmt: skip
    write_result(tmp_path, base)
    (tmp_path / path).with_suffix(".safetensors").write_bytes(model.read_bytes())
    assert set(records.with_returns(tmp_path, ENV, 0).returns) == {"mean", "least", "greatest"}
    record = records.make_record(tmp_path, row, ENV, 0, few())
    assert record.ok
    assert record.family == "Disturbed"
    assert record.guarantee.kind == "proved"
    assert "measured, not proved" in record.guarantee.reason
    assert record.returns["least"] <= record.returns["mean"] <= record.returns["greatest"]
    folder = tmp_path / "imitation-flow+stable-residual"
    file = folder / str(record.model)
    assert file.stat().st_size < 60_000
    policy = recorded.load_recorded(file)
    assert isinstance(policy.base_policy, ImitationFlow)
    assert policy.stable == row.stable
    with pytest.raises(FileNotFoundError, match="Expected the base of"):
        recorded.load_recorded(file, tmp_path / "absent.safetensors")
    with pytest.raises(AgentFileError, match="corrections belong to that base alone"):
        recorded.load_recorded(file, file)
    with pytest.raises(ModelFileError, match="no whole 'imitation-flow' model"):
        recorded.load_recorded(model)
    monkeypatch.setattr(records, "train", None)
    assert records.make_record(tmp_path, row, ENV, 0, few()) == record
    with pytest.raises(TypeError):
        records.make_record(tmp_path, row, ENV, 0, few(scale=0.2))
    assert "tube" not in record.guarantee.reason
    assert "a tube of 2% of" in row.guarantee(False, True).reason
    kinds = {r.name: r.guarantee(True, False).kind for r in records.rows("ppo").values()}
    assert kinds == {
        "imitation-flow+residual": "none",
        "imitation-flow+stable-residual": "proved",
        "ppo": "none",
    }


def test_the_command_line_trains_resumes_scores_and_says_what_it_misses(
    model, tmp_path, monkeypatch
):
    from iflow_gym.baselines import residual
    from iflow_gym.evaluate import Evaluation

    monkeypatch.setattr(
        "iflow_gym.evaluate.evaluate", lambda *_, **__: Evaluation({"rmse": 2.5}, {}, {})
    )
    preset = tmp_path / "few.toml"
    preset.write_text(
        '[training]\nalgorithm = "ppo"\ntotal_steps = 64\nnum_envs = 4\nn_evaluations = 1\n'
        "[algorithm]\nn_steps = 16\nbatch_size = 32\nn_epochs = 1\n[policy]\nnet_arch = [8]\n"
    )
    folder = tmp_path / "run"
    text = io.StringIO()
    console = Console(file=text, width=140)
    command = residual.Train(
        folder, base=model, stable=True, preset=str(preset), env=ENV, progress=False
    )
    assert residual.run(command, console) == 0
    assert "64 steps in" in text.getvalue()
    assert "in the environment and the base" in text.getvalue()
    assert read_card(folder).stable == 0.9
    assert residual.run(residual.Resume(folder, total_steps=128, progress=False), console) == 0
    assert read_card(folder).steps == 128
    assert residual.run(residual.Score(folder), console) == 0
    assert "rmse" in text.getvalue()
    with pytest.raises(FileNotFoundError, match="Expected a trained residual"):
        residual.run(residual.Resume(tmp_path), console)
    with pytest.raises(ValueError, match=r"Expected rows among imitation-flow\+residual"):
        residual.run(residual.Bench(rows=("sac",), output=tmp_path), console)


def test_the_script_explains_itself():
    script = [sys.executable, str(ROOT / "baselines" / "residual.py"), "train", "--help"]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "--rate-share" in done.stdout


def test_batches_of_arrays_are_made_where_there_are_any():
    assert isinstance(batch_of("iflow/LASA-Angle-v0", 2).unwrapped, LASAVectorEnv)
