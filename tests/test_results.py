"""Result records: what is written is what is read, and what is no record is said to be none."""

from __future__ import annotations

import json
import math

import pytest

from iflow_gym.metrics import metrics_of
from iflow_gym.results import (
    SCHEMA_VERSION,
    Result,
    ResultFileError,
    read_result,
    read_results,
    result_path,
    short_name,
    write_result,
)
from iflow_gym.system import Guarantee


def scores(**values):
    """Every metric, None but for these."""
    return {metric.name: None for metric in metrics_of("goal")} | values


def record(**changes):
    values = {
        "method": "linear",
        "title": "Linear",
        "environment": "iflow/LASA-Angle-v0",
        "family": "LASA-26",
        "protocol": "reproduction",
        "seed": 0,
        "preset": "smoke",
        "status": "ok",
        "key": "0" * 64,
        "created": "2026-01-01T00:00:00+00:00",
        "metrics": scores(rmse=2.5, settling_time=math.inf, nll_1=-1.5),
        "medians": {"rmse": 2.25},
        "per_demonstration": {"rmse": [1.0, math.inf, None]},
        "guarantee": Guarantee("proved", "A is Hurwitz."),
        "config": {"layers": [64, 64], "clip": None},
        "dt": 0.003,
        "fit": {"batch_size": 3, "batch_wall_seconds": 1.5},
        "model": "LASA-Angle-v0.reproduction.seed0.safetensors",
    }
    return Result(**{**values, **changes})


def test_a_record_comes_back_as_it_was_with_infinity_and_null(tmp_path):
    written = record()
    path = write_result(tmp_path, written)
    assert path == tmp_path / "linear" / "LASA-Angle-v0.reproduction.seed0.json"
    assert read_results(tmp_path) == [written]
    text = path.read_text()
    assert json.loads(text)["metrics"]["settling_time"] == "inf"
    assert "Infinity" not in text
    assert "NaN" not in text
    assert list(json.loads(text)) == sorted(json.loads(text))


def test_nan_means_not_applicable(tmp_path):
    write_result(tmp_path, record(metrics=scores(rmse=math.nan)))
    assert read_results(tmp_path)[0].metrics == scores()


def test_a_failed_record_needs_a_reason_and_only_it():
    assert not record(status="failed", reason="ValueError: no").ok
    with pytest.raises(ValueError, match="Expected a reason"):
        record(status="failed")
    with pytest.raises(ValueError, match="Expected a reason"):
        record(reason="none")
    with pytest.raises(ValueError, match="'ok' or 'failed'"):
        record(status="done")


def test_names_that_would_leave_the_folder_are_refused():
    assert short_name("iflow/LASA-Angle-v0") == "LASA-Angle-v0"
    for method in ("../linear", "", ".hidden", "a b"):
        with pytest.raises(ValueError, match="name of the method"):
            result_path(method, "iflow/LASA-Angle-v0", "reproduction", 0)
    with pytest.raises(ValueError, match="Expected a protocol"):
        result_path("linear", "iflow/LASA-Angle-v0", "training", 0)


def test_writing_replaces_and_leaves_nothing_behind(tmp_path):
    write_result(tmp_path, record(seed=1))
    path = write_result(tmp_path, record(seed=1, metrics=scores(rmse=1.0)))
    assert read_result(path).metrics == scores(rmse=1.0)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_what_cannot_be_written_leaves_the_old_record(tmp_path):
    path = write_result(tmp_path, record())
    with pytest.raises(TypeError):
        write_result(tmp_path, record(config={"value": object()}))
    assert read_result(path) == record()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_record_from_before_methods_used_time_is_read(tmp_path):
    path = write_result(tmp_path, record())
    values = json.loads(path.read_text())
    del values["uses_time"]
    path.write_text(json.dumps(values))
    assert read_result(path) == record(uses_time=False)


def broken_files(path):
    """What is wrong, the file's text, and what the error says."""
    values = json.loads(path.read_text())
    newer = {**values, "schema_version": SCHEMA_VERSION + 1}
    less = {k: v for k, v in values.items() if k != "seed"}
    return [
        (path.read_text()[:100], "no whole JSON file"),
        ("[1, 2]", "no result record"),
        ('{"method": "linear"}', "no result record"),
        (json.dumps(newer), "upgrade iflow-gym"),
        (json.dumps(less), r"missing \['seed'\]"),
        (json.dumps({**values, "extra": 1}), r"unknown \['extra'\]"),
        (json.dumps({**values, "metrics": scores(rmse="bad")}), "expected a number"),
        (json.dumps({**values, "metrics": {"rmse": 1.0}}), r"got none of \['converged'"),
        (json.dumps({**values, "metrics": scores(rmse=-1e-3)}), "rmse to be at least 0"),
        (json.dumps({**values, "metrics": scores(rmse="-inf")}), "rmse to be at least 0"),
        (json.dumps({**values, "metrics": scores(rmse=math.nan)}), "rmse to be at least 0"),
        (json.dumps({**values, "metrics": scores(rmse=10**400)}), "too large"),
        (json.dumps({**values, "medians": {"dtw": -1.0}}), "dtw to be at least 0"),
        (json.dumps({**values, "per_demonstration": {"dtw": [-1.0]}}), "dtw to be at least 0"),
        ("[" * 100_000 + "]" * 100_000, "no whole JSON file"),
        (json.dumps({**values, "metrics": None}), "no valid result record"),
        (json.dumps({**values, "guarantee": {"kind": "proved"}}), "no valid result record"),
    ]


def test_a_file_that_is_no_record_is_named_with_what_to_do(tmp_path):
    path = write_result(tmp_path, record())
    for text, message in broken_files(path):
        path.write_text(text)
        with pytest.raises(ResultFileError, match=message) as caught:
            read_result(path)
        assert str(path) in str(caught.value)


def test_a_failed_record_needs_no_metrics(tmp_path):
    failed = record(status="failed", reason="ValueError: no", metrics={})
    assert read_result(write_result(tmp_path, failed)) == failed


def test_reading_a_folder_lists_every_bad_file_or_hands_each_over(tmp_path):
    good = record(seed=1)
    write_result(tmp_path, good)
    cut = write_result(tmp_path, record())
    cut.write_text(cut.read_text()[:-20])
    misplaced = tmp_path / "other" / "LASA-Angle-v0.reproduction.seed1.json"
    misplaced.parent.mkdir()
    misplaced.write_text((tmp_path / good.path).read_text())
    with pytest.raises(ResultFileError) as caught:
        read_results(tmp_path)
    assert str(cut) in str(caught.value)
    assert str(misplaced) in str(caught.value)
    seen = []
    assert read_results(tmp_path, on_error=lambda path, error: seen.append(path)) == [good]
    assert seen == [cut, misplaced]


def test_no_folder_is_an_error_that_says_how_to_make_one(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"run_all\.py"):
        read_results(tmp_path / "absent")
