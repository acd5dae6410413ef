"""A session on disk gives the same estimates bit for bit, as far as it goes."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip.agents.live import controller
from sideslip.agents.live.controller import (
    _BLOCK,
    _BLOCK_MAGIC,
    _ITEM,
    Recorder,
    read_blocks,
    read_setup,
    replay_session,
)
from sideslip.agents.live.messages import PATIENCE
from tests.agents.live.both_ends import SEED, STEERING, drive, onboard, watch_ticks

SETUP: dict[str, Any] = {
    **{"estimator": "dakf", "agent": "lqr", "env": "sideslip/YawGps-v0"},
    **{key: {} for key in ("options", "agent_options", "estimator_options")},
    **{"seed": SEED, "patience": None},
}


@pytest.fixture(scope="module", params=[True, False], ids=["lock-step", "real time"])
def driven(request: Any, tmp_path_factory: Any) -> tuple[Path, Any, int | None]:
    """(a session's file, its estimates (T, 2 n), its patience); the real one at a fifth of the
    speed, so that rows are missing at many a deadline."""
    path = tmp_path_factory.mktemp("session") / "drive.session"
    car, found = onboard(STEERING, "dakf"), []
    recorder = Recorder(path, SETUP)
    drive(
        STEERING, car, request.param, recorder,
        lambda _: found.append(np.concatenate([car.x, car.std])),
        speed=1.0 if request.param else 0.2,
    )  # fmt: skip
    recorder.close()
    return path, np.array(found), None if request.param else 5 * PATIENCE


def test_a_replay_has_the_same_bits(driven: tuple[Path, Any, int | None]) -> None:
    path, estimates, patience = driven
    car, replayed = onboard(STEERING, "dakf"), list[Any]()
    watch_ticks(car, lambda _: replayed.append(np.concatenate([car.x, car.std])))
    ticks, same = replay_session(path, car, patience)
    assert same and read_setup(path) == SETUP
    assert np.array_equal(replayed, estimates) and ticks == len(estimates) >= 500


def test_a_second_drive_of_a_controller_replays(tmp_path: Path) -> None:
    car, recorder = onboard(STEERING, "dakf"), Recorder(tmp_path / "second.session", SETUP)
    drive(STEERING, car, True)
    drive(STEERING, car, True, recorder)
    recorder.close()
    assert replay_session(tmp_path / "second.session", onboard(STEERING, "dakf"), None)[1]


def test_a_file_that_is_cut_anywhere_is_read_up_to_there(
    driven: tuple[Path, Any, int | None], tmp_path: Path
) -> None:
    path, estimates, patience = driven
    data, cut = path.read_bytes(), tmp_path / "cut.session"
    blocks, car, lengths = list(read_blocks(path)), onboard(STEERING, "dakf"), set()
    replayed = list[Any]()
    watch_ticks(car, lambda _: replayed.append(np.concatenate([car.x, car.std])))
    assert len(blocks) >= 5
    beginning = data.index(b"BLOK")
    for size in [*range(beginning, len(data), len(data) // 23), len(data) - 1]:
        cut.write_bytes(data[:size])
        replayed.clear()
        ticks, same = replay_session(cut, car, patience)
        assert same and len(replayed) == ticks < len(estimates)
        assert not ticks or np.array_equal(replayed, estimates[:ticks])
        lengths.add(len(list(read_blocks(cut))))
    assert lengths <= set(range(len(blocks))) and len(lengths) > 3
    for size in range(beginning):
        cut.write_bytes(data[:size])
        with pytest.raises(ValueError, match="no session"):
            assert read_setup(cut)


def test_a_damaged_block_ends_the_replay_and_another_filter_is_found_out(
    driven: tuple[Path, Any, int | None], tmp_path: Path
) -> None:
    path, estimates, patience = driven
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.session"
    damaged.write_bytes(data)
    assert 0 < replay_session(damaged, onboard(STEERING, "dakf"), patience)[0] < len(estimates)
    other = onboard(STEERING, "exact-kf")
    assert not replay_session(path, other, patience)[1]


@pytest.mark.parametrize("items", [_ITEM.pack(7, 1) + b"a", _ITEM.pack(0, 9) + b"a", b"abc"])
def test_a_block_that_somebody_made_up_ends_the_replay(tmp_path: Path, items: bytes) -> None:
    """Its checksum is right: batches that are not there, lengths beyond its end."""
    path = tmp_path / "made-up.session"
    Recorder(path, {}).close()
    with path.open("ab") as file:
        file.write(_BLOCK.pack(_BLOCK_MAGIC, 2, len(items), zlib.crc32(items), 0) + items)
    assert list(read_blocks(path)) == []


@pytest.mark.parametrize(
    ("change", "what"), [({"agent": 3}, "agent"), ({"patience": "long"}, "patience"), ({}, "seed")]
)
def test_what_a_setup_lacks_is_named(tmp_path: Path, change: Any, what: str) -> None:
    path = tmp_path / "a.session"
    setup = SETUP | change if change else {k: v for k, v in SETUP.items() if k != "seed"}
    Recorder(path, setup).close()
    with pytest.raises(ValueError, match=f"its setup lacks {what}, or has it of another type"):
        assert read_setup(path)


def test_a_session_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.session"
    path.write_text("precious")
    with pytest.raises(FileExistsError):
        Recorder(path, SETUP)
    assert path.read_text() == "precious"


def test_after_a_crash_all_but_the_last_block_is_there(tmp_path: Path) -> None:
    """Nothing waits in memory but the block at hand."""
    path = tmp_path / "a.session"
    recorder = Recorder(path, SETUP)
    for i in range(3 * controller.MAX_BATCHES + 7):
        recorder.take([bytes([i % 256])], 0)
    batches = [batch for block in read_blocks(path) for batch in block[0]]
    assert [batch[0].data[0] for batch in batches] == [i % 256 for i in range(300)]
    recorder.close()
    assert sum(len(block[0]) for block in read_blocks(path)) == 307
