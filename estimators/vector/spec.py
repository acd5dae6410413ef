"""The spec of a vector wrapper: it names the single wrapper around each environment."""

import copy
from collections.abc import Mapping
from typing import Any

from gymnasium.envs.registration import EnvSpec, VectorizeMode, WrapperSpec
from gymnasium.vector import AutoresetMode


def make_vector_spec(
    spec: EnvSpec | None, single: Any, kwargs: Mapping[str, Any]
) -> EnvSpec | None:
    """Make the spec of a vector env whose rows wear the wrapper `single(**kwargs)`.

    `gym.make_vec` of it makes environments that are wrapped one by one: it puts no wrappers around
    an env that is a vector by itself.

    Args:
        spec: Spec of the vector env, or None.
        single: Class of the single wrapper.
        kwargs: Keyword arguments of the wrapper.

    Returns:
        A JSON-able spec; None without one.
    """
    if spec is None:
        return None
    spec = copy.deepcopy(spec)
    entry = f"{single.__module__}:{single.__name__}"
    wrapper = WrapperSpec(single.class_name(), entry, copy.deepcopy(dict(kwargs)))
    spec.additional_wrappers += (wrapper,)
    if spec.kwargs.get("vectorization_mode") == VectorizeMode.VECTOR_ENTRY_POINT.value:
        spec.kwargs["vectorization_mode"] = VectorizeMode.SYNC.value
        spec.kwargs.pop("info", None)
        if "autoreset_mode" in spec.kwargs:
            mode = spec.kwargs.pop("autoreset_mode")
            spec.kwargs["vector_kwargs"] = {"autoreset_mode": mode}
    vector_kwargs = spec.kwargs.get("vector_kwargs", {})
    if isinstance(vector_kwargs.get("autoreset_mode"), AutoresetMode):
        vector_kwargs["autoreset_mode"] = vector_kwargs["autoreset_mode"].value
    return spec
