"""The length of the object, which gives all lengths of a run a unit."""

from __future__ import annotations

from typing import Any

from tracking3d.config.explain import a_kind
from tracking3d.config.models import LARGEST_OBJECT, PipelineConfig
from tracking3d.errors import InputError, argument

_SIZE = argument("object_size=", "--object-size")


def check_object_size(metres: Any) -> float | None:
    """``metres``, if it can be the length of an object or is None.

    Raises:
        InputError: It cannot.
    """
    if metres is None:
        return None
    if isinstance(metres, bool) or not isinstance(metres, int | float):
        raise InputError(f"{_SIZE} is {a_kind(metres)}; give a number of metres above 0.")
    if not 0 < metres <= LARGEST_OBJECT:
        raise InputError(
            f"{_SIZE} is {metres:g}; give a number of metres above 0 and not above {LARGEST_OBJECT:,.0f}."
        )
    return float(metres)


def set_object_size(config: PipelineConfig, metres: Any) -> PipelineConfig:
    """The configuration with the length of the object; the same if ``metres`` is None.

    Raises:
        InputError: It is no length, or the object is known and has a unit of its own.
    """
    if check_object_size(metres) is None:
        return config
    if config.object.model is not None:
        raise InputError(
            f"A known object has its own unit; leave out {_SIZE}, or {argument('object=', '--object')}."
        )
    return config.model_copy(update={"object": config.object.model_copy(update={"size": float(metres)})})
