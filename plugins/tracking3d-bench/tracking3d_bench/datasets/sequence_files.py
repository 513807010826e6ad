"""The data in the files of one sequence, found by a data set's description."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.geometry.camera import Camera
from tracking3d.trackers.region_files import read_regions
from tracking3d.trackers.vot_regions import EncodedMask, Region, Special, bounding_box
from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.bop import Annotation, read_scene_camera, read_scene_gt, read_symmetries
from tracking3d_bench.datasets.cameras import camera_from_matrix, read_dataset_intrinsics
from tracking3d_bench.datasets.clip import read_poses, symmetries_of
from tracking3d_bench.datasets.frame_matching import frame_numbers, match_frames
from tracking3d_bench.datasets.layout import DatasetLayout, MaskLayout, Regions
from tracking3d_bench.datasets.masks import IndexedMask, RegionMask
from tracking3d_bench.datasets.placeholders import Place
from tracking3d_bench.datasets.pose_files import read_matrices, read_matrix_lines
from tracking3d_bench.datasets.truth import DepthFile, MaskFile, MaskReference, MeshFile


@dataclass(frozen=True)
class SequenceFiles:
    """What the files of one sequence tell.

    Attributes:
        layout: Where they are.
        place: The sequence and the object.
        frames: The images in order.
    """

    layout: DatasetLayout
    place: Place
    frames: tuple[Path, ...]

    @cached_property
    def size(self) -> tuple[int, int]:
        """``(height, width)`` of the first frame."""
        height, width = read_image(self.frames[0]).shape[:2]
        return height, width

    @cached_property
    def scene(self) -> dict[int, Annotation]:
        """The object in scene_gt.json by frame index; empty without such a file."""
        told = self.layout.poses
        if told is None or told.form != "bop":
            return {}
        index = frame_numbers(self.frames)
        images = read_scene_gt(self.place.required(told.file, "poses"))
        return {
            index[number]: annotation
            for number, image in images.items()
            for annotation in image
            if number in index and str(annotation.object_id) == self.place.object
        }

    def matched(self, patterns: tuple[str, ...]) -> dict[int, Path]:
        """Files by frame index."""
        if not any("{frame" in pattern for pattern in patterns):
            return match_frames(self.place.files(patterns), self.frames, self.layout.match, self.layout.every)
        found = {
            n: self.place.of_frame(patterns, number, self.scene[n].instance if n in self.scene else None)
            for number, n in frame_numbers(self.frames).items()
        }
        return {n: file for n, file in sorted(found.items()) if file is not None}

    def masks(self, told: MaskLayout | None) -> dict[int, MaskReference]:
        """Masks in images by frame index."""
        files = self.matched(told.files) if told else {}
        return {n: self.mask(file, told) for n, file in files.items()} if told else {}

    def mask(self, file: Path, told: MaskLayout) -> MaskReference:
        """The mask that an image holds."""
        if told.values == "threshold":
            return MaskFile(file)
        if told.values == "nonzero":
            return IndexedMask(file, None)
        if told.values == "objects":
            return IndexedMask(file, None if self.place.object is None else self.place.object_number)
        return IndexedMask(file, told.values)

    def regions(self, told: Regions | None) -> tuple[dict[int, MaskReference], dict[int, Box]]:
        """Masks and boxes of a text file by frame index; out of sight is an empty mask."""
        if told is None:
            return {}, {}
        file = self.place.required(told.file, "regions")
        regions = self.by_index(file, told)
        if told.zero == "unknown":
            regions = {n: region for n, region in regions.items() if region != Special(0)}
        masked = told.score == "mask" or any(isinstance(region, EncodedMask) for region in regions.values())
        around = {} if masked else {n: bounding_box(region) for n, region in regions.items()}
        boxes = {n: box for n, box in around.items() if box is not None}
        return {n: RegionMask(region, self.size) for n, region in regions.items() if n not in boxes}, boxes

    def by_index(self, file: Path, told: Regions) -> dict[int, Region]:
        """Regions of a text file by frame index."""
        regions = read_regions(
            file,
            told.form,
            header_lines=told.header_lines,
            frame_column=told.frame_column,
            first_column=told.first_column,
            one_based=told.one_based,
        )
        if told.frame_column is not None:
            index = frame_numbers(self.frames)
            return {index[number]: region for number, region in regions.items() if number in index}
        if regions and max(regions) >= len(self.frames):
            raise InputError(
                f"{file} has {len(regions)} lines, but the sequence '{self.place.sequence}' has only "
                f"{len(self.frames)} frames; restore the missing frames."
            )
        return regions

    def poses(self) -> dict[int, NDArray[np.float64]]:
        """``T_cam_obj`` by frame index."""
        told = self.layout.poses
        if told is None:
            return {}
        if told.form == "bop":
            return {n: annotation.T_cam_obj for n, annotation in self.scene.items()}
        file = self.place.required(told.file, "poses")
        if told.form == "clip":
            return read_poses(file, {frame.stem: n for n, frame in enumerate(self.frames)})[0]
        if told.form == "matrices":
            return read_matrices(self.matched(told.file), inverse=told.inverse)
        poses = read_matrix_lines(file, inverse=told.inverse)
        return {n: T for n, T in poses.items() if n < len(self.frames)}

    def camera(self) -> Camera | None:
        """The camera; None if it is not the same in all frames."""
        told = self.layout.camera
        if told is None:
            return None
        size = self.size[::-1]
        if told.values is not None:
            fx, fy, cx, cy = told.values
            return camera_from_matrix(
                [fx, 0, cx, 0, fy, cy, 0, 0, 1], *size, f"the description {self.layout.name}"
            )
        assert told.file is not None  # the model sees to it
        file = self.place.required(told.file, "camera")
        if told.form != "bop":
            return read_dataset_intrinsics(file, told.form, size)
        index = frame_numbers(self.frames)
        cameras = {
            camera_from_matrix(K, *size, str(file))
            for n, (K, _) in read_scene_camera(file).items()
            if n in index
        }
        return cameras.pop() if len(cameras) == 1 else None

    def depth(self) -> dict[int, DepthFile]:
        """Depth images by frame index."""
        told, camera = self.layout.depth, self.layout.camera
        if told is None:
            return {}
        files = self.matched(told.files)
        scales: dict[int, float] = {}
        if told.scale is None and camera is not None and camera.form == "bop" and camera.file is not None:
            index = frame_numbers(self.frames)
            entries = read_scene_camera(self.place.required(camera.file, "camera"))
            scales = {index[number]: scale for number, (_, scale) in entries.items() if number in index}
        usual = told.scale or 1 / (self.layout.millimetres or 1000.0)
        return {n: DepthFile(file, scales.get(n, usual)) for n, file in files.items()}

    def mesh(self) -> MeshFile | None:
        """The true shape, if its file is there."""
        told = self.layout.mesh
        file = self.place.file(told.file) if told else None
        return MeshFile(file, told.scale) if told and file else None

    def symmetries(self) -> NDArray[np.float64]:
        """``(S, 4, 4)``, the identity first."""
        told = self.layout.symmetries
        if told is None or told.file is None:
            return symmetries_of(told.values if told else (), f"the description {self.layout.name}")
        file = self.place.required(told.file, "symmetries")
        return read_symmetries(file, self.place.object_number)
