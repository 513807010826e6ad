"""The matching test: perfect features score perfectly, and each figure counts what it says."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional
from typer.testing import CliRunner

from tracking3d.errors import InputError, PluginError
from tracking3d.features.rgb import RgbEncoder
from tracking3d.plugins.guard import PluginFailure
from tracking3d_bench.benchmark import matching
from tracking3d_bench.benchmark.feature_encoders import (
    MeasuredEncoder,
    build_encoders,
    measure_encoders,
    painted_images,
    parse_encoder,
    read_images,
)
from tracking3d_bench.benchmark.matching import MatchingPair, MatchingScores, make_pairs, matching_scores
from tracking3d_bench.benchmark.matching_table import format_matching, matching_report, time_ratios

SIZE = 64


def noise(seed: int = 0, channels: int = 3) -> torch.Tensor:
    return torch.rand(channels, SIZE, SIZE, generator=torch.Generator().manual_seed(seed))


def some_points(count: int = 50, margin: int = 16) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randint(margin, SIZE - margin, (count, 2), generator=generator)


def moved_pair(image: torch.Tensor, right: int, down: int, told: tuple[float, float]) -> MatchingPair:
    """The image moved by whole pixels, and where its points are said to have gone."""
    points = some_points()
    warped = image.roll((down, right), dims=(1, 2))
    return MatchingPair(image, warped, points, points.double() + torch.tensor(told))


def identity(images: torch.Tensor) -> torch.Tensor:
    return images


def test_features_that_move_with_the_image_match_perfectly():
    scores = matching_scores(identity, [moved_pair(noise(), 7, -5, (7, -5))])
    assert scores == MatchingScores(1.0, 1.0, 50)


@pytest.mark.parametrize(("off", "share"), [(3.0, 1.0), (3.1, 0.0)])
def test_a_match_counts_up_to_three_pixels_from_the_truth(off, share):
    scores = matching_scores(identity, [moved_pair(noise(), 7, -5, (7 + off, -5))])
    assert scores == MatchingScores(share, share, 50)


def test_the_axes_are_not_confused():
    assert matching_scores(identity, [moved_pair(noise(), 7, -5, (-5, 7))]).everywhere == 0


def test_only_the_search_everywhere_falls_for_a_copy_far_away():
    left = noise()[:, :, : SIZE // 2]
    image = torch.cat([left, left], dim=2)  # a copy 32 px away, and the first of equals is found
    points = some_points()
    points[:, 0] = SIZE // 2 + points[:, 0] // 2
    pair = MatchingPair(image, image, points, points.double())
    assert matching_scores(identity, [pair]) == MatchingScores(0.0, 1.0, 50)


def test_the_scores_of_pairs_are_pooled():
    right, wrong = moved_pair(noise(), 4, 4, (4, 4)), moved_pair(noise(), 4, 4, (12, 4))
    scores = matching_scores(identity, [right, wrong, wrong, right])
    assert scores == MatchingScores(0.5, 0.5, 200)


def test_coarse_features_are_compared_where_they_are():
    smooth = functional.avg_pool2d(noise()[None], 5, stride=1, padding=2)[0]
    coarse = matching_scores(
        lambda images: functional.avg_pool2d(images, 2), [moved_pair(smooth, 8, 4, (8, 4))]
    )
    assert coarse.everywhere > 0.95


def test_length_and_brightness_of_features_do_not_count():
    pair = moved_pair(noise(), 7, -5, (7, -5))
    dark = MatchingPair(pair.image, pair.warped / 8, pair.points, pair.truth)
    assert matching_scores(identity, [dark]).everywhere == 1


def test_reduced_features_keep_what_varies_and_lose_what_does_not():
    pair = moved_pair(noise(), 7, -5, (7, -5))

    def padded(images):  # two constant channels beside the three that tell places apart
        return torch.cat([images, torch.ones_like(images[:, :2])], dim=1)

    assert matching_scores(padded, [pair], channels=3).everywhere == 1
    assert matching_scores(padded, [pair], channels=1).everywhere < 0.2
    assert matching_scores(padded, [pair], channels=9) == matching_scores(padded, [pair])


def test_pairs_show_the_same_places_under_the_told_homography(monkeypatch):
    monkeypatch.setattr(matching, "_relit", lambda image, rng: image)
    smooth = [matching.cv2.GaussianBlur(image, (0, 0), 3) for image in painted_images(size=300)]
    for pair in make_pairs(smooth, size=128):
        x, y = pair.points.T
        grid = 2 * (pair.truth.float() + 0.5) / 128 - 1
        seen = functional.grid_sample(pair.warped[None], grid[None, None], align_corners=False)[0, :, 0].T
        assert (seen - pair.image[:, y, x].T).abs().mean() < 0.01


def test_points_are_textured_and_inside_both_images():
    half = painted_images(size=200)[0].copy()
    half[:, :100] = 128
    pairs = make_pairs([half], size=128)
    assert len(pairs) == 3
    for pair in pairs:
        assert pair.image.shape == pair.warped.shape == (3, 128, 128)
        assert 0 <= pair.warped.min() <= pair.warped.max() <= 1
        assert pair.points.min() >= 4 and pair.points.max() <= 123
        assert pair.truth.min() >= 4 and pair.truth.max() <= 123
        near = functional.max_pool2d(pair.image[None], 15, 1, 7) + functional.max_pool2d(
            -pair.image[None], 15, 1, 7
        )
        assert (near[0, :, pair.points[:, 1], pair.points[:, 0]].amax(0) > 0).all()


def test_stronger_warps_move_points_further_apart_from_the_shift():
    pairs = make_pairs(painted_images()[:1])
    motions = [pair.truth - pair.points for pair in pairs]
    moved = [float((motion - motion.mean(0)).norm(dim=1).mean()) for motion in motions]
    assert moved == sorted(moved)
    assert moved[-1] > 2 * moved[0] > 2


def test_where_something_lies_in_the_image_tells_nothing():
    """Features that are nothing but the place in the image find next to no point."""
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="ij")
    place = torch.stack([rows, columns, torch.ones_like(rows)])
    pairs = make_pairs(painted_images()[:4], size=128)
    scores = matching_scores(lambda images: place.expand(len(images), -1, -1, -1), pairs)
    assert scores.everywhere < 0.1


def test_the_light_is_another():
    for pair in make_pairs(painted_images()[:2], size=128):
        x, y = pair.points.T
        u, v = pair.truth.round().long().T
        assert (pair.image[:, y, x] - pair.warped[:, v, u]).abs().mean() > 0.05


def test_a_seed_makes_the_same_pairs_again_and_another_makes_others():
    images = painted_images(seed=3)[:1]
    first, again, other = (make_pairs(images, seed, 128)[0] for seed in (0, 0, 1))
    for name in ("image", "warped", "points", "truth"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.warped, other.warped)


def test_small_images_are_enlarged_and_large_ones_reduced():
    tiny, wide = painted_images(size=40)[0], np.hstack([painted_images(size=600)[0]] * 2)
    assert [pair.image.shape for pair in make_pairs([tiny, wide], size=96)] == [(3, 96, 96)] * 6


def test_blank_images_are_passed_over_and_refused_alone():
    blank = np.full((300, 300, 3), 90, np.uint8)
    assert len(make_pairs([blank, painted_images()[0]], size=128)) == 3
    with pytest.raises(InputError, match="enough texture"):
        make_pairs([blank], size=128)


@pytest.mark.parametrize(
    ("text", "label", "name", "options"),
    [
        ("rgb", "rgb", "rgb", {}),
        ("mine=rgb", "mine", "rgb", {}),
        ("onnx:model=a/b=c.onnx", "onnx", "onnx", {"model": "a/b=c.onnx"}),
        (
            "alike-n=onnx:model=a.onnx, threads=2",
            "alike-n",
            "onnx",
            {"model": "a.onnx", "threads": 2},
        ),
        ("onnx:model=C:\\nets\\a.onnx", "onnx", "onnx", {"model": "C:\\nets\\a.onnx"}),
    ],
)
def test_an_encoder_is_written_with_label_and_options(text, label, name, options):
    found, choice = parse_encoder(text)
    assert (found, choice.name, choice.options) == (label, name, options)


@pytest.mark.parametrize("text", ["", "mine=", "onnx:model", "onnx:=a", "rgb:name=lab", ":a=b"])
def test_an_encoder_of_another_form_is_refused(text):
    with pytest.raises(InputError, match=f"--features {text}"):
        parse_encoder(text)


class Threaded(RgbEncoder):
    """The identity, with an option threads that it remembers."""

    class Options(RgbEncoder.Options):
        threads: int = 7

    def __init__(self, threads: int) -> None:
        self.threads_used = threads

    @classmethod
    def from_options(cls, options):
        return cls(options.threads)


class Failing(RgbEncoder):
    def encode(self, images):
        raise RuntimeError("out of luck")


@pytest.fixture
def registered(monkeypatch):
    here = f"{__name__}:"
    names = {"threaded": "Threaded", "failing": "Failing"}
    items = [f"tracking3d.features:{name}={here}{cls}" for name, cls in names.items()]
    monkeypatch.setenv("TRACKING3D_PLUGINS", ";".join(items))


def test_encoders_are_given_the_threads_unless_they_were_told(registered):
    encoders = build_encoders(["threaded", "two=threaded:threads=2", "rgb"], threads=3)
    assert [encoders["threaded"].threads_used, encoders["two"].threads_used] == [3, 2]
    assert list(encoders) == ["threaded", "two", "rgb"]


def test_encoders_of_one_label_are_refused():
    with pytest.raises(InputError, match="called 'rgb'; write --features LABEL=rgb"):
        build_encoders(["rgb", "rgb"])


def test_an_unknown_encoder_or_option_is_refused():
    with pytest.raises(PluginError, match="rgbb"):
        build_encoders(["rgbb"])
    with pytest.raises(PluginError, match="colour"):
        build_encoders(["rgb:colour=red"])


def test_an_encoder_that_fails_is_blamed(registered):
    encoders = build_encoders(["failing"])
    with pytest.raises(PluginFailure, match=r"'failing'.*out of luck"):
        measure_encoders(encoders, make_pairs(painted_images()[:1], size=64))


def test_times_are_compared_with_the_first():
    scores = MatchingScores(0.5, 0.75, 8)
    slow, fast = (MeasuredEncoder(3, 1, time, scores, None) for time in (10.0, 2.5))
    measured = {"slow": slow, "fast": fast}
    assert time_ratios(measured) == {"slow": 1, "fast": 0.25}
    report = matching_report(measured, {"seed": 4})
    assert report["seed"] == 4
    assert report["encoders"]["fast"]["time_ratio"] == 0.25
    assert report["encoders"]["fast"]["scores"] == {"everywhere": 0.5, "nearby": 0.75, "points": 8}
    cells = [list(column.cells) for column in format_matching(measured).columns]
    assert cells[0] == ["slow", "fast"]
    assert cells[1] == ["50.0", "50.0"]
    assert cells[4] == ["1.00", "0.25"]


def test_images_are_read_from_files_and_folders_at_even_distances(tmp_path):
    for n in range(9):
        Image.new("RGB", (8, 6), (n, 0, 0)).save(tmp_path / f"{n}.png")
    assert [image[0, 0, 0] for image in read_images([tmp_path], most=3)] == [0, 4, 8]
    assert [image[0, 0, 0] for image in read_images([tmp_path / "5.png", tmp_path], most=99)][:2] == [5, 0]


def test_folders_without_images_and_absent_images_are_refused(tmp_path):
    with pytest.raises(InputError, match="holds no image"):
        read_images([tmp_path])
    with pytest.raises(InputError, match=r"absent\.png"):
        read_images([tmp_path / "absent.png"])


def call(*arguments: object):
    from tracking3d.cli import app

    return CliRunner().invoke(app, ["bench", "matching", *map(str, arguments)])


def test_the_command_prints_json(tmp_path):
    Image.fromarray(painted_images()[0]).save(tmp_path / "photo.png")
    result = call(
        *("--features", "rgb", "--features", "again=rgb", "--images", tmp_path, "--size", 64),
        *("--repeats", 1, "--pca", 2, "--json"),
    )
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    rgb, again = report["encoders"]["rgb"], report["encoders"]["again"]
    assert (rgb["channels"], rgb["stride"], rgb["time_ratio"]) == (3, 1, 1)
    assert rgb["scores"] == again["scores"]
    assert rgb["reduced"]["points"] == rgb["scores"]["points"] == 3 * 256
    assert (report["pairs"], report["size"], report["reduced_channels"]) == (3, 64, 2)


def test_the_command_prints_a_table_of_painted_images():
    result = call("--features", "rgb", "--size", 64, "--repeats", 1)
    assert result.exit_code == 0, result.output
    assert "everywhere [%]" in result.stdout
    assert "18 pairs of 64 x 64 pixels from 6 painted images, seed 0, 1 thread" in result.stdout


def test_the_command_says_what_it_cannot_use(tmp_path):
    result = call("--features", "rgb", "--images", tmp_path)
    assert result.exit_code == 2 or isinstance(result.exception, SystemExit)
    assert "holds no image" in result.output
