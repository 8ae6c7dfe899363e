"""The plan of a run: names, presets, keys and jobs; nothing here starts a process."""

from __future__ import annotations

import dataclasses
import importlib
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from iflow_gym.baselines import registry
from iflow_gym.baselines.registry import METHODS, UnknownNameError, load_method
from iflow_gym.baselines.runner import fingerprint, plan, presets, report
from iflow_gym.baselines.runner.fingerprint import method_code
from iflow_gym.baselines.runner.presets import (
    PRESETS,
    PresetError,
    load_preset,
    load_settings,
)
from iflow_gym.baselines.runner.scoring import failed_result
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS
from iflow_gym.metrics import metrics_of
from iflow_gym.results import write_result

ROOT = Path(__file__).parents[1]

TOY = '''
"""A toy."""
from dataclasses import dataclass
import numpy as np
from iflow_gym.system import DynamicalSystem, Guarantee
{imports}

@dataclass(frozen=True)
class Config:
    rate: float = 2.0


class Toy(DynamicalSystem):
    """Goes straight home."""

    name = "{name}"
    title = "Toy"
    Config = Config
    stochastic_fit = {stochastic}

    def _fit(self, demonstrations, rng):
        self.rate_ = np.array([self.config.rate])  # per second

    def _velocity(self, x):
        return -self.rate_ * (x - self.goal_)

    @property
    def guarantee(self):
        return Guarantee("proved", "linear")

    def _arrays(self):
        return {{"rate": self.rate_}}

    def _restore(self, arrays):
        self.rate_ = arrays["rate"]
'''


@pytest.fixture
def make_toy(tmp_path, monkeypatch):
    """Write a module with a toy method, and return its `module:Class`."""
    monkeypatch.syspath_prepend(tmp_path)
    names = []

    def make(module, name=None, stochastic=False, imports="", text=TOY):
        source = text.format(name=name or module, stochastic=stochastic, imports=imports)
        (tmp_path / f"{module}.py").write_text(source)
        importlib.invalidate_caches()
        names.append(module)
        return f"{module}:Toy"

    yield make
    for name in names:
        sys.modules.pop(name, None)


def keys(target, preset="smoke", **changes):
    """Environment, protocol and seed of each cell to its key."""
    settings = presets.load_preset(preset)
    settings = dataclasses.replace(settings, **changes) if changes else settings
    environments = plan.select_environments(settings.environments)
    cells = plan.make_cells(plan.select_entries([target], preset), environments, settings)
    return {(c.environment, c.protocol, c.seed): c.key for c in cells}


# Names ------------------------------------------------------------------------------------


def test_names_that_are_none_are_answered_with_the_nearest():
    with pytest.raises(UnknownNameError, match="Did you mean linear"):
        load_method("liner")
    with pytest.raises(UnknownNameError, match="Did you mean replay"):
        plan.select_entries(["replai"], "smoke")
    with pytest.raises(UnknownNameError, match="Did you mean LASA-Angle"):
        plan.select_environments(["LASA-Angel-v0"])
    with pytest.raises(UnknownNameError, match="Did you mean LASA-Angle"):
        plan.select_environments(["Angle"])


def test_a_module_without_the_class_and_a_class_that_is_no_method_are_refused():
    with pytest.raises(UnknownNameError, match="put its folder on PYTHONPATH"):
        load_method("no_such_package:Method")
    with pytest.raises(UnknownNameError, match=r"Did you mean iflow_gym\.system:DynamicalSystem"):
        load_method("iflow_gym.system:DynamicalSystme")
    with pytest.raises(UnknownNameError, match="abstract"):
        load_method("iflow_gym.system:DynamicalSystem")
    with pytest.raises(UnknownNameError, match="subclass"):
        load_method("iflow_gym.system:Guarantee")


@pytest.mark.parametrize("name", ["mine", "mine.py", "./mine.py", "mine.py:Toy"])
def test_a_file_in_place_of_a_class_is_told_how_the_class_is_named(
    make_toy, tmp_path, monkeypatch, name
):
    make_toy("mine")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UnknownNameError, match=r"as module:Class, got '.*': mine:Toy\."):
        plan.select_entries([name], "smoke")
    with pytest.raises(UnknownNameError, match="such as my_module:MyMethod"):
        plan.select_entries(["mein"], "smoke")


@pytest.mark.parametrize(
    ("imports", "message"),
    [
        ("def broken(:", r"a SyntaxError in .*broken\.py, line 6: invalid syntax"),
        ("1 / 0", r"ZeroDivisionError in .*broken\.py, line 6: division by zero"),
    ],
)
def test_a_module_that_cannot_be_imported_is_told_by_its_line(make_toy, imports, message):
    with pytest.raises(UnknownNameError, match=message):
        plan.select_entries([make_toy("broken", imports=imports)], "smoke")


def test_a_guarantee_without_a_reason_is_refused_before_anything_runs(make_toy):
    text = TOY.replace('"linear"', '""')
    with pytest.raises(UnknownNameError, match=r"guarantee of silent:Toy: Expected the reason"):
        plan.select_entries([make_toy("silent", text=text)], "smoke")
    learned = TOY.replace('"linear"', 'f"rate {{self.rate_}}"')  # known after `fit` alone
    assert plan.select_entries([make_toy("learned", text=learned)], "smoke")


def test_environments_are_chosen_by_globs_over_ids_and_short_names():
    assert len(plan.select_environments(["LASA-*"])) == 30
    assert plan.select_environments(["iflow/LASA-Angle-v0", "LASA-Ang*"]) == ["iflow/LASA-Angle-v0"]
    families = Counter(plan.family(e) for e in plan.select_environments(["LASA-*"]))
    assert families == {"LASA-26": 26, "LASA-Multi": 4}


def test_a_class_that_takes_anothers_name_is_refused(make_toy):
    thief = make_toy("thief", name="linear")
    with pytest.raises(UnknownNameError, match=r"different names.*another `name`"):
        plan.select_entries([thief], "smoke")


# Presets ----------------------------------------------------------------------------------


def test_presets_say_what_the_documentation_says():
    smoke, standard, full = (load_preset(name) for name in PRESETS)
    shapes = ("LASA-Angle-v0", "LASA-Sshape-v0", "LASA-Sharpc-v0")
    assert smoke.environments == (*shapes, "Letter-O-v0")
    assert smoke.protocols == ("reproduction",)
    assert len(plan.select_environments(standard.environments)) == 30 + 4
    assert len(plan.select_environments(full.environments)) == 30 + 4 + 1 + 2
    assert (len(standard.seeds), len(full.seeds)) == (1, 3)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_one_file_one_line_and_one_preset(name):
    """Beside its own files a method appears once, in the registry, and has one preset file."""
    module = METHODS[name].partition(":")[0]
    own = ROOT / Path(*module.split(".")[1:])
    assert own.with_suffix(".py").is_file() != (own / "__init__.py").is_file()
    others = [ROOT / "baselines" / f for f in ("registry.py", "references.py", "run_all.py")]
    others += [*(ROOT / "baselines" / "runner").glob("*.py"), *(ROOT / "envs").glob("*.py")]
    mentions = [
        (path.name, line)
        for path in others
        for line in path.read_text().splitlines()
        if re.search(rf"{re.escape(module)}\b", line)
    ]
    assert [path for path, _ in mentions] == ["registry.py"]
    assert set(tomllib.loads((presets.PRESETS_FOLDER / f"{name}.toml").read_text())) == set(PRESETS)
    for preset in PRESETS:
        (entry,) = plan.select_entries([name], preset)
        assert entry.name == name


def test_no_preset_is_left_over():
    files = {p.stem for p in presets.PRESETS_FOLDER.glob("*.toml")}
    assert files == {*METHODS, "run"}


def test_a_new_method_runs_after_its_file_its_line_and_its_preset(make_toy, monkeypatch, tmp_path):
    target = make_toy("newcomer")
    monkeypatch.setitem(registry.METHODS, "newcomer", target)
    folder = tmp_path / "presets"
    folder.mkdir()
    monkeypatch.setattr(presets, "PRESETS_FOLDER", folder)
    with pytest.raises(PresetError, match=r"newcomer\.toml.*\[smoke\], \[standard\], \[full\]"):
        plan.select_entries(["newcom*"], "smoke")
    (folder / "newcomer.toml").write_text("[smoke]\nrate = 3.0\n[standard]\n[full]\n")
    (entry,) = plan.select_entries(["newcom*"], "smoke")
    assert entry.config == {"rate": 3.0}
    (folder / "newcomer.toml").write_text("[smoke]\nrat = 3.0\n")
    with pytest.raises(PresetError, match=r"newcomer in preset \[smoke\].*rat.*known: rate"):
        plan.select_entries(["newcom*"], "smoke")
    with pytest.raises(PresetError, match=r"section \[full\]"):
        plan.select_entries(["newcom*"], "full")


# Keys -------------------------------------------------------------------------------------


def test_every_cell_has_a_key_of_its_own_that_stays(make_toy):
    target = make_toy("toy_keys", stochastic=True)
    first = keys(target, "full", environments=("LASA-A*", "LASA-B*"))
    assert len(first) == len(set(first.values())) == 2 * 2 * 3
    assert first == keys(target, "full", environments=("LASA-A*", "LASA-B*"))


def test_a_method_without_randomness_runs_with_one_seed(make_toy):
    assert {seed for _, _, seed in keys(make_toy("toy_fixed"), "full")} == {0}


def test_seeds_and_time_limits_that_are_none_are_refused_and_a_seed_counts_once(make_toy):
    entries = plan.select_entries([make_toy("toy_seeds", stochastic=True)], "smoke")
    environments = plan.select_environments(["LASA-Line-v0"])
    preset = dataclasses.replace(load_preset("smoke"), protocols=("reproduction",))

    def cells(**changes):
        return plan.make_cells(entries, environments, dataclasses.replace(preset, **changes))

    for seeds in ((-1,), (0, -2), ()):
        with pytest.raises(PresetError, match=r"Expected seeds that are integers >= 0, got \["):
            cells(seeds=seeds)
    for limit in (0.0, -1.0, float("nan")):
        with pytest.raises(PresetError, match=f"Expected a time limit above 0 s, got {limit}"):
            cells(time_limit=limit)
    assert [c.seed for c in cells(seeds=(3, 0, 3), time_limit=float("inf"))] == [3, 0]


def test_code_settings_and_libraries_change_a_key_and_comments_do_not(make_toy, monkeypatch):
    target = make_toy("toy_code")
    before = keys(target)
    make_toy("toy_code", text=TOY.replace("  # per second", "").replace("Goes straight", "Goes"))
    assert keys(target) == before
    make_toy("toy_code", text=TOY.replace("-self.rate_", "-2 * self.rate_"))
    changed = keys(target)
    assert not set(changed.values()) & set(before.values())
    monkeypatch.setattr(plan, "versions", lambda libraries=(): {"numpy": "0.0"})
    assert not set(keys(target).values()) & set(changed.values())


def test_code_that_a_method_imports_from_beside_it_counts(make_toy, tmp_path):
    package = tmp_path / "toy_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "helper.py").write_text("FACTOR = 1.0\n")
    (package / "other.py").write_text("UNUSED = 1.0\n")
    source = TOY.format(name="toy", stochastic=False, imports="from . import helper")
    (package / "method.py").write_text(source)
    before = method_code("toy_package.method")
    assert before.libraries == ("numpy",)
    (package / "other.py").write_text("UNUSED = 2.0\n")
    assert method_code("toy_package.method") == before
    (package / "helper.py").write_text("FACTOR = 2.0\n")
    assert method_code("toy_package.method") != before


def test_the_core_and_the_metrics_change_every_key(make_toy, monkeypatch):
    target = make_toy("toy_core")
    before = keys(target)
    for name in ("core_hash", "metrics_hash"):
        with monkeypatch.context() as context:
            context.setattr(plan, name, lambda *of: "another")
            assert not set(keys(target).values()) & set(before.values())
    assert keys(target) == before


# Jobs -------------------------------------------------------------------------------------


@pytest.fixture
def make_cells(make_toy):
    """Cells of a toy that is fitted in batches, or is not, on environments of LASA."""

    def make(environments, batched=True, preset="standard"):
        (entry,) = plan.select_entries([make_toy("toy_jobs")], preset)
        entry = dataclasses.replace(entry, batched=batched)
        return plan.make_cells([entry], environments, load_preset(preset))

    return make


LASA = [f"iflow/LASA-{shape}-v0" for shape in (*SINGLE_MOTIONS, *MULTI_MODELS)]


@pytest.mark.parametrize(
    ("n", "sizes"), [(30, [15, 15]), (3, [3]), (15, [15]), (16, [8, 8]), (1, [1])]
)
def test_batches_are_of_one_protocol_and_differ_by_one_cell_at_most(make_cells, n, sizes):
    cells = make_cells(LASA[:n])
    jobs = plan.make_jobs(cells, cells)
    assert [len(job.batch) for job in jobs] == sizes * 2
    assert sorted(c.key for job in jobs for c in job.cells) == sorted(c.key for c in cells)
    for job in jobs:
        assert job.cells == job.batch
        assert len({c.protocol for c in job.batch}) == 1
        assert {c.batch for c in job.batch} == {tuple(str(c.path) for c in job.batch)}


def test_a_batch_does_not_depend_on_the_order_nor_on_what_is_up_to_date(make_cells):
    cells = make_cells(LASA)
    assert {c.path: c.key for c in cells} == {c.path: c.key for c in make_cells(LASA[::-1])}
    stale = [cells[0], cells[7], cells[20]]
    whole = {c.path: job.batch for job in plan.make_jobs(cells, cells) for c in job.batch}
    jobs = plan.make_jobs(cells, stale)
    assert [len(job.batch) for job in jobs] == [15, 15]
    assert [job.cells for job in jobs] == [(cells[0], cells[7]), (cells[20],)]
    for job in jobs:
        assert job.batch == whole[job.cells[0].path]


@pytest.mark.parametrize(
    ("made_by", "run_by", "done"),
    [
        ("smoke", "smoke", True),
        ("smoke", "standard", False),
        ("smoke", "full", False),
        ("standard", "smoke", True),
        ("standard", "full", True),
    ],
)
def test_a_trials_record_is_done_again_by_another_preset(
    make_cells, tmp_path, made_by, run_by, done
):
    """Though its key is the same where smoke leaves the settings alone."""
    (made, *_), (wanted, *_) = (make_cells(LASA[:1], preset=p) for p in (made_by, run_by))
    assert made.key == wanted.key
    failed = failed_result(made, "made up")
    write_result(tmp_path, failed)
    assert not plan.is_up_to_date(wanted, tmp_path)
    metrics = {metric.name: 0.5 for metric in metrics_of("goal")}
    write_result(tmp_path, dataclasses.replace(failed, status="ok", reason=None, metrics=metrics))
    assert plan.is_up_to_date(wanted, tmp_path) == done


@pytest.mark.parametrize(
    ("values", "text"),
    [([0.00034, None], "0.34 ms"), ([0.5, 0.25], "0.375"), ([0.0], "0"), ([None], "-")],
)
def test_short_times_are_told_in_milliseconds(values, text):
    assert report._mean_seconds(values) == text


def test_a_trial_of_other_settings_has_another_key():
    settings = {preset: load_settings("bc", preset, registered=True) for preset in PRESETS}
    assert settings["smoke"] != settings["standard"] == settings["full"]
    smoke, standard = (
        keys("bc", preset, protocols=("reproduction",), environments=(LASA[0],))
        for preset in ("smoke", "standard")
    )
    assert smoke.keys() == standard.keys()
    assert not set(smoke.values()) & set(standard.values())


def test_the_company_in_a_batch_is_in_the_key_and_only_where_there_are_batches(make_cells):
    for batched in (True, False):
        few, many = (
            {c.path: c.key for c in make_cells(environments, batched=batched)}
            for environments in (LASA[:3], LASA[:4])
        )
        assert all((many[path] != key) == batched for path, key in few.items())


def test_a_method_has_cells_where_it_learns_the_motion_and_the_rest_is_counted():
    environments = ["iflow/LASA-Angle-v0", "iflow/Letter-I-v0", "iflow/Drumming-v0"]
    entries = plan.select_entries(["seds", "orbit-field", "dmp", "replay"], "standard")
    preset = dataclasses.replace(load_preset("standard"), protocols=("reproduction",))
    found = {entry.name: set() for entry in entries}
    for cell in plan.make_cells(entries, environments, preset):
        found[cell.entry.name].add(cell.environment)
    assert found["seds"] == {environments[0]}
    assert found["orbit-field"] == set(environments[1:])
    assert found["dmp"] == found["replay"] == set(environments)
    assert plan.not_learned(entries, environments) == {
        "seds": "2 (Letter-I-v0, Drumming-v0)",
        "orbit-field": "1 (LASA-Angle-v0)",
    }


def test_another_suite_beside_it_changes_no_batch():
    letters = [f"iflow/Letter-{letter}-v0" for letter in "IROS"]
    alone = plan.make_batches(LASA, batched=True)
    assert plan.make_batches([*letters, *LASA], batched=True)[: len(alone)] == alone


def test_others_are_a_job_each(make_cells):
    cells = make_cells(LASA[:5], batched=False)
    assert [(job.batch, job.cells) for job in plan.make_jobs(cells, cells[:2])] == [
        ((cell,), (cell,)) for cell in cells[:2]
    ]


def test_how_a_cell_is_scored_is_in_the_key_and_what_is_printed_is_not(monkeypatch):
    def hashes():
        points = plan.entry_points("iflow/LASA-Angle-v0")
        return {m: fingerprint.core_hash.__wrapped__(points, m) for m in ("goal", "cycle")}

    before = hashes()
    source = fingerprint._source
    both = {"goal", "cycle"}
    for module, counts in (
        ("baselines.runner.scoring", both),
        ("baselines.runner.work", set()),
        ("baselines.runner.report", set()),
        ("evaluate", both),
        ("evaluation.rollouts", both),
        ("evaluation.goals", {"goal"}),
        ("evaluation.cycles", {"cycle"}),
        ("envs.task", both),
        ("envs.dynamics", both),
        ("envs.letters", set()),
        ("envs.rendering", set()),
        ("demonstrations", both),
        ("policy", both),
        ("primitive", both),
        ("system", both),
    ):
        changed = f"iflow_gym.{module}"

        def edited(name, changed=changed):
            return source(name) + "\nEDITED = 1\n" if name == changed else source(name)

        monkeypatch.setattr(fingerprint, "_source", edited)
        assert {m for m, value in hashes().items() if value != before[m]} == counts, module


def test_the_command_line_explains_itself_and_refuses_in_a_line(tmp_path):
    script = str(ROOT / "baselines" / "run_all.py")

    def run(*arguments):
        return subprocess.run(
            [sys.executable, script, *arguments], cwd=tmp_path, capture_output=True, text=True
        )

    shown = run("--help")
    assert shown.returncode == 0
    assert "--preset" in shown.stdout
    refused = run("--methods", "liner", "--output", "results")
    assert refused.returncode == 2
    assert refused.stderr.startswith("run_all.py: Unknown method 'liner'. Did you mean linear")
    negative = run("--methods", "linear", "--seeds", "-1", "--output", "results")
    assert negative.returncode == 2
    assert negative.stderr == "run_all.py: Expected seeds that are integers >= 0, got [-1].\n"
    assert not (tmp_path / "results").exists()
