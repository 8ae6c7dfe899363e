"""Training that goes wrong is noticed, taken back, recorded, and never returned as a fit."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow import (
    ConditionalImitationFlow,
    ImitationFlow,
    guard,
)
from iflow_gym.baselines.imitation_flow.data import Draws, Recordings, Task
from iflow_gym.baselines.imitation_flow.guard import TrainingError
from iflow_gym.baselines.imitation_flow.objectives import reproduction
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.metrics import rmse
from iflow_gym.model_files import ModelFileError, read_model_file, write_model_file
from iflow_gym.partial_fits import PartialFitError

SMALL = {"n_layers": 2, "n_times": 5, "n_pairs": 14}


def disturbed(monkeypatch, factor, when):
    """Multiply losses and gradients of two models by factors at the steps where `when` says so."""
    original, calls = guard.GuardedAdam.descend, []

    def descend(self, step, judged):
        calls.append(1)
        if when(len(calls)):
            judged = judged * torch.tensor(factor)
            self._gradient.mul_(torch.tensor(factor)[:, None])
        original(self, step, judged)

    monkeypatch.setattr(guard.GuardedAdam, "descend", descend)


def fit(n_steps=120, **settings):
    return ImitationFlow(n_steps=n_steps, **(SMALL | settings)).fit_many(
        [load_lasa("Angle"), load_lasa("Line")], seeds=[0, 0]
    )


def test_a_bad_step_is_taken_back_and_leaves_the_other_models_alone(monkeypatch):
    undisturbed = fit()
    disturbed(monkeypatch, [torch.nan, 1.0], lambda n: n == 60)
    systems = fit()
    x = [[-10.0, 5.0]]
    np.testing.assert_array_equal(systems[1].velocity(x), undisturbed[1].velocity(x))
    assert systems[1].restarts_ == []
    assert undisturbed[0].restarts_ == []
    (restart,) = systems[0].restarts_
    assert restart.rate == 0.5
    assert 60 <= restart.step < 60 + guard.WINDOW
    assert np.isfinite(systems[0].velocity(x)).all()


def test_a_rate_that_is_far_too_high_is_lowered_until_training_holds():
    """At a rate of 2 the loss of a curved motion explodes; the rate is halved until it holds.

    With which seeds it does depends on a processor's rounding.
    """
    motion = load_lasa("Angle")
    untrained = ImitationFlow(n_steps=1, **SMALL).fit(motion, seed=0)
    restarts = 0
    for seed in range(3):
        system = ImitationFlow(n_steps=300, learning_rate=2.0, **SMALL).fit(motion, seed=seed)
        halvings = range(1, len(system.restarts_) + 1)
        assert [r.rate for r in system.restarts_] == [0.5**k for k in halvings]
        assert error(system) < 0.6 * error(untrained)
        restarts += len(halvings)
    assert restarts >= 1


def error(system):
    motion = load_lasa("Angle")
    recordings = zip(motion.positions, motion.dt, strict=True)
    return np.mean([rmse(p, system.rollout(p[0], len(p) - 1, h)) for p, h in recordings])


def test_a_jump_late_in_a_window_is_not_kept_as_good():
    """The mean of a window forgives its last step; what is kept is where that step began."""
    parameter = torch.nn.Parameter(torch.ones(1, 1))
    adam = guard.GuardedAdam(
        [(parameter, 0)], ["toy"], n_steps=200, learning_rate=1e-3, max_norm=1.0
    )
    for step in range(2 * guard.WINDOW):
        if step == guard.WINDOW - 1:
            parameter.data.fill_(20.0)
        adam.step(step, parameter[:, 0] ** 2 + 1)
    assert len(adam.restarts[0]) == 1
    assert abs(parameter.item()) < 2


def test_an_end_that_is_worse_than_the_beginning_is_an_error():
    with pytest.raises(TrainingError, match="did not converge on 'LASA-Angle'"):
        ImitationFlow(n_steps=300, learning_rate=1e8, **SMALL).fit(load_lasa("Angle"), seed=0)


@pytest.mark.parametrize(("tolerance", "failed"), [(1.0, True), (guard.TOLERANCE, False)])
def test_a_stage_may_end_worse_by_its_tolerance(tolerance, failed):
    """What is judged rises from 0.5 to 3 where a penalty that is not judged pulls."""
    parameter = torch.nn.Parameter(torch.ones(1, 1))
    adam = guard.GuardedAdam(
        [(parameter, 0)], ["toy"], n_steps=100, learning_rate=1e-3, max_norm=1.0
    )
    for step in range(100):
        judged = torch.full((1,), 0.5 if step == 0 else 3.0)
        adam.step(step, parameter[:, 0] ** 2, judged=judged)
    adam.finish(100, tolerance)
    assert not adam.restarts[0]
    assert bool(adam.failures) is failed


def test_training_that_diverges_for_good_is_an_error_that_holds_the_others(monkeypatch):
    """They are the same bits as without it, and come back from the error as they would without."""
    undisturbed = fit(n_steps=400)
    disturbed(monkeypatch, [torch.nan, 1.0], lambda n: n % 5 == 0)
    with pytest.raises(
        PartialFitError, match=r"1 of 2 motions .*'LASA-Angle' at place 0"
    ) as caught:
        fit(n_steps=400)
    error = pickle.loads(pickle.dumps(caught.value))
    assert error.names == ["LASA-Angle", "LASA-Line"]
    assert str(error) == str(caught.value)
    (failure,) = error.failures.values()
    assert list(error.failures) == [0]
    assert isinstance(failure, TrainingError)
    assert "did not converge on 'LASA-Angle': its training diverged 6" in str(failure)
    assert error.systems[0] is None
    x = [[-10.0, 5.0], [3.0, 4.0]]
    np.testing.assert_array_equal(error.systems[1].velocity(x), undisturbed[1].velocity(x))
    assert error.systems[1].guarantee.kind == "proved"


def test_failures_in_batches_of_their_own_are_collected(monkeypatch):
    """Two batches, since the counts differ; in each one model fails, in one of them at the end."""
    motions = [load_lasa("Angle"), load_lasa("Line")]
    motions += [motion.subset(range(3)) for motion in motions]
    disturbed(monkeypatch, [torch.nan, 1.0], lambda n: n % 5 == 0)
    take, calls = ImitationFlow._take, []

    def refused(self, trained, task):
        calls.append(1)
        if len(calls) == 4:
            raise ValueError("expected a flow that inverts")
        take(self, trained, task)

    monkeypatch.setattr(ImitationFlow, "_take", refused)
    with pytest.raises(PartialFitError, match="3 of 4 motions") as caught:
        ImitationFlow(n_steps=160, **SMALL).fit_many(motions, seeds=[0, 1, 2, 3])
    assert {i: type(e) for i, e in caught.value.failures.items()} == {
        0: TrainingError,
        2: TrainingError,
        3: ValueError,
    }
    assert [s is None for s in caught.value.systems] == [True, False, True, True]


def test_a_batch_that_fails_whole_ends_at_once(monkeypatch):
    """The second model fails first: each has its own error all the same."""
    calls, late = [], 4 * guard.WINDOW
    disturbed(monkeypatch, [torch.nan, 1.0], lambda n: n > late)
    disturbed(monkeypatch, [1.0, torch.nan], lambda n: calls.append(n) or True)
    with pytest.raises(PartialFitError, match="2 of 2 motions") as caught:
        fit(n_steps=5000)
    assert len(calls) == late + (guard.MOST_RESTARTS + 1) * guard.WINDOW
    failures = caught.value.failures
    assert "on 'LASA-Angle': its training diverged 6 times, last at step 249" in str(failures[0])
    assert "on 'LASA-Line': its training diverged 6 times, last at step 149" in str(failures[1])


def test_a_file_keeps_where_training_was_taken_back(monkeypatch, tmp_path):
    disturbed(monkeypatch, [torch.nan, 1.0], lambda n: n in (30, 60))
    systems = fit()
    assert [r.rate for r in systems[0].restarts_] == [0.5, 0.25]
    for system in systems:
        again = ImitationFlow.load(system.save(tmp_path / "model"))
        assert again.restarts_ == system.restarts_
        assert all(isinstance(restart, guard.Restart) for restart in again.restarts_)


def test_a_file_of_several_motions_keeps_it_too(monkeypatch, tmp_path):
    disturbed(monkeypatch, [torch.nan], lambda n: n == 30)
    motions = [load_lasa("Angle"), load_lasa("Line")]
    model = ConditionalImitationFlow(n_steps=60, **SMALL).fit(motions, seed=0)
    again = ConditionalImitationFlow.load(model.save(tmp_path / "model"))
    assert len(model.at([1, 0]).restarts_) == 1
    assert again.at([1, 0]).restarts_ == model.at([1, 0]).restarts_
    assert model.calm_ is not None
    assert again.calm_ == model.calm_


@pytest.mark.parametrize("n_steps", [1, 2, 7, 1500])
def test_the_rates_are_those_of_torchs_one_cycle_schedule(n_steps):
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, 3e-3, total_steps=n_steps + 1, pct_start=guard.WARM_UP
    )
    (group,) = optimizer.param_groups
    expected = []
    for _ in range(n_steps):
        expected.append((group["lr"], group["betas"][0]))
        optimizer.step()
        schedule.step()
    np.testing.assert_allclose(guard.one_cycle(3e-3, n_steps), expected, rtol=1e-12)


def test_fitting_imports_no_compiler():
    """It takes a second, which is longer than many a fit here."""
    code = (
        "import sys; from iflow_gym import load_lasa; "
        "from iflow_gym.baselines.imitation_flow import ImitationFlow; "
        "ImitationFlow(n_steps=3).fit(load_lasa('Angle'), seed=0); "
        "print('torch._dynamo' in sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"


@pytest.mark.parametrize(
    "restarts", [[[3]], [[-1, 0.5]], [[3, 1.5]], [["3", 0.5]], [[3, float("nan")]], 7]
)
def test_restarts_that_no_training_records_are_refused(restarts, tmp_path):
    path = fit(n_steps=1)[0].save(tmp_path / "model")
    header, arrays = read_model_file(path)
    write_model_file(path, {**header, "restarts": restarts}, arrays)
    with pytest.raises(ModelFileError, match="no whole 'imitation-flow' model"):
        ImitationFlow.load(path)


@pytest.mark.parametrize("setting", ["calm_weight", "tube_weight", "likelihood_weight"])
def test_weights_must_be_finite(setting):
    with pytest.raises(ValueError, match=f"finite {setting} >= 0, got nan"):
        ImitationFlow(**{setting: float("nan")})


@pytest.fixture
def double_precision():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


CASES = [
    (emission, name, {"objective": objective})
    for emission in ("coupling", "autoregressive", "spline")
    for name, objective in (("Angle", "reproduction"), ("Angle", "paper"), ("I", "reproduction"))
]


def short_fit(emission, name, settings):
    motion = load_letter(name) if len(name) == 1 else load_lasa(name)
    method = ImitationFlow(emission=emission, n_steps=20, **SMALL, **settings)
    return method.fit(motion.subset(range(3)), seed=0)


@pytest.fixture(scope="module")
def in_single_precision():
    return [short_fit(*case) for case in CASES]


@pytest.mark.parametrize("case", range(len(CASES)), ids=["-".join(c[:2]) for c in CASES])
def test_the_processs_default_precision_changes_nothing(
    case, in_single_precision, double_precision
):
    system, expected = short_fit(*CASES[case]), in_single_precision[case]
    for name, array in expected._parameters.items():
        np.testing.assert_array_equal(system._parameters[name], array, err_msg=name)


def squared_error(offsets, **settings):
    """`reproduction` of what is `offsets` (n, 2) off a straight recording along x, and its end."""
    x = np.linspace(-10.0, 0.0, 101)
    motion = Demonstrations.from_arrays([np.column_stack([x, 0 * x])], dt=0.01, name="line")
    data = Recordings([Task([motion])], torch.device("cpu"))
    draws = Draws([np.random.default_rng(0)], 100, torch.device("cpu"))
    draws.new_step()
    term = reproduction(data, draws, len(offsets) - 1, **settings)
    points = next(term)
    starts = term.send((points.states, None))
    shown = data.at(starts.recordings, (starts.times / data.steps).round().long())
    with pytest.raises(StopIteration) as end:
        term.send(shown + torch.as_tensor(offsets, dtype=torch.float32).T[None])
    return float(end.value.value)


def test_what_is_late_counts_less_than_what_is_beside():
    along, across = np.zeros((5, 2)), np.zeros((5, 2))
    along[:4, 0], across[:4, 1] = 0.1, 0.1
    assert squared_error(across, timing_weight=0.7) == pytest.approx(0.01, rel=1e-4)
    assert squared_error(along, timing_weight=0.7) == pytest.approx(0.007, rel=1e-4)
    assert squared_error(along, timing_weight=0.0) == pytest.approx(0.0, abs=1e-5)


def test_errors_count_by_their_power_mean_and_the_end_by_itself():
    offsets = np.zeros((5, 2))
    offsets[:, 1] = [0.1, 0.2, 0.0, 0.3, 0.5]
    squares = offsets[:, 1] ** 2
    for power in (1.0, 3.0):
        mean = np.mean(squares[:4] ** power) ** (1 / power)
        found = squared_error(offsets, power=power, end_weight=2.0)
        assert found == pytest.approx(mean + 2 * squares[4], rel=1e-3)


def test_powers_below_single_precision_are_refused():
    for power in (0.5, 6.0):
        with pytest.raises(ValueError, match="error_power"):
            ImitationFlow(error_power=power)


def test_processes_fit_what_one_process_fits_and_in_its_order():
    motions = [load_lasa(shape) for shape in ("Angle", "Line", "Worm")]
    alone = ImitationFlow(n_steps=20, **SMALL).fit_many(motions, seeds=[0, 1, 2])
    dealt = ImitationFlow(n_steps=20, n_jobs=2, **SMALL).fit_many(motions, seeds=[0, 1, 2])
    for one, other in zip(alone, dealt, strict=True):
        x = [[-20.0, 5.0]]
        np.testing.assert_allclose(other.velocity(x), one.velocity(x), rtol=1e-2)
