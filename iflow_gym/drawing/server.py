"""Serving the page on the loopback address."""

from __future__ import annotations

import os
import socket
import sys
import threading
import webbrowser
from pathlib import Path

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
    preview_steps: int = 150,
    steps: int = 600,
    full_steps: int | None = None,
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
    preview_steps, steps : int
        Of ImitationFlow's first two trainings: the preview and what replaces it.
    full_steps : int or None
        Of the one that "refine" asks for; None takes the method's default.

    Raises
    ------
    ServingError
        If the extra is not installed, or the port is taken.
    ValueError
        If a number of steps is none.
    """
    for name, value in (("preview_steps", preview_steps), ("steps", steps), ("full_steps", full_steps)):
        if value is not None and value < 1:
            raise ValueError(f"Expected {name} >= 1, got {value}.")
    try:
        import uvicorn

        from iflow_gym.drawing.app import make_app
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "anyio", "h11", "click"):
            raise
        raise ServingError(
            f"Expected the extra draw to be installed, got {error}: pip install 'iflow-gym[draw]'."
        ) from error
    with _listening(port) as listener:
        port = listener.getsockname()[1]
        hosts = [f"{HOST}:{port}", f"localhost:{port}"]
        if port == 80:
            hosts += [HOST, "localhost"]
        app = make_app(
            hosts,
            Path(directory).absolute(),
            preview_steps=preview_steps,
            steps=steps,
            full_steps=full_steps,
        )
        address = f"http://{HOST}:{port}/"
        print(f"Draw at {address} (Ctrl-C ends it).", flush=True)
        # The methods are imported while the page is opened and drawn on.
        threading.Thread(target=_warm_up, daemon=True).start()
        if open_browser and not webbrowser.open(address):
            print("No browser was found: open the address in one.", file=sys.stderr)
        config = uvicorn.Config(
            app, log_level="warning", server_header=False, timeout_graceful_shutdown=1
        )
        uvicorn.Server(config).run(sockets=[listener])


def _listening(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if os.name == "posix":  # elsewhere it would let two servers share a port
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise ServingError(
            f"Expected port {port} of {HOST} to be free, got: {error}. Choose another by --port; 0 "
            "takes any that is free."
        ) from error
    listener.listen(128)
    return listener


def _warm_up() -> None:
    from iflow_gym.drawing.fits import method_entries

    method_entries()
