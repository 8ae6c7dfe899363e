"""What can happen to a run: it is killed, the disk is full, files are cut, another run is there."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest
import tyro
from test_runner import MOTIONS, ROOT, by_environment, run, toys  # noqa: F401 (a fixture)

from iflow_gym import results
from iflow_gym.baselines import run_all
from iflow_gym.baselines.run_all import RunOptions
from iflow_gym.baselines.runner.lock import LOCK_NAME, FolderInUseError, output_lock
from iflow_gym.baselines.runner.store import (
    CannotWriteError,
    cannot_write,
    model_is_whole,
    no_room,
    store,
)
from iflow_gym.results import read_result, read_results

ONE = MOTIONS[:1]


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_run_that_is_killed_leaves_no_workers_and_the_next_one_goes_on(toys, tmp_path):  # noqa: F811
    output, scratch = tmp_path / "results", tmp_path / "scratch"
    scratch.mkdir()
    (toys / "sleep-Toy-C").touch()
    command = ["--preset", "smoke", "--jobs", "1", "--methods", "toys:Toy", "--envs", *MOTIONS]
    process = subprocess.Popen(
        [sys.executable, ROOT / "baselines" / "run_all.py", *command, "--output", output],
        cwd=toys,
        env={**os.environ, "TMPDIR": str(scratch)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 120
    while len(list(output.glob("*/*.json"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    workers = psutil.Process(process.pid).children(recursive=True)
    assert workers
    assert list(scratch.glob("iflow-gym-run-*"))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert psutil.wait_procs(workers, timeout=30)[1] == []
    assert not list(scratch.glob("iflow-gym-run-*"))
    assert (output / LOCK_NAME).exists()  # nobody took leave
    (output / "toy" / "Toy-C-v0.reproduction.seed0.json.1.partial").write_text("{")
    done = read_results(output)
    assert len(done) == 2
    (toys / "sleep-Toy-C").unlink()
    status, text = run(output, "toys:Toy", jobs=1)
    assert status == 0
    assert "3 cells, 2 up to date, 1 to do" in text
    assert [r for r in read_results(output) if r in done] == done
    assert not (output / LOCK_NAME).exists()


def test_a_second_run_into_a_folder_is_refused_and_changes_nothing(tmp_path, monkeypatch, capsys):
    output = tmp_path / "results"
    output.mkdir()
    arguments = ["--methods", "replay", "--envs", "LASA-Line-v0", "--output", str(output)]
    monkeypatch.setattr(sys, "argv", ["run_all.py", *arguments])
    monkeypatch.setattr(signal, "signal", lambda *of: None)
    with output_lock(output), pytest.raises(SystemExit) as stopped:
        run_all.main()
    assert stopped.value.code == 3
    said = capsys.readouterr().err
    assert said.startswith(f"run_all.py: Another run writes into {output} (process {os.getpid()}")
    assert "Nothing was changed." in said
    assert list(output.iterdir()) == []


def test_a_lock_goes_with_its_holder_and_what_it_left_is_taken(tmp_path):
    (tmp_path / LOCK_NAME).write_text("left by a run that was killed")
    with output_lock(tmp_path):
        holder = json.loads((tmp_path / LOCK_NAME).read_text())
        assert holder["pid"] == os.getpid()
        with pytest.raises(FolderInUseError), output_lock(tmp_path):
            pass
        assert (tmp_path / LOCK_NAME).exists()  # the one that was refused removed nothing
    assert list(tmp_path.iterdir()) == []
    with output_lock(tmp_path):
        pass


def test_a_full_disk_ends_a_run_and_fails_no_cell(toys, tmp_path):  # noqa: F811
    output = tmp_path / "results"
    assert run(output, "toys:Toy", envs=ONE, jobs=1)[0] == 0
    before = {path: path.read_bytes() for path in output.rglob("*.*")}
    (toys / "full-Toy-A").touch()
    with pytest.raises(CannotWriteError, match="No space left on device"):
        run(output, "toys:Toy", envs=ONE, jobs=1, force=True)
    assert {path: path.read_bytes() for path in output.rglob("*.*")} == before


@pytest.mark.skipif(
    sys.platform != "linux"
    or os.geteuid() != 0
    or shutil.which("mount") is None
    or shutil.which("dd") is None,
    reason="mounts a small file system",
)
def test_on_a_disk_that_fills_up_what_was_written_stays(toys, tmp_path):  # noqa: F811
    output = tmp_path / "results"
    output.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(output)]
    if subprocess.run(mounting, capture_output=True, check=False).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        assert run(output, "toys:Toy", envs=ONE, jobs=1)[0] == 0
        done = read_results(output)
        filler = output / "filler"
        subprocess.run(["dd", "if=/dev/zero", f"of={filler}"], capture_output=True, check=False)
        with pytest.raises(CannotWriteError, match="No space left on device"):
            run(output, "toys:Toy", envs=MOTIONS, jobs=1)
        assert read_results(output) == done
        assert not list(output.rglob("*.partial"))
        filler.unlink()
        status, text = run(output, "toys:Toy", envs=MOTIONS, jobs=1)
        assert status == 0
        assert "3 cells, 1 up to date, 2 to do" in text
    finally:
        subprocess.run(["umount", str(output)], check=True)


@pytest.mark.parametrize(
    ("obstacle", "is_folder", "message"),
    [
        (LOCK_NAME, True, "Is a directory"),
        ("toy", False, "Not a directory"),
        ("toy/Toy-A-v0.reproduction.seed0.json", True, "Is a directory"),
    ],
)
def test_what_is_in_the_way_of_a_record_is_named_before_anything_is_fitted(
    toys,  # noqa: F811
    tmp_path,
    obstacle,
    is_folder,
    message,
):
    output = tmp_path / "results"
    path = output / obstacle
    path.parent.mkdir(parents=True)
    path.mkdir() if is_folder else path.touch()
    with pytest.raises(CannotWriteError, match=f"{message}: .*move it away") as refused:
        run(output, "toys:Toy", envs=ONE, jobs=1)
    assert str(path) in str(refused.value)
    assert not list(output.rglob("*.safetensors"))


def test_a_disk_says_where_it_is_full_and_a_right_that_lacks_how_to_go_on(tmp_path):
    full = cannot_write(OSError(errno.ENOSPC, "No space left on device"), tmp_path)
    assert str(full) == f"OSError: [Errno 28] No space left on device, in {tmp_path}"
    refused = cannot_write(PermissionError(errno.EACCES, "Permission denied", "a/.lock"), tmp_path)
    assert "Permission denied: 'a/.lock'; you need the right to read and write" in str(refused)


def test_a_record_and_its_model_change_together_or_not_at_all(toys, tmp_path, monkeypatch):  # noqa: F811
    output = tmp_path / "results"
    run(output, "toys:Toy", envs=ONE, jobs=1)
    (record,) = output.glob("*/*.json")
    result = read_result(record)
    before = {path: path.read_bytes() for path in output.rglob("*.*")}

    def full(*of):
        raise OSError(errno.ENOSPC, "No space left on device")

    for calls in (0, 1):  # of the model, then of the record
        left = [None] * calls
        with monkeypatch.context() as context:
            context.setattr(
                results.os, "fsync", lambda *of, left=left: left.pop() if left else full()
            )
            with pytest.raises(OSError, match="No space") as failed:
                store(output, result, b"another model")
        assert no_room(failed.value)
        assert {path: path.read_bytes() for path in output.rglob("*.*")} == before
    store(output, result, b"another model")
    assert record.with_suffix(".safetensors").read_bytes() == b"another model"
    store(output, result, None)
    assert not record.with_suffix(".safetensors").exists()
    assert not no_room(OSError(errno.ENOENT, "No such file"))


def test_files_that_were_cut_are_named_and_done_again(toys, tmp_path):  # noqa: F811
    output = tmp_path / "results"
    run(output, "toys:Toy", jobs=1)
    a, b, c = (output / "toy" / f"{name}.reproduction.seed0.json" for name in MOTIONS)
    kept = read_result(c)
    a.write_text(a.read_text()[:100])
    model = b.with_suffix(".safetensors")
    assert model_is_whole(model)
    model.write_bytes(model.read_bytes()[:-3])
    assert not model_is_whole(model)
    status, text = run(output, "toys:Toy", jobs=1, json=tmp_path / "said.json")
    assert status == 0
    assert "3 cells, 1 up to date, 2 to do" in text
    assert f"Done again: {a} is no whole JSON file" in text
    assert f"Done again: {model} is no whole model file" in text
    assert model_is_whole(model)
    assert by_environment(output, "toy")[MOTIONS[2]] == kept

    said = json.loads((tmp_path / "said.json").read_text())
    assert (said["cells"], said["up_to_date"], said["failed"]) == (3, 1, 0)
    (row,) = said["methods"].values()
    assert row["cells"] == 2
    assert row["cpu_seconds"] > 0
    assert row["seconds"] <= said["wall_seconds"]  # by one worker
    assert "What each method took of this run" in text


@pytest.mark.parametrize(
    "content", [b"", b"\x08\0\0\0\0\0\0\0", b"\xff" * 20, b"\x02\0\0\0\0\0\0\0[]"]
)
def test_what_is_no_model_file_is_not_whole(tmp_path, content):
    path = tmp_path / "model.safetensors"
    path.write_bytes(content)
    assert not model_is_whole(path)
    assert not model_is_whole(tmp_path / "absent")


def test_one_method_or_several_are_asked_for_by_either_word():
    for word in ("--method", "--methods"):
        options = tyro.cli(RunOptions, args=[word, "my_package:MyMethod", "linear"])
        assert options.methods == ("my_package:MyMethod", "linear")


def test_only_errors_of_the_disk_are_told_in_a_line():
    told = run_all._why_it_ended(OSError(errno.ENOSPC, "No space left on device"))
    assert "make room" in told
    assert run_all._why_it_ended(CannotWriteError("full")) is not None
    assert run_all._why_it_ended(OSError(errno.ENOENT, "No such file")) is None
