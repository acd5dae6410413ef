"""A user's contestant in a process of its own, which never holds the env, its seeds or a result."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...agents.env_facts import EnvView
from ...agents.learned.files import ZIP
from ...envs.sensors.link import SlowSensor
from ...estimators.user_files import is_user_file
from ...estimators.vector.foreign import ForeignBatch
from ...estimators.wrappers.outputs import write_outputs
from ..control.episodes import NUMBERS, Chunk, DriveResult, run_chunk
from .process import ChildProcess, ContestantError

LIMIT = 600.0  # s of wall time a cell


class RemoteAgent:
    """The agent of a child, as `make_agent` takes a factory and an agent.

    Args:
        child: Where it is built and asked.
        source: The text of which the child makes it.
        trust: Whether the child may read a zip.
    """

    def __init__(self, child: ChildProcess, source: str, trust: bool = False) -> None:
        self._child, self._source, self._trust = child, source, trust

    def __call__(self, env: Any, **options: Any) -> "_RemotePolicy":
        """Let the child build its agent from the view of an env."""
        view = EnvView.from_env(env)
        self._child.call("agent", self._source, view, {"trust": self._trust, **options})
        return _RemotePolicy(self._child, (view.num_envs, view.facts.width))


class _RemotePolicy:
    def __init__(self, child: ChildProcess, shape: tuple[int, int]) -> None:
        self._child, self._shape = child, shape

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:  # fmt: skip
        """The child's actions, float32 (rows, width); its memory stays there."""
        length = 4 * self._shape[0] * self._shape[1]
        answer = self._child.call("predict", observation, episode_start, length=length)
        return np.frombuffer(answer, np.float32).reshape(self._shape), None


class RemoteEstimators:
    """The estimators of a child, as `make_estimator` takes a factory.

    Args:
        child: Where they are built and asked.
        source: The text of which the child makes them.
    """

    def __init__(self, child: ChildProcess, source: str) -> None:
        self._child, self.name, self._rows = child, source, 0

    def __call__(self, **arguments: Any) -> "_RemoteRow":
        """Let the child build one more estimator."""
        row, self._rows = self._rows, self._rows + 1
        return _RemoteRow(self._child, self.name, row, arguments)


class RemoteBatch(ForeignBatch):
    """The estimators of a child, all rows in one message."""

    def take(
        self, mask: Any, fast: Any, rows: Any, packets: Any, counts: Any, *observed: Any
    ) -> None:
        """As `BatchEstimator.take`."""
        obs, inner, plan, limits, *others = observed
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        remote: list[Any] = [self[i].inner for i in chosen.tolist()]
        records = [
            (item.row, fast[i, : rows[i]], packets[i, : counts[i]])
            for i, item in zip(chosen.tolist(), remote, strict=True)
        ]
        _RemoteRow.take(remote, records)
        for i in chosen.tolist():
            beta, gamma, out, summary = (item[i] for item in others)
            write_outputs(self[i], obs[i], inner, plan, limits, beta, gamma, out, summary)


class _RemoteRow:
    """One estimator of a child, as an `EstimatorLike`."""

    batch = RemoteBatch
    x: Any = None
    P: Any = None

    def __init__(
        self, child: ChildProcess, source: str, row: int, arguments: dict[str, Any]
    ) -> None:
        self.child, self.row = child, row
        names = json.loads(child.call("estimator", row, source, arguments))
        self.names = tuple(names) if isinstance(names, list) else ()

    def reset(self, sensors: Mapping[str, SlowSensor], first: int) -> None:
        """As `EstimatorLike.reset`."""
        self.child.call("reset", self.row, dict(sensors), first)

    def step(self, rows: Any, packets: Any) -> None:
        """As `EstimatorLike.step`."""
        self.take([self], [(self.row, rows, packets)])

    @staticmethod
    def take(rows: Sequence["_RemoteRow"], records: Sequence[tuple[int, Any, Any]]) -> None:
        """Step some rows of one child with their records; set each one's x and P."""
        if not rows:
            return
        n = len(rows[0].names)
        answer = rows[0].child.call("step", records, length=8 * len(rows) * n * (n + 1))
        for row, values in zip(rows, np.frombuffer(answer).reshape(len(rows), -1), strict=True):
            row.x, row.P = values[:n], values[n:].reshape(n, n)


def is_foreign(source: Any) -> bool:
    """Whether a text names code that is not the package's."""
    return isinstance(source, str) and (
        is_user_file(source) or source.endswith(ZIP) or ":" in source
    )


def run_user_chunk(chunk: Chunk) -> DriveResult:
    """`run_chunk`; a cell of which every episode ends by an action that is none was not driven."""
    result = run_chunk(chunk)
    if not result.error and result.mark_failures("bad-action").all():
        return _make_failed_result(
            chunk, "every action is NaN, or infinite, before an episode is over"
        )
    return result


def run_isolated_chunk(
    chunk: Chunk, limit: float = LIMIT, allowed: Iterable[str] | None = None
) -> DriveResult:
    """`run_user_chunk`, but what is not the package's code runs in a child of its own, agent and
    estimator apart.

    Args:
        chunk: Whose contestants are names and files.
        limit: Seconds of wall time.
        allowed: Files that a child may open, of `Start`.

    Returns:
        The episodes.
    """
    return _run_isolated_chunk(chunk, limit, allowed)[0]


def run_rehearsal(chunk: Chunk, limit: float = LIMIT) -> tuple[DriveResult, set[str]]:
    """Drive a chunk as `run_isolated_chunk`; return the files that its contestants opened, too."""
    return _run_isolated_chunk(chunk, limit, None)


def _run_isolated_chunk(
    chunk: Chunk, limit: float, allowed: Iterable[str] | None
) -> tuple[DriveResult, set[str]]:
    entry, children, opened = chunk.entry, list[ChildProcess](), set[str]()
    objects = dict(entry.objects)
    try:
        for part in ("controller", "estimator"):
            source = getattr(entry, part)
            if part in objects or not is_foreign(source):
                continue
            child = ChildProcess((entry.controller, entry.estimator), limit, allowed)
            children.append(child)
            trust = bool(entry.best["controller"].get("trust"))
            agent = part == "controller"
            objects[part] = (
                RemoteAgent(child, source, trust) if agent else RemoteEstimators(child, source)
            )
        result = run_user_chunk(replace(chunk, entry=replace(entry, objects=objects)))
        for child in children:
            if not child.reason:
                opened.update(json.loads(child.call("opened")))
    except ContestantError as error:
        result = _make_failed_result(chunk, str(error))
    finally:
        spent = sum(child.close() for child in children)
    reason = next((child.reason for child in children if child.reason), result.error)
    if reason:
        return _make_failed_result(chunk, reason), opened
    return replace(result, seconds=result.seconds + spent), opened


def _make_failed_result(chunk: Chunk, error: str) -> DriveResult:
    return DriveResult(np.full((len(chunk.seeds), len(NUMBERS)), np.nan), np.nan, error=error)
