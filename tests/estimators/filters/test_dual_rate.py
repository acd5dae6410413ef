"""dual-rate, written out again, slowly, in the paper's letters; its theorems."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from sideslip.envs.record import PACKET
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import DualRate, make_estimator
from sideslip.estimators.design.gains import SampledSystem, frame_map
from tests.estimators.simulation import FIG6, simulate

from .literal import COURSE, T, car, due, excited, gain, inputs, pushed, zoh

pytestmark = [
    pytest.mark.plain,
    pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning"),
]

RULES = ("predict", "hold", "oh", "pseudo")
power = np.linalg.matrix_power


def random_system(seed: Any) -> Any:
    """a, b, c, r, disturbed rows, a_d, u_d, Q, Q_d, R of 2 to 5 states."""
    rng = np.random.default_rng(seed)
    m, p, q, r = (int(rng.integers(*ends)) for ends in ((2, 6), (1, 3), (1, 4), (3, 21)))
    q = min(q, m)
    a = rng.normal(size=(m, m))
    a *= 0.98 / np.abs(np.linalg.eigvals(a)).max()
    rows = rng.permutation(m)[: rng.integers(0, min(q, 3) + 1)]
    d = len(rows)
    a_d = np.diag(rng.uniform(0.9, 0.99, d)) + 0.01 * np.triu(rng.normal(size=(d, d)), 1)
    w, v, w_d = (rng.normal(size=(k, k)) for k in (m, q, d))
    return {
        "A": a, "B": rng.normal(size=(m, p)), "C": rng.normal(size=(q, m)), "ratio": r,
        "disturbed": rows, "leak": a_d, "rate": 0.1 * rng.normal(size=d), "Q": 1e-2 * w @ w.T,
        "Q_d": 1e-3 * w_d @ w_d.T, "R": v @ v.T + 0.1 * np.eye(q),
    }  # fmt: skip


def extended(s: Any) -> Any:
    """A_k, B_k, C, Q_e of (8)-(12) with the chosen rows; B_k takes (u_k, u_d)."""
    m, d = len(s["A"]), len(s["disturbed"])
    push = np.zeros((m, d))
    push[s["disturbed"], range(d)] = 1.0
    A = np.block([[s["A"], push], [np.zeros((d, m)), s["leak"]]])
    B = np.block([[s["B"], np.zeros((m, d))], [np.zeros((d, s["B"].shape[1])), np.eye(d)]])
    C = np.hstack([s["C"], np.zeros((len(s["C"]), d))])
    Q = np.block([[s["Q"], np.zeros((m, d))], [np.zeros((d, m)), s["Q_d"]]])
    return A, B, C, Q


def sampled(A: Any, C: Any, Q: Any, R: Any, r: Any) -> Any:
    """The stationary Kalman gain with a sample every r steps."""
    Q_r = sum(power(A, i) @ Q @ power(A, i).T for i in range(r))
    return gain(solve_discrete_are(power(A, r).T, C.T, Q_r, R), C, R)


def psi_of(A: Any, C: Any, L: Any, G: Any, i: Any) -> Any:
    """(26)."""
    first = power(A, i) @ (np.eye(len(A)) - L[0] @ C)
    return first - sum(power(A, j) @ L[i - j] @ G[i - j] @ C for j in range(1, i))


def pinv(C: Any) -> Any:
    return C.T @ np.linalg.inv(C @ C.T)


def gains_31(A: Any, C: Any, L: Any) -> Any:
    """G_k = I, G_{k+i} of (31), for gains L."""
    G = [np.eye(len(C))]
    for i in range(1, len(L)):
        G.append(C @ psi_of(A, C, L, G, i) @ pinv(C))
    return G


def gains_35(A: Any, C: Any, L: Any, r: Any) -> Any:
    """Oh (35) with E_1 the estimated error after the sample's correction."""
    rest, E_1 = (np.eye(len(A)) - L @ C) @ A, pinv(C) - L
    return [np.eye(len(C)), *(C @ A @ power(rest, i - 1) @ E_1 for i in range(1, r))]


def gains_29(A: Any, C: Any, Q: Any, R: Any, r: Any) -> Any:
    """L_{k+i} and G_{k+i} with the pseudo measurement's noise of (29), (30) taken for true."""
    P: Any = Q
    L: Any
    G: Any
    for _ in range(300):
        P_before, L, G = P, [], []
        for i in range(r):
            P = A @ P @ A.T + Q
            noise = R
            G.append(np.eye(len(C)))
            if i > 0:
                G[i] = C @ psi_of(A, C, L, G, i) @ pinv(C)  # (31)
                upsilon = sum(power(A, j) @ Q @ power(A, j).T for j in range(i))  # (27)
                lambda_ = sum(power(A, j) @ L[i - j] @ G[i - j] for j in range(1, i + 1))  # (28)
                V = G[i] + C @ lambda_
                noise = C @ upsilon @ C.T + V @ R @ V.T  # (29), corrected
            L.append(gain(P, C, noise))
            P = (np.eye(len(A)) - L[i] @ C) @ P
        if np.abs(P - P_before).max() < 1e-13 * np.abs(P).max():
            break
    return L, G


def gains_of(rule: Any, gains: Any, A: Any, C: Any, Q: Any, R: Any, r: Any, placed: Any) -> Any:
    """L_{k+i}, G_{k+i} for i = 0 .. r-1."""
    one, nothing = np.eye(len(C)), np.zeros((len(A), len(C)))
    if gains == "from-29":
        return gains_29(A, C, Q, R, r)
    L = placed if gains == "placed" else sampled(A, C, Q, R, r)
    if rule == "predict":
        return [L] + [nothing] * (r - 1), [one] * r
    if rule == "hold":  # Hara: the same poles as L alone once every r steps
        held = np.linalg.solve(sum(power(A, i) for i in range(1, r + 1)), power(A, r) @ L)
        return [held] * r, [one] * r
    L = L if gains == "placed" else L / r
    return [L] * r, gains_35(A, C, L, r) if rule == "oh" else gains_31(A, C, [L] * r)


def literal(A: Any, B: Any, C: Any, U: Any, samples: Any, L: Any, G: Any) -> Any:
    """(13)-(19): samples by step, U (K, p) the inputs of each step."""
    x, since, eps = np.zeros(len(A)), len(L), np.zeros(len(C))
    wanted: Any = []
    for k in range(len(U) + 1):
        if k > 0:
            x, since = A @ x + B @ U[k - 1], since + 1  # (17)
        if k in samples:
            eps, since = samples[k] - C @ x, 0  # (13)
        if since < len(L):
            x = x + L[since] @ (G[since] @ eps)  # (14), (19)
        wanted.append(x)
    return np.array(wanted)


CASES = [(rule, "constant") for rule in RULES] + [("pseudo", "from-29")]


@pytest.mark.parametrize(("rule", "gains"), CASES)
@pytest.mark.parametrize("seed", range(6))
def test_random_systems(rule: Any, gains: Any, seed: Any) -> None:
    s = random_system(seed)
    A, B, C, Q = extended(s)
    r, rng = s["ratio"], np.random.default_rng([seed, 1])
    U, Y = rng.normal(size=(5 * r + 1, s["B"].shape[1])), rng.normal(size=(6, len(C)))
    Y[3] = np.nan  # never came
    samples = {i * r: y for i, y in enumerate(Y) if i != 3}
    with_rate = np.hstack([U, np.tile(s["rate"], (len(U), 1))])
    L, G = gains_of(rule, gains, A, C, Q, s["R"], r, None)
    wanted = literal(A, B, C, with_rate, samples, L, G)
    filter_ = DualRate(**s, intersample=rule, gains=gains, allow_unstable=True)
    found = filter_.run(U, Y)
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(found.x, wanted, rtol=0.0, atol=1e-9 * scale)
    filter_.reset()
    for k, x in enumerate(found.x):  # the same, step by step
        if k > 0:
            filter_.step(U[k - 1])
        if k in samples:
            filter_.update(samples[k])
        np.testing.assert_array_equal(filter_.x, x)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("seed", range(4))
def test_placed_poles_are_where_they_were_placed(rule: Any, seed: Any) -> None:
    s = random_system(seed) | {"disturbed": None, "leak": 1.0, "rate": 0.0, "Q_d": 0.0, "ratio": 4}
    c, r, m = s["C"], 4, len(s["A"])
    a = s["A"] = np.eye(m) + 0.2 * (s["A"] - np.eye(m))  # slow: a power of it still shows all
    poles = np.linspace(0.80, 0.95, m)
    filter_ = DualRate(**s, intersample=rule, gains="placed", poles=poles, allow_unstable=True)
    if rule in ("predict", "hold"):
        map_, wanted = frame_map(a, c, filter_.shares), poles**r
    else:
        map_, wanted = (np.eye(m) - filter_.shares[0] @ c) @ a, poles  # (22)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(map_).real), np.sort(wanted), atol=1e-7)
    L = filter_.shares[0]
    if rule == "hold":
        return
    L_i, G_i = gains_of(rule, "placed", a, c, s["Q"], s["R"], r, L)
    found = np.array([x @ y for x, y in zip(L_i, G_i, strict=True)])
    np.testing.assert_allclose(filter_.shares, found, atol=1e-9 * np.abs(L).max())


@pytest.mark.parametrize("seed", range(6))
def test_pseudo_measurement_and_ohs_gain_are_the_same(seed: Any) -> None:
    """(31) and (35) for any gain."""
    s = random_system(seed)
    A, _, C, Q = extended(s)
    L = sampled(A, C, Q, s["R"], s["ratio"]) / s["ratio"]
    ours, ohs = gains_31(A, C, [L] * s["ratio"]), gains_35(A, C, L, s["ratio"])
    np.testing.assert_allclose(ours, ohs, atol=1e-12 * max(1.0, np.abs(ohs).max()))


@pytest.mark.parametrize("seed", range(6))
def test_haras_error_map_is_the_single_rates(seed: Any) -> None:
    s = random_system(seed)
    A, _, C, Q = extended(s)
    r = s["ratio"]
    shares = SampledSystem(A, Q, C, s["R"], r).compute_shares("hold", "constant", None)
    held = frame_map(A, C, shares)
    single = power(A, r) @ (np.eye(len(A)) - sampled(A, C, Q, s["R"], r) @ C)
    np.testing.assert_allclose(held, single, atol=1e-10)


V = FIG6.speed
SLALOM = type(FIG6)(duration=0.65, amplitude=0.1, frequency=1.0, real=7000.0)
COURSE_10_HZ = SlowSensor(period=0.1)


@pytest.mark.parametrize(("rule", "gains"), CASES)
def test_course_alone(rule: Any, gains: Any) -> None:
    """4.2-4.3: (37)-(38) at 10 Hz, a disturbance on every state (per second) that leaks.

    100 Hz where gains are from (29), whose products are dear.
    """
    quick = gains == "from-29"
    ratio, leak = (10, 20.0) if quick else (100, 0.5)
    log = excited(simulate(SLALOM, {"gps": SlowSensor(period=ratio * T)}, 0))
    q = [1e-4, 2e-4, 1e-2 if quick else 1e-6, 1e-2, 0.1, 1e-4]
    A, B = car(V)
    A_k, B_k = zoh(*pushed(A[:3, :3], B[:3], (0, 1, 2)))
    A_k[range(3, 6), range(3, 6)] = np.exp(-leak * T)
    C = np.array([[1.0, 0, 1, 0, 0, 0]])
    U = [inputs(row) for row in log.record.fast[1:]]
    samples = {k: packet[[PACKET.value]] for k, packet in due(log).items()}
    R = np.array([[(COURSE / V) ** 2]])
    L, G = gains_of(rule, gains, A_k, C, np.diag(q) * T, R, ratio, None)
    options: dict[str, Any] = {"leak": leak, "Q": q, "intersample": rule, "gains": gains}
    filter_ = make_estimator("dual-rate", sensors=log.slow, speed=V, allow_unstable=True, **options)
    wanted = literal(A_k, B_k, C, U, samples, L, G)
    np.testing.assert_allclose(filter_.run(log).x, wanted, rtol=0.0, atol=1e-9)


def test_course_alone_with_placed_poles() -> None:
    poles = (-2.0, -3.0, -4.0, -5.0, -6.0, -7.0)
    placed: dict[str, Any] = {"sensors": {"gps": COURSE_10_HZ}, "speed": V, "gains": "placed"}
    three = {"poles": poles[:3], "disturbances": "none", "intersample": "hold"}
    filter_ = make_estimator("dual-rate", **placed, **three)
    assert filter_.spectral_radius == pytest.approx(np.exp(-2.0 * 0.1), rel=1e-6)
    with pytest.raises(ValueError, match="cannot be placed"):
        make_estimator("dual-rate", poles=poles, **placed)


def test_literal_gains_from_29_make_the_error_grow() -> None:
    """By 1.17 to 1.22 from sample to sample, where the disturbances' noise is not small."""
    common: dict[str, Any] = {"sensors": {"gps": COURSE_10_HZ}, "speed": V, "gains": "from-29"}
    common["vehicle"] = type(FIG6)(nominal=9100.0).told
    for q in ([1e-6] * 3 + [10.0] * 3, [1e-4, 1e-4, 1e-6] + [10.0] * 3):
        with pytest.raises(ValueError, match=r"error grows by a factor of 1\.[12]"):
            make_estimator("dual-rate", Q=q, **common)
        filter_ = make_estimator("dual-rate", Q=q, allow_unstable=True, **common)
        assert 1.17 < filter_.spectral_radius < 1.22
