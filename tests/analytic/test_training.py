"""Training that goes wrong is noticed, and never returned as a fit."""

import pytest
import torch

from iflow_gym.baselines.imitation_flow import ImitationFlow, training
from iflow_gym.baselines.imitation_flow.training import TrainingError
from iflow_gym.datasets.lasa import load_lasa


def test_gradients_that_are_not_finite_are_counted_and_refused(monkeypatch):
    original, calls = training._reproduction, []

    def sometimes_nan(config, model, data, draws):
        calls.append(1)
        loss = original(config, model, data, draws)
        return loss * torch.tensor([torch.nan, 1.0]) if len(calls) % 5 == 0 else loss

    monkeypatch.setattr(training, "_reproduction", sometimes_nan)
    motions = [load_lasa("Angle"), load_lasa("Line")]
    with pytest.raises(TrainingError, match=r"converge on 'LASA-Angle': 17% of its gradients"):
        ImitationFlow(n_steps=30, n_layers=3, likelihood_fraction=0.1).fit_many(
            motions, seeds=[0, 0]
        )


def test_a_single_bad_step_leaves_the_other_models_alone(monkeypatch):
    def fit():
        return ImitationFlow(n_steps=120, n_layers=2, n_times=5, n_pairs=10).fit_many(
            [load_lasa("Angle"), load_lasa("Line")], seeds=[0, 0]
        )

    undisturbed = fit()
    original, calls = training._reproduction, []

    def once_nan(config, model, data, draws):
        calls.append(1)
        loss = original(config, model, data, draws)
        return loss * torch.tensor([torch.nan, 1.0]) if len(calls) == 9 else loss

    monkeypatch.setattr(training, "_reproduction", once_nan)
    disturbed = fit()
    x = [[-10.0, 5.0]]
    assert (disturbed[1].velocity(x) == undisturbed[1].velocity(x)).all()
    assert (disturbed[0].velocity(x) != undisturbed[0].velocity(x)).any()


@pytest.mark.parametrize("setting", ["calm_weight", "tube_weight", "likelihood_weight"])
def test_weights_must_be_finite(setting):
    with pytest.raises(ValueError, match=f"finite {setting} >= 0, got nan"):
        ImitationFlow(**{setting: float("nan")})
