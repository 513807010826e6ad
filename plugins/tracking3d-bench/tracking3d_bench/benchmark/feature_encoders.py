"""Feature encoders by themselves: how well their features match, and how long they take."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.config.loading import parse_yaml
from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Image
from tracking3d.plugins import FEATURES, build_plugin, list_plugins, load_plugin, plugin_label
from tracking3d.plugins.guard import GuardedEncoder
from tracking3d.testing.synthesis.procedural_texture import paint_background, paint_panel
from tracking3d.video.image_file import read_image
from tracking3d.video.image_sequence import images_among
from tracking3d_bench.benchmark.matching import MatchingPair, MatchingScores, matching_scores


@dataclass(frozen=True)
class MeasuredEncoder:
    """One encoder's result."""

    channels: int  # channels of its features
    stride: int  # input pixels per feature pixel
    milliseconds: float  # median time of one image
    scores: MatchingScores  # with all channels
    reduced: MatchingScores | None  # with the reduced number of channels, if that was requested


def parse_encoder(text: str) -> tuple[str, PluginChoice]:
    """Read ``[LABEL=]NAME[:OPTION=VALUE,...]``, such as ``alike=onnx:model=alike.onnx,description=alike``.

    Returns:
        The label, which is the name if left out, and the plug-in with its options, whose values are YAML.

    Raises:
        InputError: If it is of another form.
    """
    head, _, tail = text.partition(":")
    label, _, name = head.rpartition("=")
    options: dict[str, Any] = {}
    for item in filter(None, tail.split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not key or key == "name":
            raise InputError(
                f"--features {text}: '{item}' is no option; write NAME:option=value,option=value."
            )
        options[key] = parse_yaml(value, f"--features {text}")
    if not name.strip():
        raise InputError(f"--features {text} names no encoder; write NAME or NAME:option=value.")
    return label.strip() or name.strip(), PluginChoice(name=name.strip(), **options)


def build_encoders(texts: Sequence[str], threads: int = 1) -> dict[str, GuardedEncoder]:
    """Build encoders by what a user wrote, see `parse_encoder`; without it, all that can do without options.

    Args:
        texts: One for each encoder.
        threads: Threads of the encoders that have such an option and were not given it.

    Returns:
        Encoders by label.

    Raises:
        InputError: If a text cannot be read, two labels are the same, or an encoder's file cannot be used.
        PluginError: If an encoder or an option is not there.
    """
    choices = [parse_encoder(text) for text in texts]
    if not choices:
        choices = [
            (plugin.name, PluginChoice(name=plugin.name))
            for plugin in list_plugins()
            if plugin.group == FEATURES
            and plugin.status == "ok"
            and not (plugin.options or {}).get("required")
        ]
    encoders: dict[str, GuardedEncoder] = {}
    for label, choice in choices:
        given = choice.options
        if "threads" in load_plugin(FEATURES, choice.name).Options.model_fields:
            given = {"threads": threads} | given
        encoder = build_plugin(FEATURES, PluginChoice(name=choice.name, **given))
        if label in encoders:
            raise InputError(
                f"Two encoders are called '{label}'; write --features LABEL={choice.name}:... to tell them apart."
            )
        encoders[label] = GuardedEncoder(encoder, plugin_label(FEATURES, choice.name))
    return encoders


def painted_images(seed: int = 0, size: int = 384) -> list[Image]:
    """Painted images ``(size, size, 3)`` for a test anywhere: printed panels and cluttered backgrounds."""
    rng = np.random.default_rng(seed)
    panels = [paint_panel(rng, size) for _ in range(3)]
    clutter = [paint_background(rng, size, size) for _ in range(3)]
    return [image.astype(np.uint8) for image in panels + clutter]


def read_images(paths: Sequence[Path], most: int = 12) -> list[Image]:
    """Read image files and folders of images; of more than ``most`` so many at even distances.

    Raises:
        InputError: If there is no image, or one cannot be read.
    """
    files = [file for path in paths for file in (images_among(path.iterdir()) if path.is_dir() else [path])]
    if not files:
        raise InputError(f"{', '.join(map(str, paths))} holds no image; give images or folders of images.")
    chosen = np.linspace(0, len(files) - 1, min(most, len(files))).round().astype(int)
    return [read_image(files[n]) for n in chosen]


def measure_encoders(
    encoders: Mapping[str, FeatureEncoder | GuardedEncoder],
    pairs: Sequence[MatchingPair],
    repeats: int = 5,
    channels: int | None = None,
) -> dict[str, MeasuredEncoder]:
    """Match with every encoder, and time them turn by turn, so that a busy machine is as unkind to all.

    Args:
        encoders: By label.
        pairs: See `tracking3d_bench.benchmark.matching.make_pairs`.
        repeats: Timed runs of each encoder, the median of which counts.
        channels: Number of channels of a second test with reduced features.

    Raises:
        PluginError: If an encoder fails.
    """
    times: dict[str, list[float]] = {label: [] for label in encoders}
    for turn in range(repeats):
        image = pairs[turn % len(pairs)].image[None]
        for label, encoder in encoders.items():
            encoder.encode(image)  # what others left in the caches is not its fault
            start = time.perf_counter()
            encoder.encode(image)
            times[label].append(1e3 * (time.perf_counter() - start))
    return {
        label: MeasuredEncoder(
            encoder.channels,
            encoder.stride,
            statistics.median(times[label]),
            matching_scores(encoder.encode, pairs),
            None if channels is None else matching_scores(encoder.encode, pairs, channels),
        )
        for label, encoder in encoders.items()
    }
