"""Submissions: what is refused, and that a proof that the motion contradicts is."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from leaderboard_records import sweep
from rich.console import Console

from iflow_gym.baselines.registry import METHODS, REFERENCES
from iflow_gym.baselines.run_all import RunOptions, run_all
from iflow_gym.baselines.runner.plan import task_of
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS
from iflow_gym.leaderboard import __main__ as command
from iflow_gym.leaderboard import rescoring
from iflow_gym.leaderboard.check import Report, check, note_extent
from iflow_gym.leaderboard.compare import changes
from iflow_gym.leaderboard.rescoring import ACROSS, SAME, differences_of_scores
from iflow_gym.leaderboard.submission import SubmissionError, read_submission
from iflow_gym.results import read_result, write_result

ROOT = Path(__file__).parents[1]

RESIDUALS = ("imitation-flow+residual", "imitation-flow+stable-residual", "ppo")
"""Rows that `baselines/residual.py bench` makes: no registered methods, since they need their
environment to learn from."""

CLAIMS = '''
"""A toy motion, and four methods that claim a proof: one of them has it."""
from dataclasses import dataclass
import gymnasium
import numpy as np
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.system import DynamicalSystem, Guarantee


def make_env(**kwargs):
    t = 0.05 * np.arange(60)
    paths = [np.outer(np.exp(-2 * t), start) for start in ((1.0, 2.0), (-2.0, 1.0), (1.0, -1.0))]
    return PointMassEnv(
        Demonstrations.from_arrays(paths, dt=0.05, goal=np.zeros(2), name="Claimed"), **kwargs
    )


if "iflow/Claimed-v0" not in gymnasium.registry:
    gymnasium.register("iflow/Claimed-v0", entry_point="claims:make_env")


@dataclass(frozen=True)
class Config:
    rate: float = 2.0


class True_(DynamicalSystem):
    name = title = "true"
    Config = Config
    stochastic_fit = False

    def _fit(self, demonstrations, rng):
        self.rate_ = np.array([self.config.rate])

    def _velocity(self, x):
        return -self.rate_ * x

    def _lyapunov(self, x):
        return (x**2).sum(axis=1)

    @property
    def guarantee(self):
        return Guarantee("proved", "it says so")

    def _arrays(self):
        return {"rate": self.rate_}

    def _restore(self, arrays):
        self.rate_ = arrays["rate"]


class Runaway(True_):
    """Right of x = 1.5 it goes to infinity."""
    name = title = "runaway"

    def _velocity(self, x):
        return np.where(x[:, :1] > 1.5, 2.0, -2.0) * x

    def _lyapunov(self, x):
        return None


class Elsewhere(True_):
    """Beyond x = 1.5 it ends at (2, 0)."""
    name = title = "elsewhere"

    def _velocity(self, x):
        return np.where(x[:, :1] > 1.5, -2 * (x - np.array([2.0, 0.0])), -2 * x)

    def _lyapunov(self, x):
        return None


class Rising(True_):
    """Ends at the goal, by the way of a spiral along which its V grows at times."""
    name = title = "rising"

    def _velocity(self, x):
        return x @ np.array([[-1.0, 8.0], [-8.0, -1.0]]).T

    def _lyapunov(self, x):
        return x[:, 0] ** 2 + 9 * x[:, 1] ** 2


class Stiff(True_):
    """Its flow is stable; the steps of the environment are too long for it."""
    name = title = "stiff"

    def _velocity(self, x):
        return x @ np.array([[-1.0, 40.0], [-40.0, -1.0]]).T

    def _rollout(self, x0, n_steps, dt):
        turned = (x0[:, :1] + 1j * x0[:, 1:]) * np.exp((-1 - 40j) * dt * np.arange(n_steps + 1))
        return np.stack([turned.real, turned.imag], axis=-1)

    def _lyapunov(self, x):
        return None


class Slow(True_):
    """Stable, and of a patience that the horizon has not."""
    name = title = "slow"

    def _velocity(self, x):
        return -0.002 * x


class Circling(Stiff):
    """Goes round the goal for ever."""
    name = title = "circling"

    def _velocity(self, x):
        return x @ np.array([[0.0, 1.0], [-1.0, 0.0]]).T

    def _rollout(self, x0, n_steps, dt):
        turned = (x0[:, :1] + 1j * x0[:, 1:]) * np.exp(-1j * dt * np.arange(n_steps + 1))
        return np.stack([turned.real, turned.imag], axis=-1)
'''

NAMES = {
    "true": "True_",
    "runaway": "Runaway",
    "elsewhere": "Elsewhere",
    "rising": "Rising",
    "stiff": "Stiff",
    "slow": "Slow",
    "circling": "Circling",
}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Results of all claims, each a whole submission."""
    code = tmp_path_factory.mktemp("code")
    (code / "claims.py").write_text(CLAIMS)
    sys.path.insert(0, str(code))
    output = tmp_path_factory.mktemp("results")
    options = RunOptions(
        preset="smoke",
        methods=tuple(f"claims:{name}" for name in NAMES.values()),
        envs=("Claimed-v0",),
        output=output,
        jobs=1,
    )
    import claims  # noqa: F401 (registers the motion)

    assert run_all(options, Console(file=io.StringIO())) == 0
    for name in NAMES:
        describe(output / name, name)
    yield output
    sys.path.remove(str(code))
    sys.modules.pop("claims")
    gymnasium.registry.pop("iflow/Claimed-v0")
    task_of.cache_clear()


def describe(folder, called, **changes):
    values = {
        "name": called,
        "title": called,
        "paper": "none",
        "code": "https://example.org/code",
        "guarantee": "proved",
        "hardware": "an abacus",
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in (values | changes).items()]
    (folder / "method.toml").write_text("\n".join(lines) + "\n")


@pytest.fixture
def submission(results, tmp_path):
    """A copy of the true claim, to be spoilt."""
    folder = tmp_path / "true"
    folder.mkdir()
    for path in (results / "true").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def only_record(folder):
    (path,) = folder.glob("*.json")
    return path


def edit(folder, change):
    """Change the JSON of the only record."""
    path = only_record(folder)
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def refused(folder, **settings):
    report = check(folder, seed=0, **{"trust": True, "n_cells": 0, **settings})
    found = [f"{f.what}: {f.text}" for f in report.findings if f.verdict == "refused"]
    assert report.status == (1 if found else 0)
    return found


# Proofs -----------------------------------------------------------------------------------


def test_a_true_claim_passes_and_its_scores_are_made_again(results):
    report = check(results / "true", seed=0, trust=True)
    assert [f.verdict for f in report.findings] == ["ok", "ok", "note", "ok"]
    assert "1 of 1 are of the smoke preset" in report.findings[2].text
    assert "the same to 1e-06 (same versions)" in report.findings[-1].text
    assert report.status == 0


def test_a_proof_of_what_runs_away_is_refused_with_the_start_and_where_it_went(results):
    found = refused(results / "runaway", n_cells=1)
    assert len(found) == 3
    assert found.pop().endswith("more states")
    for text in found:
        assert "claimed proved, but it diverged" in text
    start = np.array(eval(found[0].rpartition("from ")[2].partition(" to ")[0]))
    box = task_of("iflow/Claimed-v0").demonstrations.bounding_box
    assert (np.abs(start - (box.low + box.high) / 2) <= (box.high - box.low) * (1 + 1e-5)).all()
    assert start[0] > 1.5


def test_of_a_proof_whose_motions_go_round_it_is_noted(results):
    report = check(results / "circling", n_cells=0)
    assert report.status == 0  # of files alone
    report = check(results / "circling", n_cells=1, seed=0, trust=True)
    (text,) = [f.text for f in report.findings if "go round" in f.text]
    assert "8 were followed" in text
    assert "8 came no nearer to the goal in the last quarter" in text
    for patient in ("slow", "true"):
        report = check(results / patient, n_cells=1, seed=0, trust=True)
        assert not [f for f in report.findings if "go round" in f.text]


def test_a_proof_of_what_comes_to_rest_elsewhere_is_refused(results):
    found = refused(results / "elsewhere", n_cells=1)
    assert len(found) == 3
    assert found.pop().endswith("more states")
    for text in found:
        assert "claimed proved, but it came to rest elsewhere" in text
        assert np.allclose(eval(text.rpartition(" to ")[2]), [2.0, 0.0], atol=1e-5)


def test_a_lyapunov_function_that_grows_is_refused_at_a_state_where_it_does(results):
    (text,) = refused(results / "rising", n_cells=1)
    assert "its Lyapunov function grows along the field" in text
    x, y = eval(text.rpartition("from ")[2].partition(" to ")[0])
    assert 2 * x * (-x + 8 * y) + 18 * y * (-8 * x - y) > 0  # the gradient along the field


@pytest.mark.parametrize("name", ["stiff", "slow"])
def test_what_the_sample_time_or_the_horizon_does_contradicts_no_proof(results, name):
    result = read_result(only_record(results / name))
    assert result.metrics["diverged" if name == "stiff" else "spurious_attractors"] > 0
    report = check(results / name, seed=0, trust=True, n_cells=1)
    assert report.status == 0
    words = {"stiff": "where the method rolls out by itself", "slow": "but moves on"}
    assert any(words[name] in f.text for f in report.findings if f.verdict == "note")


def test_a_claim_that_the_model_does_not_make_is_refused(submission):
    edit(submission, lambda values: values["guarantee"].update(kind="sampled"))
    assert any("expected the claimed guarantee" in text for text in refused(submission))
    describe(submission, "true", guarantee="sampled")
    assert refused(submission) == []
    (text,) = refused(submission, n_cells=1)
    assert "the model claims 'proved', its record 'sampled'" in text


def test_how_much_of_a_family_is_there_is_noted(tmp_path):
    report = Report(tmp_path, 0)
    results = sweep("good", shapes=SINGLE_MOTIONS[:3]) + sweep("good", shapes=MULTI_MODELS)
    note_extent(report, results)
    (finding,) = report.findings
    text = "of LASA-26, 3 of 26 environments: the row will be incomplete"
    assert (finding.verdict, finding.text) == ("note", text)


def test_failed_cells_alone_are_refused(submission):
    old = read_result(only_record(submission))
    failed = dataclasses.replace(
        old, status="failed", reason="no", metrics={}, medians={}, per_demonstration={},
        likelihoods={}, fit={}, guarantee=None, model=None, dt=None,
    )  # fmt: skip
    for path in [only_record(submission), *submission.glob("*.safetensors")]:
        path.unlink()
    write_result(submission.parent, failed)
    assert refused(submission) == ["records: expected scores, got failed cells alone"]


# Scores -----------------------------------------------------------------------------------


def test_scores_that_the_model_does_not_make_are_refused(submission):
    def better(values):
        for part in (values["metrics"], values["medians"]):
            part["rmse"] /= 2
        values["per_demonstration"]["rmse"] = [v / 2 for v in values["per_demonstration"]["rmse"]]
        values["metrics"]["step_us"] /= 1000  # a cost, which is not compared

    edit(submission, better)
    assert refused(submission) == []  # plausible by itself
    found = refused(submission, n_cells=1)
    assert found
    assert all("rmse" in text for text in found)


def test_a_mean_that_is_none_of_its_values_is_refused(submission):
    edit(submission, lambda values: values["metrics"].update(rmse=0.0))
    (text,) = refused(submission)
    assert "expected rmse to be the mean of its values" in text


@pytest.mark.parametrize("name", ["metrics", "data", "core", "config"])
def test_other_hashes_are_refused(submission, name):
    edit(submission, lambda values: values["hashes"].update({name: "0" * 64}))
    (text,) = refused(submission)
    assert ("hash of its config" if name == "config" else "made with") in text


def test_another_model_or_other_settings_are_refused(submission, results):
    model = only_record(submission).with_suffix(".safetensors")
    model.write_bytes((only_record(results / "slow").with_suffix(".safetensors")).read_bytes())
    (text,) = refused(submission, n_cells=1)
    assert "could not be scored again: ModelFileError" in text
    model.write_bytes(model.read_bytes()[:-1])
    assert any("expected a whole model file" in text for text in refused(submission))
    model.unlink()
    assert any("expected a whole model file" in text for text in refused(submission))


def test_code_from_outside_is_not_run_unless_it_is_trusted(submission, monkeypatch):
    monkeypatch.setattr("iflow_gym.leaderboard.check.load_model", None)
    report = check(submission, seed=0)
    assert report.status == 2
    assert "pass --trust" in report.findings[-1].text


def test_tolerances_are_of_the_machine_and_the_versions(results):
    result = read_result(only_record(results / "true"))
    assert rescoring.tolerance_for(result)[0] is SAME
    for changes_ in (
        {"versions": result.versions | {"numpy": "1.0"}},
        {"hardware": result.hardware | {"cpu": "abacus"}},
    ):
        assert rescoring.tolerance_for(dataclasses.replace(result, **changes_))[0] is ACROSS

    def differ(left, right, tolerance, name="rmse"):
        return any(differences_of_scores({name: left}, {name: right}, tolerance))

    assert not differ(1.0, 1.0 + 5e-7, SAME)
    assert differ(1.0, 1.0 + 2e-6, SAME)
    assert not differ(1.0, 1.005, ACROSS)
    assert differ(1.0, 1.02, ACROSS)
    assert differ(1.0, None, ACROSS)
    assert differ(math.inf, 1.0, ACROSS)
    assert not differ(math.inf, math.inf, SAME)
    assert differ(1.0, 1 - 1 / 256, SAME, "converged")
    assert not differ(1.0, 1 - 5 / 256, ACROSS, "converged")
    assert not differ(1.0, 9.0, SAME, "step_us")


# Files ------------------------------------------------------------------------------------


def test_files_that_are_traps_are_refused_and_nothing_outside_is_read(submission, tmp_path):
    path = only_record(submission)
    whole = path.read_text()
    for text, words in (
        (whole[:200], "no whole JSON file|Unterminated|Expecting"),
        (whole.replace('"dt": 0.05', '"dt": NaN'), "strict JSON, got NaN"),
        (whole.replace('"seed": 0', '"seed": 0, "seed": 1'), "one twice"),
        ("[" * 100_000, "recursion|nested"),
        (whole.replace('"method": "true"', '"method": "../true"'), "made of letters"),
        (whole.replace('"method": "true"', '"method": "other"'), "record of other"),
        ('{"a": "' + "x" * 5_000_000 + '"}', "at most 4194304 bytes"),
        (whole.replace("iflow/Claimed-v0", "iflow/Nowhere-v0"), "record of true/Nowhere"),
    ):
        path.write_text(text)
        found = refused(submission)
        assert any(any(word in line for word in words.split("|")) for line in found), (words, found)
    path.write_text(whole)
    edit(submission, lambda values: values.update(model="../../secret.safetensors"))
    assert any("expected the model Claimed-v0" in text for text in refused(submission))
    path.write_text(whole)
    (submission / "linked.json").symlink_to(tmp_path / "anything")
    (submission / "run.sh").write_text("echo")
    (submission / "left.safetensors").write_bytes(b"")
    found = refused(submission)
    assert len(found) == 3
    assert any("got a link" in text for text in found)
    assert any("records, models and method.toml alone" in text for text in found)
    assert any("expected a record beside it" in text for text in found)


@pytest.mark.parametrize(
    ("changes_", "words"),
    [
        ({"guarantee": "certain"}, "expected guarantee to be of"),
        ({"name": "../true"}, "other characters in name"),
        ({"title": "<script>"}, "other characters in title"),
        ({"title": "x" * 61}, "at most 60 characters"),
        ({"paper": "two\nlines"}, "line of text"),
        ({"code": "http://example.org"}, "https address or a path"),
        ({"code": "../secret"}, "https address or a path"),
        ({"link": "javascript:alert(1)"}, "link to be an https address"),
        ({"colour": "red"}, "unknown 'colour'"),
        ({"hardware": 3}, "line of text, got 3"),
    ],
)
def test_a_description_that_is_wrong_says_where(tmp_path, changes_, words):
    describe(tmp_path, "true", **changes_)
    with pytest.raises(SubmissionError) as error:
        read_submission(tmp_path)
    assert words in str(error.value)


def test_a_description_that_is_none_says_so(tmp_path):
    with pytest.raises(SubmissionError, match=r"write one with name, title, paper, code, gua"):
        read_submission(tmp_path)
    (tmp_path / "method.toml").write_text("name = ")
    with pytest.raises(SubmissionError, match="no valid TOML"):
        read_submission(tmp_path)
    (tmp_path / "method.toml").write_text('name = "a"\n')
    with pytest.raises(SubmissionError, match="expected title, got none; expected paper"):
        read_submission(tmp_path)
    (tmp_path / "method.toml").write_text("#" * 70_000)
    with pytest.raises(SubmissionError, match="at most 65536 bytes"):
        read_submission(tmp_path)


def test_every_committed_method_has_a_description_that_is_true():
    folders = sorted(p for p in (ROOT / "leaderboard" / "results").iterdir() if p.is_dir())
    assert folders
    for folder in folders:
        submission = read_submission(folder)
        assert submission.name == folder.name
        assert folder.name in {*METHODS, *REFERENCES, *RESIDUALS}
        assert (ROOT / submission.code).exists()
        record = read_result(next(folder.glob("*.json")))
        assert record.title == submission.title
        assert record.guarantee is None or record.guarantee.kind == submission.guarantee


# Commands ---------------------------------------------------------------------------------


def test_the_command_tells_in_a_table_and_by_its_status(results, submission, capsys):
    assert command.check(submission, 0) == 0
    assert "method.toml" in capsys.readouterr().out
    assert command.check(submission, 1, 0) == 2
    assert command.check(submission.parent / "absent") == 2
    assert "Expected the folder of a submission" in capsys.readouterr().err
    edit(submission, lambda values: values["hashes"].update(metrics="0"))
    assert command.check(submission.parent, 0) == 1


def test_what_changed_is_told(results, tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    for name in ("true", "slow"):
        write_result(before, read_result(only_record(results / name)))
        write_result(after, read_result(only_record(results / name)))
    assert changes(before, after) == (
        "2 cells: 2 with the same scores, 0 with others, 0 new, 0 gone."
    )
    old = read_result(only_record(results / "true"))
    write_result(after, dataclasses.replace(old, metrics=old.metrics | {"rmse": 123.0}))
    write_result(after, read_result(only_record(results / "rising")))
    failed = dataclasses.replace(
        old, method="bad", title="b|d", status="failed", reason="<b>no</b>", metrics={}
    )
    write_result(after, failed)
    text = changes(before, after)
    assert "4 cells: 1 with the same scores, 1 with others, 2 new, 0 gone." in text
    assert "→ 123 |" in text
    assert "| rising | " in text
    assert "<b>" not in text
    assert changes(after, before).splitlines()[2] == "Gone: cells of bad, rising."


def test_the_page_on_submissions_does_what_it_says(tmp_path):
    """Its class of twenty lines, its commands and its description, from a folder of its own."""
    page = (ROOT / "docs" / "submissions.md").read_text()
    (source,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.M | re.S)
    (description,) = re.findall(r"^```toml\n(.*?)^```$", page, flags=re.M | re.S)
    assert len([line for line in source.splitlines() if line]) <= 20
    (tmp_path / "straight.py").write_text(source)
    ran, checked = re.findall(r"^python -m .*$", page, flags=re.M)
    assert "'LASA-*'" in ran
    ran = ran.replace("'LASA-*'", "LASA-Line-v0 --protocol reproduction --jobs 1")
    for command_line in (ran, checked):
        if command_line == checked:
            (tmp_path / "results" / "straight" / "method.toml").write_text(description)
        done = subprocess.run(
            [sys.executable, *command_line.split()[1:]],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stderr == ""
    assert "scored again" in done.stdout
