"""The server: what it answers, and whom it refuses."""

import http.client
import json
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from drawing_hands import ellipse, reach

from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.orbit_field import OrbitField
from iflow_gym.baselines.registry import METHODS
from iflow_gym.drawing import ServingError, serve

local_only = pytest.importorskip(
    "iflow_gym.drawing.local_only",
    reason="the page needs its extra: pip install -e '.[draw]'",
    exc_type=ModuleNotFoundError,
)
MOST_BYTES = local_only.MOST_BYTES


@pytest.fixture
def ask(server):
    """Asks the server as its own page does; returns status, headers and JSON or text."""

    def asked(method, path, body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        own = {"Origin": server.address} | {k.replace("_", "-"): v for k, v in headers.items()}
        content = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        connection.request(method, path, content, {k: v for k, v in own.items() if v is not None})
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        as_json = answer.headers.get_content_type() == "application/json"
        return answer.status, answer.headers, json.loads(text) if as_json else text

    return asked


def strokes(*arrays):
    return [array.tolist() for array in arrays]


@pytest.fixture
def fit(ask):
    """Starts a fit and waits for its end; returns its answer and the last state."""

    def fitted(kind, method, *arrays):
        asked = {"kind": kind, "method": method, "strokes": strokes(*arrays)}
        status, _, answer = ask("POST", "/api/fits", asked)
        assert status == 202, answer
        while (told := ask("GET", f"/api/fits/{answer['id']}")[2])["state"] == "running":
            time.sleep(0.05)
        return answer, told

    return fitted


def test_the_page_loads_nothing_from_elsewhere(ask):
    for path, kind in (
        ("/", "text/html"),
        ("/draw.js", "text/javascript"),
        ("/draw.css", "text/css"),
    ):
        status, headers, text = ask("GET", path)
        assert (status, headers.get_content_type()) == (200, kind)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert "http://www.w3.org" in text or "http" not in text.replace("http-equiv", "")
    assert ask("GET", "/api/nothing")[0] == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1:1", "", "localhost"]
)
def test_a_foreign_host_is_refused(ask, server, host):
    status, headers, answer = ask("GET", "/", Host=host.format(port=server.port))
    assert status == 421
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "Expected the host" in answer["error"]


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", None, "https://127.0.0.1:{port}"]
)
@pytest.mark.parametrize("path", ["/api/fits", "/api/fits/x/save", "/api/fits/x/stop"])
def test_a_foreign_origin_changes_nothing(ask, server, origin, path):
    origin = origin and origin.format(port=server.port)
    status, _, answer = ask("POST", path, {}, Origin=origin)
    assert status == 403
    assert "the page itself" in answer["error"]


def test_localhost_is_the_server_too(ask, server):
    own = f"localhost:{server.port}"
    assert ask("GET", "/", Host=own)[0] == 200
    assert ask("POST", "/api/fits", {}, Host=own, Origin=f"http://{own}")[0] == 422


def test_too_large_a_request_is_refused(ask, server):
    assert ask("POST", "/api/fits", b" " * (MOST_BYTES + 1))[0] == 413
    with socket.create_connection(("127.0.0.1", server.port)) as connection:  # no length is told
        connection.sendall(
            f"POST /api/fits HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
            f"Origin: {server.address}\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
        )
        chunk = b"100000\r\n" + b" " * 0x100000 + b"\r\n"
        for _ in range(MOST_BYTES // 0x100000 + 1):
            connection.sendall(chunk)
        assert connection.recv(12) == b"HTTP/1.1 413"


@pytest.mark.skipif(sys.platform != "linux", reason="all of 127.0.0.0/8 is the machine's on Linux")
def test_it_listens_on_one_address(server):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", server.port), timeout=5)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"no json", "JSON object"),
        (b"[" * 100_000, "JSON object"),
        ([], "JSON object"),
        ({}, "list of at most"),
        ({"strokes": [[]] * 31, "kind": "goal"}, "list of at most"),
        ({"strokes": [], "kind": ["goal"]}, "a kind among goal, cycle"),
        ({"strokes": [], "kind": "goal", "method": "os:system"}, "a method that learns a field"),
        ({"strokes": [], "kind": "goal", "method": {}}, "a method that learns a field"),
        ({"strokes": [], "kind": "goal", "method": "dmp"}, "a method that learns a field"),
        ({"strokes": [], "kind": "cycle", "method": "seds"}, "not learn motions that go round"),
        ({"strokes": [], "kind": "goal", "method": "linear"}, "nothing to fit"),
        ({"strokes": [[[0, float("nan"), 1]]], "kind": "goal", "method": "linear"}, "finite"),
        ({"strokes": [[[0, 1e999, 1]]], "kind": "goal", "method": "linear"}, "finite"),
    ],
)
def test_what_cannot_be_fitted_is_said(ask, body, words):
    status, _, answer = ask("POST", "/api/fits", body)
    assert status == 422
    assert words in answer["error"]


def test_methods(ask):
    offered = ask("GET", "/api/methods")[2]["methods"]
    assert {entry["name"] for entry in offered} < set(METHODS)
    assert {entry["name"] for entry in offered if entry["cycle"]} >= {"imitation-flow", "lwr"}


def test_from_strokes_to_files(ask, fit, server):
    """What the page is shown is what the saved model says."""
    answer, told = fit("goal", "imitation-flow", *(reach(k) for k in range(3)))
    assert (told["state"], told["version"]) == ("done", 2)
    assert answer["refines"]
    assert answer["demonstrations"][0][-1] == pytest.approx(answer["goal"])
    at = f"/api/fits/{answer['id']}"
    field = ask("GET", f"{at}/field")[2]
    assert field["guarantee"]["kind"] == "proved"
    assert field["label"] == "60 steps"
    start = [-33.0, 41.0]
    paths = ask("POST", f"{at}/paths", {"starts": [start, start]})[2]
    assert paths["lost"] == [False, False]
    for name in ("files", "files-2"):
        status, _, saved = ask("POST", f"{at}/save", {"name": "../files"})
        assert status == 201
        assert saved["files"] == [
            str(server.folder / f"{name}.{e}") for e in ("csv", "safetensors")
        ]
    system = ImitationFlow.load(saved["files"][1])
    nodes = np.linspace(-field["half"], field["half"], field["n"])
    grid = np.stack(np.meshgrid(nodes, nodes), axis=-1)
    shown = np.reshape(field["velocities"], grid.shape)
    assert shown == pytest.approx(system.velocity(grid), abs=1e-5)
    path = np.array(paths["paths"][0])
    assert path == pytest.approx(system.rollout(start, len(path) - 1, paths["dt"]), abs=1e-5)
    # Refined, and what is saved then is the refined one.
    assert ask("POST", f"{at}/refine", {})[0] == 202
    assert ask("POST", f"{at}/refine", {})[0] == 409
    while ask("GET", at)[2]["state"] == "running":
        time.sleep(0.05)
    assert ask("GET", f"{at}/field")[2]["version"] == 3
    files = ask("POST", f"{at}/save", {"name": "files"})[2]["files"]
    assert ImitationFlow.load(files[1]).config.n_steps == 100


def test_a_cycle_by_another_method(ask, fit, server):
    answer, told = fit("cycle", "orbit-field", ellipse(3))
    assert told["state"] == "done"
    assert not answer["refines"]
    assert answer["period"] == pytest.approx(0.8, rel=0.02)
    files = ask("POST", f"/api/fits/{answer['id']}/save", {"name": "round"})[2]["files"]
    assert OrbitField.load(files[1]).period_ == answer["period"]


def test_starts_and_names_are_checked(ask, fit):
    answer, _ = fit("goal", "linear", reach())
    at = f"/api/fits/{answer['id']}"
    for starts in ([[1]], "x", [[1e9, 0]], [[0, None]], [[0, 0]] * 201, None):
        assert ask("POST", f"{at}/paths", {"starts": starts})[0] == 422
    assert ask("POST", f"{at}/paths", {"starts": []})[2]["paths"] == []
    assert ask("POST", f"{at}/save", {"name": 3})[0] == 422
    for path in ("", "/field"):
        assert ask("GET", f"/api/fits/none{path}")[0] == 404


def test_a_port_that_is_taken_is_said(server):
    with pytest.raises(ServingError, match=rf"port {server.port} .* to be free.*--port"):
        serve(server.port, open_browser=False)
    with pytest.raises(ServingError, match="a port from 0 to 65535, got 99999"):
        serve(99999, open_browser=False)
    command = [sys.executable, "-m", "iflow_gym.drawing", "--no-open", "--port", str(server.port)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "Traceback" not in done.stderr


def test_without_the_extra_its_name_is_said(monkeypatch):
    for name in [m for m in sys.modules if m.split(".")[0] in ("uvicorn", "starlette")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    with pytest.raises(ServingError, match=r"iflow-gym\[draw\]"):
        serve(0, open_browser=False)
