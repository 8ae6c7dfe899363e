"""Serving the page on the loopback address."""

from __future__ import annotations

import os
import socket
import sys
import webbrowser
from contextlib import suppress
from pathlib import Path

from iflow_gym.drawing.training_steps import TrainingSteps

HOST = "127.0.0.1"

DEFAULT_PORT = 8765

DEFAULT_DIRECTORY = "drawings"


class ServingError(RuntimeError):
    """The page cannot be served; the message says what to do."""


def serve(
    port: int = DEFAULT_PORT,
    open_browser: bool = True,
    directory: str | os.PathLike[str] = DEFAULT_DIRECTORY,
    *,
    steps: TrainingSteps | None = None,
) -> None:
    """Serve the page until it is interrupted. Needs the extra ``draw``.

    Parameters
    ----------
    port : int
        0 takes any that is free.
    open_browser : bool
        Open the page in the browser.
    directory : path
        Folder for what is saved; made when there is something.
    steps : TrainingSteps, optional
        How long ImitationFlow is trained.

    Raises
    ------
    ServingError
        If the extra is not installed, or the port is taken.
    """
    try:
        import uvicorn

        from iflow_gym.drawing.app import make_app
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "anyio", "h11", "click"):
            raise
        raise ServingError(
            f"Expected the extra draw to be installed, got {error}: pip install 'iflow-gym[draw]'."
        ) from error
    if not 0 <= port < 2**16:
        raise ServingError(f"Expected a port from 0 to 65535, got {port}.")
    if Path(directory).exists() and not Path(directory).is_dir():
        raise ServingError(f"Expected a folder for drawings at {directory}, got a file.")
    with _listening(port) as listener:
        port = listener.getsockname()[1]
        hosts = [f"{HOST}:{port}", f"localhost:{port}"]
        if port == 80:
            hosts += [HOST, "localhost"]
        app = make_app(hosts, Path(directory).absolute(), steps or TrainingSteps())
        address = f"http://{HOST}:{port}/"
        print(f"Draw at {address} (Ctrl-C ends it).", flush=True)
        if open_browser and not webbrowser.open(address):
            print("No browser was found: open the address in one.", file=sys.stderr)
        config = uvicorn.Config(
            app, log_level="warning", server_header=False, timeout_graceful_shutdown=1
        )
        with suppress(KeyboardInterrupt):  # uvicorn hands it on when it has shut down
            uvicorn.Server(config).run(sockets=[listener])


def _listening(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if os.name == "posix":  # elsewhere it would let two servers share a port
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
    except OSError as error:
        listener.close()
        raise ServingError(
            f"Expected port {port} of {HOST} to be free, got: {error}. Choose another by --port; 0 "
            "takes any that is free."
        ) from error
    listener.listen(128)
    return listener
