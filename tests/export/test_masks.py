"""Masks in the formats of data sets, each read back by its own rules, and cut-outs with their alpha."""

from __future__ import annotations

import json
import shutil

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from tracking3d.errors import InputError
from tracking3d.results.files import write_probability
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.region_files import read_regions
from tracking3d.trackers.vot_regions import rasterise

SIZE = (96, 128)


def true_mask(run, index: int) -> np.ndarray:
    return np.zeros(SIZE, bool) if index == 4 else RunReader(run).mask(index)  # 4 was skipped


def test_davis_has_an_indexed_mask_for_every_frame(export, run):
    folder = export(run, "davis") / "run"
    assert sorted(path.name for path in folder.iterdir()) == [f"{index:05d}.png" for index in range(7)]
    for index in range(7):
        image = Image.open(folder / f"{index:05d}.png")
        assert image.mode == "P"
        assert image.getpalette()[:6] == [0, 0, 0, 128, 0, 0]
        np.testing.assert_array_equal(np.asarray(image), true_mask(run, index).astype(np.uint8))


def test_youtube_vos_says_in_which_frames_the_object_is(export, run):
    folder = export(run, "youtube-vos")
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["videos"]["run"]["objects"]["1"]["frames"] == [f"{n:05d}" for n in (0, 1, 2, 3, 5, 6)]
    image = np.asarray(Image.open(folder / "Annotations" / "run" / "00003.png"))
    np.testing.assert_array_equal(image, true_mask(run, 3))


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools and numpy 2
def test_pycocotools_reads_the_masks(export, run, capsys):
    coco = pytest.importorskip("pycocotools.coco").COCO(export(run, "coco"))
    capsys.readouterr()  # it talks
    assert sorted(coco.getImgIds()) == [0, 1, 2, 3, 5, 6]
    for annotation in coco.loadAnns(coco.getAnnIds()):
        mask = true_mask(run, annotation["image_id"])
        np.testing.assert_array_equal(coco.annToMask(annotation), mask)
        assert annotation["area"] == mask.sum()
        x, y, width, height = annotation["bbox"]
        assert mask[y : y + height, x : x + width].sum() == mask.sum()
        assert (
            mask[y].any() and mask[y + height - 1].any() and mask[:, x].any() and mask[:, x + width - 1].any()
        )


@pytest.mark.parametrize("mask", [[[0, 0], [0, 0]], [[1, 1], [1, 1]], [[1, 0], [0, 1]], [[0, 1], [0, 0]]])
def test_run_lengths_go_down_the_columns_and_begin_with_zeros(mask):
    from tracking3d.export.coco import run_lengths

    lengths = run_lengths(np.array(mask, bool))
    values = np.repeat(np.arange(len(lengths)) % 2, lengths)
    np.testing.assert_array_equal(values.reshape(2, 2, order="F"), mask)


def test_vot_has_a_region_a_line(export, run):
    regions = read_regions(export(run, "vot"))
    for index in range(7):
        np.testing.assert_array_equal(rasterise(regions[index], SIZE), true_mask(run, index))


def test_cut_outs_are_transparent_around_the_object(export, run):
    folder = export(run, "cut-outs")
    for index in range(7):
        image = np.asarray(Image.open(folder / f"{index:06d}.png"))
        mask = true_mask(run, index)
        np.testing.assert_array_equal(image[..., 3] == 255, mask)
        assert set(np.unique(image[..., 3])) <= {0, 255}
        if index != 4:
            picture = np.asarray(Image.open(run.parent / "video" / f"{index:03d}.png"))
            np.testing.assert_array_equal(image[mask][:, :3], picture[mask])
            assert not image[0, 0, :3].any()  # far from the object nothing of the video is given away


@pytest.mark.parametrize(
    ("to", "suffix", "decoder"), [("vp9", "webm", "libvpx-vp9"), ("prores", "mov", "prores")]
)
def test_videos_have_the_masks_as_alpha(export, run, to, suffix, decoder):
    path = export(run, to, f"out.{suffix}", source=str(run.parent / "video"))
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert stream.average_rate == 25
        # FFmpeg's own decoder of VP9 leaves alpha out; browsers and editors have it.
        codec = av.CodecContext.create(decoder, "r")
        codec.extradata = stream.codec_context.extradata
        pictures = [
            frame.to_ndarray(format="rgba")
            for packet in file.demux(stream)
            for frame in codec.decode(packet if packet.size else None)
        ]
    assert len(pictures) == 7
    for index, picture in enumerate(pictures):
        mask = true_mask(run, index)
        alpha = picture[..., 3]
        assert alpha.shape == SIZE
        assert np.abs(alpha / 255.0 - mask).mean() < 0.01
        if to == "prores" and index != 4:
            np.testing.assert_array_equal(alpha > 127, mask)
            # The pictures are noise, which a codec cannot keep; the colours on the whole it can.
            colours = np.asarray(Image.open(run.parent / "video" / f"{index:03d}.png"))
            np.testing.assert_allclose(picture[mask][:, :3].mean(0), colours[mask].mean(0), atol=2)


@pytest.fixture
def likely_run(run, tmp_path):
    """A copy of the run with probabilities in two of its frames, which rise from left to right."""
    folder = shutil.copytree(run, tmp_path / "likely")
    for index in (1, 5):
        write_probability(folder, index, np.tile(np.linspace(0, 1, SIZE[1], dtype=np.float32), (SIZE[0], 1)))
    return folder


@pytest.mark.parametrize(
    ("to", "kind", "white"), [("probabilities", np.uint8, 255), ("probabilities-16", np.uint16, 65535)]
)
def test_probabilities_are_grey_pictures_of_the_frames_that_have_them(export, likely_run, to, kind, white):
    folder = export(likely_run, to)
    assert sorted(path.name for path in folder.glob("*.png")) == ["00001.png", "00005.png"]
    picture = cv2.imread(str(folder / "00005.png"), cv2.IMREAD_UNCHANGED)  # another reader than what wrote it
    assert picture.dtype == kind
    assert (picture.min(), picture.max()) == (0, white)
    np.testing.assert_allclose(picture / white, RunReader(likely_run).probability(5), atol=1e-5)
    assert json.loads((folder / "export.json").read_text())["frames_without_answer"] == [0, 2, 3, 4, 6]


def test_what_a_run_has_no_probabilities_for_is_said(export, run, likely_run):
    with pytest.raises(
        InputError, match=r"stored no probabilities; track again with runtime.probabilities=true"
    ):
        export(run, "probabilities")
    with pytest.raises(InputError, match="of the final estimates only"):
        export(likely_run, "probabilities", answers="causal")
    shutil.rmtree(likely_run / "probabilities")
    (likely_run / "probabilities").mkdir()
    with pytest.raises(InputError, match="no frame with a fused mask"):
        export(likely_run, "probabilities-16")
