"""A file is whole or as it was; links, modes, pipes and devices stay what they are."""

import os
import pty
import stat
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sideslip.envs.io import atomic_file, write_atomic


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "file"


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_new_file_has_the_umasks_mode(path: Path) -> None:
    old = os.umask(0o027)
    try:
        write_atomic(path, b"new")
    finally:
        os.umask(old)
    assert path.read_bytes() == b"new" and mode_of(path) == 0o640
    assert os.listdir(path.parent) == ["file"]


@pytest.mark.parametrize("mode", [0o600, 0o644, 0o664, 0o755, 0o400])
def test_an_older_files_mode_stays(mode: int, path: Path) -> None:
    path.write_bytes(b"old")
    path.chmod(mode)
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new" and mode_of(path) == mode


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_an_older_files_owner_stays(path: Path) -> None:
    path.write_bytes(b"old")
    os.chown(path, 12345, 12346)
    path.chmod(0o600)
    write_atomic(path, b"new")
    found = path.stat()
    assert (found.st_uid, found.st_gid, mode_of(path)) == (12345, 12346, 0o600)


@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_and_its_target_is_written(there: bool, path: Path) -> None:
    link, folder = path.with_name("link"), path.with_name("folder")
    folder.mkdir()
    target = folder / "target"
    if there:
        target.write_bytes(b"old")
        target.chmod(0o600)
    path.symlink_to("folder/target")
    link.symlink_to("file")  # a link to a link
    write_atomic(link, b"new")
    assert link.is_symlink() and path.is_symlink()
    assert target.read_bytes() == b"new" and os.listdir(folder) == ["target"]
    assert not there or mode_of(target) == 0o600


def test_a_pipe_is_written_and_stays(path: Path) -> None:
    os.mkfifo(path)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(path.read_bytes()), daemon=True)
    reader.start()
    write_atomic(path, b"new")
    reader.join(timeout=10)
    assert read == [b"new"] and stat.S_ISFIFO(path.stat().st_mode)
    assert os.listdir(path.parent) == ["file"]


def test_a_device_is_written_and_stays() -> None:
    ours, theirs = pty.openpty()
    write_atomic(os.ttyname(theirs), b"new")
    assert os.read(ours, 3) == b"new" and stat.S_ISCHR(os.stat(os.ttyname(theirs)).st_mode)
    os.close(ours)
    os.close(theirs)


WRITE = """
import sys
from sideslip.envs.io import write_atomic
print("before", flush=True)
write_atomic(sys.argv[1], b"rows\\n")
print("after")
"""


@pytest.mark.parametrize(
    ("name", "to"), [("/dev/stdout", "file"), ("/dev/fd/1", "pipe"), ("/proc/self/fd/1", "file")]
)
def test_standard_output_is_written_where_it_goes(name: str, to: str, path: Path) -> None:
    """What is printed before and after stays, also where the shell sends it to a file."""
    command = [sys.executable, "-c", WRITE, name]
    if to == "pipe":
        out = subprocess.run(command, capture_output=True, check=True).stdout
    else:
        with path.open("ab") as file:
            subprocess.run(command, stdout=file, check=True)
        out = path.read_bytes()
        assert os.listdir(path.parent) == ["file"]
    assert out == b"before\nrows\nafter\n"


def test_nothing_is_written_where_the_writer_fails(path: Path) -> None:
    path.write_bytes(b"old")
    with pytest.raises(ValueError, match="no more"), atomic_file(path) as file:
        file.write(b"half of it")
        raise ValueError("no more")
    assert path.read_bytes() == b"old" and os.listdir(path.parent) == ["file"]


def test_a_full_disk_leaves_the_older_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old" and os.listdir(path.parent) == ["file"]


def test_a_folder_is_refused(path: Path) -> None:
    path.mkdir()
    with pytest.raises(IsADirectoryError):
        write_atomic(path, b"new")
    assert os.listdir(path) == [] and os.listdir(path.parent) == ["file"]


def test_writers_at_once_leave_one_whole_file(path: Path) -> None:
    """Each has a part of its own, in one process too."""
    contents = [bytes([65 + i]) * 100_000 for i in range(8)]
    started = threading.Barrier(len(contents))

    def write(content: bytes) -> None:
        with atomic_file(path) as file:
            started.wait(timeout=10)  # all are at it
            file.write(content)

    with ThreadPoolExecutor(len(contents)) as pool:
        list(pool.map(write, contents))
    assert path.read_bytes() in contents and os.listdir(path.parent) == ["file"]


def test_a_long_name_is_written(path: Path) -> None:
    long = path.with_name("n" * 255)
    write_atomic(long, b"new")
    assert long.read_bytes() == b"new"


def test_a_link_to_itself_is_refused_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "link"
    path.symlink_to(path)
    with pytest.raises(OSError, match="symbolic links"):
        write_atomic(path, b"new")
    assert path.is_symlink()
