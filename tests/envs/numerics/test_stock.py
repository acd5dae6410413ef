"""Any numba compiles the equations: without our compiler the numbers are the same."""

from pathlib import Path

import pytest

from ..processes import finish, start

USE = """
from sideslip.envs.scenarios.road import TrackPath, compute_path_offset
offset = compute_path_offset(TrackPath(1.0, 0.3, 1.0, 0.7, 0.1, 1.0), 0.85)
print(offset.hex(), compute_path_offset.signatures != [])
print("sideslip.envs.numerics.compiler" in sys.modules)
"""


def run(cache: Path, first: str = "", **variables: str) -> tuple[list[str], str]:
    code = f"import sys, numba\n{first}\n{USE}"
    return finish(start(code, {"XDG_CACHE_HOME": str(cache)} | variables))


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What the process with our compiler prints."""
    cache = tmp_path_factory.mktemp("ours")
    printed, _ = run(cache)
    assert printed[1] == "True" and list(cache.rglob("*.kernel"))
    return printed


@pytest.mark.parametrize(
    ("first", "variables", "reason"),
    [
        ("", {"SIDESLIP_STOCK_NUMBA": "1"}, "SIDESLIP_STOCK_NUMBA is set"),
        ("numba.__version__ = '0.99.1'", {}, "0.99.1"),
        ("numba.__version__ = '0.680.1'", {}, "0.680.1"),
        ("del numba.core.codegen.JITCodeLibrary", {}, "JITCodeLibrary"),
    ],
)
def test_numba_by_itself_gives_the_same_bits_and_says_so(
    ours: list[str], first: str, variables: dict[str, str], reason: str, tmp_path: Path
) -> None:
    stock, notices = run(tmp_path / "stock", first, **variables)
    assert stock == [ours[0], "False"]
    assert len(notices.splitlines()) == 1 and reason in notices
    assert not (tmp_path / "stock").exists()  # nothing on disk
