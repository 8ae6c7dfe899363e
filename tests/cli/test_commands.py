"""The commands as a person or a script calls them: output, exit status, errors."""

import csv
import io
import json
import os
import re
import socket
import subprocess
import sys

import numpy as np
import pytest

from iflow_gym.cli import run
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
        (["rollout", "linear.safetensors", "--start", "1,2"], "--duration"),
        (["rollout", "linear.safetensors", "--motion", "angle.safetensors", "--push", "1"], "t:dx"),
        (["plot", "angle.safetensors", "-o", "a.gif"], ".png"),
        (["plot", "angle.safetensors", "-o", "a.png", "--grid", "4"], "--model"),
        (["export", "linear.safetensors", "-o", "a.onnx"], "imitation-flow"),
        (["score", "-", "-"], "one of the inputs"),
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
        (["fit", "reach.csv", "-o", "m"], "iflow-gym import"),
        (["score", "absent", "angle.safetensors"], "absent"),
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


def test_fit_writes_a_model_that_says_what_it_was_fitted_on(call, folder):
    status, output, said = call(
        "fit", "angle.safetensors", "-o", "again.safetensors", "--method", "linear",
        "--set", "margin=2", "--json",
    )  # fmt: skip
    assert status == 0
    assert "Stability: proved." in said
    told = json.loads(output)
    assert told["settings"]["margin"] == 2.0
    model = load_model(folder / "again.safetensors")
    assert model.config.margin == 2.0
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
