"""The library's way in: frames go through one at a time, and what cannot be used is told in a sentence."""

from __future__ import annotations

import gc
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

import tracking3d
from tracking3d import Frame, FrameEstimate, PipelineConfig, Session, Status, load_config, track
from tracking3d.config.models import CameraConfig
from tracking3d.errors import InputError, PluginError
from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.track import choose_camera
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.prompt import make_prompt

QUICK = [
    "crop.size=32",
    "object.frequency=2",
    "camera.fov=45",
    "object.texture_size=16",
]
QUICK_PRESETS = {
    "default": QUICK,
    "rerendering": [
        *QUICK,
        "solver.iterations=2",
        "solver.pose_iterations=2",
        "solver.init_frames=1",
        "solver.tau=2",
    ],
}
"""A preset of either solver, each with settings that are quick."""


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=4, size=(80, 64)))


@pytest.fixture(scope="module", params=sorted(QUICK_PRESETS))
def quick(request) -> PipelineConfig:
    """A preset of either solver."""
    overrides = [*QUICK_PRESETS[request.param], "tracker.segmentation_size=64"]
    return load_config(preset=request.param, overrides=overrides)


@pytest.fixture(scope="module")
def boxed(clip, quick) -> list[FrameEstimate]:
    """The answers for all frames, from a box."""
    return list(track(clip.images, box=clip.box, config=quick))


def masks_of(estimates: list[FrameEstimate]) -> list[np.ndarray]:
    return [estimate.mask for estimate in estimates]


# Frames


def test_plain_arrays_with_a_box(clip, boxed):
    estimates = boxed
    assert [estimate.index for estimate in estimates] == [0, 1, 2, 3]
    assert all(isinstance(estimate, FrameEstimate) for estimate in estimates)
    assert all(estimate.mask.shape == (64, 80) for estimate in estimates)
    assert all(estimate.status is not Status.LOST for estimate in estimates)
    assert (estimates[0].initial_mask & clip.masks[0]).sum() > 0.7 * clip.masks[0].sum()


def test_plain_arrays_with_a_mask(clip, quick):
    estimates = list(track(list(clip.images), mask=clip.masks[0], config=quick))
    np.testing.assert_array_equal(estimates[0].initial_mask, clip.masks[0])


def test_frames_keep_their_index_and_time(clip, quick):
    frames = [Frame(10 + 2 * n, image, time=0.5 * n) for n, image in enumerate(clip.images)]
    estimates = list(track(frames, mask=clip.masks[0], config=quick))
    assert [(estimate.index, estimate.time) for estimate in estimates] == [
        (10, 0.0),
        (12, 0.5),
        (14, 1.0),
        (16, 1.5),
    ]


def test_frames_that_could_not_be_read_are_passed_over(clip, quick):
    images = list(clip.images)
    frames = [SkippedFrame(0, "damaged"), images[0], images[1], SkippedFrame(3, "damaged"), images[3]]
    with pytest.raises(InputError, match=r"The first frame.*cannot be decoded \(damaged\).*skip_damaged"):
        next(track(frames, mask=clip.masks[0], config=quick))
    estimates = list(track(frames, mask=clip.masks[0], config=quick, skip_damaged=True))
    assert [estimate.index for estimate in estimates] == [1, 2, 4]


def test_answers_come_as_the_frames_do(clip, quick):
    taken: list[int] = []

    def camera():
        for number, image in enumerate(clip.images):
            taken.append(number)
            yield image

    estimates = track(camera(), box=clip.box, config=quick)
    assert taken == []
    for number in range(3):
        assert next(estimates).index == number
        assert taken == list(range(number + 1))


@pytest.mark.slow
def test_frames_are_not_kept(clip, quick):
    """Of ten images that go through, only those in the optimization may stay, as tensors of their own."""
    alive: list[weakref.ref] = []

    def camera():
        for number in range(10):
            image = np.array(clip.images[number % 4])
            alive.append(weakref.ref(image))
            yield image
            del image

    session = track(camera(), mask=clip.masks[0], config=quick)
    for _ in range(10):
        next(session)
    gc.collect()
    assert sum(reference() is not None for reference in alive) <= 2


def test_no_frames_no_answers(quick):
    assert list(track([], box=(0, 0, 4, 4), config=quick)) == []


def test_a_caller_may_decode_every_frame_into_one_buffer(clip, quick, boxed):
    buffer = np.empty_like(clip.images[0])

    def camera():
        for image in clip.images:
            buffer[:] = image
            yield buffer

    reused = masks_of(list(track(camera(), box=clip.box, config=quick)))
    assert all(np.array_equal(a, b) for a, b in zip(reused, masks_of(boxed), strict=True))


def test_images_may_be_read_only_or_views(clip, quick, boxed):
    images = clip.images[:2].copy()
    images.flags.writeable = False
    blue_first = images[..., ::-1].copy()
    expected = masks_of(boxed[:2])
    for frames in (images, blue_first[..., ::-1]):
        assert np.array_equal(masks_of(list(track(frames, box=clip.box, config=quick))), expected)


def test_a_session_takes_views_too(clip, quick):
    first = Frame(0, clip.images[0, :, ::-1])
    session = Session(quick, make_prompt(first, mask=clip.masks[0, :, ::-1]))
    np.testing.assert_array_equal(session.step(first).initial_mask, clip.masks[0, :, ::-1])
    assert session.step(Frame(1, clip.images[1, :, ::-1])).mask.any()


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((64, 80), np.uint8),
        np.zeros((64, 80, 4), np.uint8),
        np.zeros((3, 64, 80), np.uint8),
        np.zeros((64, 80, 3), np.float32),
        np.zeros((64, 80, 3), np.uint16),
        np.zeros((0, 0, 3), np.uint8),
        None,
    ],
    ids=["grey", "alpha", "channels first", "float", "16 bit", "empty", "none"],
)
def test_an_image_of_another_form_is_refused_by_its_number(clip, quick, bad):
    frames = track([clip.images[0], bad], mask=clip.masks[0], config=quick)
    next(frames)
    with pytest.raises(InputError, match=r"^Frame 1 .*uint8"):
        next(frames)


def test_the_image_of_a_frame_object_is_checked_too(clip, quick):
    with pytest.raises(InputError, match=r"^Frame 7 .*uint8"):
        next(track([Frame(7, clip.images[0, ..., 0])], box=clip.box, config=quick))


def test_all_frames_must_have_one_size(clip, quick):
    frames = track([clip.images[0], clip.images[1, :60]], mask=clip.masks[0], config=quick)
    next(frames)
    with pytest.raises(InputError, match=r"^frame 1 has 80 x 60 pixels but the first frame 80 x 64"):
        next(frames)


# What the object is


def test_neither_box_nor_mask_is_refused_where_the_tracker_needs_one(clip, quick):
    with pytest.raises(InputError, match="one of a box, a mask or points"):
        next(track(clip.images, config=quick))


def test_both_box_and_mask_are_refused(clip, quick):
    with pytest.raises(InputError, match="one of a box, a mask or points"):
        next(track(clip.images, box=clip.box, mask=clip.masks[0], config=quick))


def test_precomputed_masks_say_what_the_object_is(clip, quick, tmp_path):
    np.savez(tmp_path / "masks.npz", masks=clip.masks)
    config = load_config(
        overrides=QUICK, tracker={"name": "precomputed", "path": str(tmp_path / "masks.npz")}
    )
    estimates = list(track(clip.images, config=config))
    for estimate, mask in zip(estimates, clip.masks, strict=True):
        np.testing.assert_array_equal(estimate.initial_mask, mask)


@pytest.mark.parametrize("box", [(0, 0, 0, 5), (5, 5, -3, 8), (200, 10, 20, 20), (math.nan, 0, 5, 5)])
def test_a_box_that_cannot_be_used_is_refused(clip, quick, box):
    with pytest.raises(InputError, match="box"):
        next(track(clip.images, box=box, config=quick))


def test_a_mask_of_another_size_is_refused(clip, quick):
    with pytest.raises(InputError, match="80 x 64"):
        next(track(clip.images, mask=clip.masks[0, :50], config=quick))


# The configuration


def test_a_configuration_file_is_read(clip, tmp_path):
    file = tmp_path / "pipeline.yaml"
    recipe = ["crop: {size: 32}", "object: {frequency: 2}", "solver: {tau: 1.0e-9, iterations: 1}"]
    file.write_text("\n".join(["preset: rerendering", *recipe]))
    for config in (file, str(file)):
        [estimate] = track(clip.images[:1], box=clip.box, config=config)
        assert estimate.status is Status.LOST


def test_without_a_configuration_the_default_preset_is_used(clip, monkeypatch):
    used: list[PipelineConfig] = []

    class Recorder:
        def __init__(self, config, prompt, intrinsics, origin, encoder, live):
            used.append(config)

        def step(self, frame):
            return frame.index

    monkeypatch.setattr("tracking3d.pipeline.open_tracking.Session", Recorder)
    assert list(track(clip.images, box=clip.box)) == [0, 1, 2, 3]
    assert used == [load_config(preset="default", tracker="segment")]  # what auto comes to
    assert used[0].solver.name == "online"


@pytest.mark.parametrize("device", ["cuda:99", "abacus", "meta", ""])
def test_a_device_that_is_not_there_is_refused(clip, device):
    config = load_config(overrides=QUICK, runtime={"device": device})
    with pytest.raises(InputError, match=rf"The device '{device}' is not available.*cpu"):
        next(track(clip.images, box=clip.box, config=config))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_is_refused_where_it_is_absent(clip):
    config = load_config(overrides=QUICK, runtime={"device": "cuda"})
    with pytest.raises(InputError, match="'cuda' is not available"):
        next(track(clip.images, box=clip.box, config=config))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_cuda_answers_nearly_as_the_cpu_does(clip, quick):
    on_gpu = quick.model_copy(update={"runtime": quick.runtime.model_copy(update={"device": "cuda"})})
    for a, b in zip(
        track(clip.images, mask=clip.masks[0], config=quick),
        track(clip.images, mask=clip.masks[0], config=on_gpu),
        strict=True,
    ):
        np.testing.assert_allclose(a.T_cam_obj, b.T_cam_obj, atol=0.05)
        assert (a.mask & b.mask).sum() > 0.9 * (a.mask | b.mask).sum()


def test_the_library_and_a_configuration_file_have_one_default():
    assert PipelineConfig() == load_config()


@pytest.mark.parametrize(("section", "name"), [("tracker", "csrtt"), ("features", "rbg")])
def test_an_unknown_plugin_is_refused(clip, section, name):
    config = load_config(overrides=QUICK, **{section: name})
    with pytest.raises(PluginError, match=rf"'{name}'.*did you mean"):
        next(track(clip.images, box=clip.box, config=config))


# The camera


def test_given_intrinsics_are_the_best_known():
    config = CameraConfig(intrinsics=(100, 101, 40, 30), fov=60)
    camera = choose_camera(config, 80, 64, (1.0, 2.0, 3.0, 4.0), "EXIF")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (100, 101, 40, 30)
    assert (camera.width, camera.height) == (80, 64)
    assert camera.origin == "given intrinsics"


def test_a_given_field_of_view_wins_over_the_source():
    camera = choose_camera(CameraConfig(fov=90), 80, 64, (1.0, 2.0, 3.0, 4.0), "EXIF")
    assert camera.fx == camera.fy == pytest.approx(32)
    assert "90" in camera.origin


def test_what_the_source_knows_wins_over_the_default():
    camera = choose_camera(CameraConfig(), 80, 64, (70.0, 72.0, 3.0, 4.0), "EXIF")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, 72, 3, 4)
    assert camera.origin == "EXIF"


def test_without_any_knowledge_the_field_of_view_is_45_degrees_vertically():
    camera = choose_camera(CameraConfig(), 80, 64)
    assert camera.fx == camera.fy == pytest.approx(32 / math.tan(math.radians(22.5)))
    assert (camera.cx, camera.cy) == (39.5, 31.5)
    assert "default" in camera.origin


# A session


def test_a_session_gives_the_camera_and_the_object_at_any_time(clip, quick):
    first = Frame(0, clip.images[0])
    untold = quick.model_copy(update={"camera": CameraConfig()})
    session = Session(untold, make_prompt(first, mask=clip.masks[0]), (90.0, 91.0, 40.0, 32.0), "EXIF")
    with pytest.raises(RuntimeError):
        _ = session.camera
    with pytest.raises(RuntimeError):
        session.result()
    session.step(first)
    assert (session.camera.fx, session.camera.origin) == (90.0, "EXIF")
    before = session.result()
    session.step(replace(first, index=1, image=clip.images[1]))
    after = session.result()
    assert before.vertices.shape == after.vertices.shape == (42, 3)
    assert before.texture.shape == (16, 16, 3)


@pytest.mark.usefixtures("made_anew")
def test_the_same_seed_gives_the_same_answers(clip, quick, boxed):
    again = track(clip.images, box=clip.box, config=quick)
    for a, b in zip(boxed, again, strict=True):
        assert np.array_equal(a.T_cam_obj, b.T_cam_obj)
        assert np.array_equal(a.mask, b.mask)


def test_the_package_has_a_version():
    assert tracking3d.__version__.count(".") == 2
