"""A tree on photos and meshes: detail kept, silhouettes in perspective, files with and without normals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import photo_scenes as scenes
from unshade.apply import apply_to_photo, shade
from unshade.assignment import read_color
from unshade.errors import PictureError, TreeError
from unshade.mesh import Mesh, View, compute_normals, look, read_mesh, render_mesh
from unshade.metrics import psnr
from unshade.rasterize import rasterize
from unshade.recolor import recolor
from unshade.serde import parse
from unshade.sphere import normals_from_xy, sphere_grid

SIZE = 160


@pytest.mark.parametrize("detail", ["ratio", "residual"])
@pytest.mark.parametrize("fault", ["clean", "stripes and shadow", "noise"])
def test_same_tree_gives_the_photo_back(detail: str, fault: str) -> None:
    normals, mask = scenes.knot(SIZE)
    tree = scenes.tree_of("wax")
    photo = scenes.photo(tree, normals, mask, fault)
    result = apply_to_photo(tree, tree, photo, normals, mask, detail)  # type: ignore[arg-type]
    assert float((result - photo).abs().max()) < 1e-6


def test_an_edit_of_the_sphere_is_an_edit_of_the_photo() -> None:
    """Against the photo of the edited tree: texture lies under the lights, so a ratio beats a residual."""
    normals, mask = scenes.knot(SIZE)
    tree = scenes.tree_of("lacquer")
    edited = recolor(tree, read_color("#3060b0"))
    photo, truth = (scenes.photo(each, normals, mask, "patch") for each in (tree, edited))
    ratio, residual = (
        psnr(apply_to_photo(edited, tree, photo, normals, mask, detail), truth, mask > 0.5)  # type: ignore[arg-type]
        for detail in ("ratio", "residual")
    )
    assert ratio > 40.0 and ratio > residual + 8.0 and psnr(photo, truth, mask > 0.5) < 25.0
    outside = apply_to_photo(edited, tree, photo, normals, mask)[:, mask[0] == 0.0]
    assert torch.equal(outside, photo[:, mask[0] == 0.0])


def test_a_glint_stays_white() -> None:
    tree = parse("multiply(albedo(#a02010), diffuse(front))")
    blue = recolor(tree, read_color("#1020a0"))
    normals = torch.zeros(3, 8, 8, dtype=torch.float64)
    normals[2] = 1.0
    photo = shade(tree, normals)
    photo[:, 3:5, 3:5] = 1.0 - (1.0 - photo[:, 3:5, 3:5]) * 0.2
    result = apply_to_photo(blue, tree, photo, normals, torch.ones(1, 8, 8))
    assert result[:, 4, 4].min() > 0.75 and result[2, 0, 0] > 3 * result[0, 0, 0]


def test_what_does_not_fit_together() -> None:
    normals, mask = scenes.knot(SIZE)
    tree = scenes.tree_of("wax")
    photo = scenes.photo(tree, normals, mask, "clean")
    with pytest.raises(PictureError, match=r"of one size, got 160 x 160, 160 x 100, 160 x 160"):
        apply_to_photo(tree, tree, photo, normals[:, :100], mask)
    with pytest.raises(TreeError, match="did you mean 'ratio'"):
        apply_to_photo(tree, tree, photo, normals, mask, "ratios")  # type: ignore[arg-type]


def sphere_mesh(at: tuple[float, float, float] = (0.0, 0.0, 0.0), count: int = 64) -> Mesh:
    up, around = np.meshgrid(np.linspace(0, np.pi, count + 1), np.linspace(0, 2 * np.pi, 2 * count + 1), indexing="ij")
    points = np.stack([np.sin(up) * np.sin(around), np.cos(up), np.sin(up) * np.cos(around)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    normals = np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
    return Mesh(normals + np.array(at), normals, False)


def test_orthographic_ball_is_the_sphere() -> None:
    normals, covered = look(sphere_mesh(), 200, View(angle=0.0), finer=1)
    grid = sphere_grid(200) * 1.06
    truth = normals_from_xy(grid)
    inside = grid.square().sum(0) < 0.98
    assert covered[0][inside].min() == 1.0 and covered[0][grid.square().sum(0) > 1.0].max() == 0.0
    assert float((normals * truth).sum(0)[inside].min()) > math.cos(math.radians(1.5))


@pytest.mark.parametrize("angle", [0.0, 40.0, 100.0])
def test_silhouettes_are_looked_up_at_the_silhouette(angle: float) -> None:
    """Also of balls away from the axis: there a normal in camera space is up to half the angle of view off."""
    balls = [sphere_mesh((x, 0.0, z)) for x, z in ((-2.2, 0.0), (0.0, 1.0), (2.2, -0.5))]
    mesh = Mesh(np.concatenate([ball.corners for ball in balls]), np.concatenate([ball.normals for ball in balls]), False)
    normals, covered = look(mesh, 300, View(angle=angle), finer=1)
    solid = covered[0].bool()
    inner = solid.clone()
    inner[1:-1, 1:-1] = solid[1:-1, 1:-1] & solid[:-2, 1:-1] & solid[2:, 1:-1] & solid[1:-1, :-2] & solid[1:-1, 2:]
    edge = solid & ~inner
    assert int(edge.sum()) > 200
    # A pixel inside the edge of a ball of 40 pixels' radius has a z of about sqrt(2 / 40).
    assert float(normals[2][edge].median()) < 0.22 and float(normals[2][edge].quantile(0.95)) < 0.35
    assert float(normals[2].min()) >= 0.0 and float((normals.norm(dim=0) - 1).abs().max()) < 1e-5
    # The middle of each ball faces the viewer.
    assert float(normals[2][inner].max()) > 0.999


def test_the_nearest_triangle_wins() -> None:
    near = [[0.0, 0.0, 2.0], [10.0, 0.0, 2.0], [0.0, 10.0, 2.0]]
    far = [[0.0, 0.0, 1.0], [10.0, 10.0, 1.0], [10.0, 0.0, 1.0]]
    for order in ((near, far), (far, near)):
        seen = rasterize(np.array(order), 10, 10)
        owner = dict(zip(seen.pixel.tolist(), seen.triangle.tolist(), strict=True))
        assert owner[11] == order.index(near) and owner[79] == order.index(far)
        assert len(owner) == 55 + 55 - 30 and np.allclose(seen.shares.sum(-1), 1.0)
    beyond = np.array([[[-50.0, -50.0, 1.0], [70.0, -50.0, 1.0], [0.0, 90.0, 1.0]]])
    assert len(rasterize(beyond, 10, 10).pixel) == 100


def test_computed_normals() -> None:
    ball = sphere_mesh()
    solid = np.linalg.norm(np.cross(ball.corners[:, 1] - ball.corners[:, 0], ball.corners[:, 2] - ball.corners[:, 0]), axis=-1) > 1e-9
    assert float((compute_normals(ball.corners) * ball.normals).sum(-1)[solid].min()) > 0.999
    corner = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 0, 1], [1, 0, 0]]], dtype=float)
    assert np.allclose(compute_normals(corner)[0], [0, 0, 1]) and np.allclose(compute_normals(corner)[1], [0, 1, 0])


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
@pytest.mark.parametrize("with_normals", [True, False])
def test_mesh_files(tmp_path: Path, suffix: str, with_normals: bool) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = sphere_mesh(count=24)
    points, place = np.unique(ball.corners.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    given = {"vertex_normals": points} if with_normals else {}
    mesh = trimesh.Trimesh(points + [5.0, 0.0, 0.0], place.reshape(-1, 3), process=False, **given)
    mesh.export(tmp_path / f"ball.{suffix}", **({} if suffix == "ply" else {"include_normals": with_normals}))
    found = read_mesh(tmp_path / f"ball.{suffix}")
    assert found.computed is not with_normals
    solid = np.linalg.norm(np.cross(found.corners[:, 1] - found.corners[:, 0], found.corners[:, 2] - found.corners[:, 0]), axis=-1) > 1e-9
    assert float((found.normals * (found.corners - [5.0, 0.0, 0.0])).sum(-1)[solid].min()) > 0.97
    image, alpha = render_mesh(scenes.tree_of("clay"), found, 32, View())
    assert image.shape == (3, 32, 32) and 0.6 < float(alpha.mean()) < 0.8


def test_parts_of_a_scene_are_in_their_places(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    turned = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    turned[:3, 3] = 3.0, 0.0, 0.0
    box = trimesh.creation.box((1.0, 1.0, 0.1))
    scene.add_geometry(box, node_name="a")
    scene.add_geometry(box, node_name="b", transform=turned)
    scene.export(tmp_path / "two.glb")
    found = read_mesh(tmp_path / "two.glb")
    assert found.faces == 24 and found.corners.reshape(-1, 3).max(0) == pytest.approx([3.05, 0.5, 0.5])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.glb", b"junk", "damaged, or no mesh that can be read"),
        ("a.obj", b"v 0 0 0\n", "expected a mesh with triangles, got none"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected finite positions"),
        ("a.png", b"", "expected a mesh (.glb"),
    ],
)
def test_bad_meshes(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PictureError) as caught:
        read_mesh(tmp_path / name)
    assert message in str(caught.value)
    with pytest.raises(PictureError, match="no such file"):
        read_mesh(tmp_path / "none.glb")
