"""A mesh with a tree's shading: load, look at, shade.

A tree is looked up by the normal as the viewer sees it. Far away that is the normal in camera space; near by, the ray to a point
does not run along the camera's axis, and a camera-space normal at the silhouette would not lie on the rim of the sphere. So each
normal is turned by the smallest rotation that takes the ray's own direction to the axis: a silhouette is then looked up at the
silhouette, in perspective too.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from unshade.apply import shade
from unshade.errors import MissingExtraError, PictureError
from unshade.nodes import Tree
from unshade.rasterize import Array, Fragments, rasterize
from unshade.relight import turn_of
from unshade.types import Image, Mask, Normals

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
MOST_FACES = 5_000_000
CREASE = math.cos(math.radians(40.0))
"""Where normals are computed, faces that meet at a sharper edge keep it."""

MARGIN = 1.06
"""The mesh's bounding sphere fills the picture but for this."""


@dataclass(frozen=True)
class Mesh:
    """``corners`` (F, 3, 3) positions and ``normals`` (F, 3, 3) unit vectors of F triangles; +y up. ``computed`` says that the file
    had no normals for some of it."""

    corners: Array
    normals: Array
    computed: bool

    @property
    def faces(self) -> int:
        """Number of triangles."""
        return len(self.corners)


def read_mesh(path: str | Path) -> Mesh:
    """Read the triangles of a file, all its parts in their places.

    Raises:
        PictureError: no mesh, or one that cannot be used. MissingExtraError: without the library that reads them.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise PictureError(f"{path}: expected a mesh ({', '.join(SUFFIXES)}), got {path.suffix or 'no suffix'!r}")
    if not path.is_file():
        raise PictureError(f"{path}: no such file")
    try:
        import trimesh
    except ImportError:
        raise MissingExtraError(f"{path}: meshes need the trimesh library; install it with: pip install 'unshade[mesh]'") from None
    try:
        scene = trimesh.load_scene(path, process=False, maintain_order=True, skip_materials=True)
        parts = [_part(scene, node) for node in scene.graph.nodes_geometry]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OSError, struct.error, NotImplementedError) as error:
        # What trimesh raises for damaged files; the last for a format that it has no reader of.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PictureError(f"{path}: damaged, or no mesh that can be read ({reason})") from None
    found = [part for part in parts if part is not None and part.faces]
    if not found:
        raise PictureError(f"{path}: expected a mesh with triangles, got none")
    corners = np.concatenate([part.corners for part in found])
    if len(corners) > MOST_FACES:
        raise PictureError(f"{path}: expected at most {MOST_FACES:,} triangles, got {len(corners):,}; simplify it first")
    return Mesh(corners, np.concatenate([part.normals for part in found]), any(part.computed for part in found))


def _part(scene: Any, node: str) -> Mesh | None:
    """One part of a scene in its place; None for points and lines."""
    matrix, name = scene.graph[node]
    geometry = scene.geometry[name]
    faces = getattr(geometry, "faces", None)
    if faces is None:
        return None
    matrix = np.asarray(matrix, dtype=np.float64)
    vertices = np.asarray(geometry.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(faces, dtype=np.int64)
    corners = vertices[faces]
    if not np.isfinite(corners).all():
        raise ValueError("expected finite positions, got NaN or infinity")
    # What the file says; asked for `vertex_normals`, trimesh would compute them without a word.
    given = geometry._cache["vertex_normals"]
    if given is None or len(given) != len(vertices) or not np.isfinite(given).all():
        return Mesh(corners, compute_normals(corners), True)
    turned = np.asarray(given, dtype=np.float64) @ np.linalg.inv(matrix[:3, :3])
    return Mesh(corners, _unit(turned[faces], _face_normals(corners)[:, None]), False)


def _face_normals(corners: Array) -> Array:
    found: Array = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return found


def _unit(vectors: Array, otherwise: Array | float = 0.0) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors = np.where(length > 1e-12, vectors, otherwise)
    found: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return found


def compute_normals(corners: Array) -> Array:
    """Normals (F, 3, 3) of triangles: at each corner the mean of the faces around it, by area, but across sharp edges (`CREASE`)."""
    scale = max(float(np.ptp(corners.reshape(-1, 3), axis=0).max(initial=0.0)), 1e-12)
    _, vertex = np.unique(np.round(corners.reshape(-1, 3) / scale * 1e6).astype(np.int64), axis=0, return_inverse=True)
    vertex = vertex.reshape(-1)
    areas = _face_normals(corners)
    units = _unit(areas)
    face = np.arange(len(corners)).repeat(3)
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex)
    starts = np.cumsum(counts) - counts
    total = np.zeros((len(vertex), 3))
    # Every corner meets each corner of its vertex once: the k-th one in round k.
    for k in range(int(counts.max(initial=0))):
        have = np.flatnonzero(counts[vertex] > k)
        other = face[order[starts[vertex[have]] + k]]
        near = (units[face[have]] * units[other]).sum(-1) > CREASE
        total[have[near]] += areas[other[near]]
    return _unit(total.reshape(-1, 3, 3), areas[:, None])


@dataclass(frozen=True)
class View:
    """How a mesh is looked at: turned by degrees (right, up, roll) as a ball is dragged, with a vertical angle of view in degrees,
    0 for orthographic."""

    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float = 30.0


def look(mesh: Mesh, size: int, view: View, finer: int = 2) -> tuple[Normals, Mask]:
    """What a tree is looked up at, (3, S, S) float32, and what is covered, (1, S, S) in {0, 1}, with S = ``size * finer``.

    The mesh is put into the middle and fills the square.
    """
    side = size * finer
    rotation = turn_of(*view.turn)
    corners = mesh.corners @ rotation.T
    flat = corners.reshape(-1, 3)
    middle = (flat.min(axis=0) + flat.max(axis=0)) / 2.0
    radius = max(float(np.linalg.norm(flat - middle, axis=-1).max()), 1e-12) * MARGIN
    centred = (corners - middle) / radius
    if view.angle > 0.0:
        half = math.radians(view.angle) / 2.0
        away = 1.0 / math.sin(half)
        distance = away - centred[..., 2]
        scale = 1.0 / (math.tan(half) * distance)
        depth = 1.0 / distance
        rays = np.stack([-centred[..., 0], -centred[..., 1], distance], axis=-1)
    else:
        scale, depth = np.ones(centred.shape[:2]), centred[..., 2]
        rays = np.broadcast_to(np.array([0.0, 0.0, 1.0]), centred.shape)
    placed = np.stack([(centred[..., 0] * scale + 1.0) * side / 2.0, (1.0 - centred[..., 1] * scale) * side / 2.0, depth], axis=-1)
    seen = rasterize(placed, side, side)
    normals = np.zeros((side * side, 3))
    normals[:] = (0.0, 0.0, 1.0)
    faces = _unit(_face_normals(centred))
    normals[seen.pixel] = _seen_normals(seen, faces, mesh.normals @ rotation.T, rays, depth if view.angle > 0.0 else None)
    covered = np.zeros(side * side)
    covered[seen.pixel] = 1.0
    found = torch.from_numpy(np.ascontiguousarray(normals.reshape(side, side, 3).transpose(2, 0, 1))).float()
    return found, torch.from_numpy(covered.reshape(1, side, side)).float()


def _seen_normals(seen: Fragments, faces: Array, normals: Array, rays: Array, depth: Array | None) -> Array:
    """Normals of the fragments, (N, 3), as the viewer sees them."""
    shares = seen.shares
    if depth is not None:
        shares = shares * depth[seen.triangle]
        shares = shares / shares.sum(axis=-1, keepdims=True)
    normal = _unit((shares[..., None] * normals[seen.triangle]).sum(axis=1), np.array([0.0, 0.0, 1.0]))
    ray = _unit((shares[..., None] * rays[seen.triangle]).sum(axis=1))
    face = faces[seen.triangle]
    # The back of an open surface is shaded as a front, whichever way its corners run.
    face = face * np.where((face * ray).sum(-1) < 0.0, -1.0, 1.0)[:, None]
    normal = normal * np.where((face * normal).sum(-1) < 0.0, -1.0, 1.0)[:, None]
    turned = turn_to_axis(normal, ray)
    # What only the interpolation turned away from the viewer goes to the silhouette.
    turned[:, 2] = np.maximum(turned[:, 2], 0.0)
    return _unit(turned, np.array([0.0, 0.0, 1.0]))


def turn_to_axis(vectors: Array, rays: Array) -> Array:
    """(N, 3) vectors turned by the smallest rotation that takes unit ``rays`` (towards the viewer) to +z."""
    x, y, z = rays.T
    # Rodrigues about (y, -x, 0), for rays in front: R v = v + k x v + k x (k x v) / (1 + z), k = ray x z.
    axis = np.stack([y, -x, np.zeros_like(x)], axis=-1)
    once = np.cross(axis, vectors)
    found: Array = vectors + once + np.cross(axis, once) / (1.0 + z)[:, None]
    return found


def render_mesh(tree: Tree, mesh: Mesh, size: int, view: View, finer: int = 3) -> tuple[Image, Mask]:
    """A picture of a mesh shaded by a tree, (3, S, S), and its opacity, (1, S, S), averaged from ``finer`` times as many pixels a side."""
    normals, covered = look(mesh, size, view, finer)
    shaded = shade(tree, normals) * covered
    alpha = torch.nn.functional.avg_pool2d(covered[None], finer)[0]
    mean = torch.nn.functional.avg_pool2d(shaded[None], finer)[0]
    return torch.where(alpha > 0.0, mean / alpha.clamp(min=1e-6), mean).clamp(0.0, 1.0), alpha
