"""One USDZ with the object moving in front of the camera.

Axes: y up, the camera at the origin looks along -z. Prims: ``/tracking3d/object`` with the mesh below it in object
coordinates, and ``/tracking3d/camera``. Time codes are frame indices. In frames without a pose the object is invisible.
Lengths are in metres, or in the run's unit taken for one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.errors import OutputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.export.axes import HALF_TURN, continuous, quaternion
from tracking3d.export.exported_run import ExportedRun
from tracking3d.geometry.camera import Camera
from tracking3d.results.mesh_export import PALE, UNSEEN, find_seen_faces, unit_note

_APERTURE = 36.0
"""Millimetres of the film's width; only its ratio to the focal length means anything."""


def write_usdz(run: ExportedRun, path: Path) -> None:
    """Write the scene.

    Raises:
        OutputError: If USD cannot put the package together.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdUtils

    parts = path.parent / "parts"
    parts.mkdir()
    Pillow.fromarray(run.model.texture).save(parts / "texture.png")
    stage = Usd.Stage.CreateNew(str(parts / "scene.usdc"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    note = unit_note(run.unit)
    stage.SetMetadata("customLayerData", {f"tracking3d:{key}": text for key, text in note.items()})
    stage.SetMetadata("comment", note.get("note", "Lengths are in metres."))
    stage.SetTimeCodesPerSecond(run.fps)
    stage.SetFramesPerSecond(run.fps)
    stage.SetStartTimeCode(run.span[0])
    stage.SetEndTimeCode(run.span[-1])
    root = UsdGeom.Xform.Define(stage, "/tracking3d")
    stage.SetDefaultPrim(root.GetPrim())
    moving = UsdGeom.Xform.Define(stage, "/tracking3d/object")
    _move(moving, run)
    _add_mesh(stage, run.model)
    _add_camera(UsdGeom.Camera.Define(stage, "/tracking3d/camera"), run.camera)
    stage.GetRootLayer().Save()
    if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(parts / "scene.usdc")), str(path)):
        raise OutputError(f"USD could not package {path.name}; run again with --debug to see why.")


def _move(moving: Any, run: ExportedRun) -> None:
    from pxr import Gf, UsdGeom

    T_view_obj = [HALF_TURN @ one.T_through(run.camera) for one in run.poses]
    translate = moving.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = moving.AddOrientOp(UsdGeom.XformOp.PrecisionFloat)
    turns = continuous(np.array([quaternion(T) for T in T_view_obj]))
    for one, T, (w, x, y, z) in zip(run.poses, T_view_obj, turns, strict=True):
        translate.Set(Gf.Vec3d(*T[:3, 3].tolist()), one.index)
        orient.Set(Gf.Quatf(float(w), float(x), float(y), float(z)), one.index)
    if run.without_pose:
        hidden = set(run.without_pose)
        visibility = moving.CreateVisibilityAttr()
        for index in run.span:
            visibility.Set(UsdGeom.Tokens.invisible if index in hidden else UsdGeom.Tokens.inherited, index)


def _add_mesh(stage: Any, model: ObjectModel) -> None:
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    mesh = UsdGeom.Mesh.Define(stage, "/tracking3d/object/mesh")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(model.vertices.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(model.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(model.faces.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    bounds = np.stack([model.vertices.min(0), model.vertices.max(0)]).astype(np.float32)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds))
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    # The origin of USD's texture coordinates is the lower left.
    uv = model.face_uvs.reshape(-1, 2) * (1, -1) + (0, 1)
    st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))

    material = UsdShade.Material.Define(stage, "/tracking3d/material")
    surface = UsdShade.Shader.Define(stage, "/tracking3d/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    reader = UsdShade.Shader.Define(stage, "/tracking3d/material/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    texture = UsdShade.Shader.Define(stage, "/tracking3d/material/texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./texture.png")
    texture.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("repeat")
    texture.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("clamp")
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    )
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    )
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    _mark_unseen(stage, mesh, np.flatnonzero(~find_seen_faces(model)))


def _mark_unseen(stage: Any, mesh: Any, faces: NDArray[np.intp]) -> None:
    """Bind the faces that no frame has shown to a pale material."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    if not len(faces):
        return
    material = UsdShade.Material.Define(stage, f"/tracking3d/{UNSEEN}")
    surface = UsdShade.Shader.Define(stage, f"/tracking3d/{UNSEEN}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*PALE))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    indices = Vt.IntArray.FromNumpy(faces.astype(np.int32))
    subset = binding.CreateMaterialBindSubset(UNSEEN, indices, UsdGeom.Tokens.face)
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)


def _add_camera(prim: Any, camera: Camera) -> None:
    from pxr import Gf

    focal = camera.fx * _APERTURE / camera.width
    middle_x, middle_y = (camera.width - 1) / 2, (camera.height - 1) / 2
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_APERTURE)
    prim.CreateVerticalApertureAttr(focal * camera.height / camera.fy)
    prim.CreateHorizontalApertureOffsetAttr(focal * (middle_x - camera.cx) / camera.fx)
    prim.CreateVerticalApertureOffsetAttr(focal * (camera.cy - middle_y) / camera.fy)
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.001, 10000.0))
