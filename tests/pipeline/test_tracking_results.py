"""One call of `tracking3d.track` gives what the command line gives, and leaves the process as it was."""

from __future__ import annotations

import asyncio
import gc
import random
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from refining_solver import CausalSolver, StandInSolver

import tracking3d
from tracking3d import Status, TrackingResult, load_config, track
from tracking3d.errors import InputError, OutputError
from tracking3d.pipeline.record import record, record_objects
from tracking3d.pipeline.session import SOLVERS
from tracking3d.reconstruction import rebuild
from tracking3d.reconstruction.shape import ReconstructedShape
from tracking3d.rendering.kernels import compilation as kernels
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import visible_side
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source

SETTINGS = [
    "crop.size=32",
    "object.texture_views=4",
    "object.adjustment_views=0",  # the stand-in is judged as it says
    "tracker.name=flow",
    "tracker.segmentation_size=64",
]


@pytest.fixture(scope="module", autouse=True)
def solvers():
    """Solvers that answer at once; how the real one does is another matter."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOLVERS, "online", StandInSolver)
        patch.setitem(SOLVERS, "paper", CausalSolver)
        patch.setattr(StandInSolver, "seen", [])
        yield


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=6, size=(80, 64)))


@pytest.fixture(scope="module")
def config():
    return load_config(overrides=SETTINGS)


@pytest.fixture(scope="module")
def by_command(clip, config, tmp_path_factory) -> RunReader:
    return record(open_source(clip.images), config, tmp_path_factory.mktemp("run"), mask=clip.masks[0])


@pytest.fixture(scope="module")
def result(clip, config) -> TrackingResult:
    return track(clip.images, mask=clip.masks[0], config=config).result()


def test_record_gives_the_reader_of_its_folder(by_command):
    assert isinstance(by_command, RunReader)
    assert by_command.state == "finished"
    assert len(by_command.frames) == 6


def test_the_result_is_that_of_the_command_line(result, by_command):
    assert result.refined
    assert len(result) == 6
    np.testing.assert_array_equal(result.indices, range(6))
    np.testing.assert_array_equal(result.poses, [one.T_cam_obj for one in by_command.frames])
    np.testing.assert_array_equal(result.masks, [by_command.mask(index) for index in range(6)])
    assert result.statuses == tuple(one.status for one in by_command.frames)
    for name in ("mesh.obj", "texture.png"):
        assert (result.run.folder / name).read_bytes() == (by_command.folder / name).read_bytes()
    np.testing.assert_array_equal(result.model.vertices, load_model(by_command.folder).vertices)
    assert result.camera == by_command.camera


def test_what_was_known_at_the_time_is_kept_beside_it(result, clip, config):
    causal = result.causal
    assert not causal.refined
    estimates = {}
    for estimate in track(clip.images, mask=clip.masks[0], config=config):
        estimates.update({one.index: one for one in (*estimate.revised, estimate)})
    np.testing.assert_array_equal(causal.poses, [estimates[index].T_cam_obj for index in range(6)])
    assert len(causal.timings) == 6
    assert all(stages is not None and stages.whole > 0 for stages in causal.timings)
    assert causal.confidences.shape == (6,)


def test_masks_are_read_one_by_one_as_well(result):
    assert len(result.masks) == 6
    assert result.masks[-1].dtype == bool
    np.testing.assert_array_equal(result.masks[1:3][1], result.masks[2])


def test_answers_are_taken_one_by_one_and_all_together_where_that_was_said(clip, config):
    tracking = track(clip.images, mask=clip.masks[0], config=config, refine=False)
    taken = [next(tracking) for _ in range(2)]
    assert [one.index for one in taken] == [0, 1]
    result = tracking.result()  # goes on with those that are left
    assert len(result) == 6 and not result.refined
    assert result is tracking.result()


def test_answers_that_were_not_kept_are_not_made_up(clip, config):
    tracking = track(clip.images, mask=clip.masks[0], config=config)
    next(tracking)
    with pytest.raises(InputError, match=r"not saved; call result\(\) first, or give refine="):
        tracking.result()


def test_the_model_is_what_was_asked_for(clip, config):
    plain = track(clip.images, mask=clip.masks[0], config=config, model="none").result()
    assert plain.refined
    assert plain.run.config["object"]["texture_views"] == 0


def test_a_result_with_a_size_is_in_metres(clip, config, result):
    metric = track(clip.images, mask=clip.masks[0], config=config, object_size=0.22).result()
    assert metric.run.unit == "metre" and visible_side(metric.model) == pytest.approx(0.22)
    for one, other in ((metric, result), (metric.causal, result.causal)):
        scale = visible_side(one.model) / visible_side(other.model)
        np.testing.assert_allclose(one.poses[:, :3, 3], other.poses[:, :3, 3] * scale, rtol=1e-9)
        np.testing.assert_array_equal(one.poses[:, :3, :3], other.poses[:, :3, :3])


def test_a_size_that_is_none_is_refused_at_once(clip, config):
    for size in ("0.2", True, -1, float("nan")):
        with pytest.raises(InputError, match=r"^object_size= is .* give a number of metres above 0"):
            track(clip.images, mask=clip.masks[0], config=config, object_size=size)
    with pytest.raises(InputError, match="has its own unit"):
        track(clip.images, config=config, object="thing", object_size=0.2)


def test_a_fine_model_has_a_new_shape_where_that_explains_the_frames_better(clip, config, monkeypatch):
    given: list[int] = []

    def smaller(starts, views, left_out):
        [(vertices, faces)] = starts
        given.extend(view.index for view in (*views, *left_out))
        return ReconstructedShape(vertices * 0.9, faces, "It is better.", None, None)

    def reshaped(model, vertices, faces, views):  # the stand-in's texture is too small to be taken apart
        return replace(model, vertices=vertices)

    monkeypatch.setattr(rebuild, "reconstruct_shape", smaller)
    monkeypatch.setattr(rebuild, "replace_shape", reshaped)
    result = track(clip.images, mask=clip.masks[0], config=config, model="fine").result()
    assert result.about_shape == "It is better."
    assert sorted(given) == [record.index for record in result.frames if record.status is Status.TRACKED]
    online = load_model(result.run.folder / "online")
    np.testing.assert_allclose(result.model.vertices, 0.9 * online.vertices)


def test_a_shape_that_cannot_be_told_stays_and_the_result_says_why(clip, config):
    few = track(clip.images[:2], mask=clip.masks[0], config=config, model="fine").result()
    assert few.about_shape.startswith("The mesh keeps its shape: ")
    assert len(few.model.vertices)
    plain = track(clip.images[:2], mask=clip.masks[0], config=config, model="fast").result()
    assert plain.about_shape == ""


def test_a_fine_model_needs_packages_and_says_which(clip, config, monkeypatch):
    monkeypatch.setattr(rebuild, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="needs scikit-image"):
        track(clip.images, mask=clip.masks[0], config=config, model="fine")


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"refine": "yes"}, r"^refine='yes' is neither True nor False"),
        ({"model": "finest"}, r"^model='finest' is unknown; give 'auto', 'none', 'fast' or 'fine'"),
        (
            {"refine": False, "model": "fast"},
            r"^model='fast' takes the texture .* without the final refinement",
        ),
        ({"frames": iter(()), "refine": True}, r"^refine=True: the iterable of frames comes once only"),
        ({"frames": iter(()), "model": "fast"}, r"^model='fast' takes .* the iterable of frames does not"),
        (
            {"frames": iter(()), "model": "fine"},
            r"^model='fine' makes .* the iterable of frames comes once only",
        ),
        ({"config": "paper", "refine": True}, r"^refine=True: the solver .* gives causal estimates only"),
    ],
)
def test_results_that_cannot_be_are_refused_at_once(clip, config, asked, sentence):
    asked = {"frames": clip.images, "config": config, **asked}
    if asked["config"] == "paper":
        asked["config"] = load_config(overrides=[*SETTINGS, "solver.name=paper"])
    with pytest.raises(InputError, match=sentence):
        track(asked.pop("frames"), mask=clip.masks[0], **asked)


def test_frames_that_come_once_have_causal_answers_and_say_so(clip, config):
    result = track(iter(clip.images), mask=clip.masks[0], config=config).result()
    assert not result.refined and len(result) == 6
    assert "cannot be read a second time" in str(result.run.description["refinement"])


def test_a_result_is_saved_and_exported(result, tmp_path):
    saved = result.save(tmp_path / "kept")
    assert saved.state == "finished"
    np.testing.assert_array_equal([one.T_cam_obj for one in saved.frames], result.poses)
    with pytest.raises(OutputError, match="already holds a run"):
        result.save(tmp_path / "kept")
    result.save(tmp_path / "kept", overwrite=True)
    refined, causal = tmp_path / "refined.txt", tmp_path / "causal.txt"
    assert result.export("tum", refined).frames == 6
    result.causal.export("tum", causal)
    assert refined.read_bytes() != causal.read_bytes()
    with pytest.raises(InputError, match=r"^There is no format gif; "):
        result.export("gif", tmp_path / "x")
    with pytest.raises(InputError, match=r"^out= is None"):
        result.export("tum", None)  # type: ignore[arg-type]


def test_the_temporary_folder_goes_with_the_result(clip, config):
    result = track(clip.images[:1], mask=clip.masks[0], config=config, refine=False).result()
    folder = result.run.folder
    causal = result.causal
    del result
    assert folder.is_dir()
    del causal
    gc.collect()
    assert not folder.exists()


def test_a_tracking_that_is_closed_lets_go_of_its_source(clip, config):
    frames = Frames(clip.images)
    with track(frames, mask=clip.masks[0], config=config) as tracking:
        next(tracking)
        assert frames.open == 1
    assert frames.open == 0
    with pytest.raises(StopIteration):
        next(tracking)


def test_no_frame_at_all_is_told(config):
    with pytest.raises(InputError, match=r"^the iterable of frames has no frame"):
        track([], box=(1, 2, 3, 4), config=config).result()


class Frames:
    """A source that knows how often it is open."""

    name, fps, intrinsics, intrinsics_origin, repeatable = (
        "the test",
        None,
        (90.0, 91.0, 40.0, 30.0),
        "the test",
        True,
    )

    def __init__(self, images) -> None:
        self._images, self.open, self.count = images, 0, len(images)

    def __iter__(self):
        self.open += 1
        try:
            for index, image in enumerate(self._images):
                yield tracking3d.Frame(index, image)
        finally:
            self.open -= 1


def test_what_the_source_knows_of_its_lens_counts(clip, config):
    result = track(Frames(clip.images[:1]), mask=clip.masks[0], config=config).result()
    assert (result.camera.fx, result.camera.fy, result.camera.origin) == (90, 91, "the test")


def test_awaited_answers_are_the_same_and_the_loop_goes_on(clip, config):
    async def together():
        turns, estimates = 0, []

        async def count():
            nonlocal turns
            while True:
                await asyncio.sleep(0.001)
                turns += 1

        counting = asyncio.create_task(count())
        async for estimate in track(clip.images, mask=clip.masks[0], config=config):
            assert threading.current_thread() is threading.main_thread()
            estimates.append(estimate)
        counting.cancel()
        return estimates, turns

    estimates, turns = asyncio.run(together())
    assert turns > 6
    for one, other in zip(estimates, track(clip.images, mask=clip.masks[0], config=config), strict=True):
        np.testing.assert_array_equal(one.T_cam_obj, other.T_cam_obj)


def test_a_result_can_be_awaited(clip, config, result):
    awaited = asyncio.run(track(clip.images, mask=clip.masks[0], config=config).result_async())
    np.testing.assert_array_equal(awaited.poses, result.poses)


def test_cancelling_finishes_the_frame_in_work_and_closes_the_source(clip, config):
    frames = Frames(clip.images)

    async def begun_and_cancelled():
        first = asyncio.Event()

        async def work():
            async for _ in track(frames, mask=clip.masks[0], config=config):
                first.set()

        task = asyncio.create_task(work())
        await first.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert frames.open == 0

    asyncio.run(begun_and_cancelled())
    assert not [one for one in threading.enumerate() if one.name.startswith("tracking3d_")]


def test_an_error_on_the_way_arrives_where_it_is_awaited(clip, config):
    async def work():
        async for _ in track([clip.images[0], None], mask=clip.masks[0], config=config):
            pass

    with pytest.raises(InputError, match=r"^Frame 1 is None"):
        asyncio.run(work())


def test_while_a_thread_tracks_threads_and_random_numbers_stay_the_caller_s(clip, config, monkeypatch):
    """Two at a time, so that one's settings would be taken for the caller's by the other."""
    config = config.model_copy(update={"runtime": config.runtime.model_copy(update={"threads": 2})})
    torch.manual_seed(5), random.seed(5), np.random.seed(5)
    expected = float(torch.rand(())), random.random(), float(np.random.random())
    torch.manual_seed(5), random.seed(5), np.random.seed(5)
    before = torch.get_num_threads(), kernels.get_num_threads()
    seen = []
    step = StandInSolver.step

    def noted(self, *arguments):
        seen.append((threading.get_ident(), kernels.get_num_threads()))
        time.sleep(0.01)
        return step(self, *arguments)

    monkeypatch.setattr(StandInSolver, "step", noted)

    async def one():
        async for _ in track(clip.images[:3], mask=clip.masks[0], config=config):
            assert (torch.get_num_threads(), kernels.get_num_threads()) == before

    async def both():
        tasks = [asyncio.create_task(one()) for _ in range(2)]
        while not all(task.done() for task in tasks):
            assert (torch.get_num_threads(), kernels.get_num_threads()) == before
            await asyncio.sleep(0.001)
        await asyncio.gather(*tasks)

    asyncio.run(both())
    assert {threads for _, threads in seen} == {2}  # at work it is as configured
    assert len({thread for thread, _ in seen}) == 2
    assert (float(torch.rand(())), random.random(), float(np.random.random())) == expected


def test_record_objects_gives_a_reader_for_each(clip, config, tmp_path):
    quick = load_config(overrides=[*SETTINGS, "solver.final_refine=false"])
    readers = record_objects(open_source(clip.images[:1]), quick, tmp_path, masks=[clip.masks[0]] * 2)
    assert [reader.folder.name for reader in readers] == ["object_0", "object_1"]
    assert {reader.frames[0].status for reader in readers} <= set(Status)


def test_without_a_question_there_are_no_tracks(result):
    assert result.tracks == ()


def test_paths_are_tracked(clip, config, tmp_path):
    for index, image in enumerate(clip.images[:2]):
        Image.fromarray(image).save(tmp_path / f"{index}.png")
    for frames in (tmp_path, str(tmp_path), sorted(tmp_path.iterdir()), map(str, sorted(tmp_path.iterdir()))):
        estimates = list(track(frames, mask=clip.masks[0], config=config))
        assert [one.index for one in estimates] == [0, 1]
