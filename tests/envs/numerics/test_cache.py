"""Compiled kernels on disk: cached once, loaded bit for bit; their absence is no trouble."""

import logging
import math
import os
import subprocess
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest

from sideslip.envs.numerics import compiler, kernel_cache
from sideslip.envs.numerics.compiler import _Kernel

from .. import processes

KERNELS = """
@kernel
def halved(x):
    return 0.5 * math.sqrt(x)


@kernel
def total(vector, offset):
    if offset < 0.0:
        raise ValueError("offset is not negative")
    for x in vector:
        offset += x
    return halved(offset)


def _apart(function):
    return kernel(function, apart=True)


@_apart
def negative(x):
    if x > 8.0:
        raise ValueError("x is at most 8")
    return 0.0 - halved(x)


@kernel
def first(x):
    return negative(x) + 1.0


@kernel
def second(x):
    return negative(x) + 2.0


@_apart
def mass_of(car):
    return car["m"]


@kernel
def weight(car):
    return 9.81 * mass_of(car)


@kernel
def blend(target, share, vector):
    target[1:] = (1.0 - share) * vector[1:]
"""
MODULE = f"""
\"\"\"Kernels in a folder named by the first argument.\"\"\"

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np

for name in ("sideslip", "sideslip.envs"):  # without what they import, which takes as long as numba
    sys.modules[name] = importlib.util.module_from_spec(importlib.util.find_spec(name))

from sideslip.envs.numerics.compiler import _Kernel

FOLDER = Path(sys.argv[1])


def kernel(function, apart=False):
    return _Kernel(function, targetoptions={{"nopython": True}}, folder=FOLDER, apart=apart)

{KERNELS}"""
USE = """
print(total(np.arange(5.0), 0.5).hex())
try:
    total(np.arange(5.0), -1.0)
except ValueError as error:
    print(error)
"""
EXPECTED = [(0.5 * np.sqrt(10.5)).hex(), "offset is not negative"]
BLEND = "a = np.zeros(3); blend(a, 0.25, np.arange(3.0)); print(a.tolist())"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "kernels").mkdir(mode=0o700)
    (tmp_path / "tiny.py").write_text(MODULE)
    return tmp_path / "kernels"


def start(folder: Path, code: str = USE, **variables: str) -> subprocess.Popen[str]:
    variables = {"PYTHONPATH": f"{folder.parent}{os.pathsep}{processes.SOURCE}"} | variables
    code = f"from tiny import *\n{code}"
    return processes.start(code, variables, str(folder), cwd=folder.parent)


def run(folder: Path, code: str = USE, **variables: str) -> tuple[list[str], str]:
    return processes.finish(start(folder, code, **variables))


def test_a_second_process_loads_what_the_first_compiled(folder: Path) -> None:
    """Expressions of whole arrays too, for which numba writes functions that are of no module."""
    expected = [*EXPECTED, "[0.0, 0.75, 1.5]"]
    first, notices = run(folder, USE + BLEND)
    assert first == expected
    assert notices.count("compiling") == 1  # one line, whatever the number of kernels
    files = {path: path.read_bytes() for path in folder.iterdir()}
    names = sorted(path.name.partition("-")[0] for path in files)
    assert names == ["tiny.blend", "tiny.total"]  # no callee
    assert run(folder, USE + BLEND) == (expected, "")
    assert {path: path.read_bytes() for path in folder.iterdir()} == files


def test_what_was_compiled_for_another_processor_is_not_loaded(folder: Path) -> None:
    """A folder that two machines share: each finds its own kernel and leaves the other's."""
    assert run(folder, NUMBA_CPU_NAME="generic")[0] == EXPECTED
    (generic,) = folder.iterdir()
    before = generic.read_bytes()
    found, notices = run(folder)
    assert found == EXPECTED and "compiling" in notices
    assert len(list(folder.iterdir())) == 2 and generic.read_bytes() == before
    assert run(folder, NUMBA_CPU_NAME="generic") == (EXPECTED, "")


def test_machine_code_is_found_by_a_name_without_a_process_counts(folder: Path) -> None:
    """Numba numbers record types as it meets them; a kernel may be made anew after its callers."""
    code = "print(weight(np.ones(1, [('m', float)])[0]))"
    others = "import numba; [numba.typeof(np.ones(1, [(f'a{i}', float)])[0]) for i in range(9)]\n"
    assert run(folder, code)[0] == ["9.81"]
    (made,) = (path for path in folder.iterdir() if "mass_of" in path.name)
    made.unlink()
    assert run(folder, others + code)[0] == ["9.81"]
    assert run(folder, code) == (["9.81"], "")


@pytest.mark.parametrize("left", [0, 31, 1000, -1], ids=["empty", "digest", "cut", "last byte"])
def test_a_damaged_file_is_compiled_again(
    left: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kernel() -> Any:
        monkeypatch.setattr(compiler, "_libraries", {})  # as in a process of its own
        return _Kernel(_tripled, targetoptions={"nopython": True}, folder=tmp_path)

    assert kernel()(2.0) == 6.0
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])  # the digest alone: the code is sound
    again = kernel()
    assert again(3.0) == 9.0 and again.parts != {}
    path.write_bytes(whole[:left])
    again = kernel()
    assert again(3.0) == 9.0 and again.parts != {}
    loaded = kernel()
    assert loaded(4.0) == 12.0 and loaded.parts == {}


def load_kernels(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The kernels, as in a process of its own."""
    monkeypatch.setattr(compiler, "_libraries", {})
    options: dict[str, Any] = {"targetoptions": {"nopython": True}, "folder": folder}
    names: dict[str, Any] = {"__name__": "tiny", "math": math}
    names["kernel"] = partial(_Kernel, **options)
    exec(KERNELS, names)
    return SimpleNamespace(**names)


def test_a_kernel_that_stands_apart_is_compiled_once_for_its_callers(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its file is needed by theirs, and comes back where it is missing; errors pass through."""

    def use() -> bool:
        """Whether something was compiled."""
        tiny = load_kernels(folder, monkeypatch)
        assert (tiny.first(4.0), tiny.second(4.0)) == (0.0, 1.0)
        with pytest.raises(ValueError, match="x is at most 8"):
            tiny.first(9.0)
        return bool(tiny.halved.parts)

    assert use()
    files = {path.name.partition("-")[0]: path for path in folder.iterdir()}
    assert sorted(files) == ["tiny.first", "tiny.negative", "tiny.second"]
    assert not use()
    files["tiny.negative"].unlink()
    assert use() and not use()


def test_processes_that_start_at_once(folder: Path) -> None:
    """Both compile one kernel, and each another signature: files are whole and their own.

    numba's numbered files are not: two processes both take the first number.
    """
    calls = "print(halved(16.0))", "print(halved(36))"
    for process in [start(folder, f"{USE}\n{call}") for call in calls]:
        printed = process.communicate(timeout=100)[0].splitlines()
        assert process.returncode == 0 and printed[:2] == EXPECTED
        assert printed[2] in ("2.0", "3.0")
    assert len(list(folder.iterdir())) == 3
    assert run(folder, f"{USE}\n{calls[0]}\n{calls[1]}") == ([*EXPECTED, "2.0", "3.0"], "")


@pytest.mark.parametrize("obstacle", ["missing", "file", "full"])
def test_a_kernel_that_cannot_be_written_is_compiled(
    obstacle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "kernels"
    if obstacle == "file":
        folder.write_text("not a folder")
    elif obstacle == "full":
        folder.mkdir()

        def full(descriptor: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
    kernel: Any = _Kernel(_tripled, targetoptions={"nopython": True}, folder=folder)
    assert kernel(2.0) == 6.0
    assert not folder.is_dir() or not list(folder.iterdir())  # nothing half written is left


def _tripled(x: float) -> float:
    return 3.0 * x


def test_a_callee_is_compiled_once_for_all_literals() -> None:
    kernel: Any = _Kernel(_tripled, targetoptions={"nopython": True})
    caller: Any = _Kernel(_caller(kernel), targetoptions={"nopython": True})
    assert caller(5) == 3 * (5 + 7 + 9)
    assert [str(each) for args in kernel.parts for each in args] == ["int64"]
    assert kernel.overloads == {}  # no machine code of its own


def _caller(kernel: Any) -> Any:
    def caller(x: int) -> Any:
        return kernel(x) + kernel(7) + kernel(9)

    return caller


@pytest.mark.parametrize("apart", [False, True])
def test_a_function_compiled_by_numba_itself_may_call_a_kernel(apart: bool) -> None:
    inner: Any = _Kernel(_tripled, targetoptions={"nopython": True})
    kernel: Any = _Kernel(_caller(inner), targetoptions={"nopython": True}, apart=apart)
    assert numba.njit(_caller(kernel))(1) == sum(3 * (x + 7 + 9) for x in (1, 7, 9))


def test_a_line_says_that_kernels_are_compiled(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On standard error, or by the program's own logging; not with SIDESLIP_QUIET."""
    records: list[logging.LogRecord] = []
    handler = logging.Handler()
    monkeypatch.setattr(handler, "emit", records.append)

    def call(has_handlers: bool) -> list[str]:
        monkeypatch.setattr(kernel_cache, "_reported", set())
        monkeypatch.setattr(kernel_cache.logger, "hasHandlers", lambda: has_handlers)
        for path in folder.iterdir():
            path.unlink()
        tiny = load_kernels(folder, monkeypatch)
        tiny.halved(2.0)
        tiny.halved(3)
        return capsys.readouterr().err.splitlines()

    monkeypatch.delenv("SIDESLIP_QUIET", raising=False)
    lines = call(False)
    assert len(lines) == 1 and str(folder.parent) in lines[0]
    monkeypatch.setattr(kernel_cache.logger, "handlers", [handler])
    monkeypatch.setattr(kernel_cache.logger, "propagate", False)
    kernel_cache.logger.setLevel(logging.INFO)
    assert call(True) == []
    first_words = [record.getMessage().split()[0] for record in records]
    assert first_words == ["sideslip:", "compiled", "compiled"]
    kernel_cache.logger.setLevel(logging.NOTSET)
    monkeypatch.setenv("SIDESLIP_QUIET", "1")
    assert call(False) == []


def test_workers_say_nothing(folder: Path) -> None:
    code = """
import multiprocessing
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(pool.map(halved, [16.0, 36.0]))
"""
    assert run(folder, code) == (["[2.0, 3.0]"], "")
