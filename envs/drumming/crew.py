"""A share of many arms, here or in a process of its own.

What an arm tells in a step is a row of numbers in memory that the processes share, and what it is
to do is another; a pipe carries the word to begin, the hits, and whatever is rare.
"""

from __future__ import annotations

import contextlib
import copy
import os
import pickle
import signal
import time
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.metrics.drumming import Hit

PATIENCE: Final = 2e-4
"""Seconds for which an answer is looked for before the process sleeps: about as long as the shares
of two processes differ. To be woken takes a third of an arm's step."""

Order = tuple[int | None, dict[str, Any]]
"""Seed and options of a reset."""


class Columns:
    """Where an arm's numbers are in its row.

    Parameters
    ----------
    n : int
        Size of an observation.
    info : dict
        What an arm tells: numbers and arrays, whose shapes are the same always. Hits, which are
        few, are not among the columns.
    """

    def __init__(self, n: int, info: dict[str, Any]) -> None:
        self.observation = slice(0, n)
        self.reward, self.terminated, self.truncated = n, n + 1, n + 2
        self.width = n + 3
        self._keys: list[tuple[str, Any, int | slice]] = []
        for key, value in info.items():
            if key == "hits":
                continue
            if isinstance(value, np.ndarray):
                self._keys.append((key, value.dtype, slice(self.width, self.width + len(value))))
                self.width += len(value)
            else:
                self._keys.append((key, type(value), self.width))
                self.width += 1

    def row(
        self,
        observation: FloatArray,
        info: dict[str, Any],
        reward: Any = 0.0,
        terminated: bool = False,
        truncated: bool = False,
    ) -> list[float]:
        """Return the row of a step, or of a reset."""
        numbers: list[float] = [*observation.tolist(), reward, terminated, truncated]
        for key, _, where in self._keys:
            if isinstance(where, slice):
                numbers.extend(info[key].tolist())
            else:
                numbers.append(info[key])
        return numbers

    def infos(self, rows: FloatArray) -> dict[str, NDArray[Any]]:
        """Return what the rows, shape (n, width), tell: of each key shape (n,) or (n, m)."""
        return {key: rows[:, where].astype(kind) for key, kind, where in self._keys}


class Plan(NamedTuple):
    """What a crew is made of; it goes into the crew's process."""

    settings: dict[str, Any]
    """Arguments of `DrummingEnv`."""
    columns: Columns
    n: int
    """How many arms there are in all."""
    share: range
    """Which of them they are."""
    rows: Any
    """Of all arms; an array of `multiprocessing`, which holds no NumPy array when it travels."""
    actions: Any
    """Of all arms."""


def shared(memory: Any, n: int) -> FloatArray:
    """Return memory that processes share as an array of n rows."""
    array: FloatArray = np.frombuffer(memory, dtype=np.float64).reshape(n, -1)
    return array


class Crew:
    """Some of the arms; methods return a value for each."""

    def __init__(self, plan: Plan) -> None:
        self._arms = [DrummingEnv(**plan.settings) for _ in plan.share]
        self._share, self._columns = plan.share, plan.columns
        own = slice(plan.share.start, plan.share.stop)
        self._rows = shared(plan.rows, plan.n)[own]
        self._actions = shared(plan.actions, plan.n)[own]
        self._ended = [False] * len(self._arms)

    def reset(self, orders: Sequence[Order | None]) -> None:
        """Begin an episode with each arm that has an order."""
        for i, order in enumerate(orders):
            if order is not None:
                self._begin(i, *order)

    def _begin(self, i: int, seed: int | None = None, options: Any = None) -> None:
        self._rows[i] = self._columns.row(*self._arms[i].reset(seed=seed, options=options))
        self._ended[i] = False

    def step(self) -> dict[int, tuple[Hit, ...]]:
        """Step each arm, or begin anew with one whose episode has ended; return hits by arm."""
        hits = {}
        for i, arm in enumerate(self._arms):
            if self._ended[i]:
                self._begin(i)
                continue
            observation, reward, terminated, truncated, info = arm.step(self._actions[i])
            self._rows[i] = self._columns.row(observation, info, reward, terminated, truncated)
            self._ended[i] = terminated or truncated
            if info["hits"]:
                hits[self._share[i]] = info["hits"]
        return hits

    def generators(self) -> list[np.random.Generator]:
        """Return copies of the arms' random number generators."""
        return [copy.deepcopy(arm.np_random) for arm in self._arms]

    def seeds(self) -> list[int]:
        """Return the arms' seeds."""
        return [arm.np_random_seed for arm in self._arms]

    def actions_of(self, commands: FloatArray, observations: FloatArray) -> list[FloatArray]:
        """Return the actions of commands, shape (n, 3), in states, shape (n, observation)."""
        triples = zip(self._arms, commands, observations, strict=True)
        return [arm.command_to_action(command, state) for arm, command, state in triples]


class CrewProcess:
    """A `Crew` in a process of its own: what is begun goes on there until it is asked for.

    One question at a time. Where an answer was not waited for, or raised, the process is of no
    further use: `end` it.
    """

    def __init__(self, context: Any, plan: Plan) -> None:
        self._pipe, theirs = context.Pipe()
        self._owner = os.getpid()
        first, last = plan.share.start, plan.share.stop - 1
        self.name = f"arm {first}" if first == last else f"arms {first} to {last}"
        self.process = context.Process(
            target=_serve, args=(theirs, self._pipe, plan), name=self.name, daemon=True
        )
        self.process.start()
        theirs.close()

    def begin(self, method: str, *arguments: Any) -> None:
        """Let a method of the crew be called.

        Raises
        ------
        RuntimeError
            If the process has ended.
        """
        try:
            self._pipe.send((method, arguments))
        except OSError as error:
            raise self._lost() from error

    def result(self) -> Any:
        """Return what it returned.

        Raises
        ------
        RuntimeError
            If the process has ended.
        Exception
            What was raised there.
        """
        try:
            value, error, where = _received(self._pipe)
        except (EOFError, OSError) as end:
            raise self._lost() from end
        if error is not None:
            raise error from RuntimeError(f"in the process of {self.name}:\n{where}")
        return value

    @property
    def is_ours(self) -> bool:
        """Whether this process began it, and is not a fork of the one that did."""
        return os.getpid() == self._owner

    def dismiss(self, *, terminate: bool) -> None:
        """Let the process end: at once, or when it has answered."""
        if terminate:
            self.process.terminate()
            return
        with contextlib.suppress(OSError):  # it has ended by itself
            self._pipe.send(None)

    def bury(self, timeout: float) -> None:
        """Wait for the process's end; after so many seconds kill it."""
        self.process.join(timeout)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self._pipe.close()

    def _lost(self) -> RuntimeError:
        self.process.join(timeout=1.0)
        code = self.process.exitcode
        why = " (it was killed, maybe for want of memory)" if code == -signal.SIGKILL else ""
        return RuntimeError(
            f"Expected an answer of the process of {self.name}, but it ended with exit code "
            f"{code}{why}: reset() begins anew in new processes."
        )


def end(crews: list[CrewProcess], timeout: float = 5.0, *, terminate: bool = True) -> None:
    """End the processes of crews and forget them: at once, or when they have answered."""
    own = [crew for crew in crews if crew.is_ours]
    for crew in own:
        crew.dismiss(terminate=terminate)
    for crew in own:
        crew.bury(timeout)
    crews.clear()


def _received(pipe: Connection) -> Any:
    """Return what comes through a pipe; look for it a while before the process sleeps."""
    until = time.perf_counter() + PATIENCE
    while not pipe.poll() and time.perf_counter() < until:
        pass
    return pipe.recv()


def _serve(pipe: Connection, other_end: Connection, plan: Plan) -> None:
    """Do what comes through a pipe until None does, or until its other end is closed."""
    other_end.close()  # a fork has it too, and would never see it closed
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for who asked
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    crew: Crew | None = None
    while True:
        try:
            asked = _received(pipe)
        except (EOFError, OSError):
            return
        if asked is None:
            return
        method, arguments = asked
        answer: tuple[Any, Exception | None, str]
        try:
            crew = crew or Crew(plan)
            answer = getattr(crew, method)(*arguments), None, ""
        except Exception as error:
            answer = None, _travelling(error), traceback.format_exc()
        try:
            pipe.send(answer)
        except OSError:
            return


def _travelling(error: Exception) -> Exception:
    """Return an error if it comes through a pipe whole, else one that says what it was."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # what an error's own code raises when it is written or read
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
