"""The compiler's decorators, plain numba in its place, and loads of eight neighbours."""

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from sideslip.envs.numerics import jit, kernel_cache
from sideslip.envs.numerics.packed import allocate_scratch, load8, mirror, store8
from sideslip.envs.scenarios.road import TrackPath, compute_path_offset

from .. import processes

PACKAGE = kernel_cache._PACKAGE
kernel_folder = kernel_cache.find_kernel_folder.__wrapped__  # asked anew each time
FOLDERS = ("envs", "estimators", "agents", "benchmarks")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the package called `sideslip` in an empty folder."""
    home = tmp_path / "copied" / "sideslip"
    home.mkdir(parents=True)
    for name in FOLDERS:
        shutil.copytree(PACKAGE / name, home / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(PACKAGE / "__init__.py", home)
    return home


def run(code: str, home: Path, **variables: str) -> str:
    """Run code on the package in `home`; returns what it prints."""
    process = processes.start(code, variables, cwd=home.parent, source=home.parent)
    return "\n".join(processes.finish(process)[0])


@pytest.mark.smoke
def test_stamp_is_that_of_the_sources(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stamp = kernel_cache.hash_sources()
    monkeypatch.setattr(kernel_cache, "_PACKAGE", copy)
    assert kernel_cache.hash_sources() == stamp
    seen = {stamp}
    # one more byte in any module of any folder
    for module in (*(f"{folder}/__init__.py" for folder in FOLDERS), "benchmarks/speed/plant.py"):
        with open(copy / module, "a") as source:
            source.write("\n")
        seen.add(kernel_cache.hash_sources())
    room = copy / "envs" / "vehicle"
    (room / "linear.py").rename(room / "linear_2.py")
    seen.add(kernel_cache.hash_sources())
    assert len(seen) == 7


SHIFT = """
from sideslip.envs.scenarios.road import TrackPath, compute_path_offset
print(compute_path_offset(TrackPath(1.0, 0.0, 1.0, 0.0, 0.0, 1.0), 0.25))
"""


def test_an_edit_in_a_callee_reaches_its_cached_callers(copy: Path, tmp_path: Path) -> None:
    """Numba alone would answer from the stale kernel: the function itself did not change."""
    cache = tmp_path / "cache"
    variables = {"XDG_CACHE_HOME": str(cache)}
    exact = 0.25**2 * (3.0 - 2.0 * 0.25)
    assert float(run(SHIFT, copy, **variables)) == exact
    assert len(list(cache.rglob("road.compute_path_offset*.kernel"))) == 1
    source = copy / "envs" / "numerics" / "functions.py"
    text = source.read_text()
    changed = text.replace("return t * t * (3.0 - 2.0 * t)", "return t * t * (6.0 - 4.0 * t)")
    assert changed != text
    source.write_text(changed)
    assert float(run(SHIFT, copy, **variables)) == 2.0 * exact


def test_old_versions_are_pruned_but_not_in_a_folder_of_the_users_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(variable, raising=False)
        base = tmp_path / variable
        kernels = base / "sideslip" / "kernels" if variable == "XDG_CACHE_HOME" else base
        for age in range(kernel_cache._MAX_VERSIONS + 3):
            old = kernels / f"version-{age}"
            old.mkdir(parents=True)
            os.utime(old, (1e9 - age, 1e9 - age))
        monkeypatch.setenv(variable, str(base))
        assert kernel_folder() == kernels / kernel_cache.hash_sources()
        left = {path.name for path in kernels.iterdir()} - {kernel_cache.hash_sources()}
        # our own newest folder is one of those that stay
        stay = kernel_cache._MAX_VERSIONS + (-1 if variable == "XDG_CACHE_HOME" else 3)
        assert left == {f"version-{age}" for age in range(stay)}


def test_plain_replaces_every_callee_and_leaves_the_original_alone() -> None:
    from sideslip.envs.vehicle.dynamics import kutta3

    function = jit.as_python(kutta3)
    seen: set[str] = set()
    todo: list[Any] = [function]
    while todo:
        each = todo.pop()
        seen.add(each.__name__)
        for name in each.__code__.co_names:
            callee = each.__globals__.get(name)
            assert not isinstance(callee, Dispatcher), f"{each.__name__} calls {name}"
            if hasattr(callee, "__code__") and callee.__name__ not in seen:
                todo.append(callee)
    assert {"kutta3", "_compute_rates", "_compute_slips", "sincos", "minimum", "floor"} <= seen
    assert jit.as_python(kutta3) is not function


def test_a_folder_that_can_only_be_read_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = tmp_path / kernel_cache.hash_sources("envs")
    assert kernel_folder("envs") == folder  # made

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError("read-only")

    monkeypatch.setattr(Path, "mkdir", refuse)
    monkeypatch.setattr(os, "utime", refuse)
    assert kernel_folder("envs") == folder
    folder.rmdir()
    assert kernel_folder("envs") is None


def test_a_folder_that_another_process_prunes_meanwhile_is_no_trouble(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    gone = [tmp_path / "gone"]
    monkeypatch.setattr(Path, "iterdir", lambda path: iter(gone))
    assert kernel_folder("envs") is not None


def test_numba_by_itself_gives_the_same_bits_and_says_so(tmp_path: Path) -> None:
    code = """
from sideslip.envs.scenarios.road import TrackPath, compute_path_offset
print(compute_path_offset(TrackPath(1.0, 0.3, 1.0, 0.7, 0.1, 1.0), 0.85).hex())
import sys; print("sideslip.envs.numerics.compiler" in sys.modules)
"""
    variables = {"XDG_CACHE_HOME": str(tmp_path / "stock"), "SIDESLIP_STOCK_NUMBA": "1"}
    stock, notices = processes.finish(processes.start(code, variables))
    ours = compute_path_offset(TrackPath(1.0, 0.3, 1.0, 0.7, 0.1, 1.0), 0.85)
    assert stock == [ours.hex(), "False"] and "sideslip.envs.numerics.compiler" in sys.modules
    assert len(notices.splitlines()) == 1 and "SIDESLIP_STOCK_NUMBA is set" in notices
    assert not (tmp_path / "stock").exists()  # nothing on disk


@pytest.mark.parametrize("version", ["0.99.1", "0.680.1"])
def test_a_numba_of_other_insides_compiles_by_itself(
    version: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kernel_cache, "_reported", set())
    monkeypatch.setattr(kernel_cache.logger, "hasHandlers", lambda: False)
    monkeypatch.delenv("SIDESLIP_QUIET", raising=False)
    monkeypatch.setattr(numba, "__version__", version)
    assert jit._load_compiler.__wrapped__() is None
    notices = capsys.readouterr().err
    assert len(notices.splitlines()) == 1 and version in notices


@jit.jit
def _product(a: Any, b: Any, c: Any) -> None:
    work = allocate_scratch(a, 2, 8)
    for i in range(len(a)):
        store8(work, 0.0, 1, 0)
        for k in range(len(b)):
            store8(work, load8(work, 1, 0) + a[i, k] * load8(b, k, 8), 1, 0)
        store8(c, load8(work, 1, 0), i, 8)


@jit.jit
def _mirror(a: Any, i: int, j: int) -> None:
    mirror(a, i, j)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.plain
def test_a_product_by_eights_is_that_of_single_numbers(rng: np.random.Generator) -> None:
    a, b, c = rng.normal(size=(5, 7)), rng.normal(size=(7, 16)), np.zeros((5, 16))
    _product(a, b, c)
    for i in range(5):
        for j in range(8, 16):
            total = 0.0
            for k in range(7):
                total += a[i, k] * b[k, j]
            assert c[i, j] == total
    assert not c[:, :8].any()


@pytest.mark.plain
@pytest.mark.parametrize("j", [0, 8])
def test_a_mirrored_block_is_the_transposed_one(rng: np.random.Generator, j: int) -> None:
    before = rng.normal(size=(16, 16))
    after = before.copy()
    _mirror(after, 0, j)
    above = np.triu_indices(8) if j == 0 else np.nonzero(np.ones((8, 8)))
    for i, k in zip(*above, strict=True):
        assert after[i, j + k] == before[i, j + k] == after[j + k, i]
    np.testing.assert_array_equal(after[8:, 8:], before[8:, 8:])
