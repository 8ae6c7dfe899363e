"""Runs with real worker processes: toy methods that fail in every way a method can."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import pytest
from rich.console import Console

from iflow_gym.baselines.run_all import RunOptions, run_all
from iflow_gym.baselines.runner import plan, pool
from iflow_gym.baselines.runner.plan import task_of
from iflow_gym.baselines.runner.presets import load_preset
from iflow_gym.baselines.runner.work import out_of_time, time_limit_of_batch
from iflow_gym.results import read_result, read_results

ROOT = Path(__file__).parents[1]

MOTIONS = ("Toy-A-v0", "Toy-B-v0", "Toy-C-v0")

TOYS = '''
"""Toy motions, small, and toy methods: what a fit does depends on the files in this folder."""
import ctypes, errno, os, signal, time
from dataclasses import dataclass
from pathlib import Path
import gymnasium
import numpy as np
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.partial_fits import PartialFitError
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.system import DynamicalSystem, Guarantee

HERE = Path(__file__).parent


def make_env(motion, **kwargs):
    t = 0.05 * np.arange(60)
    paths = [np.outer(np.exp(-2 * t), start) for start in ((1.0, 2.0), (-2.0, 1.0), (1.0, -1.0))]
    demonstrations = Demonstrations.from_arrays(paths, dt=0.05, goal=np.zeros(2), name=motion)
    return PointMassEnv(demonstrations, **kwargs)


for motion in ("Toy-A", "Toy-B", "Toy-C"):
    if f"iflow/{motion}-v0" not in gymnasium.registry:
        kwargs = {"motion": motion}
        gymnasium.register(f"iflow/{motion}-v0", entry_point="toys:make_env", kwargs=kwargs)


@dataclass(frozen=True)
class Config:
    rate: float = 2.0


class Mute(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class Toy(DynamicalSystem):
    name = "toy"
    title = "Toy"
    Config = Config
    stochastic_fit = True

    def _fit(self, demonstrations, rng):
        shape = demonstrations.name
        if (HERE / f"raise-{shape}").exists():
            raise ValueError(f"no fit of {shape}")
        if (HERE / f"sleep-{shape}").exists():
            try:
                time.sleep(60)
            except Exception:  # a method may swallow what it likes
                pass
        if (HERE / f"hang-{shape}").exists():  # no signal, and no other thread, gets through
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
            ctypes.PyDLL(None).sleep(1000)
        if (HERE / f"interrupt-{shape}").exists():
            raise KeyboardInterrupt
        if (HERE / f"exit-{shape}").exists():
            raise SystemExit(3)
        if (HERE / f"full-{shape}").exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        if (HERE / f"mute-{shape}").exists():
            raise Mute
        if (HERE / f"grow-{shape}").exists():
            grown = np.ones(20_000_000 // 8)
            time.sleep(0.2 * grown[0])  # to be seen by what looks now and then
        if (HERE / f"die-{shape}").exists():
            os.kill(os.getpid(), signal.SIGKILL)
        self.rate_ = np.array([self.config.rate])

    def _velocity(self, x):
        return -self.rate_ * (x - self.goal_)

    @property
    def guarantee(self):
        if (HERE / "unreadable").exists():
            return "proved"
        if (HERE / "unwritable").exists():
            return object()
        return Guarantee("proved", "linear")

    def _arrays(self):
        return {"rate": self.rate_}

    def _restore(self, arrays):
        self.rate_ = arrays["rate"]


class Together(Toy):
    name = "together"

    def _fit_many(self, demonstrations, seeds):
        with (HERE / "batches").open("a") as file:
            print(len(seeds), file=file)
        return super()._fit_many(demonstrations, seeds)


class Partly(Toy):
    name = "partly"

    def _fit_many(self, demonstrations, seeds):
        systems, failures = [], {}
        for i, (motion, seed) in enumerate(zip(demonstrations, seeds, strict=True)):
            try:
                systems.append(type(self)(self.config).fit(motion, seed=seed))
            except ValueError as error:
                systems.append(None)
                failures[i] = error
        if failures:
            raise PartialFitError([d.name for d in demonstrations], systems, failures)
        return systems


class Other(Toy):
    name = "other"
'''


@pytest.fixture
def toys(tmp_path, monkeypatch):
    """Write the toys into a folder that is on the path; return the folder."""
    folder = tmp_path / "code"
    folder.mkdir()
    (folder / "toys.py").write_text(TOYS)
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("toys", None)
    for name in MOTIONS:
        gymnasium.registry.pop(f"iflow/{name}", None)
        task_of.cache_clear()


def run(output, *methods, envs=MOTIONS, time_limit=120.0, jobs=2, **settings):
    """Run toys; return the exit status and what was printed."""
    text = io.StringIO()
    options = RunOptions(
        preset="smoke",
        methods=methods,
        envs=envs,
        output=output,
        jobs=jobs,
        time_limit=time_limit,
        **settings,
    )
    status = run_all(options, Console(file=text, width=200))
    assert not list(output.rglob("*.partial"))
    return status, text.getvalue()


def by_environment(output, method):
    return {r.environment.split("/")[1]: r for r in read_results(output) if r.method == method}


def test_one_cell_fails_the_rest_goes_on_and_the_next_run_redoes_only_it(toys, tmp_path):
    output = tmp_path / "results"
    (toys / "raise-Toy-C").touch()
    (toys / "sleep-Toy-A").touch()
    status, text = run(output, "toys:Toy", time_limit=4.0)
    assert status == 1
    found = by_environment(output, "toy")
    assert found["Toy-A-v0"].reason == out_of_time(4, "it was fitted")
    message, *frames = found["Toy-C-v0"].reason.splitlines()
    assert message == "ValueError: no fit of Toy-C"
    assert "toys.py" in frames[-1]
    assert "3 cells, 0 up to date, 3 to do" in text
    assert "toy on Toy-C-v0, reproduction, seed 0: FAILED, ValueError: no fit" in text

    good = found["Toy-B-v0"]
    assert good.ok
    assert good.metrics["converged"] == 1.0
    assert good.metrics["fit_seconds"] < 4
    assert good.fit["batch_size"] == 1
    assert good.guarantee.kind == "proved"
    assert good.config == {"rate": 2.0}
    assert (good.preset, good.family, good.integrator) == ("smoke", "Toy", "explicit Euler")
    assert set(good.hashes) == {"data", "metrics", "code", "core", "config"}
    import toys as module

    model = module.Toy.load(output / "toy" / good.model)
    assert model.rate_ == 2.0

    for file in toys.glob("*-Toy-*"):
        file.unlink()
    status, text = run(output, "toys:Toy")
    assert status == 0
    assert "3 cells, 1 up to date, 2 to do" in text
    again = by_environment(output, "toy")
    assert again["Toy-B-v0"] == good
    assert all(r.ok for r in again.values())
    assert "3 up to date, 0 to do" in run(output, "toys:Toy")[1]


def test_a_change_of_one_methods_code_redoes_its_cells_alone(toys, tmp_path):
    output = tmp_path / "results"
    (toys / "others.py").write_text("from toys import Toy\n\nclass Late(Toy):\n    name = 'late'\n")
    methods = ("toys:Toy", "others:Late")
    assert run(output, *methods, envs=MOTIONS[:1])[0] == 0
    kept = by_environment(output, "toy")
    with (toys / "others.py").open("a") as file:
        file.write("    title = 'Later'\n")
    _, text = run(output, *methods, envs=MOTIONS[:1])
    assert "2 cells, 1 up to date, 1 to do" in text
    assert by_environment(output, "toy") == kept
    sys.modules.pop("others")


def test_a_batch_is_fitted_together_and_a_failing_one_cell_by_cell(toys, tmp_path):
    output = tmp_path / "results"
    status, text = run(output, "toys:Together")
    assert status == 0
    assert (toys / "batches").read_text().split() == ["3"]
    found = by_environment(output, "together").values()
    assert {r.fit["batch_size"] for r in found} == {3}
    for r in found:
        assert r.metrics["fit_seconds"] == pytest.approx(r.fit["batch_wall_seconds"] / 3)

    # One stale cell: its batch is fitted whole, and the others' records stay.
    path = output / found_path(found, "Toy-B-v0")
    path.unlink()
    kept = {r.environment: r.created for r in found if "Toy-B" not in r.environment}
    assert "3 cells, 2 up to date, 1 to do" in run(output, "toys:Together")[1]
    assert (toys / "batches").read_text().split() == ["3", "3"]
    assert read_result(path).fit["batch_size"] == 3
    again = by_environment(output, "together").values()
    assert {r.environment: r.created for r in again if r.environment in kept} == kept

    (toys / "raise-Toy-C").touch()
    status, text = run(output, "toys:Together", force=True)
    assert status == 1
    assert "3 cells could not be fitted together (ValueError: no fit of Toy-C)" in text
    again = by_environment(output, "together")
    assert {name: r.ok for name, r in again.items()} == {s: s != "Toy-C-v0" for s in MOTIONS}
    assert again["Toy-A-v0"].fit["batch_size"] == 1
    assert not (output / "together" / "Toy-C-v0.reproduction.seed0.safetensors").exists()


def found_path(results, environment):
    (path,) = [r.path for r in results if r.environment.endswith(environment)]
    return path


def test_what_was_fitted_beside_a_failing_one_is_kept(toys, tmp_path):
    output = tmp_path / "results"
    (toys / "raise-Toy-C").touch()
    status, text = run(output, "toys:Partly")
    assert status == 1
    assert "1 cell could not be fitted together (no fit of Toy-C); now one by one" in text
    found = by_environment(output, "partly")
    assert {name: r.ok for name, r in found.items()} == {s: s != "Toy-C-v0" for s in MOTIONS}
    for r in (found["Toy-A-v0"], found["Toy-B-v0"]):
        assert r.fit["batch_size"] == 3
        assert r.metrics["fit_seconds"] == pytest.approx(r.fit["batch_wall_seconds"] / 3)
    assert found["Toy-C-v0"].reason.startswith("ValueError: no fit of Toy-C")


@pytest.mark.skipif(os.name != "posix", reason="blocks a signal")
def test_a_worker_that_no_alarm_stops_is_killed_and_costs_its_cell_alone(
    toys, tmp_path, monkeypatch
):
    monkeypatch.setattr(pool, "GRACE_SECONDS", 0.5)
    output = tmp_path / "results"
    (toys / "hang-Toy-B").touch()
    status, text = run(output, "toys:Together", "toys:Other", time_limit=2.0)
    assert status == 1
    assert "together: 3 cells could not be fitted together in 2 s (and their worker" in text
    for method in ("together", "other"):
        found = by_environment(output, method)
        assert {name: r.ok for name, r in found.items()} == {s: s != "Toy-B-v0" for s in MOTIONS}
        doing = "it was fitted or scored (and was killed)"
        assert found["Toy-B-v0"].reason == out_of_time(2, doing)


def test_whatever_a_method_raises_or_says_is_a_failed_cell(toys, tmp_path):
    output = tmp_path / "results"
    for fault, shape in (("interrupt", "A"), ("exit", "B"), ("mute", "C")):
        (toys / f"{fault}-Toy-{shape}").touch()
    for method in ("toy", "together"):
        assert run(output, f"toys:{method.capitalize()}", jobs=1)[0] == 1
        found = by_environment(output, method)
        reasons = [found[name].reason.splitlines()[0] for name in MOTIONS]
        assert reasons == [
            "KeyboardInterrupt",
            "SystemExit: 3",
            "Mute: (its message cannot be shown: RuntimeError)",
        ]
    for file in toys.glob("*-Toy-*"):
        file.unlink()
    for fault, reason in (
        ("unwritable", "TypeError: Object of type object is not JSON serializable"),
        ("unreadable", "ResultFileError: "),
    ):
        (toys / fault).touch()
        status, text = run(output, "toys:Toy", envs=MOTIONS[:1])
        assert status == 1
        assert f"FAILED, {reason}" in text
        assert not (output / "toy" / "Toy-A-v0.reproduction.seed0.safetensors").exists()
        (toys / fault).unlink()


def test_memory_is_the_rise_during_the_fit(toys, tmp_path):
    """A worker holds some 300 MB before it begins; 20 MB are allocated, and pages round."""
    (toys / "grow-Toy-B").touch()
    run(tmp_path / "results", "toys:Toy", jobs=1)
    found = by_environment(tmp_path / "results", "toy")
    rises = [found[name].metrics["peak_memory_mb"] for name in MOTIONS]
    assert all(0 <= rise < 100 for rise in rises)
    assert rises[1] > 15


def test_the_limit_of_a_batch_is_that_of_a_quarter_of_its_cells_one_by_one(toys):
    (entry,) = plan.select_entries(["toys:Together"], "smoke")
    cells = plan.make_cells([entry], [f"iflow/{name}" for name in MOTIONS], load_preset("smoke"))
    limit = cells[0].time_limit
    assert time_limit_of_batch(cells) == limit
    assert time_limit_of_batch(cells * 5) == limit * 15 / 4


def test_a_worker_that_dies_costs_only_its_own_cell(toys, tmp_path):
    output = tmp_path / "results"
    (toys / "die-Toy-C").touch()
    status, _ = run(output, "toys:Together", "toys:Other")
    assert status == 1
    for method in ("together", "other"):
        found = by_environment(output, method)
        assert {name: r.ok for name, r in found.items()} == {s: s != "Toy-C-v0" for s in MOTIONS}
        assert found["Toy-C-v0"].reason == "its worker process died (SIGKILL(-9))"


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_keeps_what_is_done_and_the_next_one_goes_on(toys, tmp_path, stop):
    output = tmp_path / "results"
    (toys / "sleep-Toy-C").touch()
    command = ["--preset", "smoke", "--jobs", "1", "--methods", "toys:Toy", "--envs", *MOTIONS]
    command += ["--output", output]
    # A job in a shell's background ignores interrupts, and so would what it starts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, ROOT / "baselines" / "run_all.py", *command],
        cwd=toys,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    signal.signal(signal.SIGINT, before)
    deadline = time.monotonic() + 60
    while len(list(output.glob("*/*.json"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(stop)
    printed, errors = process.communicate(timeout=100)
    assert process.returncode == (130 if stop == signal.SIGINT else 128 + stop)
    assert re.search(r"^\d\d:\d\d:\d\d 3 cells, 0 up to date", printed)
    if stop == signal.SIGINT:
        assert errors == "Stopped. What is done is kept; the next run goes on from there.\n"
    done = read_results(output)
    assert len(done) == 2
    assert not list(output.rglob("*.partial"))
    (toys / "sleep-Toy-C").unlink()
    if stop == signal.SIGINT:
        status, text = run(output, "toys:Toy")
        assert status == 0
        assert "3 cells, 2 up to date, 1 to do" in text
        assert [r for r in read_results(output) if r in done] == done


def test_a_truncated_record_is_redone(toys, tmp_path):
    output = tmp_path / "results"
    run(output, "replay", envs=("LASA-Line-v0",))
    (path,) = output.glob("*/*.json")
    record = read_result(path)
    assert record.reference
    assert record.metrics["rmse"] < 1e-12
    path.write_text(path.read_text()[:50])
    status, text = run(output, "replay", envs=("LASA-Line-v0",))
    assert (status, "0 up to date, 1 to do" in text) == (0, True)
    assert read_result(path).metrics["rmse"] == record.metrics["rmse"]


def test_the_page_on_adding_a_method_does_what_it_says(tmp_path):
    """Its class and its two commands, from a folder that knows nothing of the checkout."""
    page = (ROOT / "docs" / "adding-a-method.md").read_text()
    source, _ = re.findall(r"^```python\n(.*?)^```$", page, flags=re.M | re.S)
    (tmp_path / "my_module.py").write_text(source)
    score, draw = re.findall(r"^python .*$", page, flags=re.M)
    assert "'LASA-S*'" in score
    score = score.replace("'LASA-S*'", "LASA-Sshape-v0 --protocol reproduction --jobs 1")
    for command in (score, draw):
        words = command.replace("<checkout>", str(ROOT)).split()[1:]
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
    (result,) = read_results(tmp_path / "results")
    assert (result.ok, result.target) == (True, "my_module:Proportional")
    assert "| Proportional | " in (tmp_path / "board" / "LEADERBOARD.md").read_text()
    assert (tmp_path / "board" / "figures" / "methods.png").is_file()
