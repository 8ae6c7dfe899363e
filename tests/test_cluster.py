"""Cells on a Dask cluster of this machine: the same as at home, whatever happens to a worker."""

from __future__ import annotations

import dataclasses
import os
import signal

import psutil
import pytest
from distributed import LocalCluster
from test_runner import MOTIONS, by_environment, run, toys  # noqa: F401 (a fixture)

from iflow_gym.baselines.runner import cluster, plan
from iflow_gym.baselines.runner.cluster import Cluster
from iflow_gym.baselines.runner.cluster_errors import ClusterError
from iflow_gym.baselines.runner.plan import make_cells, make_jobs, select_entries
from iflow_gym.baselines.runner.presets import load_preset
from iflow_gym.baselines.runner.remote import differences
from iflow_gym.evaluate import FIT_COSTS
from iflow_gym.results import read_result

COSTS = {*FIT_COSTS, "step_us"}


@pytest.fixture
def jobs(toys):  # noqa: F811
    """Jobs of a toy, one a motion."""
    (entry,) = select_entries(["toys:Toy"], "smoke")
    cells = make_cells([entry], [f"iflow/{name}" for name in MOTIONS], load_preset("smoke"))
    return make_jobs(cells, cells)


def scores(result):
    return {name: value for name, value in result.metrics.items() if name not in COSTS}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_killed_worker_costs_time_alone_and_results_are_those_of_home(
    toys,  # noqa: F811
    jobs,
    tmp_path,
    monkeypatch,
):
    """Toys are code from outside: they travel. Each record comes when it is known."""
    monkeypatch.setattr(cluster, "BUNDLE", 1)
    there, home = tmp_path / "there", tmp_path / "home"
    assert run(home, "toys:Toy", jobs=1)[0] == 0
    events, killed = [], []
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as machines:

        def on_event(event):
            events.append(event["event"])
            if event["event"] != "begin" or killed:
                return
            try:
                above = {parent.pid for parent in psutil.Process(event["pid"]).parents()}
            except psutil.NoSuchProcess:  # on a busy machine word of it comes when it is done
                return
            (pid,) = above & {worker.pid for worker in machines.workers.values()}
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

        Cluster(there, machines.scheduler_address, on_event).run(jobs)
    assert events.count("done") == 3
    if killed:
        assert events.count("begin") > 3  # one at least was begun twice
    found, expected = by_environment(there, "toy"), by_environment(home, "toy")
    assert set(found) == set(MOTIONS)
    for name in MOTIONS:
        assert found[name].key == expected[name].key
        assert scores(found[name]) == scores(expected[name])
        assert found[name].per_demonstration == expected[name].per_demonstration
        models = [(folder / "toy" / found[name].model).read_bytes() for folder in (there, home)]
        assert models[0] == models[1]
        assert read_result(there / found[name].path) == found[name]


def test_where_no_scheduler_is_the_run_says_so(toys, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.3)
    for address in ("tcp://127.0.0.1:1", "nowhere"):
        with pytest.raises(ClusterError, match=f"Expected a Dask scheduler at {address}, got none"):
            run(tmp_path / "r", "toys:Toy", backend="dask", scheduler=address)
    for settings in ({"backend": "dask"}, {"scheduler": "tcp://127.0.0.1:1"}):
        with pytest.raises(ValueError, match="--backend dask and --scheduler ADDRESS together"):
            run(tmp_path / "r", "toys:Toy", **settings)


def test_a_worker_that_would_make_other_records_is_refused(jobs):
    assert differences(jobs) == []
    (cell,) = jobs[0].batch
    entry = dataclasses.replace(cell.entry, versions=cell.entry.versions | {"numpy": "0.1"})
    hashes = cell.hashes | {"data": "other", "core": "other"}
    changed = dataclasses.replace(cell, entry=entry, hashes=hashes)
    found = differences([plan.Job((changed,), (changed,))])
    assert len(found) == 3
    assert found[0].startswith("numpy ")
    assert found[0].endswith(" instead of 0.1")
    assert found[1:] == ["other core of iflow_gym", f"other data of {cell.environment}"]


def test_small_jobs_go_out_together_and_batches_alone(jobs):
    (entry,) = select_entries(["toys:Together"], "smoke")
    cells = make_cells([entry], [f"iflow/{name}" for name in MOTIONS], load_preset("smoke"))
    batch = make_jobs(cells, cells)
    assert cluster._bundles([*jobs, *batch, *jobs, *jobs, *jobs]) == [
        [0, 1, 2],
        [3],
        [4, 5, 6, 7, 8, 9],
        [10, 11, 12],
    ]


def test_code_from_outside_travels_and_the_suites_own_does_not(jobs):
    (entry,) = select_entries(["linear"], "smoke")
    cells = make_cells([entry], ["iflow/LASA-Line-v0"], load_preset("smoke"))
    linear = make_jobs(cells, cells)
    assert cluster._code_of(linear) == {}
    sent = cluster._code_of(jobs)
    assert list(sent) == ["toys.py"]
    assert b"class Toy(DynamicalSystem)" in sent["toys.py"]
