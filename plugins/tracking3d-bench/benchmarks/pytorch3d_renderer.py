"""The same image by PyTorch3D (Ravi et al., 2020), for comparison if that package is installed.

Written against its documented interface. If the package is absent, as in this project's own tests, it cannot be
tried: the tests call it with a stand-in of that interface. Check the first figures of an installation with
``RenderScene.loss``, which has to agree with that of ``render`` to about a per cent.

Two things differ from `tracking3d.rendering`. At most `FACES_PER_PIXEL` faces are kept at a pixel, the nearest instead
of the first ones; and a face counts within a distance of ``boxlen`` instead of within its grown box. The number kept
has to be this large: with ten, faces that a pixel is only close to push out the one that covers it, in some 18 pixels
of a frame of the benchmark, which then look empty; with thirty that happens in none.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tracking3d.rendering import Rendering, SoftBand
from tracking3d.rendering.renderer import to_camera, to_screen
from tracking3d_bench.speed.dense import PrecomputedRendering

FACES_PER_PIXEL = 30
ABSENT = "it is not installed"


def why_no_pytorch3d(device: torch.device) -> str:
    """Why PyTorch3D cannot render on a device; `ABSENT` if it is not installed, empty if it can."""
    try:
        import pytorch3d  # noqa: F401

        corners = torch.tensor([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]], device=device)
        drawn = render_pytorch3d(
            vertices=corners.requires_grad_(),
            faces=torch.tensor([[0, 1, 2]], device=device),
            face_uvs=torch.zeros(1, 3, 2, device=device),
            texture=torch.zeros(1, 2, 2, device=device),
            R=torch.eye(3, device=device)[None],
            t=torch.tensor([[0.0, 0.0, 4.0]], device=device),
            K=torch.tensor([[[8.0, 0.0, 3.5], [0.0, 8.0, 3.5], [0.0, 0.0, 1.0]]], device=device),
            size=(8, 8),
        )
        drawn.silhouette.sum().backward()
    except ModuleNotFoundError as error:
        return ABSENT if error.name == "pytorch3d" else _in_words(error)
    except Exception as error:  # an installation that does not fit fails in many ways
        return _in_words(error)
    return ""


def to_pytorch3d(screen: Tensor, size: tuple[int, int]) -> Tensor:
    """PyTorch3D's normalized coordinates ``(..., 2)`` of pixels ``(..., 2)`` in a window ``(H, W)``.

    x points left and y up, zero is the window's centre and the shorter side goes from -1 to 1.
    """
    height, width = size
    return (screen.new_tensor([width - 1, height - 1]) - 2 * screen) / min(size)


def render_pytorch3d(
    vertices: Tensor,
    faces: Tensor,
    face_uvs: Tensor,
    texture: Tensor,
    R: Tensor,
    t: Tensor,
    K: Tensor,
    size: tuple[int, int],
    band: SoftBand | None = None,
) -> Rendering:
    """The same as `tracking3d.rendering.render` in square windows, rasterized by PyTorch3D."""
    from pytorch3d.ops import interpolate_face_attributes

    band = band or SoftBand()
    x_cam = to_camera(vertices, R, t)
    screen, depth = to_screen(x_cam, K), x_cam[..., 2]
    corners = torch.cat([to_pytorch3d(screen, size), depth[..., None]], 2)
    # Distances are squared ones, and so is the radius they are compared with.
    face, z, barycentric, distance = _rasterize(corners, faces, size, band.boxlen**2)

    # Faces come from near to far. The first one that contains the pixel is seen; before it may be some that it is
    # only close to.
    inside = (face >= 0) & (distance < 0)
    covered = inside.any(3)
    seen = inside.long().argmax(3, keepdim=True)
    seen_face = face.gather(3, seen)
    seen_barycentric = barycentric.gather(3, seen[..., None].expand(-1, -1, -1, -1, 3))
    uv = interpolate_face_attributes(seen_face, seen_barycentric, face_uvs.repeat(len(R), 1, 1))
    pixels = torch.nonzero(covered.reshape(-1))[:, 0]

    squared = torch.where((face >= 0) & ~covered[..., None], distance, torch.inf)
    rest = (1 - torch.exp(-band.sigma * squared)).prod(3)
    return PrecomputedRendering(
        face_index=torch.where(covered, seen_face[..., 0] % len(faces), -1),
        depth=torch.where(covered, z.detach().gather(3, seen)[..., 0], torch.inf),
        given_silhouette=torch.where(covered, 1.0, 1 - rest),
        pixels=pixels,
        given_uv=uv.reshape(-1, 2).index_select(0, pixels),
        texture=texture,
        x_cam=x_cam,
        screen=screen,
        faces=faces,
        face_uvs=face_uvs,
        K=K,
        backend="torch",
    )


def _in_words(error: Exception) -> str:
    first = next(iter(str(error).strip().splitlines()), "")
    return f"it is installed but cannot render here ({type(error).__name__}{first and ': '}{first})"


def _rasterize(
    corners: Tensor, faces: Tensor, size: tuple[int, int], blur_radius: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Faces, depths, barycentrics and signed squared distances ``(B, H, W, faces per pixel, ...)``.

    Args:
        corners: ``(B, V, 3)`` x and y as `to_pytorch3d` gives them, and z in camera coordinates.
        faces: ``(F, 3)``.
        size: ``(H, W)``.
        blur_radius: Squared distance within which a face counts.
    """
    from pytorch3d.renderer.mesh import rasterize_meshes
    from pytorch3d.structures import Meshes

    meshes = Meshes(corners, faces.expand(len(corners), -1, -1))
    result: tuple[Tensor, Tensor, Tensor, Tensor] = rasterize_meshes(
        meshes,
        image_size=size,
        blur_radius=blur_radius,
        faces_per_pixel=FACES_PER_PIXEL,
        perspective_correct=True,
        clip_barycentric_coords=blur_radius > 0,
        cull_backfaces=False,
    )
    return result
