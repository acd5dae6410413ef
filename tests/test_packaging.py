"""The root is the package: what ships, what `src` points to, what an import costs."""

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import gymnasium
import pytest

import sideslip

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("envs", "estimators", "agents", "benchmarks")
FACE = ("__init__.py", "__main__.py", "py.typed")
HEAVY = {
    "control",
    "cv2",
    "filterpy",
    "highway_env",
    "matplotlib",
    "numba",
    "omegaconf",
    "optuna",
    "pandas",
    "plotly",
    "scipy",
    "sqlalchemy",
    "stable_baselines3",
    "torch",
    "vehiclemodels",
}

DRIVEN = (
    *("control", "cv2", "matplotlib", "pandas", "plotly", "torch"),
    *("scipy.optimize", "scipy.signal", "scipy.stats"),
)
"""Modules that `sideslip run` does not load."""
SLOW = (*DRIVEN, "scipy.linalg", "scipy.special")
"""Modules that a command without a drive does not load."""


def python(code: str, cwd: Path) -> str:
    """Run code in a fresh interpreter that finds the same `sideslip`, and return what it prints."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    return run.stdout


def shipped() -> set[str]:
    """The files that git tracks, or would after `git add`, and that belong in the package."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if run.returncode:
        pytest.skip("this copy is not a git checkout")
    names = [name for name in run.stdout.split("\0") if name and (ROOT / name).exists()]
    return {name for name in names if name in FACE or name.split("/")[0] in PACKAGES}


def test_wheel_holds_the_tracked_files_and_nothing_else(tmp_path: Path) -> None:
    builders = pytest.importorskip("hatchling.builders.wheel")
    builder = builders.WheelBuilder(str(ROOT))
    (wheel,) = builder.build(directory=str(tmp_path), versions=["standard"])
    names = zipfile.ZipFile(wheel).namelist()
    inside = {name for name in names if ".dist-info/" not in name}
    assert inside == {f"sideslip/{name}" for name in shipped()}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_links_are_the_packages() -> None:
    plate = ROOT / "src" / "sideslip"
    links = [path for path in plate.iterdir() if path.name != "__pycache__"]
    assert {link.name for link in links} == {*PACKAGES, *FACE}
    for link in links:
        assert os.readlink(link) == f"../../{link.name}"
        assert link.resolve() == ROOT / link.name
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests"}
    assert folders == set(PACKAGES)


@pytest.mark.smoke
def test_import_loads_no_heavy_module_and_none_of_ours(tmp_path: Path) -> None:
    code = "import sys, sideslip; print(*{name.split('.')[0] for name in sys.modules})"
    assert not HEAVY & set(python(code, tmp_path).split())
    code = "import sys, sideslip; print(*[n for n in sys.modules if n.startswith('sideslip')])"
    assert python(code, tmp_path).split() == ["sideslip"]


@pytest.mark.parametrize("command", ["--help", "--version", "list", "bench --help", "run --help"])
def test_a_command_that_drives_nothing_loads_nothing_slow(command: str, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        f"sys.argv = ['sideslip', *{command.split()!r}]\n"
        "from sideslip.__main__ import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        f"print('loaded', [name for name in {SLOW!r} if name in sys.modules])"
    )
    assert python(code, tmp_path).splitlines()[-1] == "loaded []"


@pytest.mark.parametrize(
    "agent",
    [
        "none",
        "lqr --estimator exact-kf",
        "lqr --estimator joint",
        "two-dof --estimator multirate-kf",
    ],
)
def test_a_drive_loads_nothing_slow_that_it_does_not_use(agent: str, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        f"sys.argv = ['sideslip', 'run', '--agent', *{agent.split()!r}]\n"
        "from sideslip.__main__ import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        f"print('loaded', [name for name in {DRIVEN!r} if name in sys.modules])"
    )
    assert python(code, tmp_path).splitlines()[-1] == "loaded []"


@pytest.mark.parametrize("own", [None, "3"])
def test_a_command_takes_one_thread_for_small_matrices_unless_told(
    own: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if own:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", own)
    code = "import os, sideslip.__main__; print(os.environ['OPENBLAS_NUM_THREADS'])"
    assert python(code, tmp_path).strip() == (own or "1")


@pytest.mark.smoke
def test_lazy_names_are_listed_and_others_refused() -> None:
    assert {"rollout", "make_agent", "make_estimator"} <= set(dir(sideslip))
    with pytest.raises(AttributeError, match="no attribute 'make_coffee'"):
        sideslip.make_coffee  # noqa: B018


@pytest.mark.smoke
@pytest.mark.plain
@pytest.mark.parametrize("name", sideslip.__all__)
def test_every_name_of_the_face_can_be_had(name: str) -> None:
    assert getattr(sideslip, name)


@pytest.mark.smoke
def test_second_import_under_another_name_registers_nothing_new() -> None:
    before = {name: id(spec) for name, spec in gymnasium.registry.items()}
    assert any(name.startswith("sideslip/") for name in before)
    path = sideslip.__file__
    assert path is not None
    spec = importlib.util.spec_from_file_location("checkout", path)
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    assert {name: id(spec) for name, spec in gymnasium.registry.items()} == before


@pytest.mark.smoke
@pytest.mark.parametrize("name", ["envs", "main.envs"])
def test_envs_refuses_another_name(name: str) -> None:
    path = Path(sideslip.__file__ or "").parent / "envs" / "__init__.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    with pytest.raises(ImportError, match=f"sideslip.envs.*as {name}"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


@pytest.mark.smoke
def test_one_version() -> None:
    assert importlib.metadata.version("sideslip") == sideslip.__version__, (
        "the installation is older than the version: touch pyproject.toml and make again"
    )


def test_the_citation_is_of_this_version() -> None:
    # No smoke test: the wheel does not carry the file.
    text = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (.+)$", text, re.MULTILINE) == [sideslip.__version__]


def test_what_is_no_code_is_installed_too() -> None:
    from sideslip.agents.learned.policy import list_shipped, load_policy
    from sideslip.benchmarks.speed.plant import read_source

    assert list_shipped() and all(load_policy(name).card.command for name in list_shipped())
    assert "plant" in read_source()
