"""What every method keeps, whichever it is: the registry's methods, one after another.

Each is fitted on thinned LASA shapes with settings that make it quick, so that nothing here says
how good a method is; it says that a method is what `DynamicalSystem` promises.
"""

import contextlib
import dataclasses
import functools
import json

import numpy as np
import pytest
import safetensors
import safetensors.numpy

from iflow_gym.baselines.registry import KINDS, METHODS, load_method
from iflow_gym.baselines.runner.presets import load_settings
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.model_files import SCHEMA_VERSION, ModelFileError, read_model_file
from iflow_gym.primitive import MovementPrimitive
from iflow_gym.system import DynamicalSystem, Guarantee, NotFittedError

QUICK = {"imitation-flow": {"n_steps": 60}}
"""Settings of methods that would take long by their smoke preset, too; an accurate fit is not what
is asked here."""

FIELDS = [name for name in METHODS if issubclass(load_method(name), DynamicalSystem)]
PRIMITIVES = [name for name in METHODS if issubclass(load_method(name), MovementPrimitive)]


def motions(name):
    """The motions that a method is tried on, of each kind that it learns."""
    method = load_method(name)
    ends = ["Angle", "Sshape"] if method.learns_goals else []
    return ends + (["Letter-I", "Letter-S"] if method.learns_cycles else [])


def first(name):
    return motions(name)[0]


def cells(names):
    return pytest.mark.parametrize(("name", "shape"), [(n, m) for n in names for m in motions(n)])


every_method = pytest.mark.parametrize("name", METHODS)
every_field = pytest.mark.parametrize("name", FIELDS)
every_cell = cells(METHODS)
every_field_cell = cells(FIELDS)


def make(name):
    smoke = load_settings(name, "smoke", registered=True)
    return load_method(name)(**smoke | QUICK.get(name, {}))


def behaviour(method, x):
    """What a method does at x: its velocity, or where it has gone some steps later."""
    if isinstance(method, DynamicalSystem):
        return method.velocity(x)
    return method.rollout(x, 10, 0.1)[..., 1:, :].reshape(*x.shape[:-1], -1)


def thinned(shape, every=10, shift=(0.0, 0.0), n=3):
    if shape.startswith("Letter-"):
        letter = load_letter(shape[-1]).subset(range(n))
        return Demonstrations.from_arrays(
            [p[::4] + shift for p in letter.positions],
            velocities=[v[::4] for v in letter.velocities],
            dt=[h * 4 for h in letter.dt],
            period=letter.period,
            name=letter.name,
        )
    full = load_lasa(shape).subset(range(n))
    # The last sample stays, since it is the goal.
    return Demonstrations.from_arrays(
        [p[::-1][::every][::-1] + shift for p in full.positions],
        velocities=[v[::-1][::every][::-1] for v in full.velocities],
        dt=[h * every for h in full.dt],
        goal=full.goal + shift,
        name=full.name,
    )


def in_space(shape):
    """Three recordings in 3-D: a planar motion, and a smooth third coordinate."""
    flat = thinned(shape)
    if flat.period is not None:
        tilted = [np.column_stack([p, 0.3 * p[:, 0]]) for p in flat.positions]
        return Demonstrations.from_arrays(tilted, dt=flat.dt, period=flat.period)
    rise = [np.linspace(1, 0, len(p)) ** 2 * 20 for p in flat.positions]
    return Demonstrations.from_arrays(
        [np.column_stack([p, z]) for p, z in zip(flat.positions, rise, strict=True)],
        dt=flat.dt,
        goal=np.zeros(3),
    )


@functools.cache
def fitted(name, shape=None):
    return make(name).fit(thinned(shape or first(name)), seed=0)


def states(shape, n=40, factor=1.0, seed=0):
    """States drawn uniformly from the demonstrations' box, enlarged by half of each side."""
    box = thinned(shape).bounding_box
    centre, half = (box.low + box.high) / 2, (box.high - box.low)
    return centre + factor * half * np.random.default_rng(seed).uniform(-1, 1, size=(n, 2))


# Fitting ------------------------------------------------------------------------------------


@every_method
def test_is_declared(name):
    cls = load_method(name)
    assert issubclass(cls, KINDS)
    assert cls.uses_time == issubclass(cls, MovementPrimitive)
    assert cls.name == name
    assert cls.title
    assert cls.integrator
    config = cls.Config()
    assert dataclasses.is_dataclass(config)
    first = dataclasses.fields(config)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(config, first, None)
    with pytest.raises(TypeError, match="Unknown settings"):
        cls(no_such_setting=1)


@every_cell
def test_fit_returns_self_and_sets_what_it_promises(name, shape):
    system = make(name)
    assert system.fit(thinned(shape), seed=0) is system
    assert system.n_dims_ == 2
    np.testing.assert_array_equal(system.goal_, thinned(shape).centre)
    assert system.period_ == thinned(shape).period
    assert system.n_parameters > 0


@every_method
def test_the_same_seed_gives_the_same_fit(name):
    again, x = make(name).fit(thinned(first(name)), seed=0), states(first(name))
    np.testing.assert_array_equal(behaviour(again, x), behaviour(fitted(name), x))


@every_method
def test_the_seed_matters_only_where_the_method_says_so(name):
    if load_method(name).stochastic_fit:
        pytest.skip("stochastic")
    other, x = make(name).fit(thinned(first(name)), seed=1), states(first(name))
    np.testing.assert_array_equal(behaviour(other, x), behaviour(fitted(name), x))


@every_method
def test_fitting_draws_no_global_random_numbers(name):
    np.random.seed(7)  # noqa: NPY002 (the global state is what is looked at)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    make(name).fit(thinned(first(name)), seed=0)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


@every_method
def test_fit_many_keeps_the_order(name):
    shifts = [(0.0, 0.0), (50.0, -20.0)]
    sets = [thinned(first(name), shift=s) for s in shifts]
    systems = make(name).fit_many(sets, seeds=[0, 1])
    for system, shift in zip(systems, shifts, strict=True):
        np.testing.assert_allclose(system.goal_, sets[0].centre + shift, atol=1e-9)
        assert np.isfinite(behaviour(system, states(first(name)) + shift)).all()
    with pytest.raises(ValueError, match="a seed for each"):
        make(name).fit_many(sets, seeds=[0])


@every_method
def test_a_shifted_motion_gives_the_shifted_field(name):
    """To 1 % of the peak speed: training in single precision rounds the shifted data otherwise.

    A primitive goes the shifted way, to 1 % of what that speed covers in a second.
    """
    shift = np.array([64.0, -32.0])
    moved = make(name).fit(thinned(first(name), shift=shift), seed=0)
    x = np.concatenate(thinned(first(name)).positions)
    there, here = behaviour(moved, x + shift), behaviour(fitted(name), x)
    if name in PRIMITIVES:
        there = there - np.tile(shift, there.shape[1] // 2)
    np.testing.assert_allclose(
        there,
        here,
        rtol=0,
        atol=0.01 * thinned(first(name)).peak_speed,
    )


@every_cell
def test_learns_in_three_dimensions(name, shape):
    demonstrations = in_space(shape)
    system = make(name).fit(demonstrations, seed=0)
    path = system.rollout(demonstrations.starts, 5, demonstrations.mean_dt)
    assert path.shape == (3, 6, 3)
    assert np.isfinite(path).all()


@every_method
def test_other_data_are_refused(name):
    with pytest.raises(TypeError, match="Expected Demonstrations, got ndarray"):
        make(name).fit(np.zeros((10, 2)), seed=0)


@every_method
def test_an_unfitted_system_says_so(name, tmp_path):
    system = make(name)
    for call in (
        lambda: behaviour(system, np.zeros(2)),
        lambda: system.step([0.0, 0.0], 0.1) if name in FIELDS else system.begin([0.0, 0.0]),
        lambda: system.rollout([0.0, 0.0], 3, 0.1),
        lambda: system.n_parameters,
        lambda: system.save(tmp_path / "model"),
    ):
        with pytest.raises(NotFittedError, match="call fit"):
            call()


# The field ----------------------------------------------------------------------------------


@every_field
def test_shapes_agree(name):
    system = fitted(name)
    x = states(first(name), n=12)
    dt = thinned(first(name)).mean_dt
    calls = {
        "velocity": system.velocity,
        "step": lambda s: system.step(s, dt),
        "rollout": lambda s: system.rollout(s, 3, dt),
        "lyapunov": system.lyapunov,
        "lyapunov_rate": system.lyapunov_rate,
        "log_prob": lambda s: system.log_prob(s, s + 1.0, dt),
    }
    for label, call in calls.items():
        batch = call(x)
        if batch is None:
            continue
        folded, one = call(x.reshape(3, 4, 2)), call(x[0])
        assert folded.shape == (3, 4, *batch.shape[1:]), label
        assert one.shape == batch.shape[1:], label
        # A product of another batch size may round otherwise.
        scale = np.abs(batch).max()
        np.testing.assert_allclose(folded.reshape(batch.shape), batch, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(one, batch[0], rtol=0, atol=1e-6 * scale, err_msg=label)


@every_field
def test_an_empty_batch_stays_empty(name):
    assert fitted(name).velocity(np.empty((0, 2))).shape == (0, 2)
    assert fitted(name).step(np.empty((0, 2)), 0.1).shape == (0, 2)


@every_field
def test_wrong_dimensions_are_refused(name):
    for bad in (np.zeros(3), np.zeros((4, 1)), 0.0):
        with pytest.raises(ValueError, match=r"Expected states of shape \(..., 2\)"):
            fitted(name).velocity(bad)


@every_field
@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf])
def test_times_that_are_none_are_refused(name, dt):
    system, x = fitted(name), states(first(name), n=3)
    for call in (
        lambda: system.step(x, dt),
        lambda: system.step(x, np.array([0.1, dt, 0.1])),
        lambda: system.rollout(x, 3, dt),
        lambda: system.log_prob(x, x, dt),
    ):
        with pytest.raises(ValueError, match="Expected a finite dt > 0"):
            call()


@every_field
def test_arguments_that_do_not_fit_are_refused(name):
    system, x = fitted(name), states(first(name), n=3)
    with pytest.raises(ValueError, match=r"dt of a shape that broadcasts to \(3,\), got \(2,\)"):
        system.step(x, np.array([0.1, 0.2]))
    with pytest.raises(ValueError, match="Expected n_steps >= 0, got -1"):
        system.rollout(x, -1, 0.1)
    with pytest.raises(TypeError, match=r"Expected n_steps to be a whole number, got 2\.5"):
        system.rollout(x, 2.5, 0.1)
    with pytest.raises(ValueError, match=r"one shape, got \(3, 2\) and \(2,\)"):
        system.log_prob(x, x[0], 0.1)


@every_field
def test_a_rollout_takes_numpys_whole_numbers_and_none_is_the_start(name):
    system, x = fitted(name), states(first(name), n=3)
    np.testing.assert_array_equal(
        system.rollout(x, np.int32(2), np.float32(0.5)), system.rollout(x, 2, 0.5)
    )
    np.testing.assert_array_equal(system.rollout(x, 0, 0.5), x[:, None])


@every_field
def test_the_field_is_float64_and_leaves_its_input_alone(name):
    x = states(first(name))
    kept = x.copy()
    assert fitted(name).velocity(x).dtype == np.float64
    fitted(name).step(x, 0.1)
    fitted(name).rollout(x, 2, 0.1)
    np.testing.assert_array_equal(x, kept)


@every_field
@pytest.mark.parametrize("factor", [10.0, 1e3])
def test_the_field_is_finite_far_away(name, factor):
    assert np.isfinite(fitted(name).velocity(states(first(name), factor=factor))).all()


@every_field_cell
def test_a_small_step_goes_along_the_field(name, shape):
    system = fitted(name, shape)
    demonstrations = thinned(shape)
    x = np.concatenate(demonstrations.positions)[::7]
    if demonstrations.goal is not None:
        # Next to the goal a step may be corrected as one of some length, and jumps to it.
        away = np.linalg.norm(x - demonstrations.goal, axis=1)
        x = x[away > 5e-3 * demonstrations.bounding_box.diagonal]
    dt = 1e-5 * demonstrations.durations.mean()
    np.testing.assert_allclose(
        (system.step(x, dt) - x) / dt,
        system.velocity(x),
        rtol=1e-2,
        atol=1e-2 * demonstrations.peak_speed,
    )


@every_field
def test_each_state_has_its_own_time_step(name):
    """A batch with one dt a state gives what each state gives alone."""
    x, dt = states(first(name), n=5), np.array([0.01, 0.02, 0.05, 0.1, 0.2])
    alone = [fitted(name).step(s, h) for s, h in zip(x, dt, strict=True)]
    np.testing.assert_allclose(fitted(name).step(x, dt), alone, rtol=1e-5, atol=1e-5)


@every_field
def test_a_rollout_is_repeated_steps_from_its_start(name):
    system = fitted(name)
    demonstrations = thinned(first(name))
    x0, dt = demonstrations.starts, demonstrations.mean_dt
    path = system.rollout(x0, 20, dt)
    assert path.shape == (3, 21, 2)
    np.testing.assert_allclose(path[:, 0], x0, rtol=0, atol=1e-9)
    x = x0
    for k in range(20):
        x = system.step(x, dt)
        # A closed form jumps from the start, a loop of steps adds their rounding.
        np.testing.assert_allclose(
            path[:, k + 1], x, rtol=0, atol=1e-3 * demonstrations.bounding_box.diagonal
        )


# Stability ----------------------------------------------------------------------------------


def test_a_guarantee_is_one_of_four_and_has_a_reason():
    for kind in ("proved", "verified", "sampled", "none"):
        assert Guarantee(kind, "it is so").kind == kind
    with pytest.raises(ValueError, match="none, sampled, verified, proved, got 'certainly'"):
        Guarantee("certainly", "it is so")
    for reason in ("", "  ", None):
        with pytest.raises(ValueError, match="Expected the reason"):
            Guarantee("proved", reason)


@every_field_cell
def test_what_is_proved_has_a_lyapunov_function(name, shape):
    system = fitted(name, shape)
    if system.guarantee.kind == "proved":
        assert system.lyapunov(states(shape)) is not None


@every_field_cell
def test_the_goal_is_an_equilibrium_of_what_promises_one(name, shape):
    system = fitted(name, shape)
    demonstrations = thinned(shape)
    if system.guarantee.kind == "none" or demonstrations.goal is None:
        pytest.skip("promises no equilibrium")
    speed = np.linalg.norm(system.velocity(system.goal_))
    assert speed <= 1e-5 * demonstrations.peak_speed
    moved = np.linalg.norm(system.step(system.goal_, 1.0) - system.goal_)
    assert moved <= 1e-5 * demonstrations.bounding_box.diagonal


@every_field_cell
def test_a_lyapunov_function_is_positive_and_decreases(name, shape):
    system = fitted(name, shape)
    x = states(shape, n=2000)
    value, rate = system.lyapunov(x), system.lyapunov_rate(x)
    assert (value is None) == (rate is None)
    if value is None:
        pytest.skip("has none")
    assert (value > 0).all()
    if thinned(shape).goal is not None:
        at_goal = system.lyapunov(system.goal_)
        assert 0 <= at_goal <= 1e-6 * value.max()
    if system.guarantee.kind == "proved":
        assert (rate < 0).all()


@every_field
def test_the_lyapunov_rate_is_the_derivative_along_the_field(name):
    system = fitted(name)
    x = np.concatenate(thinned(first(name)).positions)[:-30:7]
    rate = system.lyapunov_rate(x)
    if rate is None:
        pytest.skip("has none")
    h = 1e-5 * thinned(first(name)).durations.mean()
    v = system.velocity(x)
    numeric = (system.lyapunov(x + h * v / 2) - system.lyapunov(x - h * v / 2)) / h
    np.testing.assert_allclose(rate, numeric, rtol=0.05, atol=0.02 * np.abs(rate).max())


# Density ------------------------------------------------------------------------------------


@every_field
@pytest.mark.parametrize("k", [1, 10])
def test_a_density_integrates_to_one(name, k):
    """By the midpoint rule on a grid that is laid by the density's own moments; within 2 %."""
    system = fitted(name)
    demonstrations = thinned(first(name))
    x, dt = demonstrations.positions[0], k * demonstrations.dt[0]
    if system.log_prob(x[0], x[k], dt) is None:
        pytest.skip("has none")
    start = x[40]
    residuals = x[k:] - system.step(x[:-k], dt)
    mean, root = system.step(start, dt), np.diag(residuals.std(axis=0))
    edges = np.linspace(-9, 9, 301)
    nodes = (edges[1:] + edges[:-1]) / 2
    cells = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    for _ in range(4):  # the last pass integrates, those before find where
        grid = mean + cells @ root.T
        mass = np.exp(system.log_prob(np.broadcast_to(start, grid.shape), grid, dt))
        mass *= np.linalg.det(root) * (nodes[1] - nodes[0]) ** 2
        total = mass.sum()
        share = mass / total
        mean = share @ grid
        root = np.linalg.cholesky((grid - mean).T @ ((grid - mean) * share[:, None]))
    assert total == pytest.approx(1.0, abs=0.02)


# Files --------------------------------------------------------------------------------------


@every_cell
def test_a_saved_system_comes_back_bit_for_bit(name, shape, tmp_path):
    system = fitted(name, shape)
    path = system.save(tmp_path / "model.safetensors")
    again = load_method(name).load(path)
    x = states(shape)
    dt = thinned(shape).mean_dt
    np.testing.assert_array_equal(behaviour(again, x), behaviour(system, x))
    assert again.config == system.config
    assert again.guarantee == system.guarantee
    assert again.n_parameters == system.n_parameters
    if name in PRIMITIVES:
        return
    np.testing.assert_array_equal(again.step(x, dt), system.step(x, dt))
    for pair in zip(
        (again.lyapunov(x), again.log_prob(x, x, dt)),
        (system.lyapunov(x), system.log_prob(x, x, dt)),
        strict=True,
    ):
        assert (pair[0] is None) == (pair[1] is None)
        if pair[0] is not None:
            np.testing.assert_array_equal(*pair)


@pytest.fixture
def model(request, tmp_path):
    return fitted(request.getfixturevalue("name")).save(tmp_path / "model.safetensors")


@every_cell
def test_no_array_has_a_name_that_a_file_keeps_for_itself(name, shape):
    """`save` would write the goal, or the period, in its place."""
    assert not {"goal", "period"} & set(fitted(name, shape)._arrays())


@every_method
def test_a_truncated_file_is_refused(name, model):
    whole = model.read_bytes()
    for cut in (0, 5, len(whole) // 2, len(whole) - 1):
        model.write_bytes(whole[:cut])
        with pytest.raises(ModelFileError):
            load_method(name).load(model)


@every_method
def test_a_foreign_file_is_refused(name, tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_text("not a model", encoding="utf-8")
    with pytest.raises(ModelFileError, match="something else"):
        load_method(name).load(path)
    safetensors.numpy.save_file({"a": np.zeros(3)}, path)
    with pytest.raises(ModelFileError, match="something else"):
        load_method(name).load(path)
    with pytest.raises(FileNotFoundError):
        load_method(name).load(tmp_path / "absent")


def rewritten(path, arrays=None, **changes):
    """Change a model file's header, or its arrays."""
    header, old = read_model_file(path)
    safetensors.numpy.save_file(
        old if arrays is None else arrays(old),
        path,
        metadata={"iflow_gym": json.dumps({**header, **changes})},
    )


HEADERS = {
    "a later schema": ({"schema_version": SCHEMA_VERSION + 1}, "upgrade iflow-gym"),
    "schema 0": ({"schema_version": 0}, "schema version is 0"),
    "schema in words": ({"schema_version": "1"}, "schema version is '1'"),
    "another method": ({"method": "another"}, "got 'another'"),
    "an unknown setting": ({"config": {"no_such_setting": 1}}, "no_such_setting"),
    "no config": ({"config": None}, "config of settings by name, got None"),
    "a list of settings": ({"config": [1, 2]}, r"config of settings by name, got \[1, 2\]"),
    "another dimension": ({"n_dims": 3}, r"goal of shape \(3,\), got \(2,\)"),
    "a huge dimension": ({"n_dims": 10**30}, r"\), got \(2,\)"),
    "no dimension": ({"n_dims": 0}, "n_dims to be a whole number >= 1, got 0"),
    "a fraction of a dimension": ({"n_dims": 2.0}, "n_dims to be a whole number >= 1, got 2.0"),
    "a dimension that is true": ({"n_dims": True}, "n_dims to be a whole number >= 1, got True"),
    "an endless dimension": ({"n_dims": np.inf}, "n_dims to be a whole number >= 1, got inf"),
}


@every_method
@pytest.mark.parametrize(("changes", "message"), HEADERS.values(), ids=HEADERS.keys())
def test_a_tampered_header_is_refused(name, model, changes, message):
    rewritten(model, **changes)
    with pytest.raises(ModelFileError, match=message):
        load_method(name).load(model)


@every_method
@pytest.mark.parametrize("text", ["[1, 2]", "3", "null", "{}", "[" * 100_000, "{"])
def test_a_header_that_is_none_is_refused(name, model, text):
    safetensors.numpy.save_file(read_model_file(model)[1], model, metadata={"iflow_gym": text})
    with pytest.raises(ModelFileError, match="something else"):
        load_method(name).load(model)


def each(change):
    """Change one array after another, the goal too."""
    return lambda arrays: [{**arrays, k: change(a)} for k, a in arrays.items()]


ARRAYS = {
    "one missing": lambda arrays: [{k: arrays[k] for k in set(arrays) - {out}} for out in arrays],
    "one more": lambda arrays: [{**arrays, "extra": np.zeros(3)}],
    "NaN": each(lambda a: np.where(np.arange(a.size).reshape(a.shape) == 0, np.nan, a)),
    "infinite": each(lambda a: np.full_like(a, np.inf)),
    "complex": each(lambda a: a.astype(np.complex64)),
    "whole numbers": each(lambda a: a.astype(np.int64)),
    "flat": each(lambda a: a.reshape(1, -1)[..., None]),
    "empty": each(lambda a: a[:0]),
    "twice as long": each(lambda a: np.concatenate([a, a])),
    "a single number": each(lambda a: np.array(1.0)),
}


@every_method
@pytest.mark.parametrize("change", ARRAYS.values(), ids=ARRAYS.keys())
def test_tampered_arrays_are_refused(name, model, change):
    for arrays in change(read_model_file(model)[1]):
        model.unlink()
        fitted(name).save(model)
        rewritten(model, arrays=lambda _, arrays=arrays: arrays)
        with pytest.raises(ModelFileError, match=r"[Ee]xpected .*(got|none)"):
            load_method(name).load(model)


@every_method
def test_absurd_numbers_are_refused_or_harmless(name, model):
    """Finite, of the right shape, and far beyond anything: an error of ours, or a system."""
    _, whole = read_model_file(model)
    for key in whole:
        for factor in (0.0, -1.0, 1e-300, 1e300):
            changed = np.clip(whole[key].astype(np.float64) * factor, -1e308, 1e308)
            rewritten(model, arrays=lambda a, k=key, new=changed: {**a, k: new})
            with contextlib.suppress(ModelFileError):
                assert load_method(name).load(model).n_parameters > 0
            fitted(name).save(model)
