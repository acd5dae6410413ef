"""The fused kernel takes the steps of the compiled engine: the same bits, episode after episode.

On a GPU, or with NUMBA_ENABLE_CUDASIM=1 in numba's simulator (`test_cuda_kernel.py`).
"""

from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

torch = pytest.importorskip("torch")
pytest.importorskip("numba_cuda")

from sideslip.envs import StabilityVectorEnv  # noqa: E402
from sideslip.envs.device.cuda_env import CudaVectorEnv  # noqa: E402
from sideslip.envs.device.cuda_kernel import SIMULATED  # noqa: E402

from ..helpers import bits  # noqa: E402

pytestmark = pytest.mark.skipif(
    not (SIMULATED or torch.cuda.is_available()),
    reason="there is no GPU; the same tests run in numba's simulator",
)
DEVICE = "cpu" if SIMULATED else "cuda"
N = 5  # of blocks of 4 in the simulator, of 128 on a GPU: never a multiple
SHORT: dict[str, Any] = {"base": "random-steering", "duration": 0.05}
FUSION: dict[str, Any] = {"sensors": "fusion", "scenario": SHORT, "on_bad_action": "fail"}


def both(mode: str = "NextStep", **arguments: Any) -> tuple[CudaVectorEnv, StabilityVectorEnv]:
    told = FUSION | arguments
    ours = CudaVectorEnv(N, device=DEVICE, autoreset_mode=mode, record=True, **told)
    return ours, StabilityVectorEnv(N, autoreset_mode=mode, **told)


def same(ours: CudaVectorEnv, theirs: StabilityVectorEnv, one: Any, other: Any) -> None:
    """What a reset or a step returned, and the records, bit for bit."""
    for mine, wanted in zip(one[:-1], other[:-1], strict=True):
        assert mine.device.type == torch.device(DEVICE).type
        assert bits(mine.cpu().numpy()) == bits(wanted)
    for name, values in other[-1].items():
        if not name.startswith(("_", "final")):
            there = other[-1][f"_{name}"]  # the rest was not reset
            assert bits(one[-1][name].cpu().numpy()[there]) == bits(values[there]), name
    if "final_obs" in other[-1]:
        over = other[-1]["_final_obs"]
        for mask in ("_final_obs", "_final_info"):
            assert one[-1][mask].tolist() == over.tolist()
        final = one[-1]["final_obs"].cpu().numpy()
        assert bits(final[over]) == bits(np.stack(other[-1]["final_obs"][over]))
        assert not final[~over].any()
        for name, mine in one[-1]["final_info"].items():
            assert bits(mine.cpu().numpy()[over]) == bits(other[-1]["final_info"][name][over]), name
    assert bits(ours.motion.cpu().numpy()) == bits(theirs.motion)
    assert ours.ticks_done.tolist() == theirs.ticks_done.tolist()
    assert ours.delivered.tolist() == theirs.delivered.tolist()
    rows, packets = ours.rows.cpu().numpy(), ours.packets.cpu().numpy()
    for i in range(N):
        done, delivered = theirs.ticks_done[i], theirs.delivered[i]
        assert bits(rows[i, :done]) == bits(theirs.rows[i, :done])
        assert bits(packets[i, :delivered]) == bits(theirs.packets[i, :delivered])


def drive(ours: CudaVectorEnv, theirs: StabilityVectorEnv, steps: int, seed: int = 3) -> int:
    """Both from a seed on, with the same random actions; how many episodes ended."""
    same(ours, theirs, ours.reset(seed=seed), theirs.reset(seed=seed))
    rng, ended = np.random.default_rng(seed), 0
    for _ in range(steps):
        actions = rng.uniform(-1.2, 1.2, theirs.action_space.shape or ()).astype(np.float32)
        one = ours.step(torch.as_tensor(actions, device=DEVICE))
        other = theirs.step(actions)
        same(ours, theirs, one, other)
        ended += int((other[2] | other[3]).sum())
    return ended


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episode_after_episode(mode: str) -> None:
    assert drive(*both(mode), steps=13) >= 2 * N


WANDER: dict[str, Any] = {
    "base": "straight", "steering": "wander", "amplitude": 0.02, "frequency": 1.0, "hold": 0.002,
}  # fmt: skip
CASES: list[dict[str, Any]] = [
    {"scenario": {"base": "double-lane-change", "duration": 0.04}, "steering": True},
    {"scenario": {"base": "tie-vision-fig7", "duration": 0.1}, "sensors": "vision"},
    {"scenario": {"base": "sensor-outage", "duration": 0.3}, "reference": "lagged"},
    {"scenario": {"base": "stiffness-step", "duration": 0.04}, "fast": "all"},
    {"scenario": {"base": "gust", "duration": 0.04, "tyres": "magic-formula"},
     "vehicle": {"base": "coms", "relaxation": 0.3}},
    {"scenario": {"base": "straight", "curvature": 0.01, "curve_start": 0.0}, "with_map": True},
    {"control_period": 33, "camera": {"loss": 0.2, "duplicate": 0.3, "jitter": 0.02}},
    {"control_period": 1, "yaw_first": False},
    {"scenario": {**WANDER, "duration": 0.04}},
    {"scenario": {**WANDER, "steering": "trace", "trace": [0.0, 0.02, -0.01], "trace_step": 0.01}},
]  # fmt: skip


@pytest.mark.parametrize("arguments", CASES, ids=str)
def test_of_other_drivers_sensors_and_plants(arguments: dict[str, Any]) -> None:
    drive(*both(**arguments), steps=6)


def test_options_and_masks_choose_rows() -> None:
    ours, theirs = both()
    drive(ours, theirs, 2)
    options: dict[str, Any] = {
        "reset_mask": np.array([True, False, True, True, False]),
        "friction": [0.5, None, 0.7, 0.5, None],
        "state": {"v_y": 0.1},
    }
    same(ours, theirs, ours.reset(options=options), theirs.reset(options=options))
    for _ in range(7):  # their next episodes have none of it
        same(ours, theirs, ours.step(np.zeros((N, 1))), theirs.step(np.zeros((N, 1))))
    with pytest.raises(ValueError, match=r"all rows have one kind of plant.*'dakf-fig6'"):
        ours.reset(options={"scenario": "dakf-fig6"})
    same(ours, theirs, ours.step(np.zeros((N, 1))), theirs.step(np.zeros((N, 1))))


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_a_bad_action_fails_its_row_and_leaves_the_others_their_bits(bad: float) -> None:
    ours, theirs = both()
    drive(ours, theirs, 1)
    actions = np.full((N, 1), 0.5, np.float32)
    actions[2] = bad
    one, other = ours.step(actions), theirs.step(actions)
    same(ours, theirs, one, other)
    assert one[2].tolist() == [False, False, True, False, False]
    same(ours, theirs, ours.step(np.zeros((N, 1))), theirs.step(np.zeros((N, 1))))


def test_a_car_whose_numbers_overflow_fails_alone() -> None:
    ours, theirs = both()
    drive(ours, theirs, 1)
    options = {"state": [None, {"gamma": 1e6}, None, None, None]}
    same(ours, theirs, ours.reset(options=options), theirs.reset(options=options))
    other = theirs.step(np.zeros((N, 1)))
    same(ours, theirs, ours.step(np.zeros((N, 1))), other)
    assert other[2].tolist() == [False, True, False, False, False]


def test_refused_actions_step_nothing() -> None:
    ours, _ = both(on_bad_action="raise")
    ours.reset(seed=0)
    before = ours.motion
    for actions, message in (
        (torch.full((N, 1), torch.nan, device=DEVICE), r"rows 0, 1, .* is not finite, \[nan\]"),
        (torch.zeros(N, 2, device=DEVICE), rf"actions have shape \({N}, 1\), got \({N}, 2\)"),
        (torch.zeros(N, 1, device="meta"), "actions are on meta, the env on"),
    ):
        with pytest.raises(ValueError, match=message):
            ours.step(actions)
    assert torch.equal(ours.motion, before)


def test_results_are_new_ones_that_the_kernel_wrote() -> None:
    ours, _ = both()
    obs, _ = ours.reset(seed=0)
    old = obs.clone()
    first = ours.step(torch.zeros(N, 1, device=DEVICE))
    kept = [each.clone() for each in first[:4]]
    ours.step(torch.ones(N, 1, device=DEVICE))
    assert torch.equal(obs, old)
    assert all(map(torch.equal, first[:4], kept))
    obs, _, _, _, infos = ours.step(torch.ones(N, 1, device=DEVICE))
    old, t = obs.clone(), infos["t"].clone()
    obs.fill_(7.0)  # whoever has a result may write into it
    infos["t"].fill_(7.0)
    again, infos = ours.reset(options={"reset_mask": np.arange(N) == 0})
    assert torch.equal(again[1:], old[1:]) and torch.equal(infos["t"][1:], t[1:])


def test_a_snapshot_goes_on_with_the_same_bits() -> None:
    ours, _ = both(scenario={"base": "random-steering", "duration": 0.03})
    ours.reset(seed=5)
    ours.step(np.ones((N, 1)))
    snapshot = ours.get_state()
    runs = []
    for _ in range(2):
        runs.append([ours.step(np.ones((N, 1)))[0].tolist() for _ in range(5)])
        ours.set_state(snapshot)
    assert runs[0] == runs[1]


def test_a_snapshot_of_another_env_is_refused() -> None:
    ours, _ = both()
    ours.reset(seed=5)
    before = ours.motion
    others: list[dict[str, Any]] = [
        {"num_envs": 2},
        {"dtype": "float32"},
        {"record": False},
        {"scenario": {"base": "dakf-fig6"}},
        {"scenario": {"base": "random-steering", "tyres": "dugoff"}},
    ]
    for arguments in others:
        told = {"num_envs": N, "device": DEVICE, "record": True, **FUSION, **arguments}
        other = CudaVectorEnv(**told)
        other.reset(seed=5)
        with pytest.raises(ValueError, match="the snapshot is of other rows"):
            ours.set_state(other.get_state())
    with pytest.raises(ValueError, match="the snapshot is of other rows, None"):
        ours.set_state({"started": True})
    with pytest.raises(TypeError, match="a snapshot is a mapping, got"):
        ours.set_state((1, 2))
    assert torch.equal(ours.motion, before)
    fresh, _ = both()
    ours.set_state(fresh.get_state())
    with pytest.raises(ResetNeeded):
        ours.step(np.zeros((N, 1)))


def test_float32_drives_the_same_noise_and_its_error_is_small() -> None:
    told = FUSION | {"scenario": {"base": "random-steering", "duration": 1.0}}
    ours = CudaVectorEnv(N, device=DEVICE, dtype="float32", **told)
    theirs = StabilityVectorEnv(N, **told)
    ours.reset(seed=1)
    theirs.reset(seed=1)
    for _ in range(20):
        obs, *_ = ours.step(np.full((N, 1), 0.3))
        wanted, *_ = theirs.step(np.full((N, 1), 0.3))
    error = np.abs(ours.motion.cpu().numpy() - theirs.motion).max(0)
    limits = [1e-4, 1e-4, 2e-5, 2e-5, 5e-4, 5e-4, 5e-4, 5e-4, 1e-6, 1e-4, 1e-3, 0.0, 0.0]
    assert (error <= limits).all(), error
    fast = [i for i, entry in enumerate(ours.layout) if entry.name in ("gyro", "wheel_left")]
    assert np.abs(obs.cpu().numpy() - wanted)[:, fast].max() < 1e-3
