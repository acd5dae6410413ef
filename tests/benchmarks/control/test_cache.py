"""A case on disk is a result only where it is whole and its own."""

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.control import run
from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.run import Chunk, DriveResult, _hash_chunk, _StoredDrives
from sideslip.benchmarks.control.tasks import ControlTask
from sideslip.envs.numerics import kernel_cache

SEEDS = (3, 4, 5)
NUMBERS, SIGNALS = len(run.NUMBERS), 1 + len(run.SIGNALS)


def _turned_over(path: Path, array: str, share: float) -> None:
    """Eight bytes of an array's data; some of a header mean nothing."""
    with zipfile.ZipFile(path) as archive:
        entry = archive.getinfo(f"{array}.npy")
    content = bytearray(path.read_bytes())
    at = entry.header_offset
    start = at + 30 + sum(int.from_bytes(content[at + k : at + k + 2], "little") for k in (26, 28))
    first = start + int(share * (entry.compress_size - 8))
    for i in range(first, first + 8):
        content[i] ^= 0xFF
    path.write_bytes(content)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "no archive": lambda path: path.write_bytes(b"PK\x03\x04" + b"\0" * 99),
    "another archive": lambda path: path.write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr': "),
    **{
        f"{array} turned over at {share}": partial(_turned_over, array=array, share=share)
        for array in ("numbers", "series")
        for share in (0.1, 0.9)
    },
    "pickled": lambda path: np.savez(path, numbers=np.full((len(SEEDS), NUMBERS), None)),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_case_is_driven_again(damage: str, tmp_path: Path) -> None:
    """Not taken for a result, and no error."""
    rng = np.random.default_rng(1)
    numbers, series = rng.normal(size=(len(SEEDS), NUMBERS)), rng.normal(size=(9, SIGNALS))
    driven: list[Chunk] = []

    def drive_it(chunk: Chunk) -> DriveResult:
        driven.append(chunk)
        return DriveResult(numbers, series)

    cached = _StoredDrives(tmp_path, drive_it)
    chunk = Chunk(ControlTask(scenario="gust"), Entry("none"), SEEDS, keep=True)
    cached(chunk)
    (path,) = tmp_path.iterdir()
    DAMAGE[damage](path)
    for _ in range(2):  # the second time from the file, which is whole again
        found = cached(chunk)
        assert np.array_equal(found.numbers, numbers)
        assert found.series is not None and np.array_equal(found.series, series)
    assert len(driven) == 2
    assert list(tmp_path.iterdir()) == [path]


def test_what_could_not_be_driven_is_not_kept(tmp_path: Path) -> None:
    failed = DriveResult(np.full((len(SEEDS), NUMBERS), np.nan), error="no solver")
    chunk = Chunk(ControlTask(scenario="gust"), Entry("none"), SEEDS)
    assert _StoredDrives(tmp_path, lambda _: failed)(chunk).error == "no solver"
    assert not list(tmp_path.iterdir())


def test_other_options_of_an_id_and_another_car_s_file_are_another_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scratch package: an id's options stand at its root, cars and cameras in files."""
    monkeypatch.setattr(kernel_cache, "_PACKAGE", tmp_path)
    (tmp_path / "__init__.py").write_text("a")
    seen = [kernel_cache.hash_experiment()]
    for path in ("__init__.py", "envs/vehicle/car.toml", "envs/camera.json", "envs/tick.py"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("b")
        seen.append(kernel_cache.hash_experiment())
    assert len(set(seen)) == 5
    (tmp_path / "envs/notes.txt").write_text("b")
    assert kernel_cache.hash_experiment() == seen[-1]


def test_other_tuned_options_are_another_case(monkeypatch: pytest.MonkeyPatch) -> None:
    """The salt follows them, and a case's name the salt: a tuning makes old cases nobody's."""
    chunk = Chunk(ControlTask(scenario="gust"), Entry("nominal"), SEEDS)
    names = []
    for salt in ("one", "another", "one"):
        monkeypatch.setattr(run, "make_salt", lambda salt=salt: salt)
        run.hash_sources.cache_clear()
        names.append(_hash_chunk(chunk))
    run.hash_sources.cache_clear()
    assert names[0] == names[2] != names[1]
