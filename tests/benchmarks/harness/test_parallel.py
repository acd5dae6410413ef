"""The same results on any engine; on a cluster a dead node's running cases run again, no others."""

import io
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from sideslip.benchmarks.harness import parallel
from sideslip.benchmarks.harness.parallel import (
    _execute_cases,
    run_cases,
    use_engine,
    use_shared_bar,
)
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies.estimation import STUDY

CASES = [float(k) for k in range(12)]


def noted(folder: str, seconds: float, case: float) -> float:
    """A case that leaves a line for each time it starts and each time it is done."""
    for what, wait in (("started", seconds), ("done", 0.0)):
        with open(f"{folder}/{case:.0f}.{what}", "a") as file:
            file.write(f"{os.getppid()}\n")
        time.sleep(wait)
    return case / 3.0


def counted(folder: Path, what: str) -> Counter[str]:
    return Counter({each.stem: len(each.read_text().split()) for each in folder.glob(f"*.{what}")})


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_cases(tmp_path: Path, jobs: int) -> None:
    found = run_cases(partial(noted, str(tmp_path), 0.0), CASES, jobs=jobs)
    assert found == [case / 3.0 for case in CASES]
    assert set(counted(tmp_path, "done").values()) == {1}
    assert run_cases(abs, [], jobs=jobs) == []


@pytest.mark.parametrize(
    ("engine", "message"),
    [
        (("rai",), "unknown engine 'rai'"),
        (("processes", "x:1"), "an address is of a Ray cluster"),
        (("ray", "127.0.0.1:1"), r"no Ray cluster at 127\.0\.0\.1:1"),
    ],
)
def test_an_engine_that_is_none_is_refused(engine: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message), use_engine(*engine):
        pass


class Deadly:
    """Ray's calls that `_execute_cases` makes; the worker of each case dies so many times."""

    def __init__(self, deaths: int) -> None:
        self.deaths = deaths

    def put(self, value: Any) -> Any:
        return value

    def remote(self, num_cpus: int, max_retries: int) -> Any:
        def ask(function: Any, *args: Any) -> Any:
            if self.deaths > max_retries:
                raise ChildProcessError(f"the worker died {self.deaths} times")
            return function(*args)

        return lambda function: SimpleNamespace(remote=lambda *args: partial(ask, function, *args))

    def wait(self, asked: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        return asked[:num_returns], asked[num_returns:]

    def get(self, asked: Any) -> Any:
        return asked()


def test_a_case_outlives_so_many_deaths_of_its_worker_and_no_more() -> None:
    token = parallel._CLUSTER.set(Deadly(parallel.RETRIES))
    try:
        assert dict(_execute_cases(abs, [-1, -2, -3])) == {0: 1, 1: 2, 2: 3}
        parallel._CLUSTER.set(Deadly(parallel.RETRIES + 1))
        with pytest.raises(ChildProcessError):
            list(_execute_cases(abs, [-1]))
    finally:
        parallel._CLUSTER.reset(token)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes of one processor each on this machine."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    memory = {"object_store_memory": 80 * 2**20}
    made = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False} | memory
    )
    yield made, made.add_node(num_cpus=1, **memory)
    made.shutdown()


@pytest.mark.long
def test_a_node_that_dies_loses_nothing(cluster: Any, tmp_path: Path) -> None:
    nodes, second = cluster
    with use_engine("ray", nodes.address):
        found: list[float] = []
        for _, result in _execute_cases(partial(noted, str(tmp_path), 1.0), CASES):
            found.append(result)
            if len(found) == 4:
                before = counted(tmp_path, "done")
                nodes.remove_node(second, allow_graceful=False)
    assert sorted(found) == [case / 3.0 for case in CASES]
    starts = counted(tmp_path, "started")
    assert all(starts[case] == 1 for case in before), "what was done ran again"
    assert max(starts.values()) <= 2 and sum(starts.values()) <= len(CASES) + 2


ENDING = """
import os, sys
from ray.exceptions import WorkerCrashedError
from sideslip.benchmarks.harness import parallel

parallel.RETRIES = 1
with parallel.use_engine("ray", sys.argv[1]):
    try:
        parallel.run_cases(os._exit, [1])
    except WorkerCrashedError:
        print("the work ended", flush=True)
"""


@pytest.mark.long
def test_a_case_that_ends_its_process_ends_the_work(cluster: Any) -> None:
    """In a process of its own, which Ray's shutdown may end by a signal after such a death."""
    command = [sys.executable, "-c", ENDING, cluster[0].address]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "the work ended" in done.stdout, done.stderr


DRIVER = """
import sys
from pathlib import Path
from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.tasks import list_scored_tasks
from sideslip.benchmarks.control.run import CHUNK, measure
from sideslip.benchmarks.harness.parallel import use_engine

with use_engine("ray", sys.argv[1]):
    cells = [(contest, Entry("none")) for contest in list_scored_tasks()[:6]]
    measure(cells, range(4 * CHUNK), keep=Path(sys.argv[2]))
"""


@pytest.mark.long
def test_a_driver_that_is_killed_goes_on(cluster: Any, tmp_path: Path) -> None:
    nodes, _ = cluster
    command = [sys.executable, "-c", DRIVER, nodes.address, str(tmp_path)]
    with subprocess.Popen(command) as driver:
        while len(done := list(tmp_path.glob("*.npz"))) < 3:
            assert driver.poll() is None, "the driver ended before it was killed"
            time.sleep(0.02)
        driver.kill()
    before = {path: path.stat().st_mtime_ns for path in done}
    subprocess.run(command, check=True)
    assert len(list(tmp_path.glob("*.npz"))) == 4 * 6  # chunks of each cell
    assert all(path.stat().st_mtime_ns == when for path, when in before.items())


@pytest.mark.long
def test_a_suite_has_the_same_rows_on_a_cluster(cluster: Any) -> None:
    nodes, _ = cluster
    alone = STUDY.run(Request(episodes=1, jobs=2))
    with use_engine("ray", nodes.address):
        there = STUDY.run(Request(episodes=1))
    timed = "us_per_tick"
    rows = [[repr(row) for row in each.rows if row.metric != timed] for each in (alone, there)]
    assert rows[0] == rows[1]  # as text: NaN is no NaN


def test_a_run_has_one_progress_bar() -> None:
    """It shows what runs; nothing of the phases before it stays."""
    written = io.StringIO()
    console = Console(file=written, width=80, force_terminal=True)
    with use_shared_bar(console, "bench"):
        for phase in ("first", "second", "third"):
            assert run_cases(abs, [-1, -2], phase, jobs=1, console=console) == [1, 2]
    last = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.getvalue()).splitlines()[-1]
    assert "third" in last and "2/2" in last
    assert "\n" not in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.getvalue()).strip()


def test_off_a_terminal_a_line_says_how_far_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, and again and again while cases run; none without a console."""
    monkeypatch.setattr(parallel, "_EVERY", 0.01)
    wait = partial(time.sleep, 0.05)
    run_cases(lambda _: wait(), [1, 2], "mine", jobs=1, console=Console(file=io.StringIO()))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "mine: 0 of 2 cases, 0 s" and "mine: 1 of 2 cases, 0 s" in lines
    run_cases(lambda _: wait(), [1, 2], "mine", jobs=1)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("term", ["dumb", "xterm"])
def test_a_terminal_without_bar_has_lines(capsys: pytest.CaptureFixture[str], term: str) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, _environ={"TERM": term})
    run_cases(abs, [1, 2], "mine", jobs=1, console=screen)
    assert ("mine: 0 of 2 cases" in capsys.readouterr().err) == (term == "dumb")


def test_a_line_says_what_is_done_and_how_long_it_takes_still(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long for each as the last ones took, without those before the first line."""
    monkeypatch.setattr(parallel, "_EVERY", 0.05)
    with use_shared_bar(Console(file=io.StringIO()), "work", "rounds", 400) as bar:
        time.sleep(0.1)
        bar.advance(bar.task_ids[0], 100)  # an earlier run's
        time.sleep(0.2)
        bar.advance(bar.task_ids[0], 4)
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "work: 0 of 400 rounds, 0 s"
    first = next(line for line in lines if line.startswith("work: 100 of 400 rounds"))
    assert "left" not in first
    left = re.fullmatch(r"work: 104 of 400 rounds, (\d+) s left, \d+ s", lines[-1])
    assert left is not None and int(left[1]) > 5  # 296, of which four took 0.1 s or more
