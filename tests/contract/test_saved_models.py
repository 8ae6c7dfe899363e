"""No file breaks a load: it is refused in words, or gives a model that is finite on its box.

The files are those of every registered method, changed at random and with intent.
"""

import contextlib
import functools
import json
import os
import struct
import sys
import tracemalloc
import warnings

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from iflow_gym.baselines.registry import METHODS, UnknownNameError, load_method
from iflow_gym.baselines.runner.presets import load_settings
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.datasets.letters import load_letter
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.fit_records import add_fit_record
from iflow_gym.model_files import ModelFileError, read_model_file
from iflow_gym.saved_models import (
    MOST_BYTES,
    MOST_HEADER_BYTES,
    MOST_ROWS,
    N_PROBES,
    inspect_model,
    load_model,
    probes,
)
from iflow_gym.system import DynamicalSystem

QUICK = {
    "imitation-flow": {"n_steps": 5},
    "bc": {"n_steps": 5},
    "seds": {"n_components": 2, "max_iterations": 20},
    "clf-dm": {
        "n_components": 2,
        "n_initialisations": 1,
        "max_terms": 1,
        "n_searches": 1,
        "energy_samples": 50,
    },
    "gmr": {"n_components": 2},
    "kmp": {"n_reference": 20},
}
"""Settings that fit in no time: nothing here says how good a method is."""

fuzzed = settings(
    max_examples=35,
    derandomize=True,  # the same files every time: no test that fails now and then
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
every_method = pytest.mark.parametrize("name", METHODS)


@functools.cache
def shown(name):
    """Three thinned recordings of a kind that the method learns."""
    if load_method(name).learns_goals:
        full = load_lasa("Angle").subset(range(3))
        return Demonstrations.from_arrays(
            [p[::-1][::20][::-1] for p in full.positions],
            dt=[20 * h for h in full.dt],
            goal=full.goal,
            name=full.name,
        )
    full = load_letter("O").subset(range(3))
    return Demonstrations.from_arrays(
        [p[::4] for p in full.positions], dt=0.04, period=full.period, name=full.name
    )


@functools.cache
def fitted(name):
    method = load_method(name)
    smoke = load_settings(name, "smoke", registered=True)
    known = {k: v for k, v in QUICK.get(name, {}).items() if k in method.Config.__annotations__}
    return method(**smoke | known).fit(shown(name), seed=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


@pytest.fixture
def saved(request, folder):
    """A method's file, its header and its arrays."""
    name = request.getfixturevalue("name")
    path = fitted(name).save(folder / f"{name}.safetensors")
    return path, *read_model_file(path)


def written(path, header, arrays):
    text = header if isinstance(header, str) else json.dumps(header)
    content = safetensors.numpy.save(
        {k: np.ascontiguousarray(a) for k, a in arrays.items()}, metadata={"iflow_gym": text}
    )
    path.write_bytes(content)
    return path


def raw(listed, body=b""):
    """The bytes of a safetensors file, whatever its header lists."""
    text = listed if isinstance(listed, bytes) else json.dumps(listed).encode()
    return struct.pack("<Q", len(text)) + text + body


def refused_or_finite(name, path):
    """Load a file in both ways: nothing but a ModelFileError may come of it, or a whole model."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # absurd numbers overflow
        try:
            assert load_method(name).load(path).n_parameters > 0
        except ModelFileError:
            loads = False
        else:
            loads = True
        try:
            model = load_model(path, demonstrations=shown(name))
        except ModelFileError as error:
            refusal = str(error)
        else:
            refusal = None
        if refusal is not None:
            assert str(path) in refusal
            assert "got" in refusal or not loads
            return
        assert loads
        box = shown(name).bounding_box
        x = np.random.default_rng(1).uniform(box.low, box.high, size=(64, model.n_dims_))
        dt = shown(name).mean_dt
        values = (
            model.velocity(x) if isinstance(model, DynamicalSystem) else model.rollout(x, 10, dt)
        )
        assert np.isfinite(values).all()
        assert model.n_parameters > 0
        assert model.guarantee.reason


# What was saved ---------------------------------------------------------------------------------


@every_method
def test_a_saved_model_is_inspected_and_comes_back(name, saved):
    path, header, arrays = saved
    info = inspect_model(path)
    assert (info.path, info.method, info.n_bytes) == (path, name, path.stat().st_size)
    assert (info.config, info.n_dims, info.schema_version) == (header["config"], 2, 1)
    assert info.shapes == {k: a.shape for k, a in arrays.items()}
    assert info.is_cycle == (shown(name).period is not None)
    for options in ({}, {"demonstrations": shown(name)}, {"method": load_method(name)}):
        model = load_model(path, **options)
        assert type(model) is load_method(name)
        for key, array in fitted(name)._arrays().items():
            np.testing.assert_array_equal(model._arrays()[key], array)


@every_method
def test_a_model_of_something_else_is_refused(name, saved):
    line = np.linspace(1, 0, 30)[:, None]
    for other, message in (
        (Demonstrations.from_arrays([line * [1, 2, 3]], dt=0.1), "a model of 3 dimensions"),
        (
            Demonstrations.from_arrays([line * [1, 2]], dt=0.1)
            if shown(name).period
            else load_letter("O"),
            "a model of a motion that (ends at a goal|repeats)",
        ),
    ):
        with pytest.raises(ModelFileError, match=f"expected {message}.*, got one of"):
            load_model(saved[0], demonstrations=other)


def test_probes_are_in_the_box_with_its_corners_the_starts_and_the_goal():
    motion = shown("linear")
    found, box = probes(motion), motion.bounding_box
    assert found.shape == (N_PROBES + 4 + 3 + 1, 2)
    assert ((found >= box.low) & (found <= box.high)).all()
    for corner in ([0, 0], [1, 0], [0, 1], [1, 1]):
        point = np.where(corner, box.high, box.low)
        assert (np.abs(found - point).max(axis=1) < 1e-12).any()
    np.testing.assert_array_equal(found[-4:-1], motion.starts)
    np.testing.assert_array_equal(found[-1], motion.goal)
    np.testing.assert_array_equal(found, probes(motion))


@every_method
def test_a_file_keeps_what_is_said_of_its_fit(name, saved, tmp_path):
    path = tmp_path / "model"
    path.write_bytes(saved[0].read_bytes())
    assert inspect_model(path).fit is None
    add_fit_record(path, {"protocol": "reproduction", "recordings": ["a"]})
    assert inspect_model(path).fit == {"protocol": "reproduction", "recordings": ["a"]}
    for key, array in load_model(path)._arrays().items():
        np.testing.assert_array_equal(array, fitted(name)._arrays()[key])


def test_only_who_loads_names_a_module(tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "model"
    path.write_bytes(raw({**head(method="evil:Method"), **GOAL}, bytes(16)))
    with pytest.raises(ModelFileError, match="method="):
        load_model(path)
    assert "evil" not in sys.modules
    with pytest.raises(UnknownNameError):
        load_model(path, method="no_such_module:Method")


# Files changed at random ------------------------------------------------------------------------


@every_method
@fuzzed
@given(data=st.data())
def test_bytes_changed_at_random(name, saved, folder, data):
    path = folder / "changed"
    whole = bytearray(saved[0].read_bytes())
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    place = st.one_of(st.integers(0, header - 1), st.integers(0, len(whole) - 1))
    for at in data.draw(st.lists(place, min_size=1, max_size=8)):
        whole[at] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        whole = whole[: data.draw(st.integers(0, len(whole)))]
    elif data.draw(st.booleans()):
        whole += data.draw(st.binary(min_size=1, max_size=9))
    path.write_bytes(bytes(whole))
    refused_or_finite(name, path)


leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from([0, 1, -1, 3, 10**6, 10**9, 10**30, -(10**30)]),
    st.floats(),
    st.sampled_from(["", "x", "../../etc/passwd", "os:system", "\0", "9" * 30]),
)
values = st.recursive(leaves, lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(), v))


@every_method
@fuzzed
@given(data=st.data())
def test_headers_changed_at_random(name, saved, folder, data):
    _, header, arrays = saved
    header = json.loads(json.dumps(header))
    for _ in range(data.draw(st.integers(1, 2))):
        within = header["config"] if isinstance(header.get("config"), dict) else {}
        if within and data.draw(st.booleans()):
            within[data.draw(st.sampled_from(sorted(within)))] = data.draw(values)
        else:
            header[data.draw(st.sampled_from([*sorted(header), "restarts", "calm"]))] = data.draw(
                values
            )
    refused_or_finite(name, written(folder / "changed", header, arrays))


def changed_array(data, array):
    """An array with other numbers, of another shape or of another type."""
    kind = data.draw(st.sampled_from(["numbers", "all", "scaled", "shape", "type"]))
    if kind == "shape":
        longer = np.concatenate([array, array]) if array.ndim else array[None]
        return data.draw(
            st.sampled_from([array[:0], longer, array[..., None], array.T, array.ravel()])
        )
    if kind == "type":
        return array.astype(data.draw(st.sampled_from(["f2", "f4", "f8", "i4", "u1", "?", "c8"])))
    new = array.astype(np.float64)
    number = st.floats(allow_nan=False, allow_infinity=False)
    with np.errstate(over="ignore"):
        if kind == "scaled":
            new = np.clip(new * data.draw(number), -1e308, 1e308)
        elif kind == "all":
            new = np.full_like(new, data.draw(number))
        elif new.size:
            new.flat[data.draw(st.integers(0, new.size - 1))] = data.draw(st.floats())
    return new


@every_method
@fuzzed
@given(data=st.data())
def test_arrays_changed_at_random(name, saved, folder, data):
    _, header, arrays = saved
    names = data.draw(
        st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=2, unique=True)
    )
    new = {**arrays, **{k: changed_array(data, arrays[k]) for k in names}}
    if data.draw(st.integers(0, 9)) == 0:
        del new[names[0]]
    refused_or_finite(name, written(folder / "changed", header, new))


# Files changed with intent ----------------------------------------------------------------------


def tensor(dtype="F64", shape=(2,), offsets=(0, 16)):
    return {"dtype": dtype, "shape": list(shape), "data_offsets": list(offsets)}


def head(**changes):
    header = {"schema_version": 1, "method": "linear", "config": {}, "n_dims": 2} | changes
    return {"__metadata__": {"iflow_gym": json.dumps(header)}}


GOAL = {"goal": tensor()}
TRAPS = {
    "empty": (b"", "cut short"),
    "a pickle": (b"\x80\x04cos\nsystem\n" * 9, "another kind"),
    "a header longer than the file": (struct.pack("<Q", 2**63) + b"{}", "cut short"),
    "a long header": (
        raw(b" " * (MOST_HEADER_BYTES + 1)),
        f"a header of at most {MOST_HEADER_BYTES} bytes",
    ),
    "deep JSON": (raw(b"[" * 200_000), "list of arrays to be JSON"),
    "deeper JSON": (raw({"__metadata__": {"iflow_gym": "[" * 200_000}}), "header to be JSON"),
    "a list": (raw(b"[]"), "JSON object, got list"),
    "no header of ours": (raw({"__metadata__": {}, **GOAL}, bytes(16)), "of another program"),
    "no metadata": (raw(GOAL, bytes(16)), "of another program"),
    "a header that is a number": (raw({"__metadata__": {"iflow_gym": "3"}}), "object, got int"),
    "a later schema": (raw(head(schema_version=2)), "at most 1, got 2: upgrade iflow-gym"),
    "a schema in words": (raw(head(schema_version="1")), "schema version >= 1, got '1'"),
    "a huge schema": (raw(head(schema_version=10**4000)), "got a huge number"),
    "no method": (raw(head(method=None)), "method to be of type str, got None"),
    "a long method": (raw(head(method="x" * 10**5)), "registry .* got 'xxx.*[.]{3}: pass"),
    "a method that is a module": (raw(head(method="os:system")), "got 'os:system': pass method="),
    "several motions in one": (
        raw(head(method="conditional-imitation-flow")),
        "expected one motion, got a model of several",
    ),
    "a method that is a path": (raw(head(method="../x")), "got '../x': pass method="),
    "settings in a list": (raw(head(config=[])), r"config to be of type dict, got \[\]"),
    "true dimensions": (raw(head(n_dims=True)), "n_dims to be of type int, got True"),
    "no dimensions": (raw(head(n_dims=0)), "n_dims to be >= 1, got 0"),
    "a shape too large": (
        raw({**head(), "goal": tensor(shape=(2**40, 2**40))}, bytes(16)),
        "expected a huge number bytes of arrays, as its header says, got 16",
    ),
    "arrays that are cut": (raw({**head(), **GOAL}, bytes(15)), "expected 16 bytes .*, got 15"),
    "more than the arrays": (raw({**head(), **GOAL}, bytes(17)), "expected 16 bytes .*, got 17"),
    "a negative shape": (raw({**head(), "goal": tensor(shape=(-2,))}), r"shape of 'goal', got"),
    "no shape": (raw({**head(), "goal": {"dtype": "F64"}}), "shape of 'goal', got None"),
    "whole numbers": (raw({**head(), "goal": tensor("I64")}, bytes(16)), "F16 or F32 or F64 in"),
    "bfloat16": (raw({**head(), "goal": tensor("BF16", (8,))}, bytes(16)), "got 'BF16'"),
    "no array but a number": (raw({**head(), "goal": 3}), "place of 'goal', got none"),
    "overlapping arrays": (
        raw({**head(), **GOAL, "matrix": tensor(), "diffusion": tensor()}, bytes(48)),
        "got something else",
    ),
    "a path for a name": (
        raw({**head(), "../../goal": tensor()}, bytes(16)),
        "expected 'goal' in it, got none",
    ),
}


@pytest.mark.parametrize(("content", "message"), TRAPS.values(), ids=TRAPS.keys())
def test_traps_are_refused_in_words(tmp_path, content, message):
    path = tmp_path / "model"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=message) as caught:
        load_model(path)
    assert len(str(caught.value)) < 600
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_of_a_terabyte_is_refused_before_it_is_read(tmp_path):
    """Sparse: it takes no room on the disk, and would take it in memory."""
    path = tmp_path / "model"
    n = 2**37
    listed = {**head(), "goal": tensor(shape=(n,), offsets=(0, 8 * n))}
    with path.open("wb") as file:
        file.write(raw(listed))
        try:
            file.truncate(len(raw(listed)) + 8 * n)
        except OSError:
            pytest.skip("no sparse files of this size here")
    with pytest.raises(ModelFileError, match=f"at most {MOST_BYTES} bytes, got 1099"):
        load_model(path)
    assert inspect_model(path, most_bytes=2**41).shapes == {"goal": (n,)}  # no array is read


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "absent")
    with pytest.raises(ModelFileError, match="got a folder: name the file"):
        load_model(tmp_path)
    os.mkfifo(tmp_path / "pipe")  # reading one waits for ever
    with pytest.raises(ModelFileError, match="got a device or pipe"):
        load_model(tmp_path / "pipe")


@pytest.mark.parametrize("name", ["gpr"])
def test_a_small_file_that_asks_for_a_huge_matrix_is_refused(name, saved, tmp_path):
    _, header, arrays = saved
    ((key, most),) = MOST_ROWS.items()
    n = len(arrays[key])
    many = {
        k: np.tile(a, (-(-(most + 1) // n), 1)) if len(a) == n else a for k, a in arrays.items()
    }
    path = written(tmp_path / "model", header, many)
    with pytest.raises(ModelFileError, match=f"at most {most} rows of '{key}', got"):
        load_model(path)


@every_method
def test_settings_that_claim_gigabytes_take_none(name, saved, tmp_path):
    path, header, arrays = saved
    load_model(path)  # what is imported is no memory of the file's
    for key, value in header["config"].items():
        for huge in (10**7, 10**12) if type(value) is int else ():
            config = header["config"] | {key: huge}
            written(tmp_path / "model", {**header, "config": config}, arrays)
            tracemalloc.start()
            with contextlib.suppress(ModelFileError):
                load_model(tmp_path / "model")
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < 50e6, key


def test_a_load_that_runs_out_of_memory_says_so(tmp_path):
    class Greedy(load_method("linear")):
        @classmethod
        def load(cls, path):
            raise MemoryError("Unable to allocate 4 TiB")

    path = fitted("linear").save(tmp_path / "model")
    with pytest.raises(ModelFileError, match=r"more memory than there is .*4 TiB"):
        load_model(path, method=Greedy)


ABSURD = {
    "dmp": {"alpha": 1e308},
    "kmp": {"feedback": None},
    "clf-dm": {"rho0": 1e308},
    "orbit-field": {"decay": 1e308},
}


@pytest.mark.parametrize("name", ABSURD)
def test_settings_that_give_no_numbers_are_refused(name, saved, tmp_path):
    """Each loads: what is wrong with it shows where it is evaluated."""
    _, header, arrays = saved
    config = header["config"] | ABSURD[name]
    path = written(tmp_path / "model", {**header, "config": config}, arrays)
    load_method(name).load(path)
    with pytest.raises(
        ModelFileError, match=r"expected (finite )?values in the demonstrations' box"
    ):
        load_model(path, demonstrations=shown(name))
