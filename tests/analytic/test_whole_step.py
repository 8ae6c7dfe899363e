"""A step by hand against the same step in torch, for all kinds of steps."""

import math

import numpy as np
import pytest
import torch

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import training
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.data import Task
from iflow_gym.baselines.imitation_flow.passes import evaluate
from iflow_gym.baselines.imitation_flow.whole_step import AHEAD, by_hand
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter

SHAPES = ("Angle", "Sshape", "BendedLine")
TRAINED = 30


class Given:
    """Uniform numbers in the order in which the terms of a step ask for them."""

    def __init__(self, numbers: list[np.ndarray]) -> None:
        self._numbers = numbers

    def uniform(self, *shape: int) -> torch.Tensor:
        taken = self._numbers.pop(0)
        assert taken.shape[1] == math.prod(shape)
        return torch.from_numpy(taken.copy()).view(-1, *shape)


def batch_of(n_models: int, **settings: object) -> training._Batch:
    config = ImitationFlowConfig(n_layers=4, **settings)
    rngs = [np.random.default_rng(seed) for seed in range(n_models)]
    generators = [torch.Generator().manual_seed(seed) for seed in range(n_models)]
    tasks = [Task([load_lasa(shape)]) for shape in SHAPES[:n_models]]
    return training._Batch(config, tasks, rngs, generators, torch.device("cpu"))


def numbers_of(batch: training._Batch, config: ImitationFlowConfig, step: int) -> list[np.ndarray]:
    """The uniform numbers of a step, in the parts that `Preparation` cuts them into."""
    q, p, n, t = training.N_HORIZONS, training._n_pairs(config), batch.data.n_recordings, 40
    sizes = [q, q, q * p, t, 2 * n, t // 2, training.CALM_ENDS.n_points]
    drawn = [np.random.default_rng(m) for m in range(batch.data.n_models)]
    rows = [rng.random((AHEAD, sum(sizes)), dtype=np.float32)[step] for rng in drawn]
    return np.split(np.stack(rows), np.cumsum(sizes)[:-1], axis=-1)


@pytest.mark.parametrize("n_models", [1, 3])
@pytest.mark.parametrize(
    ("stage", "turn"),
    [(training.LIKELIHOOD, 0), (training.WHOLE, 0), (training.WHOLE, 1), (training.WHOLE, 2)],
)
def test_a_step_by_hand_is_the_step_in_torch(n_models: int, stage: int, turn: int) -> None:
    batch = batch_of(n_models)
    config, whole, calm = batch._config, batch._whole, batch.watched
    assert whole is not None
    assert calm is not None
    adam = batch.optimizer(TRAINED, 0.01)
    for step in range(TRAINED):  # away from the start, where half the gradients are 0
        batch.step(adam, step, training.WHOLE)
    calm.weight = torch.arange(2.0, 2.0 + n_models)
    kept, kept_excess = calm.kept, calm._kept_excess
    weights = training._weights(config, batch.resolved, turn, stage)
    judged = whole(weights, adam.gradients)
    gradients = [g.clone() for g in adam.gradients]

    calm.kept, calm._kept_excess = kept, kept_excess
    parts = numbers_of(batch, config, TRAINED)
    wanted = [
        *(parts[:3] if weights.likelihood else []),
        *(parts[3:4] if weights.reproduction else []),
        *(parts[4:6] if weights.tube else []),
        parts[6],
        np.zeros((n_models, calm.n_new), dtype=np.float32),
    ]
    draws = Given(wanted)
    terms = training._terms(config, weights, batch.latent, batch.data, draws)
    terms.append((weights.calm, calm(draws)))
    losses = evaluate(batch.flow, batch.latent, batch.data, [term for _, term in terms])
    weighted = [w * x for (w, _), x in zip(terms, losses, strict=True)]
    total = torch.stack(weighted).sum(0)
    torch.testing.assert_close(judged, total.detach(), rtol=1e-4, atol=1e-5)
    assert all(x.detach().abs().min() > 0 for x in weighted)

    loss = (total + (calm.weight - 1) * weighted[-1]).sum()
    parameters = [p for p, _ in batch.parameters]
    expected = torch.autograd.grad(loss, parameters, allow_unused=True)
    for (parameter, axis), found, sought in zip(batch.parameters, gradients, expected, strict=True):
        assert found.shape == parameter.shape
        sought = torch.zeros_like(parameter) if sought is None else sought
        for one, other in zip(found.unbind(axis), sought.unbind(axis), strict=True):
            # Single precision: rounding alone makes 2e-3 on some processors.
            assert torch.norm(one - other) <= 4e-3 * torch.norm(other) + 1e-5


def test_each_model_trains_as_alone() -> None:
    together, alone = batch_of(3), batch_of(1)
    for batch in (together, alone):
        adam = batch.optimizer(20, 0.003)
        for step in range(20):
            batch.step(adam, step, training.WHOLE)
    for (many, axis), (one, _) in zip(together.parameters, alone.parameters, strict=True):
        torch.testing.assert_close(many.narrow(axis, 0, 1), one, rtol=1e-3, atol=1e-4)


def test_a_model_that_is_lost_leaves_the_others_as_they_are() -> None:
    """Bit by bit, whatever its parameters have become; it is taken back."""
    disturbed, undisturbed = batch_of(3), batch_of(3)
    adams = [batch.optimizer(60, 0.003) for batch in (disturbed, undisturbed)]
    for step in range(60):
        if step == 30:
            for parameter, axis in disturbed.parameters:
                parameter.data.select(axis, 1).fill_(torch.nan)
        for batch, adam in zip((disturbed, undisturbed), adams, strict=True):
            batch.step(adam, step, training.WHOLE)
    assert [len(r) for r in adams[0].restarts] == [0, 1, 0]
    for (one, axis), (other, _) in zip(disturbed.parameters, undisturbed.parameters, strict=True):
        for model in (0, 2):
            assert torch.equal(one.select(axis, model), other.select(axis, model))
        assert one.isfinite().all()


def test_more_than_a_group_come_back_in_their_order() -> None:
    n = training.GROUP + 1
    config = ImitationFlowConfig(n_layers=2, n_steps=2, calm_speed=1e6)
    motions = [load_lasa(SHAPES[i % 3]) for i in range(n)]
    rngs = [np.random.default_rng(i) for i in range(n)]
    found = training.train(config, [Task([motion]) for motion in motions], rngs)
    last = training.train_one(config, Task([motions[-1]]), np.random.default_rng(n - 1))
    assert len(found) == n
    model = found[-1]
    assert isinstance(model, training.Trained)
    for name, array in model.arrays().items():
        np.testing.assert_allclose(array, last.arrays()[name], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "settings", [{"calm_weight": 0.0}, {"emission": "spline"}, {"objective": "paper"}]
)
def test_other_settings_train_in_torch(settings: dict) -> None:
    assert batch_of(1, **settings)._whole is None


def test_other_motions_and_devices_train_in_torch() -> None:
    config, cpu = ImitationFlowConfig(), torch.device("cpu")
    ends = Task([load_lasa("Angle")])
    assert by_hand(config, ends, cpu)
    assert not by_hand(config, ends, torch.device("cuda"))
    assert not by_hand(config, Task([load_letter("S")]), cpu)
    assert not by_hand(config, Task([load_lasa("Angle")], np.zeros((1, 1))), cpu)
    line = np.linspace(1, 0, 20)[:, None] * np.ones(3)
    space = Demonstrations.from_arrays([line, line * 1.1], dt=0.1, name="line")
    assert not by_hand(config, Task([space]), cpu)
