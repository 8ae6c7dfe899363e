"""A share of many arms, here or in a process of its own.

What an arm tells in a step is a row of numbers in memory that the processes share, and what it is
to do is another; a pipe carries the word to begin, the hits, and whatever is rare.
"""

from __future__ import annotations

import contextlib
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

    arm: type[DrummingEnv]
    settings: dict[str, Any]
    """The arms' arguments."""
    columns: Columns
    share: range
    """Which of all arms they are."""
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

    def __init__(self, plan: Plan, n: int) -> None:
        self._arms = [plan.arm(**plan.settings) for _ in plan.share]
        self._share, self._columns = plan.share, plan.columns
        own = slice(plan.share.start, plan.share.stop)
        self._rows, self._actions = shared(plan.rows, n)[own], shared(plan.actions, n)[own]
        self._ended = [False] * len(self._arms)

    def reset(self, orders: Sequence[Order | None]) -> None:
        """Begin an episode with each arm that has an order; they are those of all arms."""
        for i, order in enumerate(orders[self._share.start : self._share.stop]):
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
        """Return the arms' random number generators."""
        return [arm.np_random for arm in self._arms]

    def seeds(self) -> list[int]:
        """Return the arms' seeds."""
        return [arm.np_random_seed for arm in self._arms]

    def actions_of(self, commands: FloatArray, observations: FloatArray) -> list[FloatArray]:
        """Return the actions of commands, shape (n, 3) of all arms, in states."""
        own = slice(self._share.start, self._share.stop)
        triples = zip(self._arms, commands[own], observations[own], strict=True)
        return [arm.command_to_action(command, state) for arm, command, state in triples]


class CrewProcess:
    """A `Crew` in a process of its own: what is begun goes on there until it is asked for."""

    def __init__(self, context: Any, plan: Plan, n: int) -> None:
        self._pipe, theirs = context.Pipe()
        self._share = plan.share
        self._process = context.Process(
            target=_serve,
            args=(theirs, self._pipe, plan, n),
            name=f"arms {plan.share.start} to {plan.share.stop - 1}",
            daemon=True,
        )
        self._process.start()
        theirs.close()
        self._asked = 0

    def begin(self, method: str, *arguments: Any) -> None:
        """Let a method of the crew be called."""
        while self._asked:  # an interrupt came between a question and its answer
            self.result()
        try:
            self._pipe.send((method, arguments))
        except OSError as error:
            raise self._ended() from error
        self._asked += 1

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
            raise self._ended() from end
        self._asked -= 1
        if error is not None:
            raise error from RuntimeError(f"in the process of {self._process.name}:\n{where}")
        return value

    def _ended(self) -> RuntimeError:
        self._process.join(timeout=1.0)
        return RuntimeError(
            f"Expected an answer of the process that moves {self._process.name}, but it ended with "
            f"exit code {self._process.exitcode} (-9: it was killed, maybe for want of memory): "
            "make the environment anew."
        )

    def close(self, timeout: float | None = None, *, terminate: bool = False) -> None:
        """End the process: at once, or when it is done with what was begun."""
        if terminate:
            self._process.terminate()
        with contextlib.suppress(OSError):  # it has ended
            self._pipe.send(None)
        self._pipe.close()
        self._process.join(5.0 if timeout is None else timeout)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _received(pipe: Connection) -> Any:
    """Return what comes through a pipe; look for it a while before the process sleeps."""
    until = time.perf_counter() + PATIENCE
    while not pipe.poll() and time.perf_counter() < until:
        pass
    return pipe.recv()


def _serve(pipe: Connection, other_end: Connection, plan: Plan, n: int) -> None:
    """Do what comes through a pipe until None does, or until its other end is closed."""
    other_end.close()  # a fork has it too, and would never see it closed
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for who asked
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
            crew = crew or Crew(plan, n)
            answer = getattr(crew, method)(*arguments), None, ""
        except Exception as error:
            answer = None, error, traceback.format_exc()
        try:
            pipe.send(answer)
        except OSError:
            return
