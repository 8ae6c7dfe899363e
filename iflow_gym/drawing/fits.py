"""Fits that run beside the page: a preview within a second or two, then what replaces it.

A fit takes a thread. `ImitationFlow` is trained several times over, each time with more steps and
from the beginning: its learning rate goes up and down once in a training, so that a short one is
better than the beginning of a long one. Other methods are fitted once, with their defaults.

A training is watched, and stopped, through its random numbers (`iflow_gym.watched_training`).
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, cast

import numpy as np

from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.drawing.motion import accuracy
from iflow_gym.drawing.strokes import Drawing
from iflow_gym.drawing.training_steps import TrainingSteps
from iflow_gym.system import DynamicalSystem
from iflow_gym.watched_training import WatchedGenerator, training_steps

SEED = 0

MOST_KEPT = 8
"""Fits that are kept for the pages that show them."""

MOST_AT_ONCE = 2
"""Fits that run at once: the newest, and one that has been told to stop and has not yet."""

DEFAULT_METHOD = "imitation-flow"

State = Literal["running", "done", "stopped", "failed"]


@dataclass(frozen=True)
class MethodEntry:
    """A method that the page offers."""

    name: str
    title: str
    goal: bool
    """Whether it learns motions that end."""
    cycle: bool
    """Whether it learns motions that repeat."""
    refines: bool
    """Whether it is trained in steps, of which there may be more."""


_IMPORTING = threading.Lock()


def load_system(name: str) -> type[DynamicalSystem] | None:
    """Return the class of a registered method; None for one that follows a clock.

    Such a one has no field to draw. Importing a method may take seconds; threads take turns, since
    two that import the same modules from two ends may meet half way.
    """
    with _IMPORTING:
        method = load_method(name)
    return method if issubclass(method, DynamicalSystem) else None


def method_entries() -> list[MethodEntry]:
    """Return the registered methods that learn a field, the default one first."""
    entries = [entry_of(name) for name in sorted(METHODS, key=lambda n: n != DEFAULT_METHOD)]
    return [entry for entry in entries if entry is not None]


def entry_of(name: str) -> MethodEntry | None:
    """Return what is to be known of a registered method; None for one that follows a clock."""
    method = load_system(name)
    if method is None:
        return None
    refines = name == DEFAULT_METHOD
    return MethodEntry(name, method.title, method.learns_goals, method.learns_cycles, refines)


def warm_up() -> None:
    """Train the default method for two steps, and import the others.

    What Python and torch do the first time is done then.
    """
    line = np.linspace(1.0, 0.0, 100)[:, None] * [1.0, 0.5]
    motion = Demonstrations.from_arrays([line], dt=0.01, length_unit="mm")
    method = load_system(DEFAULT_METHOD)
    assert method is not None
    method(n_steps=2, device="cpu").fit(motion, seed=SEED)
    method_entries()


@dataclass(frozen=True)
class Model:
    """A fitted system, as its own file gives it back."""

    system: DynamicalSystem
    content: bytes
    """The model file."""
    label: str
    """What kind of a training it is of."""
    cpu_seconds: float
    error: float
    """`motion.accuracy`."""


class Stopped(Exception):  # noqa: N818 (no error)
    """A fit was told to stop."""


@dataclass
class Fit:
    """One drawing being learned. Fields change under `lock`, but for those that are given."""

    drawing: Drawing
    method: str
    plan: list[int | None]
    """Steps of each training that is still to come; None takes the method's default."""
    id: str = field(default_factory=lambda: secrets.token_hex(8))
    lock: threading.Lock = field(default_factory=threading.Lock)
    stop: threading.Event = field(default_factory=threading.Event)
    state: State = "running"
    message: str = ""
    progress: float = 0.0
    """Share of the training that runs, from 0 to 1."""
    label: str = ""
    """Which training runs."""
    models: list[Model] = field(default_factory=list)

    @property
    def demonstrations(self) -> Demonstrations:
        """What is fitted."""
        return self.drawing.demonstrations

    def newest(self) -> tuple[int, Model] | None:
        """Return the newest model and its version, counted from 1; None before there is one."""
        with self.lock:
            return (len(self.models), self.models[-1]) if self.models else None


class Fits:
    """The fits of a server: starts them, keeps the newest, stops the one before.

    Parameters
    ----------
    steps : TrainingSteps
    """

    def __init__(self, steps: TrainingSteps | None = None) -> None:
        steps = TrainingSteps() if steps is None else steps
        self._quick = sorted({min(steps.preview, steps.quick), steps.quick})
        self._full = steps.full
        self._executor = ThreadPoolExecutor(MOST_AT_ONCE, thread_name_prefix="fit")
        self._fits: dict[str, Fit] = {}
        self._lock = threading.Lock()

    def __getitem__(self, key: str) -> Fit:
        with self._lock:
            return self._fits[key]

    def start(self, drawing: Drawing, method: str) -> Fit:
        """Start a fit; one that runs is told to stop."""
        plan: list[int | None] = [*self._quick] if method == DEFAULT_METHOD else [None]
        fit = Fit(drawing, method, plan)
        with self._lock:
            for other in self._fits.values():
                other.stop.set()
            self._fits[fit.id] = fit
            while len(self._fits) > MOST_KEPT:
                del self._fits[next(iter(self._fits))]
        self._executor.submit(_run, fit)
        return fit

    def refine(self, fit: Fit) -> bool:
        """Train a fit that rests once more, with all steps; return whether it rested."""
        with self._lock:
            others = [other for other in self._fits.values() if other is not fit]
        with fit.lock:
            if fit.state == "running":
                return False
            fit.state, fit.message, fit.progress = "running", "", 0.0
            fit.plan = [self._full]
            fit.stop.clear()
        for other in others:
            other.stop.set()
        self._executor.submit(_run, fit)
        return True

    def close(self) -> None:
        """Tell all fits to stop and let go of their threads."""
        with self._lock:
            for fit in self._fits.values():
                fit.stop.set()
        self._executor.shutdown(wait=False, cancel_futures=True)


def _run(fit: Fit) -> None:
    """Do what is planned, and leave word of how it went."""
    try:
        while fit.plan:
            if fit.stop.is_set():
                raise Stopped
            model = _train(fit, fit.plan[0])
            with fit.lock:
                fit.models.append(model)
                del fit.plan[0]
        state, message = "done", ""
    except Stopped:
        state, message = "stopped", ""
    except Exception as error:  # whatever it is, the page says it, and the server goes on
        state, message = "failed", f"{type(error).__name__}: {error}"
    with fit.lock:
        fit.state, fit.message = cast(State, state), message


def _train(fit: Fit, n_steps: int | None) -> Model:
    method = load_system(fit.method)
    assert method is not None, "checked when the fit was asked for"
    settings: Mapping[str, Any] = {}
    if fit.method == DEFAULT_METHOD:
        # On a GPU the small tensors of one model take longer than on a CPU.
        settings = {"n_steps": n_steps, "device": "cpu"}
    unfitted = method(**settings)
    total = training_steps(unfitted, fit.demonstrations)
    label = f"{total} steps" if total else ""
    with fit.lock:
        fit.label, fit.progress = label, 0.0

    def look(rows: int) -> None:
        if fit.stop.is_set():
            raise Stopped
        if total:
            fit.progress = min(rows / total, 1.0)

    begin = time.thread_time()
    rng = WatchedGenerator(SEED, look)
    system = unfitted.fit(fit.demonstrations, seed=cast(int, rng))
    seconds = time.thread_time() - begin
    with TemporaryDirectory() as folder:
        path = system.save(Path(folder) / "model.safetensors")
        content = path.read_bytes()
        system = method.load(path)
    return Model(system, content, label, seconds, accuracy(system, fit.demonstrations))
