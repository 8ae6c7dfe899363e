"""A server of the page, as a user starts it."""

import re
import signal
import subprocess
import sys

import pytest


class Server:
    """Where the page is, and where it saves."""

    def __init__(self, port, folder):
        self.port, self.folder = port, folder
        self.address = f"http://127.0.0.1:{port}"


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    """`python -m iflow_gym.drawing` with few steps; at the end Ctrl-C ends it without a word."""
    for name in ("starlette", "uvicorn"):
        pytest.importorskip(name, reason="the page needs its extra: pip install -e '.[draw]'")
    folder = tmp_path_factory.mktemp("drawing") / "saved"
    command = [sys.executable, "-m", "iflow_gym.drawing", "--port", "0", "--no-open"]
    command += ["--directory", str(folder), "--steps.preview", "20", "--steps.quick", "60"]
    process = subprocess.Popen(
        [*command, "--steps.full", "100"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        said = process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:(\d+)/", said)
        assert found, said + process.stderr.read()
        yield Server(int(found.group(1)), folder)
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60) == ("", "")
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()
