"""The calm is enforced: its weight grows with need, and lattices see what steps do not."""

import math

import numpy as np
import pytest
import torch

from iflow_gym.baselines.imitation_flow import ImitationFlow, calm, training
from iflow_gym.baselines.imitation_flow.calm import Calm, Calmness, Sampling
from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow
from iflow_gym.baselines.imitation_flow.data import Draws, Recordings, Task
from iflow_gym.baselines.imitation_flow.latent import LinearLatent
from iflow_gym.baselines.imitation_flow.passes import evaluate
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.model_files import ModelFileError, read_model_file, write_model_file

SETTINGS = {"n_layers": 8, "n_times": 10, "n_pairs": 28, "n_steps": 300, "calm_weight": 0.002}
SHAPE = "Khamesh"
ALLOWED = 2.6


def peak(system):
    """Fastest speed on a fine grid over twice the recordings' box, in their peak speed."""
    motion = load_lasa(SHAPE)
    low, high = motion.bounding_box
    axes = np.meshgrid(*[np.linspace(-2, 2, 101)] * 2)
    grid = (low + high) / 2 + np.stack(axes, -1).reshape(-1, 2) * (high - low) / 2
    return np.linalg.norm(system.velocity(grid), axis=1).max() / motion.peak_speed


def test_a_weight_that_grows_holds_a_ratio_that_the_penalty_alone_exceeds(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Calm, "loud", staticmethod(lambda speeds: speeds > math.inf))
        loose = ImitationFlow(**SETTINGS).fit(load_lasa(SHAPE), seed=0)
    monkeypatch.setattr(calm, "LOUD", ALLOWED)
    held = ImitationFlow(**SETTINGS).fit(load_lasa(SHAPE), seed=0)
    assert loose.calm_.rounds == 0
    assert peak(loose) > 1.15 * ALLOWED
    assert held.calm_.peak < ALLOWED
    assert peak(held) < 1.05 * ALLOWED
    assert peak(loose) == pytest.approx(loose.calm_.peak, rel=0.05)


def test_rounds_are_added_for_the_model_that_is_loud_and_for_no_other(monkeypatch):
    motions = [load_lasa(SHAPE), load_lasa("Line")]
    settings = SETTINGS | {"n_steps": 40, "n_layers": 4}

    def loud(speeds):
        return speeds == speeds.max() if len(speeds) > 1 else speeds > 0

    monkeypatch.setattr(training, "N_WATCHES", 1)  # no weight changes on the way
    with monkeypatch.context() as patch:
        patch.setattr(Calm, "loud", staticmethod(lambda speeds: speeds > math.inf))
        before = ImitationFlow(**settings).fit_many(motions, seeds=[0, 0])
    monkeypatch.setattr(Calm, "loud", staticmethod(loud))
    after = ImitationFlow(**settings).fit_many(motions, seeds=[0, 0])
    calmer, other = sorted(range(2), key=lambda i: before[i].calm_.peak, reverse=True)
    assert after[calmer].calm_.rounds == training.CALM_ROUNDS
    assert after[other].calm_ == before[other].calm_
    x = [[-20.0, 5.0]]
    np.testing.assert_array_equal(after[other].velocity(x), before[other].velocity(x))
    assert np.abs(after[calmer].velocity(x) - before[calmer].velocity(x)).max() > 1e-4


@pytest.fixture
def untrained():
    task = Task([load_lasa(SHAPE)])
    data = Recordings([task], torch.device("cpu"))
    generators = [torch.Generator().manual_seed(0)]
    flow = CouplingFlow(2, 2, 4, log_scale_bound=0.3, sharpness=2.0, generators=generators)
    return flow, LinearLatent(1, 2, min_decay=0.05), data


def test_weights_double_while_a_model_is_loud_and_come_back(untrained, monkeypatch):
    flow, latent, data = untrained
    watched = Calm(data, Sampling(8, 0.001), 1.5)
    monkeypatch.setattr(calm, "LOUD", 0.0)
    for expected in (2.0, 4.0, 8.0):
        watched.watch(flow, latent)
        assert watched.weight.tolist() == [expected]
        assert watched.raised
    monkeypatch.setattr(calm, "LOUD", math.inf)
    for expected in (4.0, 2.0, 1.0, 1.0):
        watched.watch(flow, latent)
        assert watched.weight.tolist() == [expected]
    assert not watched.raised


def test_sweeps_have_lattices_of_their_own_and_their_fastest_states_are_looked_at(untrained):
    flow, latent, data = untrained
    watched = Calm(data, Sampling(8, 0.001), 1.5)
    first, second = watched._lattice().states, watched._lattice().states
    assert (first - second).abs().amax() > 1e-3
    low, high = data.centre - 2 * data.half, data.centre + 2 * data.half
    assert ((first >= low - 1e-6) & (first <= high + 1e-6)).all()
    speeds = torch.stack([watched.sweep(flow, latent) for _ in range(5)])
    kept = watched.kept
    with torch.no_grad():
        (excess,) = evaluate(flow, latent, data, [watched._excess(kept)])
    assert 1.5 * torch.exp(excess.amax()) == pytest.approx(float(speeds.max()), rel=1e-3)
    draws = Draws([np.random.default_rng(0)], 100, torch.device("cpu"))
    draws.new_step()
    points = next(watched(draws))
    torch.testing.assert_close(points.states[..., :4], kept.states)


def test_motions_that_repeat_are_not_watched():
    settings = SETTINGS | {"n_steps": 3, "n_layers": 2}
    assert ImitationFlow(**settings).fit(load_letter("I"), seed=0).calm_ is None


def test_a_file_keeps_how_calm_a_model_is(tmp_path):
    system = ImitationFlow(**SETTINGS | {"n_steps": 3, "n_layers": 2}).fit(load_lasa(SHAPE), seed=0)
    path = system.save(tmp_path / "model")
    again = ImitationFlow.load(path)
    assert again.calm_ == system.calm_
    assert isinstance(again.calm_, Calmness)
    header, arrays = read_model_file(path)
    for entry in ([-1.0, 0], [1.0, -1], [1.0], ["fast", 0], [1.0, 0.5]):
        write_model_file(path, {**header, "calm": entry}, arrays)
        with pytest.raises(ModelFileError, match="no whole 'imitation-flow' model"):
            ImitationFlow.load(path)
