"""What somebody else could have written is not run: kernels are compiled in memory, and one line
says so."""

import errno
import hashlib
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sideslip.envs.numerics import compiler, kernel_cache
from sideslip.envs.numerics.compiler import _Kernel

kernel_folder = kernel_cache.find_kernel_folder.__wrapped__  # asked anew each time
KERNELS = "sideslip/kernels"
LEVELS = ("", "sideslip", KERNELS, f"{KERNELS}/{kernel_cache.hash_sources('envs')}")


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As in a process of its own, in which nothing was said yet."""
    monkeypatch.setattr(compiler, "_libraries", {})
    monkeypatch.setattr(kernel_cache, "_reported", {"compiling"})
    monkeypatch.setattr(kernel_cache.logger, "hasHandlers", lambda: False)
    for name in ("NUMBA_CACHE_DIR", "SIDESLIP_QUIET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "base"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """The file of a cached kernel, in a folder of the user's."""
    compiled(tmp_path / "kernels")
    (path,) = (tmp_path / "kernels").iterdir()
    compiler._libraries.clear()
    return path


def compiled(folder: Path, function: Any = None) -> bool:
    """Whether a kernel was compiled, and not loaded from a folder; its result is right anyhow."""
    folder.mkdir(mode=0o700, exist_ok=True)
    kernel: Any = _Kernel(function or _tripled, targetoptions={"nopython": True}, folder=folder)
    assert kernel(2.0) == (6.0 if function is None else function(2.0))
    return bool(kernel.parts)


def _tripled(x: float) -> float:
    return 3.0 * x


def _halved(x: float) -> float:
    return 0.5 * x


def belongs_to_another(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A path that belongs neither to this user nor to root, whoever runs the tests."""
    if os.geteuid() == 0:
        os.chown(path, 12345, 12345, follow_symlinks=False)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)


class _Bomb:
    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, ("exploded",)


def digested(data: bytes) -> bytes:
    return hashlib.sha256(data).digest() + data


def test_a_pickle_is_not_opened(
    planted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not even where digest, owner and mode are right."""
    for content in (pickle.dumps(_Bomb()), pickle.dumps((b"", _Bomb(), (), ()), protocol=0)):
        planted.write_bytes(digested(content))
        assert compiled(planted.parent)
        compiler._libraries.clear()
    assert not (tmp_path / "exploded").exists()
    assert capsys.readouterr().err.count(str(planted)) == 1
    assert not compiled(planted.parent)  # the file is a kernel's again


def test_another_kernels_file_is_not_run(
    planted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compiled(tmp_path / "other", _halved)
    (other,) = (tmp_path / "other").iterdir()
    planted.write_bytes(other.read_bytes())
    compiler._libraries.clear()
    assert compiled(planted.parent)
    assert "another kernel's" in capsys.readouterr().err


@pytest.mark.parametrize(
    "header",
    [1, [], ["too short"], {"kernel": 1}, ["", "", "", [], [["..", "x"]]], ["", "", "", [], [3]]],
    ids=str,
)
def test_a_file_that_says_nonsense_is_compiled_again(
    header: Any, planted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = planted.read_bytes()[32:].partition(b"\n")[0]
    if isinstance(header, list) and len(header) == 5:
        header[0] = json.loads(head)[0]  # the right key
    planted.write_bytes(digested(json.dumps(header).encode() + b"\nno machine code"))
    assert compiled(planted.parent)
    assert len(capsys.readouterr().err) < 600


@pytest.mark.parametrize("fault", ["group", "others", "owner", "link", "pipe", "folder"])
def test_a_file_that_others_could_have_written_is_not_read(
    fault: str, planted: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good = planted.with_name("good")
    if fault in ("group", "others"):
        planted.chmod(0o620 if fault == "group" else 0o602)
    elif fault == "owner":
        belongs_to_another(planted, monkeypatch)
    else:
        planted.rename(good)
        if fault == "link":
            planted.symlink_to(good)
        elif fault == "pipe":
            os.mkfifo(planted)  # whoever opens it waits for a writer
        else:
            planted.mkdir()
    assert kernel_cache.read_trusted(planted) is None
    message = capsys.readouterr().err
    assert str(planted) in message and len(message.splitlines()) == 1
    assert compiled(planted.parent)
    assert good.exists() == (fault in ("link", "pipe", "folder"))
    assert capsys.readouterr().err == ""


def test_what_is_checked_is_what_is_read(planted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that is exchanged once it is open changes nothing, whichever is the good one."""
    whole, really = planted.read_bytes(), os.open
    planted.chmod(0o666)

    def exchanged(path: Any, *args: Any, **keywords: Any) -> int:
        opened = really(path, *args, **keywords)
        if path == planted.name:
            planted.unlink()
            planted.write_bytes(b"exchanged")
            planted.chmod(0o600 if first else 0o666)
        return opened

    for first in (True, False):
        monkeypatch.setattr(os, "open", exchanged)
        assert kernel_cache.read_trusted(planted) == (None if first else whole)
        monkeypatch.setattr(os, "open", really)
        assert planted.read_bytes() == b"exchanged"
        planted.write_bytes(whole)
        planted.chmod(0o600)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("fault", ["group", "others", "owner", "link", "file"])
def test_a_folder_that_others_could_write_is_not_used(
    fault: str, level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert kernel_folder("envs") == tmp_path / "base" / LEVELS[-1]
    folder = tmp_path / "base" / level
    if fault in ("group", "others"):
        folder.chmod(0o770 if fault == "group" else 0o777)
    elif fault == "owner":
        belongs_to_another(folder, monkeypatch)
    else:
        folder.rename(tmp_path / "moved")
        if fault == "file":
            folder.write_text("no folder")
        else:
            folder.symlink_to(tmp_path / "moved")
            if level == "":  # the user's own link is his choice
                assert kernel_folder("envs") == tmp_path / "moved" / LEVELS[-1]
                belongs_to_another(folder, monkeypatch)
    assert kernel_folder("envs") is None
    message = capsys.readouterr().err
    assert "not cached" in message and str(tmp_path) in message and message.count("\n") == 1
    assert kernel_folder("envs") is None and capsys.readouterr().err == ""


def test_where_no_folder_can_be_made_the_reason_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert kernel_folder("envs") is None
    assert "are not cached: [Errno 30] Read-only file system" in capsys.readouterr().err


def test_a_kernels_folder_is_checked_whenever_it_is_read(planted: Path) -> None:
    planted.parent.chmod(0o777)
    assert kernel_cache.read_trusted(planted) is None


@pytest.mark.parametrize(
    "variables",
    [{"XDG_CACHE_HOME": "here"}, {"NUMBA_CACHE_DIR": "./here"}, {"HOME": ""}, {"HOME": "here"}, {}],
    ids=str,
)
def test_a_path_that_is_not_absolute_is_not_used(
    variables: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """A folder that was downloaded and is worked in could bring kernels."""
    for name in ("XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "here").mkdir(mode=0o700)
    assert kernel_folder("envs") is None
    message = capsys.readouterr().err
    assert next(iter(variables), "HOME") in message and "absolute" in message
    assert [path.name for path in tmp_path.rglob("*")] == ["here"]


def test_what_is_made_is_the_users_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "far" / "base"))
    old = os.umask(0)
    try:
        folder = kernel_folder("envs")
        assert folder is not None
        compiled(folder)
    finally:
        os.umask(old)
    modes = {path: path.stat().st_mode & 0o777 for path in (tmp_path / "far").rglob("*")}
    modes[tmp_path / "far"] = (tmp_path / "far").stat().st_mode & 0o777
    (file,) = folder.iterdir()
    assert modes.pop(file) == 0o600
    assert len(modes) == 5 and set(modes.values()) == {0o700}


def test_a_folder_for_all_where_none_takes_anothers_place_is_used(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base").chmod(0o1777)  # as /tmp
    assert kernel_folder("envs") == tmp_path / "base" / LEVELS[-1]
