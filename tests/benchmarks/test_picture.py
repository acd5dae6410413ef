"""The benchmark's picture: who drives a part of the contests is marked."""

from pathlib import Path

import pytest

from sideslip.benchmarks.control.tasks import list_scored_tasks
from sideslip.benchmarks.harness.results import ResultRow, Suite
from sideslip.benchmarks.picture import _find_partial_entries, write_picture

MINE = [each.name for each in list_scored_tasks() if each.tier == "road"]
STEERING = [name for name in MINE if name.endswith("steering")]


def driven(who: str, names: list[str]) -> list[ResultRow]:
    return [
        ResultRow("control", name, "score", 0.5, controller=who) for name in (*names, "tier road")
    ]


def test_a_score_over_a_part_of_a_tiers_contests_is_marked(tmp_path: Path) -> None:
    """Of this tier: what anybody drives of another one is no part of it."""
    assert 0 < len(STEERING) < len(MINE)
    elsewhere = next(each.name for each in list_scored_tasks() if each.tier == "small car")
    rows = driven("lqr", MINE) + driven("model-following", STEERING)
    rows += [ResultRow("control", elsewhere, "score", 0.5, controller="lqr")]
    assert _find_partial_entries(rows, "tier road") == {"model-following"}
    assert _find_partial_entries(rows, "tier small car") == set()
    pytest.importorskip("matplotlib")
    for ending, head in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        path = tmp_path / f"bench.{ending}"
        write_picture(path, [Suite("control", "Who", "How", rows)])
        assert path.stat().st_size > 10_000 and path.read_bytes().startswith(head)
