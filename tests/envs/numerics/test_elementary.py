"""The polynomials against extended precision, within the errors their docstrings state."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs.numerics import functions
from sideslip.envs.numerics.functions import PI
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.numerics.primitives import (
    ARRAYS,
    absolute,
    floor,
    frexp,
    maximum,
    minimum,
    select,
    sqrt,
)

pytestmark = pytest.mark.plain

RNG = np.random.default_rng(20)
N = 200_000
reals = st.floats(-1e15, 1e15)


def on_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    return as_python(function, ARRAYS)


def worst(value: np.ndarray, exact: np.ndarray) -> float:
    assert exact.dtype == np.longdouble  # more than 53 bits: the reference's own error is nothing
    return float(np.max(np.abs(value - exact)))


@pytest.mark.smoke
def test_kernels_err_less_than_stated() -> None:
    r = RNG.uniform(-PI / 4.0, PI / 4.0, N)
    exact = r.astype(np.longdouble)
    assert worst(on_arrays(functions._sin_kernel)(r), np.sin(exact)) < 1e-16
    assert worst(on_arrays(functions._cos_kernel)(r), np.cos(exact)) < 2e-16


@pytest.mark.parametrize("reach", [1.0, 10.0, 1e3, 1e6])
def test_sincos_errs_less_than_stated(reach: float) -> None:
    x = RNG.uniform(-reach, reach, N)
    s, c = on_arrays(functions.sincos)(x)
    exact = x.astype(np.longdouble)
    allowed = 3e-16 + 1e-16 * np.abs(x)
    assert np.all(np.abs(s - np.sin(exact)) < allowed)
    assert np.all(np.abs(c - np.cos(exact)) < allowed)


@pytest.mark.smoke
def test_atan_errs_less_than_stated() -> None:
    x = np.sinh(RNG.uniform(-30.0, 30.0, N))  # from 1e-13 to 1e13, both signs
    assert worst(on_arrays(functions.atan)(x), np.arctan(x.astype(np.longdouble))) < 5e-16


def test_atan2_errs_less_than_stated_in_all_quadrants() -> None:
    y, x = np.sinh(RNG.uniform(-20.0, 20.0, (2, N)))
    exact = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
    assert worst(on_arrays(functions.atan2)(y, x), exact) < 1e-15


@pytest.mark.parametrize("y", [0.0, 1.0, -1.0, 1e-310, -1e-310])
@pytest.mark.parametrize("x", [0.0, 1.0, -1.0, 1e-310, -1e-310])
def test_atan2_stays_in_its_range_on_the_axes_and_near_the_origin(y: float, x: float) -> None:
    value = functions.atan2(y, x)
    assert -PI <= value <= PI
    if abs(x) != 1e-310 and abs(y) != 1e-310:
        assert value == pytest.approx(math.atan2(y, x), abs=1e-15)  # the stated error


def test_trigonometry_at_zero_is_exact() -> None:
    assert functions.sincos(0.0) == (0.0, 1.0)
    assert functions.atan(0.0) == functions.atan2(0.0, 0.0) == 0.0


@given(st.floats(-1e5, 1e5))
def test_wrap_takes_whole_turns_away(angle: float) -> None:
    wrapped = functions.wrap(angle)
    # the quotient's rounding may leave the range by the last bits of `angle`
    slack = 4.0 * math.ulp(max(abs(angle), 1.0))
    assert -PI - slack <= wrapped < PI + slack
    turns = (angle - wrapped) / (2.0 * PI)
    assert abs(turns - round(turns)) <= slack


def test_wrap_keeps_what_is_in_range() -> None:
    for angle in (-3.0, -1e-9, 0.0, 2.5, 3.14):
        assert functions.wrap(angle) == angle
    assert functions.wrap(PI) == -PI


def test_smoothstep_is_the_c1_cubic() -> None:
    assert functions.smoothstep(-1.0) == 0.0
    assert functions.smoothstep(0.5) == 0.5
    assert functions.smoothstep(7.0) == 1.0
    for x in (0.2, 0.6, 0.9):
        exact = 3.0 * x**2 - 2.0 * x**3
        assert functions.smoothstep(x) == pytest.approx(exact, abs=2e-16)  # one rounding of 1
    h = 1e-6  # flat at both ends: the cubic rises by 3 h^2 only
    assert functions.smoothstep(h) < 4.0 * h * h
    assert 1.0 - functions.smoothstep(1.0 - h) < 4.0 * h * h


@given(reals, reals)
def test_primitives_mean_what_python_means(a: float, b: float) -> None:
    assert minimum(a, b) == min(a, b)
    assert maximum(a, b) == max(a, b)
    assert absolute(a) == abs(a)
    assert floor(a) == float(math.floor(a))
    assert sqrt(abs(a)) == math.sqrt(abs(a))
    assert frexp(abs(a) + 1.0) == math.frexp(abs(a) + 1.0)
    assert select(a < b, a, b) == min(a, b)


def test_array_primitives_mean_the_same() -> None:
    a, b = RNG.normal(size=(2, 1000))
    for name, function in (("minimum", minimum), ("maximum", maximum)):
        expected = [function(x, y) for x, y in zip(a.tolist(), b.tolist(), strict=True)]
        assert ARRAYS[name](a, b).tolist() == expected
    for name, one in (("absolute", absolute), ("floor", floor)):
        assert ARRAYS[name](a).tolist() == [one(x) for x in a.tolist()]
    assert ARRAYS["sqrt"](a * a).tolist() == [sqrt(x) for x in (a * a).tolist()]
    m, e = ARRAYS["frexp"](a * a)
    assert list(zip(m.tolist(), e.tolist(), strict=True)) == [frexp(x) for x in (a * a).tolist()]
    assert ARRAYS["to_float"](np.arange(3)).dtype == np.float64


def test_exp_errs_less_than_stated() -> None:
    x = np.linspace(-8.0, 8.0, 100_001)
    exact = np.exp(x.astype(np.longdouble))
    assert float(np.max(np.abs(on_arrays(functions.exp)(x) / exact - 1.0))) < 5e-14
    assert functions.exp(0.0) == 1.0
