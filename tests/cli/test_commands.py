"""The commands as a person or a script calls them: output, exit status, errors."""

import csv
import io
import json
import os
import re
import socket
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from iflow_gym.cli import main, run
from iflow_gym.cli.commands import COMMANDS
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.demonstration_files import load_demonstrations, save_demonstrations
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.saved_models import inspect_model, load_model

CSV = "t,x (mm),y (mm),demo\n" + "\n".join(
    f"{k * 0.02:.3f},{100 * (1 - s):.4f},{50 * s**2:.4f},{d}"
    for d in (1, 2)
    for k, s in enumerate(np.linspace(0, 1, 60))
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a recording, demonstrations and models of them."""
    path = tmp_path_factory.mktemp("cli")
    (path / "reach.csv").write_text(CSV)
    (path / "broken.py").write_text("1 / 0\n")
    motion = load_lasa("Angle")
    thin = Demonstrations.from_arrays(
        [p[::-1][::20][::-1] for p in motion.positions],
        dt=[h * 20 for h in motion.dt],
        goal=motion.goal,
        name="angle",
        length_unit="mm",
    )
    save_demonstrations(thin, path / "angle.safetensors")
    for name, more in (
        ("linear", ()),
        ("dmp", ()),
        ("part", ("--protocol", "generalisation")),
    ):
        method = "linear" if name == "part" else name
        arguments = [f"{path}/angle.safetensors", "-o", f"{path}/{name}.safetensors"]
        assert run(["fit", *arguments, "--method", method, *more]) == 0
    load_model(path / "linear.safetensors").save(path / "bare.safetensors")
    return path


@pytest.fixture
def call(folder, monkeypatch, capfd):
    """Call a command in the folder; return its status, what it printed and what it said."""
    monkeypatch.chdir(folder)

    def called(*arguments):
        capfd.readouterr()
        try:
            status = run([str(a) for a in arguments])
        except SystemExit as error:  # help, and what is not understood
            status = error.code
        output, said = capfd.readouterr()
        return status or 0, output, said

    return called


# Help ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_every_command_has_help(call, name):
    status, output, said = call(*([name] if name else []), "--help")
    assert (status, said) == (0, "")
    assert "iflow-gym" in output
    assert "None" not in output
    if name:
        assert len(re.findall(rf"^    .*iflow-gym {name}", output, flags=re.M)) >= 1


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("import", "Another one than --unit scales: both are among m, dm, cm"),
        ("fit", "or the first four sevenths, so that `score` can take the rest"),
        ("data export-minari", "Write demonstrations as Minari datasets, such as"),
        ("leaderboard run", "Seeds; the preset's by default. Methods without"),
        ("leaderboard check", "Check a submission: method.toml, records"),
    ],
)
def test_helps_texts_are_there_once_and_wrapped_as_paragraphs(call, monkeypatch, line, text):
    monkeypatch.setenv("COLUMNS", "400")
    status, output, _ = call(*line.split(), "--help")
    assert (status, sum(text in one for one in output.splitlines())) == (0, 1)
    assert "(default: )" not in output


def test_a_group_lists_its_commands(call):
    status, output, _ = call("data", "--help")
    assert (status, "export-minari" in output, "iflow-gym data fetch" in output) == (0, True, True)
    assert call("data")[0] == 2
    assert call("data", "wher")[0] == 2


def test_the_version_is_the_packages(call):
    from importlib.metadata import version

    assert call("--version") == (0, f"iflow-gym {version('iflow-gym')}\n", "")


def test_help_imports_nothing_heavy():
    script = (
        "import sys\nfrom iflow_gym.cli import run\n"
        "try: run(['--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'torch', 'mujoco', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_installed_script_is_the_command(folder):
    """The one that pip makes of pyproject.toml's entry, where the tests run."""
    (entry,) = metadata.entry_points(group="console_scripts", name="iflow-gym")
    assert entry.load() is main
    script = Path(sysconfig.get_path("scripts")) / "iflow-gym"
    if not script.exists():
        pytest.skip("the package is imported from a folder, and not installed")
    done = subprocess.run(
        [script, "fit", "LASA-Angel", "-o", "m"], cwd=folder, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("iflow-gym: Expected a motion")
    assert "Did you mean LASA-Angle" in done.stderr


def test_completion_knows_the_commands(call):
    _, output, _ = call("--tyro-print-completion", "bash")
    assert all(name in output for name in COMMANDS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fitt"], "fit"),
        (["fit"], "MOTION"),
        (["import", "reach.csv"], "--output"),
        (["import", "-o", "a"], "at least one file"),
        (["import", "reach.csv", "-o", "a", "--kind", "other"], "other"),
        (["fit", "angle.safetensors", "-o", "m", "--method", "imitation"], "Did you mean"),
        (["fit", "angle.safetensors", "-o", "m", "--set", "n_step=3"], "n_steps"),
        (["fit", "angle.safetensors", "-o", "m", "--set", "n_steps=soon"], "a whole number"),
        (["fit", "angle.safetensors", "-o", "m", "--set", "n_steps"], "key=value"),
        (["fit", "angle.safetensors", "-o", "m", "--set", "n_steps=-1"], "n_steps"),
        (["fit", "LASA-Angel", "-o", "m"], "LASA-Angle"),
        (["fit", "PointMass", "-o", "m"], "iflow-gym import"),
        (["fit", "angle.safetensors", "-o", "no/such/folder/m"], "Expected a folder"),
        (["fit", "", "-o", "m"], "neither"),
        (["fit", ".", "-o", "m"], "a folder"),
        (["fit", "iflow/Angel-v0", "-o", "m"], "Did you mean LASA-Angle"),
        (["envs", "nothing*"], "Unknown environment 'nothing*'. `iflow-gym envs` lists"),
        (["envs", "LASA-Angel"], "Did you mean LASA-Angle"),
        (["envs", "heee-v0"], "Did you mean LASA-heee"),
        (["data", "where", "nothing"], "nothing"),
        (["rollout", "linear.safetensors"], "--start"),
        (["rollout", "linear.safetensors", "--start", "1"], "2 numbers"),
        (["rollout", "bare.safetensors", "--start", "1,2"], "(--dt), got none"),
        (
            ["rollout", "bare.safetensors", "--start", "1,2", "--dt", "1"],
            "demonstrations), got none",
        ),
        (["rollout", "linear.safetensors", "--motion", "angle.safetensors", "--push", "1"], "t:dx"),
        (["plot", "angle.safetensors", "-o", "a.gif"], ".png"),
        (["plot", "angle.safetensors", "-o", "a.png", "--grid", "4"], "--model"),
        (["export", "linear.safetensors", "-o", "a.onnx"], "imitation-flow"),
        (["score", "-", "-"], "one of the inputs"),
        (["import", "reach.csv", "-o", "reach.csv"], "which is one of them"),
        (["import", "reach.csv", "./reach.csv", "-o", "a"], "reach.csv again"),
        (["import", "reach.csv", "-o", os.devnull], "a device or a pipe"),
        (["import", "reach.csv", "-o", "a", "--plot", "a.gif"], ".png"),
        (["import", "reach.csv", "-o", "a", "--format", "xyz"], "csv, npz"),
        (["import", "reach.csv", "-o", "mine.csv"], "such as mine.safetensors"),
        (["fit", "angle.safetensors", "-o", "m.onnx"], "such as m.safetensors"),
        (["export", "linear.safetensors", "-o", "a.safetensors"], "such as a.onnx"),
        (["rollout", "linear.safetensors", "--start", "1,2", "-o", "a.png"], "such as a.csv"),
        (["fit", "angle.safetensors", "-o", "angle.safetensors"], "which is one of them"),
        (["fit", "angle.safetensors", "-o", ""], "an empty name"),
        (["fit", "angle.safetensors", "-o", "m", "--seed", "-1"], "seed >= 0"),
        (["fit", "angle.safetensors", "-o", "m", "--preset", "fast"], "smoke, standard or full"),
        (["fit", "angle.safetensors", "-o", "m", "--method", ".:"], "module:Class"),
        (["fit", "angle.safetensors", "-o", "m", "--method", "broken:Mine"], "ZeroDivisionError"),
        (
            ["fit", "angle.safetensors", "-o", "m", "--method", "bc", "--set", "decays=['a']"],
            "each a number",
        ),
        (["score", "linear.safetensors", "angle.safetensors", "--seed", "-1"], "seed >= 0"),
        (["plot", "angle.safetensors", "-o", "a.png", "--method", "linear"], "--model"),
        (["rollout", "linear.safetensors", "--starts", "absent"], "absent, got none"),
        (
            ["rollout", "linear.safetensors", "--motion", "angle.safetensors", "--dt", "0"],
            "time step > 0",
        ),
        (["export", "linear.safetensors", "-o", "no/a.onnx"], "Expected a folder"),
        (["data", "export-minari", "LASA-Angle", "--folder", "reach.csv"], "got a file"),
    ],
)
def test_what_is_not_understood_is_2_and_says_why(call, arguments, message):
    status, output, said = call(*arguments)
    assert status == 2
    assert message in said
    assert output == ""
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["import", "absent.csv", "-o", "a"], "absent.csv"),
        (["import", "reach.csv", "-o", "a", "--time", "stamp"], "'stamp'"),
        (["fit", "reach.csv", "-o", "m"], "import reach.csv -o reach.safetensors"),
        (["score", "absent", "angle.safetensors"], "Expected a model at absent"),
        (["fit", "angle.safetensors", "-o", "m", "--set", "device=tpu"], "could not be fitted"),
        (["draw", "--no-open", "--port", "70000"], "from 0 to 65535"),
        (["draw", "--no-open", "--directory", "reach.csv"], "a folder for drawings"),
        (["score", "reach.csv", "angle.safetensors"], "model file"),
        (["score", "angle.safetensors", "angle.safetensors"], "got demonstrations"),
        (["fit", "linear.safetensors", "-o", "m"], "holds a model"),
        (["fit", "angle.safetensors", "-o", "m", "--method", "orbit-field"], "repeat"),
    ],
)
def test_what_cannot_be_done_is_1_and_says_why(call, arguments, message):
    status, output, said = call(*arguments)
    assert status == 1
    assert message in said
    assert output == ""
    assert said.startswith("iflow-gym: ")


# Commands -----------------------------------------------------------------------------------


def test_import_reports_draws_and_writes(call, folder):
    status, output, said = call(
        "import", "reach.csv", "-o", "reach.safetensors", "--to-unit", "m",
        "--plot", "reach.png", "--json",
    )  # fmt: skip
    assert status == 0
    report = json.loads(output)
    motion = load_demonstrations(folder / "reach.safetensors")
    assert report["sha256"] == motion.sha256
    assert (motion.name, motion.length_unit, len(motion)) == ("reach", "m", 2)
    np.testing.assert_allclose(motion.positions[0][0], [0.1, 0.0], atol=2e-3)
    np.testing.assert_allclose(motion.goal, [0.0, 0.05], atol=2e-3)
    assert {"columns", "units", "kind"} <= {entry["step"] for entry in report["report"]}
    assert all(entry["text"] in said for entry in report["report"])
    assert (folder / "reach.png").read_bytes()[:4] == b"\x89PNG"


def test_one_recording_alone_is_said_to_be_one(call, folder):
    (folder / "one.csv").write_text(CSV.rpartition("0.000,")[0])
    assert "One recording alone" in call("import", "one.csv", "-o", "one.safetensors")[2]
    assert "One recording alone" not in call("import", "reach.csv", "-o", "two.safetensors")[2]


def test_what_was_there_and_is_replaced_is_said(call):
    line = ("import", "reach.csv", "-o", "twice.safetensors")
    assert "Replaced" not in call(*line)[2]
    assert "Replaced twice.safetensors, which was there already." in call(*line)[2]


def test_fit_writes_a_model_that_says_what_it_was_fitted_on(call, folder):
    status, output, said = call(
        "fit", "angle.safetensors", "-o", "again.safetensors", "--method", "linear",
        "--set", "margin=2", "--set", "noise_horizons=[1, 5]", "--json",
    )  # fmt: skip
    assert status == 0
    assert "Stability: proved." in said
    told = json.loads(output)
    assert told["settings"]["margin"] == 2.0
    model = load_model(folder / "again.safetensors")
    assert model.config.margin == 2.0
    assert repr(model.config.noise_horizons) == "(1, 5)"
    record = inspect_model(folder / "again.safetensors").fit
    assert (record["protocol"], len(record["recordings"])) == ("reproduction", 7)


def test_a_class_of_ones_own_is_fitted_and_scored(call, folder):
    (folder / "my_method.py").write_text(
        "from iflow_gym.baselines.linear import StableLinear\n\n"
        "class Mine(StableLinear):\n    name = 'mine'\n"
    )
    mine = ("--method", "my_method:Mine")
    assert call("fit", "angle.safetensors", "-o", "mine.safetensors", *mine)[0] == 0
    assert call("score", "mine.safetensors", "angle.safetensors")[0] == 1
    status, output, _ = call(
        "score", "mine.safetensors", "angle.safetensors", *mine, "--no-stability", "--json"
    )
    assert (status, json.loads(output)["method"]) == (0, "mine")


def test_score_is_the_evaluations(call, folder):
    import gymnasium

    import iflow_gym  # noqa: F401
    from iflow_gym.evaluate import score

    status, output, _ = call("score", "linear.safetensors", "angle.safetensors", "--json")
    assert status == 0
    told = json.loads(output)
    motion = load_demonstrations(folder / "angle.safetensors")
    env = gymnasium.make("iflow/PointMass-v0", demonstrations=motion)
    expected = score(load_model(folder / "linear.safetensors"), env, 0)
    for name in ("rmse", "frechet", "dtw", "converged", "perturbation_recovery"):
        assert told["metrics"][name] == expected[name]
    assert told["guarantee"]["kind"] == "proved"
    assert told["recordings_seen_in_fit"] == 7


@pytest.mark.parametrize(
    "line",
    [
        "score linear.safetensors metres.safetensors",
        "plot metres.safetensors --model linear.safetensors -o a.png",
        "rollout linear.safetensors --motion metres.safetensors",
    ],
)
def test_a_model_and_a_motion_of_different_units_are_refused(call, folder, line):
    motion = load_demonstrations(folder / "angle.safetensors")
    metres = Demonstrations.from_arrays(
        [p / 1000 for p in motion.positions], dt=motion.dt, length_unit="m", goal_tolerance=1.0
    )
    save_demonstrations(metres, folder / "metres.safetensors")
    status, output, said = call(*line.split())
    assert (status, output) == (2, "")
    assert "a model in mm and a motion in m: import" in said


def test_score_prints_a_table_with_units_and_the_guarantee(call):
    status, output, _ = call("score", "dmp.safetensors", "angle.safetensors", "--no-stability")
    assert status == 0
    assert re.search(r"^RMSE +[\d.e-]+ +[\d.e-]+  mm$", output, flags=re.M)
    assert "Stability: " in output
    assert "SEDS error" not in output  # it has no field


def test_what_was_seen_is_not_scored_as_unseen(call):
    unseen = ("--protocol", "generalisation", "--no-stability", "--json")
    status, _, said = call("score", "linear.safetensors", "angle.safetensors", *unseen)
    assert (status, "has not seen" in said) == (2, True)
    status, output, _ = call("score", "part.safetensors", "angle.safetensors", *unseen)
    assert status == 0
    told = json.loads(output)
    assert (told["recordings"], told["recordings_seen_in_fit"]) == (3, 0)


def rows(output):
    table = list(csv.DictReader(io.StringIO(output)))
    return [{k: float(v) for k, v in row.items()} for row in table]


@pytest.mark.parametrize("model", ["linear", "dmp"])
def test_rollouts_are_the_models_and_pushes_displace(call, folder, model):
    arguments = ("rollout", f"{model}.safetensors", "--start=-40,20", "--start", "10,10")
    times = ("--dt", "0.05", "--duration", "0.5")
    status, output, _ = call(*arguments, *times)
    assert status == 0
    plain = rows(output)
    assert list(plain[0]) == ["start", "t", "x", "y", "vx", "vy"]
    path = load_model(folder / f"{model}.safetensors").rollout([-40.0, 20.0], 10, 0.05)
    np.testing.assert_allclose([[r["x"], r["y"]] for r in plain[:11]], path, rtol=1e-8)
    _, output, _ = call(*arguments, *times, "--push", "0.2:3,-4")
    pushed = rows(output)
    moved = [np.hypot(a["x"] - b["x"], a["y"] - b["y"]) for a, b in zip(plain, pushed, strict=True)]
    np.testing.assert_allclose(moved[:4], 0, atol=1e-9)
    assert moved[4] == pytest.approx(5.0)
    assert moved[15] == pytest.approx(5.0)
    _, output, _ = call(*arguments, *times, "--push", "0:3,-4")
    assert (rows(output)[0]["x"], rows(output)[0]["y"]) == (-37, 16)


def test_a_rollouts_velocity_is_the_slope_of_its_path(call):
    for model in ("linear", "dmp"):
        _, output, _ = call(
            "rollout",
            f"{model}.safetensors",
            "--start=-40,20",
            "--dt",
            "0.001",
            "--duration",
            "0.1",
        )
        table = rows(output)
        x, vx = (np.array([r[k] for r in table]) for k in ("x", "vx"))
        np.testing.assert_allclose(np.diff(x) / 0.001, (vx[1:] + vx[:-1]) / 2, rtol=0.02, atol=0.05)


def test_rollouts_from_a_file_of_starts_and_of_a_motion(call, folder):
    (folder / "starts.csv").write_text("x,y\n-40,20\n10;10\n")
    _, output, _ = call("rollout", "linear.safetensors", "--start=-40,20")
    longest = load_demonstrations(folder / "angle.safetensors").durations.max()
    assert rows(output)[-1]["t"] == pytest.approx(longest, rel=0.02)
    times = ("--dt", "0.1", "--duration", "0.2")
    _, output, _ = call("rollout", "linear.safetensors", "--starts", "starts.csv", *times)
    assert len(rows(output)) == 6
    status, _, said = call(
        "rollout", "linear.safetensors", "--motion", "angle.safetensors", "-o", "paths.csv"
    )
    assert (status, "7 rollouts" in said) == (0, True)


def test_draw_says_why_it_cannot_serve(call):
    """On a port that is taken."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        status, output, errors = call("draw", "--no-open", "--port", str(taken.getsockname()[1]))
    assert (status, output) == (1, "")
    assert "port" in errors


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_plot_draws_the_motion_and_the_model(call, folder, suffix):
    model = ("--model", "linear.safetensors", "--grid", "3")
    assert call("plot", "angle.safetensors", *model, "-o", f"field.{suffix}")[0] == 0
    assert (folder / f"field.{suffix}").stat().st_size > 10_000


def test_plot_draws_motions_in_space_over_time(call, folder):
    t = np.linspace(0, 1, 30)[:, None]
    save_demonstrations(
        Demonstrations.from_arrays([(1 - t) * [1.0, 2.0, 3.0]], dt=0.1), folder / "space"
    )
    assert call("plot", "space", "-o", "space.png")[0] == 0
    assert call("plot", "space", "-o", "space.png", "--model", "linear.safetensors")[0] == 2


def test_an_exported_file_says_what_a_controller_asks_for(call, folder):
    pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    line = ("fit", "angle.safetensors", "-o", "flow.safetensors", "--set", "n_steps=2")
    assert call(*line)[0] == 0
    status, output, said = call("export", "flow.safetensors", "-o", "flow.onnx")
    assert (status, "of the states' size" in said) == (0, True)
    motion = load_demonstrations(folder / "angle.safetensors")
    start = [round(float(c), 6) for c in motion.starts[0]]
    assert f"x = np.array([{start}])  # where you are, in mm" in output
    session = onnxruntime.InferenceSession(str(folder / "flow.onnx"))
    about = {k: json.loads(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}
    assert (about["length_unit"], about["goal"]) == ("mm", pytest.approx(motion.goal.tolist()))
    assert about["sample_time"] == pytest.approx(motion.mean_dt)
    assert "period" not in about
    exec(output, {})  # what it prints runs


def test_methods_lists_all_and_the_settings_of_one(call):
    from iflow_gym.baselines.registry import METHODS

    _, output, _ = call("methods", "--json")
    assert [m["name"] for m in json.loads(output)] == list(METHODS)
    _, output, _ = call("methods", "imitation-flow", "--json")
    settings = {f["name"]: f for f in json.loads(output)}
    assert settings["n_steps"]["text"].startswith("Steps of Adam")
    assert all(f["text"] for f in settings.values())


def test_envs_lists_families_and_status(call):
    import gymnasium

    status, output, _ = call("envs", "--json")
    listed = json.loads(output)
    assert status == 0
    assert {e["id"] for e in listed} == {i for i in gymnasium.registry if i.startswith("iflow/")}
    of = {e["id"]: e for e in listed}
    assert of["iflow/LASA-Multi_Models_1-v0"]["family"] == "LASA-Multi"
    assert of["iflow/Letter-S-v0"]["status"] == "built in"
    _, output, _ = call("envs", "LASA-S*")
    assert len(output.splitlines()) == 6


def test_data_says_where_and_verifies(call, monkeypatch, tmp_path):
    monkeypatch.setenv("IFLOW_GYM_RECORDED", str(tmp_path))
    status, output, _ = call("data", "where", "--json")
    states = {s["name"]: s["state"] for s in json.loads(output)}
    assert (status, states["recorded-drums"], states["lasa"]) == (1, "not here", "here")
    (tmp_path / "drums_recorded").mkdir()
    (tmp_path / "drums_recorded" / "Drums.npy").write_bytes(b"another file")
    status, output, said = call("data", "verify", "recorded-drums")
    assert (status, "sha256" in said) == (1, True)
    status, output, _ = call("data", "verify", "lasa")
    assert (status, "30 of 30" in output) == (0, True)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_a_fit_says_how_many_of_its_steps_are_done(call, folder, monkeypatch):
    """And it is the fit that it is without one."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    arguments = ("fit", "angle.safetensors", "--set", "n_steps=80", "-o")
    assert call(*arguments, "plain.safetensors")[0] == 0
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    assert call(*arguments, "watched.safetensors")[0] == 0
    for text in ("80%, 64 of 80 steps", "Fitting ImitationFlow: finishing"):
        assert text in terminal.getvalue()
    plain, watched = (load_model(folder / f"{n}.safetensors") for n in ("plain", "watched"))
    states = load_demonstrations(folder / "angle.safetensors").starts
    np.testing.assert_array_equal(plain.velocity(states), watched.velocity(states))


# Pipes --------------------------------------------------------------------------------------


def piped(folder, line):
    environ = os.environ | {"OMP_NUM_THREADS": "1"}
    command = line.replace("iflow-gym", f'"{sys.executable}" -W error -m iflow_gym')
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", command],
        cwd=folder, env=environ, capture_output=True, timeout=120, check=False,
    )  # fmt: skip


def test_commands_make_a_pipe(folder):
    line = (
        "cat reach.csv | iflow-gym import - --format csv -o - "
        "| iflow-gym fit - --method linear -o - "
        "| iflow-gym rollout - --start 100,0 --duration 1 --dt 0.1"
    )
    done = piped(folder, line)
    assert done.returncode == 0, done.stderr.decode()
    assert len(done.stdout.splitlines()) == 12


def test_who_has_read_enough_is_not_complained_to(folder):
    line = "iflow-gym rollout linear.safetensors --start 1,2 --dt 1e-4 --duration 20 | head -2"
    done = piped(folder, line)
    assert done.stdout.splitlines()[0] == b"start,t,x,y,vx,vy"
    assert done.stderr == b""
    assert done.returncode == 141


@pytest.mark.parametrize(
    ("line", "status", "said"),
    [
        ("iflow-gym methods >&-", 2, b"Expected a standard output, got a closed one"),
        ("iflow-gym fit - -o m <&-", 2, b"Expected a file on standard input (-), got a closed one"),
        ("iflow-gym fit nothing -o m 2>&-", 2, b""),
        ("iflow-gym methods > /dev/full", 1, b"got: No space left on device."),
    ],
)
def test_closed_and_full_streams_are_told(folder, line, status, said):
    if "/dev/full" in line and not Path("/dev/full").exists():
        pytest.skip("there is no device that is full")
    done = piped(folder, line)
    assert (done.returncode, done.stdout) == (status, b"")
    assert said in done.stderr
    assert b"Traceback" not in done.stderr


def test_infinite_cells_are_missing_in_the_picture_too(call, folder):
    rows = [f"{0.01 * i},{1 - 0.01 * i},{(1 - 0.01 * i) ** 2}" for i in range(101)]
    rows[3], rows[5] = "0.03,inf,1.0", ",0.95,0.9"
    (folder / "gappy.csv").write_text("t,x,y\n" + "\n".join(rows) + "\n")
    status, _, said = call("import", "gappy.csv", "-o", "gappy.safetensors", "--plot", "gappy.png")
    assert status == 0, said
    assert "dropped 2" in said
    assert "nan" not in said
    assert (folder / "gappy.png").stat().st_size > 1000
