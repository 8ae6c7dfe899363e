"""The authors' recordings: from a mirror, by download, and what happens when neither works."""

import hashlib
import http.server
import io
import os
import socket
import threading
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from iflow_gym.datasets import recorded
from iflow_gym.datasets.recorded import (
    FILES,
    RecordedFile,
    load_recorded_drums,
    load_recorded_letter,
)
from iflow_gym.rounds import round_starts, turning

ROOT = Path(__file__).parents[1]


def real_mirror():
    named = os.environ.get("IFLOW_GYM_RECORDED")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    return folder if (folder / "letters_recorded").is_dir() else None


MIRROR = real_mirror()
needs_mirror = pytest.mark.skipif(MIRROR is None, reason="no mirror of the authors' recordings")


@pytest.fixture
def content(monkeypatch):
    """Stand in for the file of I, with two ellipses, so that no mirror is needed."""
    t = np.arange(150) / 60
    path = np.column_stack([0.2 * np.cos(2 * np.pi * t), 0.5 * np.sin(2 * np.pi * t)])
    file = io.BytesIO()
    np.save(file, np.stack([path, 1.1 * path]))
    content = file.getvalue()
    digest = hashlib.sha256(content).hexdigest()
    stand_in = RecordedFile(FILES["I"].path, FILES["I"].mirrored, digest)
    monkeypatch.setitem(recorded.FILES, "I", stand_in)
    monkeypatch.setattr(recorded, "_PERIODS", {})
    monkeypatch.delenv("IFLOW_GYM_RECORDED", raising=False)
    return content


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Put pooch's cache into an empty folder."""
    pooch = pytest.importorskip("pooch")
    folder = tmp_path / "cache"
    monkeypatch.setattr(pooch, "os_cache", lambda name: folder / name)
    for variable in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(variable, raising=False)
    return folder


class Quiet(http.server.SimpleHTTPRequestHandler):
    short = False

    def log_message(self, *args):
        pass

    def end_headers(self):
        self.server.requests += 1
        super().end_headers()

    def copyfile(self, source, outputfile):
        data = source.read()
        outputfile.write(data[: len(data) // 2] if self.short else data)


@pytest.fixture
def serve(tmp_path, monkeypatch):
    """Serve bytes as the file of I, whole or cut short half way."""
    servers = []

    def start(data, short=False):
        target = tmp_path / "served" / FILES["I"].path
        target.parent.mkdir(parents=True)
        target.write_bytes(data)
        handler = type("Handler", (Quiet,), {"short": short})
        server = http.server.ThreadingHTTPServer(
            ("127.0.0.1", 0), partial(handler, directory=str(tmp_path / "served"))
        )
        server.requests = 0
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        monkeypatch.setattr(recorded, "BASE_URL", f"http://127.0.0.1:{server.server_port}")
        return server

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def files_in(folder):
    return [p for p in folder.rglob("*") if p.is_file()]


def put(folder, data):
    target = folder / FILES["I"].mirrored
    target.parent.mkdir(parents=True)
    target.write_bytes(data)
    return folder


def test_a_mirror_by_argument_and_by_variable(content, tmp_path, monkeypatch):
    mirror = put(tmp_path / "mirror", content)
    by_argument = load_recorded_letter("I", mirror=mirror)
    monkeypatch.setenv("IFLOW_GYM_RECORDED", str(mirror))
    by_variable = load_recorded_letter("I")
    assert by_argument.sha256 == by_variable.sha256
    np.testing.assert_array_equal(by_argument.positions, np.load(io.BytesIO(content)))
    assert by_argument.period == pytest.approx(0.6, rel=0.01)
    assert by_argument.dt == (0.01, 0.01)


def test_the_argument_comes_before_the_variable(content, tmp_path, monkeypatch):
    monkeypatch.setenv("IFLOW_GYM_RECORDED", str(tmp_path / "nowhere"))
    assert len(load_recorded_letter("I", mirror=put(tmp_path / "mirror", content))) == 2


def test_a_mirror_without_the_file_says_where_to_put_it(content, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"the mirror that mirror= names(.|\n)*IShape\.npy"):
        load_recorded_letter("I", mirror=tmp_path)
    monkeypatch.setenv("IFLOW_GYM_RECORDED", str(tmp_path))
    with pytest.raises(FileNotFoundError) as caught:
        load_recorded_letter("I")
    for words in (
        "IFLOW_GYM_RECORDED names",
        f"{recorded.BASE_URL}/IROS_dataset/IShape.npy",
        str(tmp_path / "letters_recorded" / "IShape.npy"),
    ):
        assert words in str(caught.value)


@pytest.mark.parametrize("kind", ["another", "truncated", "empty"])
def test_a_wrong_file_in_the_mirror_is_not_read(content, tmp_path, kind):
    data = {"another": content[:-1] + b"!", "truncated": content[:-7], "empty": b""}[kind]
    mirror = put(tmp_path / "mirror", data)
    expected = recorded.FILES["I"].sha256
    with pytest.raises(ValueError, match=rf"with sha256 {expected}, got .* \({len(data)} bytes\)"):
        load_recorded_letter("I", mirror=mirror)


def test_a_download_is_kept_and_not_repeated(content, cache, serve, capfd):
    server = serve(content)
    first = load_recorded_letter("I")
    assert server.requests == 1
    again = load_recorded_letter("I")
    assert server.requests == 1
    assert first.sha256 == again.sha256
    (kept,) = files_in(cache)
    assert kept.read_bytes() == content
    output = capfd.readouterr()
    assert output.out == ""
    assert "Downloading" not in output.err


def test_a_spoilt_file_in_the_cache_is_downloaded_again(content, cache, serve):
    serve(content)
    load_recorded_letter("I")
    (kept,) = files_in(cache)
    kept.write_bytes(content[:100])
    assert len(load_recorded_letter("I")) == 2
    assert kept.read_bytes() == content


def test_a_download_with_another_hash_leaves_nothing(content, cache, serve):
    serve(content[:-1] + b"!")
    with pytest.raises(ValueError, match=r"got another file(.|\n)*IFLOW_GYM_RECORDED"):
        load_recorded_letter("I")
    assert files_in(cache) == []


def test_a_connection_that_breaks_leaves_nothing(content, cache, serve):
    serve(content, short=True)
    with pytest.raises((OSError, ValueError), match="set IFLOW_GYM_RECORDED to that folder"):
        load_recorded_letter("I")
    assert files_in(cache) == []


def test_an_interrupted_download_leaves_nothing(content, cache, serve, monkeypatch):
    import requests

    serve(content)

    def interrupted(self, chunk_size=1, decode_unicode=False):
        yield content[:100]
        raise KeyboardInterrupt

    monkeypatch.setattr(requests.Response, "iter_content", interrupted)
    with pytest.raises(KeyboardInterrupt):
        load_recorded_letter("I")
    assert files_in(cache) == []
    monkeypatch.undo()


def test_an_address_that_does_not_answer_says_how_to_get_the_file(content, cache, monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    base = f"http://127.0.0.1:{port}"
    monkeypatch.setattr(recorded, "BASE_URL", base)
    with pytest.raises(OSError, match="could not be downloaded") as caught:
        load_recorded_letter("I")
    for words in (
        f"save {base}/IROS_dataset/IShape.npy as letters_recorded/IShape.npy",
        "set IFLOW_GYM_RECORDED",
        "mirror=",
    ):
        assert words in str(caught.value)
    assert files_in(cache) == []


def test_a_missing_page_is_no_recording(content, cache, serve, monkeypatch):
    server = serve(content)
    monkeypatch.setattr(recorded, "BASE_URL", f"http://127.0.0.1:{server.server_port}/elsewhere")
    with pytest.raises(OSError, match="404"):
        load_recorded_letter("I")
    assert files_in(cache) == []


def test_a_cache_that_cannot_be_written_says_so(content, cache, serve):
    serve(content)
    cache.write_text("a file where the folder should be")
    with pytest.raises(OSError, match=r"could not be downloaded into .*cache(.|\n)*mirror="):
        load_recorded_letter("I")
    assert cache.read_text() == "a file where the folder should be"


def test_addresses_are_those_of_a_fixed_commit():
    assert recorded.BASE_URL == (
        "https://raw.githubusercontent.com/TheCamusean/iflow/"
        "bbab87a69727a21a4989d98e5074e8019a6cc5f0/data"
    )
    assert {k: f.path for k, f in FILES.items()} == {
        "I": "IROS_dataset/IShape.npy",
        "R": "IROS_dataset/RShape.npy",
        "O": "IROS_dataset/OShape.npy",
        "S": "IROS_dataset/SShape.npy",
        "drums": "DRUMS_dataset/Drums.npy",
    }


@pytest.mark.parametrize(("letter", "nearest"), [("i", "I"), ("SShape", "S")])
def test_an_unknown_letter_gets_the_nearest(letter, nearest):
    with pytest.raises(ValueError, match=f"Unknown letter '{letter}'. Did you mean '{nearest}'"):
        load_recorded_letter(letter)


@needs_mirror
@pytest.mark.parametrize(
    ("letter", "shape", "n_rounds"),
    [("I", (3, 213, 2), (3, 2, 1)), ("R", (2, 838, 2), (3, 2)), ("O", (1, 203, 2), (2,)),
     ("S", (1, 201, 2), (2,))],
)  # fmt: skip
def test_recorded_letters_and_their_rounds(letter, shape, n_rounds):
    motion = load_recorded_letter(letter, MIRROR)
    assert np.stack(motion.positions).shape == shape
    durations = []
    for p, n in zip(motion.positions, n_rounds, strict=True):
        starts = round_starts(p, 0.01)
        assert len(starts) == n + 1
        size = np.linalg.norm(np.ptp(p, axis=0))
        for a, b in pairwise(starts):
            # A simple closed curve turns once, anticlockwise here: a check that knows no returns.
            smooth = gaussian_filter1d(p, 2.0, axis=0)[a : b + 1]
            assert turning(smooth) == pytest.approx(1, abs=0.2)
            assert np.linalg.norm(p[b] - p[a]) < 0.15 * size
            durations.append((b - a) * 0.01)
    assert min(durations) * 0.95 < motion.period < max(durations) * 1.05


@needs_mirror
def test_a_round_of_drumming_is_two_strokes():
    motion = load_recorded_drums(MIRROR)
    assert np.stack(motion.positions).shape == (6, 1000, 3)
    assert motion.length_unit == "m"
    assert motion.period == pytest.approx(5.0, abs=0.1)  # README: about 5 s
    for p in motion.positions:
        a, b = round_starts(p, 0.01)[:2]
        y, z = gaussian_filter1d(p[a:b, 1:], 3.0, axis=0).T
        right, left = (y - y.min()) / np.ptp(y) > 0.75, (y - y.min()) / np.ptp(y) < 0.25
        assert visits(right) == visits(left) == 1  # there and back
        assert visits(z < z.min() + 0.25 * np.ptp(z)) == 2  # a stroke on each drum


def visits(inside):
    """Return how often a cycle enters a region."""
    return int(np.sum(inside & ~np.roll(inside, 1)))


@needs_mirror
def test_the_orientation_comes_beside_the_position():
    six, three = load_recorded_drums(MIRROR, orientation=True), load_recorded_drums(MIRROR)
    assert six.n_dims == 6
    assert six.period == three.period
    np.testing.assert_array_equal([p[:, :3] for p in six.positions], three.positions)
    assert "rad" in six.length_unit
