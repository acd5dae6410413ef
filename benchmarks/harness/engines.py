"""The engines of independent cases: processes of this machine, or an existing Ray cluster.

Every engine and every number of workers give the same results.
"""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import joblib

from ...envs.arguments import check_choice
from ...envs.backend.extras import require_extra

Case = TypeVar("Case")
Result = TypeVar("Result")

PROCESSES, RAY = ENGINES = ("processes", "ray")
RETRIES = 3
"""Deaths of its worker or node that a case outlives on a cluster; a fourth may be its own doing."""
_CLUSTER: ContextVar[Any] = ContextVar("cluster", default=None)


def count_cores() -> int:
    """Count the processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def use_engine(name: str = PROCESSES, address: str = "") -> Iterator[None]:
    """Use an engine for the cases within.

    Args:
        name: Name in `ENGINES`.
        address: Existing Ray cluster, "host:port"; "": the one on this machine. Its nodes need this
            version of sideslip and a shared folder for finished cases.

    Raises:
        ValueError: The name is unknown, an address without Ray, or there is no such cluster.
        ModuleNotFoundError: ray is not installed.
    """
    check_choice("engine", name, ENGINES)
    if name == PROCESSES:
        if address:
            raise ValueError(f"an address is of a Ray cluster (engine {RAY!r}), got {address!r}")
        yield
        return
    with require_extra("scale", "the engine 'ray' needs ray"):
        import ray
    quiet = {"env_vars": {"SIDESLIP_QUIET": "1", "OPENBLAS_NUM_THREADS": "1"}}
    try:
        if address:  # Ray itself asks for minutes, then ends the process
            host, _, port = address.removeprefix("ray://").rpartition(":")
            socket.create_connection((host, int(port)), timeout=5.0).close()
        ray.init(address or "auto", runtime_env=quiet, log_to_driver=False, logging_level="error")
    except (OSError, ValueError, RuntimeError) as error:
        where = f"at {address}" if address else "on this machine (`ray start --head`)"
        raise ValueError(f"there is no Ray cluster {where}: {error}") from None
    token = _CLUSTER.set(ray)
    try:
        yield
    finally:
        _CLUSTER.reset(token)
        ray.shutdown()


def execute_cases(
    function: Callable[[Case], Result], cases: Sequence[Case], jobs: int | None = None
) -> Iterator[tuple[int, Result]]:
    """Execute cases, and yield the index and result of each when it is done.

    Args:
        function: Function of a case, importable by workers.
        cases: Cases.
        jobs: Number of processes; None: one for each processor at most. A cluster has its own.
    """
    ray = _CLUSTER.get()
    if ray is None:
        # the number asked for is left alone: another one would end the processes of the last call
        pool = joblib.Parallel(
            jobs or max(min(count_cores(), len(cases)), 1), return_as="generator"
        )
        yield from enumerate(pool(joblib.delayed(function)(case) for case in cases))
        return
    remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)  # a dead node's cases run again
    function_ref, waiting = ray.put(function), {}
    for place, case in enumerate(cases):
        waiting[remote.remote(function_ref, case)] = place
    while waiting:
        (done,), _ = ray.wait(list(waiting), num_returns=1)
        yield waiting.pop(done), ray.get(done)


def _call(function: Callable[[Case], Result], case: Case) -> Result:
    return function(case)
