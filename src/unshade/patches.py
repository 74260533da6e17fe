"""Patches of a photo: pixels that hang together without a jump of colour that the normals do not explain.

Inside a patch the paint is the same, so a patch can be judged as a whole: it is seen from many directions, where a pixel is
seen from one.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from unshade.reflectance import Array

Labels: TypeAlias = NDArray[np.int64]

JUMP = 0.06
"""Least jump that a change of paint makes between two neighbours, in the logarithm of the channel that jumps most."""

NOISE = 0.01
"""Deviation of a channel that the camera or the file may cause, of [0, 1]."""


def patches(logarithms: Array, shaded: Array, valid: NDArray[np.bool_]) -> Labels:
    """Number the patches.

    Args:
        logarithms: (H, W, 3) of the photo. shaded: (H, W, 3) of what the normals explain of it.
        valid: (H, W) the object.
    Returns:
        (H, W): the same number for pixels of one patch, from 0 up without gaps; -1 where ``valid`` is false.
    """
    height, width = valid.shape
    place = np.arange(height * width).reshape(height, width)
    rest, doubt = logarithms - shaded, JUMP + NOISE * np.exp(-logarithms)
    links = []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        same = (np.abs(rest[first] - rest[second]) < np.maximum(doubt[first], doubt[second])).all(axis=-1)
        joined = valid[first] & valid[second] & same
        links.append(np.stack([place[first][joined], place[second][joined]]))
    root = _components(height * width, np.concatenate(links, axis=1))
    found = np.full((height, width), -1, dtype=np.int64)
    found[valid] = np.unique(root.reshape(height, width)[valid], return_inverse=True)[1]
    return found


def _components(count: int, links: NDArray[np.int64]) -> Labels:
    """The smallest member of each node's component, by hooking roots and jumping pointers (Shiloach and Vishkin 1982)."""
    root = np.arange(count)
    while links.shape[1]:
        one, other = root[links[0]], root[links[1]]
        apart = one != other
        links, one, other = links[:, apart], one[apart], other[apart]
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while (root[root] != root).any():
            root = root[root]
    return root
