"""The render modes: Gymnasium's and stable-baselines3's wrappers, windows, and what is refused."""

import copy
import importlib
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AddRenderObservation, HumanRendering, RecordVideo
from gymnasium.wrappers.vector import RecordVideo as RecordVideos

pytest.importorskip("pygame")
from sideslip.envs import StabilityEnv, StabilityVectorEnv
from sideslip.estimators import EstimateObservation
from sideslip.estimators.vector import EstimateObservation as EstimateObservations

from .. import processes
from ..helpers import IDS

FRAME = (540, 960, 3)
SHORT: dict[str, Any] = {"scenario": {"base": "slalom", "duration": 0.05}}
DRAWN: dict[str, Any] = {**SHORT, "render_mode": "rgb_array"}


@pytest.fixture
def no_warnings() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*is out of date")
        yield


@pytest.fixture
def screenless(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)


def driven(env: Any) -> None:
    """One episode."""
    env.reset(seed=0)
    for _ in range(6):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample() * 0)
        if np.all(np.logical_or(terminated, truncated)):
            break
    env.close()


@pytest.mark.parametrize("name", IDS)
def test_every_id_keeps_gymnasiums_contract(no_warnings: None, name: str) -> None:
    check_env(gym.make(name, **DRAWN).unwrapped)


def test_gymnasiums_wrappers(no_warnings: None, tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env: Any = EstimateObservation(gym.make("sideslip/YawFusion-v0", **DRAWN), "exact-kf")
    driven(RecordVideo(env, str(tmp_path / "one"), disable_logger=True))
    driven(HumanRendering(gym.make("sideslip/YawFusion-v0", **DRAWN)))
    shown = AddRenderObservation(gym.make("sideslip/YawFusion-v0", **DRAWN))
    assert shown.reset(seed=0)[0].shape == FRAME
    rows: Any = gym.make_vec("sideslip/YawFusion-v0", num_envs=2, **DRAWN)
    driven(RecordVideos(EstimateObservations(rows, "exact-kf"), str(tmp_path / "rows")))
    films = [each.stat().st_size for each in tmp_path.rglob("*.mp4")]
    assert len(films) >= 2 and min(films) > 5000


def test_stable_baselines_records_what_it_makes(no_warnings: None, tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    util = pytest.importorskip("stable_baselines3.common.env_util")
    from stable_baselines3.common.vec_env import VecVideoRecorder

    from sideslip.agents.vec_env import make_vec_env

    name = "sideslip/YawVision-v0"
    theirs = util.make_vec_env(name, 2, seed=0, env_kwargs=SHORT)
    ours = make_vec_env(name, 2, seed=0, estimator="exact-kf", env_kwargs=DRAWN)
    assert theirs.render_mode == ours.render_mode == "rgb_array"
    for i, env in enumerate((theirs, ours)):
        assert env.render_mode == "rgb_array"
        film = VecVideoRecorder(env, str(tmp_path), lambda step: step == 0, 3, f"film{i}")
        film.reset()
        for _ in range(4):
            film.step(np.zeros((2, 1), np.float32))
        assert film.frames_per_sec == 100
        film.close()
    assert len(list(tmp_path.glob("*.mp4"))) == 2


def test_a_row_is_drawn_as_the_car_alone() -> None:
    arguments: dict[str, Any] = {"scenario": "slalom", "render_mode": "rgb_array"}
    cars = gym.make_vec("sideslip/YawFusion-v0", num_envs=2, **arguments)
    rows = EstimateObservations(cars, "exact-kf")
    alone = EstimateObservation(gym.make("sideslip/YawFusion-v0", **arguments), "exact-kf")
    rows.reset(seed=4)
    alone.reset(seed=5)
    for _ in range(2):
        frames = rows.render()
        assert frames is not None and len(frames) == 2
        assert np.array_equal(np.asarray(frames[1]), np.asarray(alone.render()))
        assert not np.array_equal(np.asarray(frames[0]), np.asarray(frames[1]))
        for _ in range(15):
            rows.step(np.full((2, 1), 0.3, np.float32))
            alone.step(np.full(1, 0.3, np.float32))


def test_a_window_shows_the_first_car() -> None:
    import pygame

    for env in (
        gym.make("sideslip/YawVision-v0", **SHORT, render_mode="human"),
        gym.make_vec("sideslip/YawVision-v0", num_envs=2, **SHORT, render_mode="human"),
    ):
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert env.render() is None
        window = pygame.display.get_surface()
        assert window is not None and window.get_size() == (960, 540)
        assert pygame.surfarray.array3d(window).std() > 10.0
        env.close()
        assert pygame.display.get_surface() is None


def test_without_a_display_nothing_is_shown_and_a_warning_says_so(screenless: None) -> None:
    """So Gymnasium's checker, which tries each mode, passes on a server."""
    env = StabilityEnv(render_mode="human")
    with pytest.warns(UserWarning, match=r"no display .*render_mode='rgb_array' returns frames"):
        env.reset(seed=0)
    assert env.render() is None
    env.close()


def test_render_fps_is_real_time() -> None:
    for period, rate in ((10, 100), (33, 30), (1, 1000), (1000, 1)):
        assert StabilityEnv(control_period=period).metadata["render_fps"] == rate
    assert gym.make_vec("sideslip/YawGps-v0").metadata["render_fps"] == 100
    assert StabilityEnv.metadata["render_modes"] == ["human", "rgb_array"]


def test_what_cannot_be_drawn_is_refused() -> None:
    drawn: dict[str, Any] = {"render_mode": "rgb_array"}
    for env in (StabilityEnv(**drawn), StabilityVectorEnv(2, **drawn)):
        with pytest.raises(ResetNeeded, match=r"nothing to draw yet: call reset\(\)"):
            env.render()
    silent = StabilityEnv()
    with pytest.warns(UserWarning, match="made without a render_mode"):
        assert silent.render() is None


def test_a_copy_draws_the_same() -> None:
    env = StabilityEnv(render_mode="rgb_array", scenario="slalom")
    env.reset(seed=0)
    env.render()
    env.step([0.5])
    other = copy.deepcopy(env)
    assert np.array_equal(np.asarray(env.render()), np.asarray(other.render()))
    other.step([1.0])
    assert len(env.make_render_state().trace.select_since(0.0)[0]) == 2


def test_pygame_is_asked_for_by_the_name_of_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("sideslip.envs.rendering.canvas")
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sideslip\[render\]'"):
        importlib.reload(module)
    monkeypatch.undo()
    importlib.reload(module)


def test_who_draws_nothing_loads_nothing() -> None:
    program = (
        "import sys, gymnasium, sideslip; "
        "gymnasium.make('sideslip/YawVision-v0', render_mode='rgb_array'); "
        "print([name for name in ('pygame', 'moviepy', 'cv2', 'PIL') if name in sys.modules])"
    )
    assert processes.finish(processes.start(program, {}))[0] == ["[]"]


def test_a_masked_reset_leaves_the_others_charts() -> None:
    env: Any = gym.make_vec(
        "sideslip/YawVision-v0", num_envs=2, autoreset_mode="Disabled", render_mode="rgb_array"
    )
    env.reset(seed=0)
    env.render()
    for _ in range(5):
        env.step(np.zeros((2, 1), np.float32))
    before = env.render()[1]
    env.reset(options={"reset_mask": np.array([True, False])})
    first, second = env.render()
    np.testing.assert_array_equal(second, before)
    assert (first != before).any()
