"""The layout of a run folder.

::

    run.json            configuration as used, camera, versions, seed, counts, timings, state
    frames.jsonl        one line a frame, flushed; a better estimate for an earlier frame is a further line
    masks/              the estimates, 0/255 PNG at full resolution, named by frame index
    visible_masks/      the same without what is in front of the object, if the mask tracker can tell
    initial_masks/      what the mask tracker gave: 255 the object, 64 what is in front of it
    probabilities/      object probabilities of the estimated masks, if requested
    overlay.mp4         the video with outlines and axes
    contact_sheet.png   the run at a glance
    report.html         the run to look at, in one file
    turntable.mp4       the model, turned once around
    mesh.obj, mesh.mtl, texture.png, mesh.glb, features.npz
    landmarks.npz       surface and poses as points were followed by, once they were
    causal/             masks and mesh as they were before the final refinement
    online/             the mesh of the online map, if its shape was rebuilt
    .refining/          what the final refinement has made so far, until it has ended
    .state/             checkpoint of a stopped run; in a finished run, checkpoints for corrections
    prompts/            the given masks of the object, named by frame index
    .correcting/        a run folder: the corrected run, until it is finished
    export/             what was exported; export_before_correction/ once the run has been corrected
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from tracking3d.errors import InputError, OutputError, argument

FORMAT = "tracking3d-run"
FORMAT_VERSION = 2

RUN = "run.json"
FRAMES = "frames.jsonl"
MASKS = "masks"
VISIBLE_MASKS = "visible_masks"
INITIAL_MASKS = "initial_masks"
PROBABILITIES = "probabilities"
CAUSAL = "causal"
ONLINE = "online"
REFINING = ".refining"
STATE = ".state"
PROMPTS = "prompts"
CORRECTING = ".correcting"
PARTS = "parts"
"""The parts of a video that is tracked in parts, until they are merged."""
PICKED = "picked"
"""What was drawn before the run: masks in a folder of this name, and files with its name and a suffix."""
DRAWN = ".drawn.png"
"""A mask drawn in the viewer, saved until its correction has started."""
STATE_FILE = "state.json"
REFINEMENT_START = "refinement.json"
"""In `STATE`: the state as the final refinement began."""
JOURNAL = "journal.jsonl"
OVERLAY = "overlay.mp4"
CONTACT_SHEET = "contact_sheet.png"
REPORT = "report.html"
TURNTABLE = "turntable.mp4"
INDEX = "index.html"
"""Next to the folders of several objects: links to the report of each."""
OBJ = "mesh.obj"
MTL = "mesh.mtl"
TEXTURE = "texture.png"
GLB = "mesh.glb"
FEATURES = "features.npz"
LANDMARKS = "landmarks.npz"
EXPORT = "export"
EXPORT_BEFORE = "export_before_correction"
"""What was exported of a run before it was corrected."""

OUTPUTS = {
    "poses": (FRAMES,),
    "masks": (MASKS,),
    "mesh": (OBJ, GLB),
    "video": (OVERLAY,),
    "contact sheet": (CONTACT_SHEET,),
    "report": (REPORT,),
}
"""What a run is made for, and its files."""

ARBITRARY, METRE = "arbitrary", "metre"
"""Units of length of a run: its own, and that of a run whose object was measured."""

_RUN_FOLDER = argument("the folder that `record` wrote", "the --out folder of a `tracking3d run`")
OUT = argument("folder", "--out")
OVERWRITE = argument("overwrite=True", "--overwrite")
"""Names in messages of the arguments of `tracking3d.pipeline.record.record` and of ``tracking3d run``."""

CONVENTIONS = {
    "axes": "OpenCV camera axes: x right, y down, z forward.",
    "pixels": "Pixel (0, 0) is the centre of the top-left pixel; K belongs to the full frame.",
    "T_cam_obj": "Object to camera: x_cam = R x_obj + t, a row-major 4 x 4 matrix.",
    "scale": "The unit of length is arbitrary, and only ratios are meaningful, unless unit.name is metre.",
    "mesh": (
        "mesh.obj is in object coordinates; a node in mesh.glb rotates them by 180 degrees about x, so that "
        "y is up."
    ),
    "revisions": (
        "The last line for an index in frames.jsonl is the final estimate; the last line that is not "
        "refined is the causal estimate."
    ),
}

MESH_FILES = (OBJ, MTL, TEXTURE, GLB, FEATURES)
_OF_MESH = (*MESH_FILES, LANDMARKS)
_FILES = (RUN, FRAMES, OVERLAY, CONTACT_SHEET, REPORT, TURNTABLE, DRAWN, *_OF_MESH)
_MASK_NAME = re.compile(r"\d{6,}\.png")
_OF_STATE = re.compile(r"\d{8,}\.npz|milestone_\d{6,}\.json|refinement\.json")


def mask_path(folder: Path, index: int) -> Path:
    """Path of the estimated mask of frame ``index``: in the run folder, or in `CAUSAL` or `REFINING` within it."""
    return folder / MASKS / f"{index:06d}.png"


def initial_mask_path(folder: Path, index: int) -> Path:
    """Path of the mask tracker's mask of frame ``index``; in `REFINING`, of a photo's own."""
    return folder / INITIAL_MASKS / f"{index:06d}.png"


def visible_mask_path(folder: Path, index: int) -> Path:
    """Path of the mask of what is seen of the object in frame ``index``."""
    return folder / VISIBLE_MASKS / f"{index:06d}.png"


def refuse_root(folder: Path) -> None:
    """Refuse to write into the root of a file system.

    Raises:
        OutputError: If ``folder`` is one.
    """
    with suppress(OSError):  # it does not exist yet
        if folder.samefile(folder.absolute().anchor):
            raise OutputError(f"{folder} is the root of a file system; give a folder in it as {OUT}.")


def object_folders(folder: Path, count: int) -> list[Path]:
    """The run folders of ``count`` objects that are tracked through one video.

    Raises:
        OutputError: If ``folder`` is the run folder of one object, or holds more objects.
    """
    refuse_root(folder)
    if (folder / RUN).exists():
        raise OutputError(f"{folder} holds a run of one object; choose another {OUT} for several.")
    if (more := folder / f"object_{count}").exists():
        raise OutputError(
            f"{folder} holds a run of several objects, such as {more.name}; choose another {OUT}."
        )
    return [folder / f"object_{number}" for number in range(count)]


def runs_in(folder: Path) -> list[Path]:
    """The run folders of a video's objects, in their order; of a run of one object the folder itself."""
    if (folder / RUN).exists():
        return [folder]
    found = {
        int(path.name.removeprefix("object_")): path for path in folder.glob("object_*") if _is_object(path)
    }
    return [found[number] for number in sorted(found)] or [folder]


def check_run_folder(folder: Path) -> None:
    """Make sure that a folder is a run folder, before what reads it is imported.

    Raises:
        InputError: It holds no ``run.json``.
    """
    if not (folder / RUN).is_file():
        what = f"holds no {RUN}" if folder.is_dir() else "does not exist"
        raise InputError(f"{folder} is not a run folder: it {what}; give {_RUN_FOLDER}.")


def _is_object(folder: Path) -> bool:
    return is_object_name(folder.name) and (folder / RUN).is_file()


def is_object_name(name: str) -> bool:
    """Whether a folder's name is that of one of several objects."""
    return name.startswith("object_") and name.removeprefix("object_").isdecimal()


def partial_path(path: Path) -> Path:
    """Temporary path of a file, before it is renamed to ``path``."""
    return path.with_name(f".{path.name}.part")


def run_files(folder: Path) -> list[Path]:
    """The files in ``folder`` that bear the names a run writes, unfinished ones included."""
    named = [folder / name for name in _FILES]
    named += [folder / CAUSAL / name for name in _OF_MESH]
    named += [folder / ONLINE / name for name in MESH_FILES]
    named += [folder / REFINING / name for name in (OVERLAY, FRAMES)]
    for masks in (
        folder / MASKS,
        folder / VISIBLE_MASKS,
        folder / INITIAL_MASKS,
        folder / PROBABILITIES,
        folder / REFINING / PROBABILITIES,
        folder / PROMPTS,
        folder / CAUSAL / MASKS,
        folder / REFINING / MASKS,
        folder / REFINING / INITIAL_MASKS,
    ):
        if masks.is_dir():
            names = {path.name.removeprefix(".").removesuffix(".part") for path in masks.iterdir()}
            named += [masks / name for name in sorted(names) if _MASK_NAME.fullmatch(name)]
    return _add_unfinished(named) + state_files(folder) + correction_files(folder)


def run_folders(folder: Path) -> list[Path]:
    """The folders within a run folder, whether they are there or not; outer ones first."""
    masks = (MASKS, VISIBLE_MASKS, INITIAL_MASKS, PROBABILITIES, PROMPTS)
    inner = (CAUSAL, ONLINE, REFINING, STATE, CORRECTING, PARTS, *masks)
    aside = tuple((REFINING, name) for name in (MASKS, INITIAL_MASKS, PROBABILITIES))
    within = ((CAUSAL, MASKS), *aside, (STATE, MASKS))
    return [folder / name for name in inner] + [folder / outer / name for outer, name in within]


def correction_files(folder: Path) -> list[Path]:
    """Those of a correction that was not finished."""
    stage = folder / CORRECTING
    return run_files(stage) if stage.is_dir() else []


def probability_path(folder: Path, index: int) -> Path:
    """Path of the object's probability in frame ``index``: in the run folder, or in `REFINING` within it."""
    return folder / PROBABILITIES / f"{index:06d}.png"


def prompt_path(folder: Path, index: int) -> Path:
    """Path of the given mask of the object in frame ``index``."""
    return folder / PROMPTS / f"{index:06d}.png"


def has_state(folder: Path) -> bool:
    """Whether a run folder has the checkpoint of a stopped run."""
    return (folder / STATE / STATE_FILE).is_file()


def state_files(folder: Path) -> list[Path]:
    """The files in ``folder`` that hold the state of a run, unfinished ones included."""
    inner = folder / STATE
    named = [inner / STATE_FILE, inner / JOURNAL]
    if inner.is_dir():
        named += sorted(path for path in inner.iterdir() if _OF_STATE.fullmatch(path.name))
    if (inner / MASKS).is_dir():
        names = {path.name.removeprefix(".").removesuffix(".part") for path in (inner / MASKS).iterdir()}
        named += [inner / MASKS / name for name in sorted(names) if _MASK_NAME.fullmatch(name)]
    return _add_unfinished(named)


def _add_unfinished(files: list[Path]) -> list[Path]:
    both = [path for file in files for path in (file, partial_path(file))]
    return [path for path in both if path.is_file() or path.is_symlink()]
