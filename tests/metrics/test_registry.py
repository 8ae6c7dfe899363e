"""The table of metrics, its functions and the fingerprint of its code."""

import ast
import dataclasses
import hashlib
import importlib
import inspect
import pathlib
import sys

import pytest

from iflow_gym import metrics
from iflow_gym.metrics import drumming, registry

MEASURED_ELSEWHERE = {
    "nll_1": "nll",
    "nll_10": "nll",
    "perturbation_recovery": "converged",
    "attraction": "attracted",
    "fit_seconds": "measure_cost",
    "fit_cpu_seconds": "measure_cost",
    "peak_memory_mb": "measure_cost",
    "step_us": "median_call_us",
}
COUNTED_BY_THE_METHOD = {"n_parameters"}


def test_names_are_unique_and_fields_are_filled():
    names = [metric.name for metric in metrics.METRICS]
    titles = [metric.title for metric in metrics.METRICS]
    assert len(set(names)) == len(names)
    assert len(set(titles)) == len(titles)
    for metric in metrics.METRICS:
        assert all(dataclasses.astuple(metric))
        assert metric.better in ("lower", "higher")
        assert metric.definition.endswith(".")


def test_families_stay_together():
    families = [metric.family for metric in metrics.METRICS]
    assert families == sorted(families, key=["accuracy", "stability", "cost"].index)
    assert {"accuracy", "stability", "cost"} == set(families)


def test_higher_is_better_only_for_what_is_a_success():
    higher = {metric.name for metric in metrics.METRICS if metric.better == "higher"}
    accurate = {"hit_f1", "rhythm_f1", "sequence_f1"}
    assert higher == {"converged", "attraction", "perturbation_recovery", *accurate}


def test_every_metric_has_a_function():
    for metric in metrics.METRICS:
        if metric.name not in COUNTED_BY_THE_METHOD:
            name = MEASURED_ELSEWHERE.get(metric.name, metric.name)
            home = drumming if metric.motions == ("drumming",) else metrics
            assert callable(getattr(home, name))


def test_every_export_is_documented():
    for name in metrics.__all__:
        value = getattr(metrics, name)
        if inspect.isfunction(value):
            doc = inspect.getdoc(value)
            assert "Returns\n" in doc or "Yields\n" in doc, name


def test_exports_do_not_hide_modules():
    for file in pathlib.Path(metrics.__file__).parent.glob("[a-z]*.py"):
        module = importlib.import_module(f"iflow_gym.metrics.{file.stem}")
        assert getattr(metrics, file.stem) is module


def test_get_metric():
    assert metrics.get_metric("dtw").title == "DTW / sample"
    with pytest.raises(KeyError, match=r"got 'frechet_distance': did you mean .*'frechet'"):
        metrics.get_metric("frechet_distance")


class TestHash:
    @pytest.fixture
    def package(self, tmp_path, monkeypatch):
        """Let the hash read files of our own instead."""
        monkeypatch.setattr(registry.resources, "files", lambda _: tmp_path)
        monkeypatch.setattr(registry, "FILES", {"goal": ("a.py", "b.py"), "cycle": ("b.py",)})
        (tmp_path / "b.py").write_bytes(b"two = 2\n")
        (tmp_path / "a.py").write_bytes(b"one = 1\nmore = 1\n")
        return tmp_path

    def hash(self, motion="goal"):
        return registry.metrics_hash.__wrapped__(motion)

    def test_value(self, package):
        text = b"a.py\0one = 1\nmore = 1\n\0" + b"b.py\0two = 2\n\0"
        assert self.hash() == hashlib.sha256(text).hexdigest()

    def test_line_endings_and_other_files_do_not_matter(self, package):
        before = self.hash()
        (package / "a.py").write_bytes(b"one = 1\r\nmore = 1\r\n")
        (package / "__pycache__").mkdir()
        (package / "notes.txt").write_text("nothing")
        assert self.hash() == before

    def test_source_matters_where_it_is_used(self, package):
        goal, cycle = self.hash("goal"), self.hash("cycle")
        (package / "a.py").write_bytes(b"one = 2\nmore = 1\n")
        assert self.hash("goal") != goal
        assert self.hash("cycle") == cycle

    @pytest.mark.parametrize("motion", ["goal", "cycle"])
    def test_of_the_package(self, motion):
        assert self.hash(motion) == metrics.metrics_hash(motion)
        assert len(metrics.metrics_hash(motion)) == 64

    @pytest.mark.parametrize("motion", ["goal", "cycle", "drumming"])
    def test_every_file_that_computes_a_motions_metrics_is_hashed(self, motion):
        files = pathlib.Path(metrics.__file__).parent
        assert all((files / name).is_file() for name in registry.FILES[motion])
        for metric in metrics.metrics_of(motion):
            function = getattr(metrics, metric.name, None)
            if function is not None and inspect.isfunction(function):
                assert pathlib.Path(inspect.getfile(function)).name in registry.FILES[motion]


def test_metrics_know_of_no_methods_environments_or_torch():
    allowed = {"numpy", "scipy", "psutil", "iflow_gym.metrics", *sys.stdlib_module_names}
    for file in pathlib.Path(metrics.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module]
            else:
                continue
            for name in names:
                parents = {name.split(".")[0], ".".join(name.split(".")[:2])}
                assert parents & allowed, f"{file.name} imports {name}"
