"""Model files as anyone may have made them: a working model, or the clear error, and no memory.

The models are those of `test_methods`, one of each registered method.
"""

import json
import sys
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_methods import fitted

from iflow_gym.baselines.registry import METHODS, UnknownNameError, load_method
from iflow_gym.model_files import ModelFileError
from iflow_gym.models import add_fit_record, fit_record, load_model, model_header
from iflow_gym.system import DynamicalSystem

every_method = pytest.mark.parametrize("name", METHODS)

ABSURD = (
    -1, 0, 1, 2**31, 2**62, 10**9, 10**30, 1e308, 1e-320, np.nan, np.inf, -1.5, True, None, "x", "",
    [], [1] * 5, {}, [10**9], "../../x", {"a": 1},
)  # fmt: skip
SHAPES = ([0], [2**40, 0], [1], [2**62, 2**62], [], [2**31, 2**31, 2])
TYPES = ("F64", "F32", "F16", "BF16", "I64", "U8", "BOOL", "C64", "other")
PLACES = ([0, 0], [0, 2**60], [8, 0], [-8, 8])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


def whole(name, folder):
    path = folder / f"{name}.safetensors"
    if not path.exists():
        fitted(name).save(path)
    return path.read_bytes()


def taken_apart(content):
    """The safetensors header, our header in it, and the arrays' bytes."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    return header, json.loads(header["__metadata__"]["iflow_gym"]), content[end:]


def put_together(header, own, arrays):
    header["__metadata__"]["iflow_gym"] = json.dumps(own)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + arrays


def damaged(data, content):
    """Bytes that differ from a model's somewhere."""
    kind = data.draw(st.sampled_from(["bytes", "header", "cut", "own", "settings", "arrays"]))
    if kind in ("own", "settings", "arrays"):
        header, own, arrays = taken_apart(content)
        if kind == "own":
            own[data.draw(st.sampled_from(sorted(own)))] = data.draw(st.sampled_from(ABSURD))
        elif kind == "settings" and own["config"]:
            key = data.draw(st.sampled_from(sorted(own["config"])))
            own["config"][key] = data.draw(st.sampled_from(ABSURD))
        else:
            key = data.draw(st.sampled_from(sorted(set(header) - {"__metadata__"})))
            what = data.draw(st.sampled_from(["shape", "dtype", "data_offsets"]))
            choices = {"shape": SHAPES, "dtype": TYPES, "data_offsets": PLACES}[what]
            header[key][what] = data.draw(st.sampled_from(choices))
        return put_together(header, own, arrays)
    changed = bytearray(content)
    last = len(content) - 1
    if kind == "header":
        last = 8 + int.from_bytes(content[:8], "little") - 1
    if kind == "cut":
        del changed[data.draw(st.integers(0, last)) :]
        return bytes(changed)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, last))] = data.draw(st.integers(0, 255))
    return bytes(changed)


@every_method
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_damaged_file_is_a_working_model_or_the_clear_error(name, folder, data):
    path = folder / "damaged.safetensors"
    path.write_bytes(damaged(data, whole(name, folder)))
    for load in (load_method(name).load, load_model):
        try:
            model = load(path)
        except ModelFileError as error:
            assert len(str(error)) > 20  # noqa: PT017 (anything else is a failure)
            continue
        if load is load_model:
            with np.errstate(all="ignore"):
                x = model.goal_
                field = isinstance(model, DynamicalSystem)
                assert np.isfinite(model.velocity(x) if field else model.rollout(x, 1, 0.01)).all()


@every_method
def test_settings_that_claim_gigabytes_are_refused_and_take_none(name, folder):
    header, own, arrays = taken_apart(whole(name, folder))
    path = folder / "huge.safetensors"
    path.write_bytes(whole(name, folder))
    load_model(path)  # what is imported is no memory of the file's
    for key, value in own["config"].items():
        if isinstance(value, bool) or not isinstance(value, int):
            continue
        for huge in (10**7, 10**12):
            changed = own | {"config": own["config"] | {key: huge}}
            path.write_bytes(put_together(json.loads(json.dumps(header)), changed, arrays))
            tracemalloc.start()
            try:
                load_model(path)
            except ModelFileError as error:
                assert "xpected" in str(error)  # noqa: PT017
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < 50e6, key


@every_method
def test_a_file_says_whose_it_is_and_keeps_what_is_said_of_its_fit(name, folder):
    path = folder / "said.safetensors"
    path.write_bytes(whole(name, folder))
    assert fit_record(path) is None
    add_fit_record(path, {"protocol": "reproduction", "recordings": ["a"]})
    assert fit_record(path)["recordings"] == ["a"]
    model = load_model(path)
    assert type(model) is load_method(name)
    for key, array in load_method(name).load(path)._arrays().items():
        np.testing.assert_array_equal(array, fitted(name)._arrays()[key])


def test_a_file_names_no_module_that_is_imported(tmp_path, folder, monkeypatch):
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    header, own, arrays = taken_apart(whole("linear", folder))
    path = tmp_path / "model"
    path.write_bytes(put_together(header, own | {"method": "evil:Method"}, arrays))
    with pytest.raises(ModelFileError, match="module:Class"):
        load_model(path)
    assert "evil" not in sys.modules
    with pytest.raises(UnknownNameError):
        load_model(path, "no_such_module:Method")


HEADERS = {
    "nothing": b"",
    "a length and nothing": (10).to_bytes(8, "little"),
    "a length of exabytes": (2**62).to_bytes(8, "little") + b"{}",
    "no JSON": (4).to_bytes(8, "little") + b"nope",
    "deep JSON": (200_000).to_bytes(8, "little") + b"[" * 200_000,
    "no metadata": (2).to_bytes(8, "little") + b"{}",
    "a zip": b"PK\x03\x04" + bytes(200),
    "a pickle": b"\x80\x04\x95" + bytes(200),
}


@pytest.mark.parametrize("content", HEADERS.values(), ids=HEADERS)
def test_what_is_no_model_file_says_so(content, tmp_path):
    path = tmp_path / "model"
    path.write_bytes(content)
    for read in (model_header, load_model, fit_record):
        with pytest.raises(ModelFileError, match="to be a model file of iflow-gym, got"):
            read(path)
    with pytest.raises(FileNotFoundError, match="got none"):
        load_model(tmp_path / "absent")
