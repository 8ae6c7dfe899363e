"""Fits beside the page: the same numbers as any fit, stopped when told to, failures kept."""

import numpy as np
import pytest
from drawing_hands import ellipse, reach

from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.linear import StableLinear
from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.drawing import fits as fits_module
from iflow_gym.drawing.fits import Fits, Stopped, method_entries
from iflow_gym.drawing.motion import HALF, LOST, N_GRID, accuracy, field_on_grid, paths_from
from iflow_gym.drawing.strokes import drawing_of
from iflow_gym.drawing.training_steps import TrainingSteps
from iflow_gym.primitive import MovementPrimitive
from iflow_gym.watched_training import WatchedGenerator

REACHES = drawing_of([reach(k) for k in range(3)], "goal")


@pytest.fixture
def started():
    """Starts fits; waits for the end of one."""
    made = []

    def start(*args, steps=None, **settings):
        made.append(Fits(steps))
        return made[-1], made[-1].start(*args, **settings)

    yield start
    for fits in made:
        fits.close()
        fits._executor.shutdown()


def ended(fit, fits):
    """Wait for a fit: its thread is done when the executor has run something after it."""
    fits._executor.shutdown(wait=True)
    return fit.state


def test_watching_a_training_does_not_change_it():
    seen = []
    rng, plain = WatchedGenerator(3, seen.append), np.random.default_rng(3)
    assert (rng.random((4, 2)) == plain.random((4, 2))).all()
    assert rng.normal() == plain.normal()
    assert (rng.random(5, dtype=np.float32) == plain.random(5, dtype=np.float32)).all()
    assert seen == [0, 4]
    motion = REACHES.demonstrations
    watched = ImitationFlow(n_steps=3).fit(motion, seed=WatchedGenerator(0, seen.append))
    alone = ImitationFlow(n_steps=3).fit(motion, seed=0)
    for name, array in alone._arrays().items():
        assert (array == watched._arrays()[name]).all(), name


def test_a_preview_then_what_replaces_it_then_all_steps(started):
    steps = TrainingSteps(preview=3, quick=5, full=7)
    fits, fit = started(REACHES, "imitation-flow", steps=steps)
    while fit.state == "running":
        fit.stop.wait(0.01)
    assert [m.system.config.n_steps for m in fit.models] == [3, 5]
    assert fits.refine(fit)
    assert ended(fit, fits) == "done"
    assert [m.system.config.n_steps for m in fit.models] == [3, 5, 7]
    version, newest = fit.newest()
    assert version == 3
    assert newest.error == accuracy(newest.system, REACHES.demonstrations)
    assert newest.cpu_seconds > 0


def test_a_new_fit_stops_the_one_before(started):
    steps = TrainingSteps(preview=20_000, quick=20_000)  # a minute, unless it is stopped
    fits, fit = started(REACHES, "imitation-flow", steps=steps)
    assert not fits.refine(fit)  # it runs
    other = fits.start(REACHES, "linear")
    assert ended(other, fits) == "done"
    assert fit.state == "stopped"
    assert fit.newest() is None


def test_a_failure_is_told(started, monkeypatch):
    def broken(name):
        raise RuntimeError("the method broke")

    monkeypatch.setattr(fits_module, "load_system", broken)
    fits, fit = started(REACHES, "linear")
    assert ended(fit, fits) == "failed"
    assert fit.message == "RuntimeError: the method broke"


def test_stopping_ends_a_training_from_within():
    def look(rows):
        raise Stopped

    with pytest.raises(Stopped):
        ImitationFlow(n_steps=5).fit(REACHES.demonstrations, seed=WatchedGenerator(0, look))


def test_only_so_many_fits_are_kept(started, monkeypatch):
    monkeypatch.setattr(fits_module, "MOST_KEPT", 2)
    fits, first = started(REACHES, "linear")
    others = [fits.start(REACHES, "linear") for _ in range(2)]
    with pytest.raises(KeyError):
        fits[first.id]
    assert [fits[f.id] for f in others] == others


def test_every_method_with_a_field_is_offered():
    offered = {entry.name: entry for entry in method_entries()}
    assert next(iter(offered)) == "imitation-flow"
    clocks = {n for n in METHODS if issubclass(load_method(n), MovementPrimitive)}
    assert set(offered) == set(METHODS) - clocks
    assert (offered["seds"].goal, offered["seds"].cycle) == (True, False)
    assert (offered["orbit-field"].goal, offered["orbit-field"].cycle) == (False, True)


@pytest.mark.parametrize("value", [0, -3, 1.5, True])
def test_steps_are_checked(value):
    with pytest.raises(ValueError, match="whole number of quick steps"):
        TrainingSteps(quick=value)


class Away(StableLinear):
    """x' = x / s, away from the origin, where the goal is."""

    def _velocity(self, x):
        return np.where(np.abs(x) < 1e150, x, np.nan)

    def _rollout(self, x0, n_steps, dt):
        t = dt * np.arange(n_steps + 1)
        return x0[:, None] * np.exp(40 * t)[:, None]


def test_paths_are_the_systems_own_and_end_where_they_get_lost():
    motion = REACHES.demonstrations
    system = StableLinear().fit(motion, seed=0)
    starts = np.array([[30.0, 30.0], [-20.0, 10.0]])
    for start, (path, lost) in zip(starts, paths_from(system, motion, starts), strict=True):
        assert path == pytest.approx(system.rollout(start, len(path) - 1, 0.004), abs=1e-9)
        assert not lost
    away = Away().fit(motion, seed=0)
    (gone, lost), (stays, never) = paths_from(away, motion, [[1.0, 1.0], [0.0, 0.0]])
    assert lost
    assert np.linalg.norm(gone[-1]) < LOST <= np.linalg.norm(gone[-1]) * np.exp(40 * 0.004)
    assert not never
    assert (stays == 0).all()


def test_the_field_is_that_of_the_nodes():
    system = StableLinear().fit(REACHES.demonstrations, seed=0)
    grid = field_on_grid(system)
    nodes = np.linspace(-HALF, HALF, N_GRID)
    assert grid[10, 50] == pytest.approx(system.velocity([nodes[50], nodes[10]]))


def test_accuracy_of_a_cycle_is_its_distance_from_the_strokes():
    """A system that goes round the drawn ellipse itself, and one that goes round beside it."""

    class Round(StableLinear):
        offset = 0.0

        def _rollout(self, x0, n_steps, dt):
            angle = 2 * np.pi * dt * np.arange(n_steps + 1) / 0.8
            path = np.column_stack([30 * np.cos(angle), 20 * np.sin(angle)])
            return (path * (1 + self.offset))[None]

    motion = drawing_of([ellipse(6)], "cycle").demonstrations
    system = Round()
    system.n_dims_ = 2
    exact = accuracy(system, motion)
    assert exact < 0.6  # a fourth of the way between two samples
    system.offset = 0.2  # 4 to 6 mm outside
    assert 4 - exact < accuracy(system, motion) < 6
