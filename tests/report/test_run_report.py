"""``report.html``: one file that holds all of a run, says what to doubt, and lets nothing in that runs."""

from __future__ import annotations

import base64
import io
import json
import re
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hostile import HOSTILE
from PIL import Image

from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.estimate import Status
from tracking3d.results import layout
from tracking3d.results.files import write_probability
from tracking3d.results.layout import runs_in
from tracking3d.results.run_reader import RunReader
from tracking3d.ui.report import run_report
from tracking3d.ui.report.run_report import probability_layers, write_report
from tracking3d.ui.report.several import write_reports
from tracking3d.ui.sentences import doubts_of
from tracking3d.video import open_source


@pytest.fixture(autouse=True)
def no_turntable(monkeypatch, request):
    if "turntable" not in request.function.__name__:
        monkeypatch.setattr(run_report, "write_turntable", lambda *_: None)


class Page(HTMLParser):
    """What a browser would make of the file: its tags, their attributes, its text."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.text += data

    @property
    def data(self) -> dict:
        [found] = re.findall(r'<script type="application/json" id="data">(.*?)</script>', self.source, re.S)
        return json.loads(found)


def report_of(folder: Path) -> Page:
    return Page(write_report(folder))


def test_the_report_holds_every_frame_with_its_status_and_reason(run_folder):
    data = report_of(run_folder).data
    assert data["indices"] == list(range(12))
    assert data["statuses"] == "tttt" + "lll" + "uu" + "ttt"
    assert data["reasons"][data["reason"][5]] == "out of sight"
    assert data["doubts"] == [4, 7]
    assert data["keyframes"] == [0, 5, 10]
    assert len(data["pictures"]) == 12
    assert base64.b64decode(data["pictures"][3])[:2] == b"\xff\xd8"
    assert [rotation is None for rotation in data["rotations"]] == [n in (4, 5, 6) for n in range(12)]


def test_the_model_in_the_page_is_that_of_the_run(run_folder):
    model = report_of(run_folder).data["model"]
    mesh = RunReader(run_folder).mesh()
    positions = np.frombuffer(base64.b64decode(model["positions"]), "<f4").reshape(-1, 3)
    faces = np.frombuffer(base64.b64decode(model["faces"]), "<u4").reshape(-1, 3)
    drawn, truly = positions[faces], mesh.vertices[mesh.faces]
    assert len(faces) == len(mesh.faces)
    assert np.allclose(drawn, truly - (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2, atol=1e-2)
    assert np.linalg.norm(positions, axis=1).max() == pytest.approx(1)


def test_the_page_is_one_file_that_asks_for_nothing(run_folder):
    page = report_of(run_folder)
    for tag, attributes in page.tags:
        for name in ("src", "href", "data", "action"):
            value = attributes.get(name) or ""
            if tag == "a":  # asks only once it is clicked
                assert (run_folder / value).exists()
            else:
                assert value.startswith("data:") or not value, (tag, value[:40])
    assert not re.search(r"https?://(?!www\.w3\.org)", page.source)
    [policy] = [one["content"] for _, one in page.tags if one.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy


def test_every_picture_and_control_has_a_name(run_folder):
    page = report_of(run_folder)
    labels = {attributes["for"] for tag, attributes in page.tags if tag == "label"}
    for tag, attributes in page.tags:
        if tag == "img":
            assert attributes.get("alt")
        if tag == "input":
            assert attributes["id"] in labels
        if tag == "svg":
            assert attributes.get("aria-label") or attributes.get("aria-hidden")
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert max(np.diff(levels)) <= 1


def test_what_a_run_says_of_itself_cannot_become_part_of_the_page(run_folder, described):
    plain = [tag for tag, _ in report_of(run_folder).tags]
    lines = [json.loads(line) for line in (run_folder / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        line["reason"] = line["name"] = HOSTILE
    (run_folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    about = RunReader(run_folder).description
    described(
        run_folder,
        source=HOSTILE,
        command=HOSTILE,
        notes=[HOSTILE],
        error=HOSTILE,
        state="failed",
        config={"tracker": {"name": HOSTILE}, HOSTILE: HOSTILE},
        versions={HOSTILE: HOSTILE},
        conventions={HOSTILE: HOSTILE},
        camera=about["camera"] | {"origin": HOSTILE},
        created=HOSTILE,
    )
    page = report_of(run_folder)
    more = {tag for tag, _ in page.tags} - set(plain)
    assert more == set()
    assert [tag for tag, _ in page.tags].count("script") == plain.count("script")
    assert [tag for tag, _ in page.tags].count("img") == plain.count("img")
    assert not any("onerror" in attributes for _, attributes in page.tags)
    assert HOSTILE in page.text  # it is shown as it is
    assert "49" not in re.findall(r"\{\{.*?\}\}|amp;(\d+)", page.text)
    assert page.data["reasons"] == [HOSTILE]


def test_the_name_of_a_folder_is_escaped_too(run_folder):
    folder = run_folder.rename(run_folder.with_name("<script>alert(1)<"))
    page = report_of(folder)
    assert "<script>alert(1)<" in page.text
    assert [tag for tag, _ in page.tags].count("script") == 2


def change_records(folder: Path, *changes: dict) -> RunReader:
    """Frames of the run as if they had been estimated otherwise: the n-th change for the n-th frame, in turn."""
    path = folder / layout.FRAMES
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines = [line | changes[number % len(changes)] for number, line in enumerate(lines)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return RunReader(folder)


PLAIN = {
    "status": "uncertain",
    "reason": "the object has hardly any texture (ratio 0.3)",
    "iou_initial": 0.97,
}


@pytest.mark.parametrize(
    ("changes", "masks", "poses"),
    [
        (
            [{"status": "tracked", "iou_initial": 0.9}],
            "plausible in all 12 frames.",
            "reliable in all 12 frames.",
        ),
        (
            [PLAIN],
            "plausible in all 12 frames.",
            "not reliable (tracked in 0 of 12 frames): the object has hardly any texture.",
        ),
        (
            [{"iou_initial": 0.9}, {"iou_initial": 0.3}],
            "plausible in 6 of 12 frames.",
            "reliable in 7 of 12 frames.",
        ),
        ([{"iou_initial": None, "area": 0}], "plausible in 0 of 12 frames.", "reliable in 7 of 12 frames."),
        (
            [*[{"iou_initial": 1.0, "area": 900}] * 11, {"iou_initial": 1.0, "area": 2500}],
            "plausible in 11 of 12 frames.",
            "reliable in 7 of 12 frames.",
        ),
    ],
    ids=["all well", "plain object", "not like the tracker's", "empty", "one is much larger"],
)
def test_the_first_line_tells_what_can_be_used_masks_and_poses_apart(run_folder, changes, masks, poses):
    change_records(run_folder, *changes)
    assert f"Masks: {masks} Poses: {poses}" in report_of(run_folder).text


LENS_GIVEN = {"assumed": False, "focal_deviation": None}
COMMAND = "tracking3d run clip.mp4 --box 1,2,3,4"


@pytest.mark.parametrize(
    ("changes", "about", "commands"),
    [
        ({}, {}, ["export RUN --to blender"]),
        (PLAIN, {}, ["export RUN --to coco"]),
        ({}, {"assumed": True}, [f"{COMMAND} --out RUN_again --fov DEGREES", "export RUN --to blender"]),
        (
            {"iou_initial": 0.5},
            {"tracker": "csrt"},
            [
                "correct RUN 0:X,Y,WIDTH,HEIGHT",
                "view RUN",
                f"{COMMAND} --out RUN_again --tracker segment",
                "export RUN --to blender",
            ],
        ),
        (
            {"iou_initial": 0.5},
            {
                "tracker": "csrt",
                "assumed": True,
                "command": f"{COMMAND} --out 'my runs/box' --tracker csrt",
            },
            [
                "correct RUN 0:X,Y,WIDTH,HEIGHT",
                "view RUN",
                f"{COMMAND} --out RUN_again --tracker segment",
                f"{COMMAND} --tracker csrt --out RUN_again --fov DEGREES",
                "export RUN --to blender",
            ],
        ),
        (
            {},
            {"unseen": 0.8},
            ["run SECOND_VIDEO --box X,Y,WIDTH,HEIGHT --object RUN --extend", "export RUN"],
        ),
        ({}, {"state": "interrupted"}, [f"{COMMAND} --resume", "export RUN --to blender"]),
        (
            {},
            {"command": "tracking3d batch clips", "assumed": True},
            ["run clip.mp4 --box X,Y,WIDTH", "export"],
        ),
    ],
    ids=["well", "plain", "lens", "masks", "options given before", "unseen", "interrupted", "batch"],
)
def test_the_report_gives_the_command_for_what_to_do_next(
    run_folder, described, monkeypatch, changes, about, commands
):
    change_records(run_folder, {"status": "tracked", "iou_initial": 0.95, "area": 900} | changes)
    (run_folder / layout.STATE).mkdir()
    (run_folder / layout.STATE / layout.STATE_FILE).write_text("{}")
    monkeypatch.setattr("tracking3d.ui.sentences.unseen_share", lambda _: about.get("unseen", 0.2))
    described(
        run_folder,
        camera=RunReader(run_folder).description["camera"]
        | LENS_GIVEN
        | {"assumed": about.get("assumed", False)},
        config={"tracker": {"name": about.get("tracker", "onnx")}},
        state=about.get("state", "finished"),
        command=about.get("command", COMMAND),
    )
    shown = report_of(run_folder).text.partition("Do this next")[2].partition("Next to this page")[0]
    given = [line.strip() for line in shown.splitlines() if "tracking3d " in line]
    told = [one for line in given for one in line.split("tracking3d ")[1:]]
    expected = [one.replace("RUN", str(run_folder)).removeprefix("tracking3d ") for one in commands]
    assert len(told) == len(expected), told
    assert all(one.startswith(start) for one, start in zip(told, expected, strict=True)), told


def test_the_report_links_to_mesh_and_masks(run_folder):
    links = {attributes.get("href") for tag, attributes in report_of(run_folder).tags if tag == "a"}
    assert {"mesh.glb", "mesh.obj", "masks", "frames.jsonl", "overlay.mp4"} <= links


def test_reasons_that_alternate_are_one_row_with_their_counts(run_folder):
    change_records(
        run_folder,
        {"status": "uncertain", "reason": "too few inliers (3)"},
        {"status": "uncertain", "reason": "much is new (ratio 0.5)"},
        {"status": "uncertain", "reason": "too few inliers (8)"},
    )
    page = report_of(run_folder)
    rows = [attributes for tag, attributes in page.tags if tag == "button" and "data-position" in attributes]
    assert len(rows) == 1
    assert "frames 0 to 11" in page.text
    assert "too few inliers (3), 8 frames; much is new (ratio 0.5), 4 frames" in page.text


def test_doubts_name_the_lost_the_uncertain_and_what_was_handed_back(run_folder):
    told = " ".join(doubts_of(RunReader(run_folder)))
    assert "The object was lost in 3 of 12 frames" in told
    assert "2 of 12 frames are uncertain" in told
    assert "In 1 of 12 frames that is not lost, the mask is the mask tracker's" in told


def test_doubts_tell_guessed_poses_from_those_of_frames_in_which_nothing_is_known(run_folder):
    path = run_folder / layout.FRAMES
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    guessed = [line for line in lines if line["status"] == "lost"][1:]
    for line in guessed:
        line["diagnostics"], line["mask_source"] = {"unaligned_map": 1.0}, "fused"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    told = " ".join(doubts_of(RunReader(run_folder)))
    assert "The object was lost in 1 of 12 frames: their poses are meaningless" in told
    assert "In 2 of 12 frames tracking was re-initialized on a side of the object" in told


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"state": "interrupted"}, "The run is interrupted."),
        ({"state": "failed", "error": "the disk was full"}, "The run is failed: the disk was full."),
        ({"skipped": [{"index": 3, "reason": "damaged"}]}, "1 frame was skipped"),
        (
            {"refinement": {"state": "skipped", "reason": "a camera cannot be read a second time"}},
            "The final refinement is skipped (a camera cannot be read a second time)",
        ),
    ],
)
def test_doubts_name_what_did_not_come_to_its_end(run_folder, described, changes, sentence):
    described(run_folder, **changes)
    assert sentence in " ".join(doubts_of(RunReader(run_folder)))


def test_a_run_without_fault_has_few_doubts(make_turning_run):
    folder = make_turning_run(4)
    assert doubts_of(RunReader(folder)) == []


@pytest.mark.parametrize("trusted", [False, True])
def test_a_run_that_added_nothing_to_its_masks_says_so_unless_it_was_to_keep_them(
    run_folder, described, trusted
):
    described(run_folder, config={"object": {"trust_masks": trusted}})
    lines = [json.loads(line) for line in (run_folder / "frames.jsonl").read_text().splitlines()]
    changed = [json.dumps(line | {"mask_source": "initial"}) for line in lines]
    (run_folder / "frames.jsonl").write_text("\n".join(changed) + "\n")
    said = [
        doubt
        for doubt in doubts_of(RunReader(run_folder))
        if doubt.startswith("All masks are the mask tracker's")
    ]
    assert len(said) == (not trusted)


def test_the_notes_of_a_run_are_doubts(run_folder, described):
    described(run_folder, notes=["nobody gave the lens: 45 degrees"])
    assert "Nobody gave the lens: 45 degrees." in doubts_of(RunReader(run_folder))


def test_a_killed_run_has_a_report(run_folder):
    """As `kill -9` leaves it: no mesh, no sheet, half a line at the end."""
    for name in ("mesh.obj", "features.npz", "contact_sheet.png", "texture.png"):
        (run_folder / name).unlink()
    run = json.loads((run_folder / "run.json").read_text())
    left = {"state": "running"} | {key: run[key] for key in ("format", "format_version", "camera", "config")}
    (run_folder / "run.json").write_text(json.dumps(left))
    lines = (run_folder / "frames.jsonl").read_text()
    (run_folder / "frames.jsonl").write_text(lines[: len(lines) * 2 // 3])
    page = report_of(run_folder)
    assert page.data["model"] is None
    assert 0 < len(page.data["indices"]) < 12
    assert "holds no features.npz" in page.text
    assert "interrupted" in page.text


def test_a_run_without_any_frame_has_a_report(run_folder):
    (run_folder / "frames.jsonl").write_text("")
    page = report_of(run_folder)
    assert page.data["indices"] == []
    assert not [tag for tag, _ in page.tags if tag == "input"]


@pytest.mark.parametrize(
    "changes",
    [
        {"config": {"tracker": "csrt"}},
        {"camera": {}},
        {"renderer": 3},
        {"versions": [1]},
        {"conventions": "none"},
    ],
)
def test_a_damaged_run_is_refused_in_a_sentence(run_folder, described, changes):
    described(run_folder, **changes)
    with pytest.raises(InputError, match=r"run\.json is damaged") as error:
        write_report(run_folder)
    assert "\n" not in str(error.value)
    assert not (run_folder / "report.html").exists()


@pytest.mark.parametrize("damage", ["vertices", "faces", "shapes"])
def test_a_damaged_model_is_left_out_with_a_sentence(run_folder, damage):
    with np.load(run_folder / "features.npz") as file:
        arrays = dict(file)
    if damage == "vertices":
        arrays["vertices"][3] = np.nan
    elif damage == "faces":
        arrays["faces"][3] = len(arrays["vertices"])
    else:
        arrays["face_uvs"] = arrays["face_uvs"][:-1]
    np.savez(run_folder / "features.npz", **arrays)
    page = report_of(run_folder)
    assert page.data["model"] is None
    assert "features.npz has" in page.text


def test_a_report_that_cannot_be_written_leaves_the_run_as_it_was(run_folder, monkeypatch):
    before = {path: path.read_bytes() for path in run_folder.rglob("*") if path.is_file()}
    monkeypatch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OutputError, match="disk is full"):
        write_report(run_folder)
    monkeypatch.undo()
    assert {path: path.read_bytes() for path in run_folder.rglob("*") if path.is_file()} == before


def test_the_turntable_shows_the_model_once_around(run_folder):
    write_report(run_folder)
    images = [frame.image for frame in open_source(str(run_folder / "turntable.mp4"))]
    assert len(images) >= 36
    steps = [np.abs(a.astype(int) - b).mean() for a, b in pairwise(images)]
    closing = np.abs(images[-1].astype(int) - images[0]).mean()
    assert min(steps) > 0
    assert closing < 2 * max(steps)
    assert not list(run_folder.glob(".*"))


def test_several_objects_have_a_page_that_links_to_their_reports(make_turning_run, tmp_path):
    parent = tmp_path / "both"
    for number in (0, 1, 10):
        make_turning_run(3, parent / f"object_{number}")
    written = write_reports(runs_in(parent))
    assert [path.relative_to(parent).as_posix() for path in written] == [
        "index.html",
        "object_0/report.html",
        "object_1/report.html",
        "object_10/report.html",
    ]
    page = Page(parent / "index.html")
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    assert links == ["object_0/report.html", "object_1/report.html", "object_10/report.html"]
    assert all((parent / link).is_file() for link in links)
    assert 'href="../index.html"' in (parent / "object_1/report.html").read_text()


def test_statuses_that_the_page_knows_are_all_that_there_are():
    assert {status.value[0] for status in Status} == {"t", "u", "l"}


def ramp(run: RunReader, column: int) -> np.ndarray:
    """Probabilities that rise from left to right, and are none left of a column."""
    rising = np.tile(np.linspace(0, 1, run.camera.width, dtype=np.float32), (run.camera.height, 1))
    rising[:, :column] = 0
    return rising


def test_probabilities_are_a_layer_where_the_run_has_them(run_folder):
    run = RunReader(run_folder)
    for index in (0, 3):
        write_probability(run_folder, index, ramp(run, 40))
    data = report_of(run_folder).data
    assert [n for n, layer in enumerate(data["probabilities"]) if layer] == [0, 3]
    layer = Image.open(io.BytesIO(base64.b64decode(data["probabilities"][3])))
    assert len(layer.getcolors()) <= 16
    shown = np.asarray(layer.convert("RGBA"))
    scale = layer.width / run.camera.width
    assert (shown[:, : int(38 * scale), 3] == 0).all()  # what is not the object's is left as it is
    assert (shown[:, int(42 * scale) :, 3] > 0).all()
    red, _, blue = shown[0, -1, :3]
    assert red > 200 > 100 > blue  # surely: yellow


def test_without_probabilities_there_is_nothing_of_them(run_folder):
    page = report_of(run_folder)
    assert page.data["probabilities"] == []
    assert not {"likely", "probability"} & {about.get("id") for _, about in page.tags}


def test_layers_get_smaller_until_they_fit(run_folder):
    run = RunReader(run_folder)
    rng = np.random.default_rng(0)
    shape = run.camera.height, run.camera.width
    for index in range(12):
        write_probability(run_folder, index, rng.random(shape, dtype=np.float32))
    free = probability_layers(run, range(12))
    bound = probability_layers(run, range(12), budget=sum(map(len, free)) // 4)
    assert sum(map(len, bound)) <= sum(map(len, free)) // 4
    small = Image.open(io.BytesIO(bound[0]))
    assert abs(small.width / small.height - run.camera.width / run.camera.height) < 0.05


def test_a_damaged_probability_is_one_that_is_not_there(run_folder):
    run = RunReader(run_folder)
    write_probability(run_folder, 0, ramp(run, 0))
    write_probability(run_folder, 1, ramp(run, 0))
    (run_folder / "probabilities" / "000001.png").write_bytes(b"no picture")
    layers = probability_layers(run, (0, 1))
    assert layers[0] is not None
    assert layers[1] is None


def test_options_in_a_doubt_are_not_broken_over_lines_and_nothing_in_it_is_markup(run_folder, described):
    described(run_folder, notes=["nobody gave the lens; give --fov or --intrinsics <b>now</b>"])
    page = report_of(run_folder)
    assert (
        '<span class="whole">--fov</span> or <span class="whole">--intrinsics</span> &lt;b&gt;' in page.source
    )


def test_a_large_texture_is_made_small_and_a_small_one_loses_nothing(run_folder, monkeypatch):
    small = run_report.model_data(run_report.read_model(run_folder))["texture"]
    assert small.startswith("data:image/png;base64,")
    monkeypatch.setattr(run_report, "_LARGE", 100)
    monkeypatch.setattr(run_report, "MOST_TEXTURE", 1500)
    large = run_report.model_data(run_report.read_model(run_folder))["texture"]
    assert large.startswith("data:image/webp;base64,")
    pictures = [Image.open(io.BytesIO(base64.b64decode(one.partition(",")[2]))) for one in (small, large)]
    assert pictures[0].size == pictures[1].size
    assert len(large) < len(small)
