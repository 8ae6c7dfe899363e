"""The page and what it asks for, as an ASGI application.

    GET  /, /draw.js, /draw.css
    GET  /api/methods                   what can be fitted
    POST /api/fits                      {kind, method, strokes} -> a fit that runs
    GET  /api/fits/{id}                 how far it is
    POST /api/fits/{id}/refine, /stop
    GET  /api/fits/{id}/field           velocities on a grid, from the newest model
    POST /api/fits/{id}/paths           {starts} -> where points go
    POST /api/fits/{id}/save            {name} -> the files

Lengths are millimetres, times seconds. What is wrong comes back as ``{"error": "..."}`` with a
sentence for the person at the page.
"""

from __future__ import annotations

import dataclasses
import json
import math
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from iflow_gym.baselines.registry import METHODS
from iflow_gym.drawing.local_only import LocalOnly
from iflow_gym.drawing.saving import save_drawing
from iflow_gym.drawing.strokes import KINDS, DrawingError, drawing_of
from iflow_gym.drawing.training_steps import TrainingSteps

PAGE_FILES = {
    "/": ("index.html", "text/html"),
    "/draw.js": ("draw.js", "text/javascript"),
    "/draw.css": ("draw.css", "text/css"),
}

MOST_STROKES = 30
MOST_STARTS = 200


class _Refused(Exception):  # noqa: N818 (an answer)
    """What came cannot be done; the page says why."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


def make_app(
    hosts: Collection[str],
    directory: Path,
    steps: TrainingSteps,
) -> Starlette:
    """Return the application.

    Parameters
    ----------
    hosts : collection of str
        Host headers that are the server's own, such as ``127.0.0.1:8765``.
    directory : Path
        Where drawings are saved; made when the first is.
    steps : TrainingSteps
    """
    page = _Page(directory, steps)
    routes = [
        *(Route(path, _served(*entry), methods=["GET"]) for path, entry in PAGE_FILES.items()),
        Route("/api/methods", page.methods, methods=["GET"]),
        Route("/api/fits", page.start, methods=["POST"]),
        Route("/api/fits/{id}", page.state, methods=["GET"]),
        Route("/api/fits/{id}/refine", page.refine, methods=["POST"]),
        Route("/api/fits/{id}/stop", page.stop, methods=["POST"]),
        Route("/api/fits/{id}/field", page.field, methods=["GET"]),
        Route("/api/fits/{id}/paths", page.paths, methods=["POST"]),
        Route("/api/fits/{id}/save", page.save, methods=["POST"]),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        # The methods are imported while the page is opened and drawn on.
        threading.Thread(target=lambda: _fits_module().warm_up()).start()
        yield
        page.close()

    return Starlette(
        routes=routes,
        lifespan=lifespan,
        middleware=[Middleware(LocalOnly, hosts=hosts)],
        exception_handlers={_Refused: _refused},
    )


def _served(name: str, media_type: str) -> Callable[[Request], Awaitable[Response]]:
    content = (files("iflow_gym.drawing") / "page" / name).read_bytes()

    async def serve(_: Request) -> Response:
        return Response(content, media_type=media_type)

    return serve


async def _refused(_: Request, error: Exception) -> Response:
    assert isinstance(error, _Refused)
    return JSONResponse({"error": str(error)}, error.status)


_IMPORTING = threading.Lock()


def _fits_module() -> Any:
    """Return `fits`, which imports torch: seconds that the page need not wait for."""
    with _IMPORTING:
        from iflow_gym.drawing import fits

    return fits


class _Page:
    """What the routes do."""

    def __init__(self, directory: Path, steps: TrainingSteps) -> None:
        self._directory, self._steps = directory, steps
        self._made: Any = None
        self._making = threading.Lock()

    def _fits(self) -> Any:
        with self._making:
            if self._made is None:
                self._made = _fits_module().Fits(self._steps)
        return self._made

    def close(self) -> None:
        if self._made is not None:
            self._made.close()

    async def methods(self, _: Request) -> Response:
        def listed() -> list[dict[str, Any]]:
            return [dataclasses.asdict(entry) for entry in _fits_module().method_entries()]

        return JSONResponse({"methods": await run_in_threadpool(listed)})

    async def start(self, request: Request) -> Response:
        asked = await _json(request)
        strokes, kind, method = (asked.get(key) for key in ("strokes", "kind", "method"))
        if not isinstance(strokes, list) or len(strokes) > MOST_STROKES:
            raise _Refused(422, f"Expected a list of at most {MOST_STROKES} strokes: delete some.")
        if kind not in KINDS:
            raise _Refused(422, f"Expected a kind among {', '.join(KINDS)}, got {kind!r}.")

        def begin() -> dict[str, Any]:
            fits, entry = self._fits(), None
            if isinstance(method, str) and method in METHODS:
                entry = _fits_module().entry_of(method)
            if entry is None:
                raise _Refused(422, f"Expected a method that learns a field, got {method!r}.")
            if not getattr(entry, kind):
                ends = "end at a point" if kind == "goal" else "go round"
                raise _Refused(
                    422,
                    f"{entry.title} does not learn motions that {ends}: choose another method.",
                )
            drawing = drawing_of(strokes, kind)
            fit = fits.start(drawing, method)
            motion = drawing.demonstrations
            return {
                "id": fit.id,
                "notices": drawing.notices,
                "demonstrations": [_rounded(p) for p in motion.positions],
                "goal": None if motion.goal is None else _rounded(motion.goal),
                "period": motion.period,
                "duration": float(motion.durations.mean()),
                "refines": entry.refines,
            }

        try:
            return JSONResponse(await run_in_threadpool(begin), 202)
        except DrawingError as error:
            raise _Refused(422, str(error)) from error

    def _fit(self, request: Request) -> Any:
        key = request.path_params["id"]
        try:
            return self._made[key]
        except (KeyError, TypeError):  # TypeError: nothing has been fitted
            raise _Refused(404, "This fit is no longer there: press “Fit” again.") from None

    async def state(self, request: Request) -> Response:
        fit = self._fit(request)
        with fit.lock:
            told = {
                "state": fit.state,
                "message": fit.message,
                "label": fit.label,
                "progress": round(fit.progress, 3),
                "version": len(fit.models),
            }
        return JSONResponse(told)

    async def refine(self, request: Request) -> Response:
        fit = self._fit(request)
        if not self._made.refine(fit):
            raise _Refused(409, "This fit is still running: wait, or stop it first.")
        return JSONResponse({}, 202)

    async def stop(self, request: Request) -> Response:
        self._fit(request).stop.set()
        return JSONResponse({}, 202)

    def _newest(self, fit: Any) -> Any:
        newest = fit.newest()
        if newest is None:
            raise _Refused(409, "Nothing is fitted yet: wait for the first model.")
        return newest

    async def field(self, request: Request) -> Response:
        from iflow_gym.drawing.motion import HALF, N_GRID, field_on_grid

        version, model = self._newest(self._fit(request))

        def shown() -> dict[str, Any]:
            guarantee = model.system.guarantee
            return {
                "version": version,
                "half": HALF,
                "n": N_GRID,
                "velocities": _rounded(field_on_grid(model.system).reshape(-1)),
                "guarantee": {"kind": guarantee.kind, "reason": guarantee.reason},
                "method": model.system.title,
                "label": model.label,
                "error": model.error if math.isfinite(model.error) else None,
                "cpu_seconds": model.cpu_seconds,
            }

        return JSONResponse(await run_in_threadpool(shown))

    async def paths(self, request: Request) -> Response:
        from iflow_gym.drawing.motion import LOST, paths_from, step_time

        fit = self._fit(request)
        version, model = self._newest(fit)
        asked = await _json(request)
        try:
            starts = np.array(asked.get("starts"), dtype=np.float64).reshape(-1, 2)
        except (TypeError, ValueError):
            starts = np.full((1, 2), np.nan)
        if len(starts) > MOST_STARTS or not (np.abs(starts) < LOST).all():
            raise _Refused(
                422, f"Expected at most {MOST_STARTS} starts [x, y] within {LOST:g} mm: take fewer."
            )

        def followed() -> dict[str, Any]:
            found = paths_from(model.system, fit.demonstrations, starts)
            return {
                "version": version,
                "dt": step_time(fit.demonstrations),
                "paths": [_rounded(path) for path, _ in found],
                "lost": [lost for _, lost in found],
            }

        return JSONResponse(await run_in_threadpool(followed))

    async def save(self, request: Request) -> Response:
        fit = self._fit(request)
        _, model = self._newest(fit)
        name = (await _json(request)).get("name", "")
        if not isinstance(name, str):
            raise _Refused(422, "Expected a name of letters and digits.")
        try:
            saved = await run_in_threadpool(
                save_drawing, self._directory, name, fit.demonstrations, model.content
            )
        except OSError as error:
            raise _Refused(500, f"Could not write into {self._directory}: {error}.") from error
        return JSONResponse({"files": [str(path) for path in saved]}, 201)


async def _json(request: Request) -> dict[str, Any]:
    """Return a request's JSON object."""
    try:
        found = json.loads(await request.body() or b"{}")
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise _Refused(422, "Expected a JSON object.")
    return found


def _rounded(array: np.ndarray[Any, Any]) -> Any:
    """Return numbers to 1e-5 mm as nested lists, None for what is not finite."""
    finite = np.isfinite(array)
    listed = np.round(array, 5).astype(object)
    listed[~finite] = None
    return listed.tolist()
