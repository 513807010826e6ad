"""Compare what an earlier git revision writes with what this working tree writes: poses, masks, vertices.

python benchmarks/same_answers.py --revision b367a89 --only demo,fresh --frames 60

Both versions run in processes of their own, and only through the command line, by options that both have. Of the run
folders only what both write under the same name is compared, so modules, settings and JSON keys may be renamed between
the two. It exits with 1 if poses, masks or exported files differ.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from tracking3d_bench.benchmark.version_metadata import write_metadata

ROOT = Path(
    subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "rev-parse", "--show-toplevel"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    or Path(__file__).resolve().parents[3]
)

TOLERANCE = 1e-9
"""The largest difference of an entry of a pose that still counts as the same."""

FRESH_SEED, FRESH_COUNT = 611, 2
SEQUENCES = ("demo", "fresh", "box_in_hand", "temple_ring")
WAYS = ("csrt", "segment", "split", "corrected", "resumed", "exports")
"""Ways to run a clip: two trackers; with ``csrt`` in two parts, corrected, stopped and resumed, and exported."""
FORMATS = ("tum", "colmap")
LEAST_PART = 24  # frames that a part of a split run has to have
MASKS = ("initial_masks", "causal/masks", "masks")


@dataclass(frozen=True)
class Version:
    """One of the two versions that are compared."""

    tree: Path  # its checkout
    runs: Path  # folder of its run folders
    keep: bool  # whether a finished run in there is taken as it is

    def command(self, *arguments: str | Path) -> None:
        """Run ``tracking3d`` of this version.

        Raises:
            SystemExit: If it fails; with its error output.
        """
        words = self._words(*arguments)
        ended = subprocess.run(
            words, cwd=self.runs, env=self.environment(), capture_output=True, text=True, check=False
        )
        if ended.returncode:
            raise SystemExit(f"{' '.join(words)} failed in {self.tree}:\n{ended.stderr[-4000:]}")

    def stop(self, run: Path, frames: int, *arguments: str | Path) -> None:
        """Run ``tracking3d`` of this version, and stop it once the run folder has lines of that many frames.

        Raises:
            SystemExit: If it ends before.
        """
        words, lines = self._words(*arguments), run / "frames.jsonl"
        with subprocess.Popen(
            words, cwd=self.runs, env=self.environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as process:
            while not lines.exists() or lines.read_bytes().count(b"\n") < frames:
                if process.poll() is not None:
                    raise SystemExit(f"{' '.join(words)} ended before it could be stopped, in {self.tree}.")
                time.sleep(0.1)
            process.send_signal(signal.SIGTERM)

    def _words(self, *arguments: str | Path) -> list[str]:
        return [sys.executable, "-m", "tracking3d", *map(str, arguments)]

    def environment(self) -> dict[str, str]:
        """What its processes see: its own modules and entry points, and nothing that makes two of its runs differ."""
        return os.environ | {
            "PYTHONPATH": write_metadata(self.tree, self.runs / ".metadata"),
            "OPENBLAS_NUM_THREADS": "1",
            # The last digits of IPP's distance transform depend on where in memory an image lies.
            "OPENCV_IPP": "disabled",
        }

    def check(self) -> None:
        """Make sure that the modules of this tree are imported, not installed ones.

        Raises:
            SystemExit: If they are not.
        """
        self.runs.mkdir(parents=True, exist_ok=True)
        words = [sys.executable, "-c", "import tracking3d; print(tracking3d.__file__)"]
        ended = subprocess.run(
            words, cwd=self.runs, env=self.environment(), capture_output=True, text=True, check=True
        )
        if not Path(ended.stdout.strip()).is_relative_to(self.tree):
            raise SystemExit(f"{ended.stdout.strip()} is imported, not the package in {self.tree}.")


@dataclass(frozen=True)
class Sequence:
    """What both versions are run on."""

    name: str  # what the table calls it
    clip: Path | None = None  # folder with frames/ and init.json; None for the demo, which makes its own
    way: str = "csrt"  # one of `WAYS`

    def run(self, version: Version, frames: int | None) -> Path:
        """Track it with one version.

        Args:
            version: Which one.
            frames: How many frames; all if None. The demo always tracks all of its own.

        Returns:
            The run folder.
        """
        folder = version.runs / (
            self.name if self.clip is None or frames is None else f"{self.name}-{frames}"
        )
        finished = folder.with_name(folder.name + ".finished")
        if not (version.keep and finished.exists()):
            finished.unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            if self.clip is None:
                version.command("demo", "--out", folder, "--quiet")
            else:
                self._track(version, self.clip, folder, frames)
            finished.touch()
        return folder / "run" if self.clip is None else folder

    def _track(self, version: Version, clip: Path, folder: Path, frames: int | None) -> None:
        box = json.loads((clip / "init.json").read_text())["bbox_xywh"]
        shape = ",".join(map(str, box))
        count = len(list((clip / "frames").iterdir())) if frames is None else frames
        tracker = "segment" if self.way == "segment" else "csrt"
        run: list[str | Path] = [
            "run",
            clip / "frames",
            "--box",
            shape,
            "--out",
            folder,
            "--quiet",
            "--frames",
            f"0:{count}",
        ]
        run += ["--tracker", tracker, "--features", "rgb"]
        if self.way == "split":
            version.command(*run, "--split", f"{max(count // 2, LEAST_PART)}f", "--workers", "1")
        elif self.way == "resumed":
            version.stop(folder, count // 2, *run)
            version.command(*run, "--resume")
        else:
            version.command(*run)
        if self.way == "corrected":
            version.command("correct", folder, f"{count // 2}:{_box_of_mask(folder, count // 2)}", "--quiet")
        for name in FORMATS if self.way == "exports" else ():
            version.command("export", folder, "--to", name, "--out", folder / "exported" / name, "--quiet")


def _box_of_mask(run: Path, index: int) -> str:
    """The box of a frame's mask, as a user would draw it; it is a correction of nothing, but computed as one."""
    mask = cv2.imread(str(run / f"masks/{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
    if mask is None or not mask.any():
        raise SystemExit(f"{run} has no mask of frame {index}, which its correction would start from.")
    return ",".join(map(str, cv2.boundingRect(mask)))


@dataclass(frozen=True)
class Difference:
    """How far two runs of a sequence differ."""

    causal: float  # the largest difference of an entry of a causal pose; infinite if one run lacks the pose
    refined: float  # the same of refined poses
    frames: tuple[int, int]  # how many frames have a pose, and how many of those a refined one
    pixels: int  # how many pixels of masks differ, in all folders of masks
    masks: int  # how many masks were compared
    vertices: float  # the largest difference of a coordinate of a vertex; infinite if the numbers of vertices differ
    remarks: list[str] = field(
        default_factory=list
    )  # what is missing on one side, and exported files that differ

    @property
    def same(self) -> bool:
        """Whether poses, masks and exports are the same and there are some."""
        poses = max(self.causal, self.refined) <= TOLERANCE
        return poses and not self.pixels and not self.remarks and min(self.frames[0], self.masks) > 0


def compare(before: Path, after: Path) -> Difference:
    """How far two run folders differ."""
    remarks: list[str] = []
    poses = [(read_poses(before, refined), read_poses(after, refined)) for refined in (False, True)]
    causal, refined = (pose_difference(*pair) for pair in poses)
    pixels, masks = mask_difference(before, after, remarks)
    vertices = array_difference(read_vertices(before), read_vertices(after))
    remarks += [f"{name} differs" for name in exports_that_differ(before, after)]
    return Difference(causal, refined, (len(poses[0][0]), len(poses[1][0])), pixels, masks, vertices, remarks)


def read_poses(run: Path, refined: bool) -> dict[int, np.ndarray]:
    """The last pose of each frame among refined or causal ones; without an entry if there is no pose."""
    found: dict[int, np.ndarray] = {}
    for line in (run / "frames.jsonl").read_text().splitlines():
        row = json.loads(line)
        if bool(row.get("refined")) == refined and row["T_cam_obj"] is not None:
            found[row["index"]] = np.array(row["T_cam_obj"], dtype=float)
    return found


def pose_difference(before: dict[int, np.ndarray], after: dict[int, np.ndarray]) -> float:
    """The largest difference of an entry; infinite if frames differ."""
    if before.keys() != after.keys():
        return float("inf")
    return max((array_difference(pose, after[index]) for index, pose in before.items()), default=0.0)


def array_difference(before: np.ndarray, after: np.ndarray) -> float:
    """The largest difference of an entry; two that are not finite are equal, and shapes have to agree."""
    if before.shape != after.shape or not np.array_equal(np.isfinite(before), np.isfinite(after)):
        return float("inf")
    finite = np.isfinite(before)
    return float(np.abs(before - after)[finite].max(initial=0.0))


def mask_difference(before: Path, after: Path, remarks: list[str]) -> tuple[int, int]:
    """How many pixels of how many masks differ; missing masks are added to the remarks."""
    pixels = count = 0
    for folder in MASKS:
        names = [{file.name for file in (run / folder).glob("*.png")} for run in (before, after)]
        if lone := names[0] ^ names[1]:
            remarks.append(f"{len(lone)} of {folder}/ are on one side only")
        for name in sorted(names[0] & names[1]):
            one, other = (
                cv2.imread(str(run / folder / name), cv2.IMREAD_UNCHANGED) for run in (before, after)
            )
            if one is None or other is None:
                raise SystemExit(f"{folder}/{name} of {before} or {after} cannot be read.")
            pixels += int((one != other).sum()) if one.shape == other.shape else max(one.size, other.size)
            count += 1
    return pixels, count


def read_vertices(run: Path) -> np.ndarray:
    """The vertices of the mesh (V, 3); none if there is no mesh."""
    mesh = run / "mesh.obj"
    lines = mesh.read_text().splitlines() if mesh.exists() else []
    return np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)


def exports_that_differ(before: Path, after: Path) -> list[str]:
    """Names of exported files that one run lacks or that differ in more than the path of the run."""
    files = [
        {
            file.relative_to(run): file.read_bytes().replace(str(run).encode(), b"RUN")
            for file in (run / "exported").rglob("*")
            if file.is_file()
        }
        for run in (before, after)
    ]
    return [
        str(name) for name in sorted(files[0].keys() | files[1]) if files[0].get(name) != files[1].get(name)
    ]


@contextmanager
def checked_out(revision: str, folder: Path) -> Iterator[Path]:
    """A temporary worktree of a revision."""
    git("worktree", "add", "--detach", "--force", str(folder), revision)
    try:
        yield folder
    finally:
        git("worktree", "remove", "--force", str(folder))


def git(*words: str) -> str:
    """What git says.

    Raises:
        SystemExit: If it fails.
    """
    ended = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    if ended.returncode:
        raise SystemExit(f"git {' '.join(words)} failed: {ended.stderr.strip()}")
    return ended.stdout.strip()


def find_sequences(
    only: list[str], ways: list[str], data: Path, before: Version, clips: Path
) -> list[Sequence]:
    """The sequences to track; those of the suite ``fresh`` are rendered once, by the earlier version."""
    found: list[Sequence] = []

    def add(name: str, clip: Path) -> None:
        found.extend(Sequence(name if way == "csrt" else f"{name}-{way}", clip, way) for way in ways)

    for name in only:
        if name == "demo":
            found.append(Sequence("demo"))
        elif name == "fresh":
            suite = clips / f"fresh-{FRESH_SEED}"
            words = ["--suite", "fresh", "--seed", str(FRESH_SEED), "--count", str(FRESH_COUNT), "--quiet"]
            before.command("synth", *words, suite)
            for clip in sorted(suite.glob("*/init.json")):
                add(clip.parent.name, clip.parent)
        elif (data / name / "init.json").exists():
            add(name, data / name)
        else:
            print(f"{name}: left out, as {data} has no such clip.")
    return found


def show(name: str, found: Difference) -> None:
    """Print a row of the table."""
    print(
        f"{name:36} {found.frames[0]:5} {found.frames[1]:7} {found.causal:9.2g} {found.refined:9.2g}"
        f" {found.masks:6} {found.pixels:8} {found.vertices:9.2g}  {'; '.join(found.remarks)}",
        flush=True,
    )


def main() -> None:
    """Compare, print and exit."""
    given = arguments()
    with tempfile.TemporaryDirectory() as scratch:
        out = (given.out or Path(scratch)).resolve()
        revision = git("rev-parse", "--verify", f"{given.revision}^{{commit}}")
        with checked_out(revision, Path(scratch) / "tree") as tree:
            before = Version(tree.resolve(), out / revision[:12], keep=True)
            after = Version(ROOT, out / "working_tree", keep=False)
            before.check()
            after.check()
            sequences = find_sequences(given.only, given.ways, given.data.resolve(), before, out / "clips")
            print(
                f"{'':36}   frames       largest difference of   masks and pixels   largest of\n"
                f"{f'{revision[:12]} and the working tree':36}  all refined    causal   refined    all   differ"
                "  vertices",
                flush=True,
            )
            differ = False
            with ThreadPoolExecutor(given.jobs) as pool:
                for one in sequences:
                    runs = pool.map(one.run, (before, after), (given.frames, given.frames))
                    found = compare(*runs)
                    show(one.name, found)
                    differ |= not found.same
    sys.exit(int(differ or not sequences))


def options() -> argparse.ArgumentParser:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--revision", default="HEAD", help="the earlier git revision; HEAD if left out")
    parser.add_argument(
        "--only", default=",".join(SEQUENCES), help=f"of {', '.join(SEQUENCES)}; all if left out"
    )
    parser.add_argument("--ways", default=",".join(WAYS), help=f"of {', '.join(WAYS)}; all if left out")
    parser.add_argument("--frames", type=int, help="frames of each sequence; the demo has its own 36")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of real clips"
    )
    parser.add_argument(
        "--out", type=Path, help="keep clips and runs there; the revision's are not tracked again"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, choices=(1, 2), help="2: both versions at the same time"
    )
    return parser


def arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = options()
    given = parser.parse_args()
    for option, known in (("only", SEQUENCES), ("ways", WAYS)):
        names = [name.strip() for name in getattr(given, option).split(",")]
        if unknown := set(names) - set(known):
            parser.error(f"--{option} {','.join(sorted(unknown))}: there are {', '.join(known)}")
        setattr(given, option, names)
    return given


if __name__ == "__main__":
    main()
