"""Checks shared by trackers and encoders."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import torch
from pydantic import BaseModel

from tracking3d.errors import Tracking3dError


def factory_of(plugin: Any, methods: tuple[str, ...], options: dict[str, Any]) -> Callable[[], Any]:
    """What builds a fresh plug-in: from a class by its options, from a factory by calling it.

    Args:
        plugin: The class of a plug-in, a function without arguments that builds one, or one that is built.
        methods: Names of the methods that one has.
        options: The plug-in's own options, where it is a class.

    Raises:
        AssertionError: If the class cannot be built as the pipeline builds it, or has not these methods.
    """
    build = _from_class(plugin, options) if isinstance(plugin, type) else plugin
    if all(callable(getattr(plugin, name, None)) for name in methods) and not isinstance(plugin, type):
        return lambda: plugin
    assert callable(build), f"{plugin!r} is not a plug-in; give its class, or a function that builds one."
    instance = build()
    for name in methods:
        assert callable(getattr(instance, name, None)), f"{_name(instance)} has no method {name}."
    return build


def _from_class(cls: type[Any], options: dict[str, Any]) -> Callable[[], Any]:
    model = getattr(cls, "Options", None)
    assert isinstance(model, type) and issubclass(model, BaseModel), (
        f"{cls.__name__} has no nested pydantic model Options."
    )
    assert callable(getattr(cls, "from_options", None)), f"{cls.__name__} has no classmethod from_options."
    assert "name" not in model.model_fields, (
        f"The Options of {cls.__name__} have a field 'name', which selects the plug-in in a configuration."
    )
    model.model_json_schema()
    return lambda: cls.from_options(model.model_validate(options))


@contextmanager
def random_state(seed: int) -> Iterator[None]:
    """Set the global random generators to ``seed``; numpy's and torch's are put back afterwards."""
    before = np.random.get_state(), torch.get_rng_state()
    np.random.seed(seed)
    torch.manual_seed(seed)
    cv2.setRNGSeed(seed)
    try:
        yield
    finally:
        np.random.set_state(before[0])
        torch.set_rng_state(before[1])


@contextmanager
def allow_refusal(what: str) -> Iterator[None]:
    """Let the plug-in refuse what it is given, in one sentence of a `Tracking3dError`.

    Raises:
        AssertionError: If anything else is raised in the block, a failed check aside.
    """
    try:
        yield
    except AssertionError:
        raise
    except Tracking3dError as error:
        sentence = str(error).strip()
        assert sentence.count(" ") >= 2 and "\n" not in sentence, (
            f"{what} is refused with {sentence!r}; write one sentence with what is wrong and what to do."
        )
    except Exception as error:
        raise AssertionError(
            f"{what} raises {type(error).__name__}: {error}; return an estimate, or raise an InputError of "
            "one sentence."
        ) from error


@contextmanager
def expect_success(what: str) -> Iterator[None]:
    """Turn whatever is raised in the block, a failed check aside, into a failed check."""
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{what} raises {type(error).__name__}: {error}.") from error


def _name(instance: Any) -> str:
    return type(instance).__name__
