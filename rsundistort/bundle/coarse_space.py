"""A coarse space for the reduced system: what clusters of neighbouring photos do together, smoothly."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from .._kernels import blocks
from ..model.array_types import Array, Index, Mask
from .envelope import Envelope
from .reduced import Reduced
from .structure import BlockPattern

__all__ = ["CoarseSpace"]

# Functions of a cluster: 1, x, y, x^2, xy, y^2 of the photos' places. Without the squares (bent strips, domes) late
# steps take ten times the iterations.
_FUNCTIONS = 6
# Share of its diagonal that keeps the coarse system positive where held unknowns leave a cluster fewer ways to move
# than functions.
_RIDGE = 1e-12


@dataclass(frozen=True)
class CoarseSpace:
    """Changes of the photos' unknowns that are quadratic in the photos' places, in each cluster of photos.

    What bundle adjustment hardly determines (that a cluster moves, rotates, grows, or bends with its neighbours) is
    smooth in the frame of the world, so rotations are taken there. The projection of the reduced system on these
    changes is a reduced system of clusters: q nb unknowns each, function by function.

    Attributes
    ----------
    cluster : (m,) int array
        Cluster of each photo.
    by_cluster, start : (m,), (clusters,) int array
        Photos in the order of their clusters, and where each begins.
    functions : (m, q) array
        The functions, orthonormal in each cluster.
    rotation : (m, 3, 3) array
        World to camera, for the first three unknowns.
    free : (m, nb) bool array
        Unknowns that are not held.
    entries : tuple of int arrays
        As `project_blocks` takes them: ranges of the pairs of clusters, block, left and right photo.
    envelope : Envelope
        Of the system of clusters.
    """

    cluster: Index
    by_cluster: Index
    start: Index
    functions: Array
    rotation: Array
    free: Mask
    entries: tuple[Index, Index, Index, Index]
    envelope: Envelope

    @classmethod
    def of(cls, pattern: BlockPattern, free: Mask, R_cw: Array, center_w: Array, max_photos: int) -> CoarseSpace:
        """Coarse space of clusters of at most `max_photos` photos at given poses, which may be rough."""
        nb = free.shape[1]
        cluster = _clusters(pattern.graph(), center_w, max_photos)
        by_cluster = np.argsort(cluster, kind="stable")
        num = int(cluster.max()) + 1
        start = np.searchsorted(cluster[by_cluster], np.arange(num))
        functions = np.zeros((len(free), _FUNCTIONS))
        for photos in np.split(by_cluster, start[1:]):
            values = _smooth_functions(center_w[photos])
            functions[photos, : values.shape[1]] = values
        # columns of held unknowns, and of the functions that a small cluster does not have
        moved = np.hstack([np.einsum("mba,mb->ma", R_cw**2, free[:, :3]), free[:, 3:]])
        size = np.add.reduceat((functions**2)[by_cluster, :, None] * moved[by_cluster, None], start)
        of_clusters, entries = _pairs_of_clusters(pattern, cluster)
        envelope = Envelope.smallest(of_clusters, size.reshape(num, _FUNCTIONS * nb) > _RIDGE)
        rotation = np.array(R_cw)  # which can be written, whosever it was: kernels are compiled for either kind
        return cls(cluster, by_cluster, start, functions, rotation, free, entries, envelope)

    def project(self, reduced: Reduced) -> Reduced:
        """The system of the clusters; the cameras' unknowns stay."""
        nb = self.free.shape[1]
        E = np.empty((len(self.envelope.pattern.cols), _FUNCTIONS * nb, _FUNCTIONS * nb))
        with numba.parallel_chunksize(1):
            blocks.project_blocks(self.rotation, self.free.astype(float), self.functions, *self.entries, reduced.S, E)
        diagonal = np.einsum("caa->ca", E[self.envelope.pattern.diagonal])
        E[self.envelope.pattern.diagonal] += _RIDGE * diagonal[:, :, None] * np.eye(_FUNCTIONS * nb)
        border = np.array([self.restrict(row) for row in reduced.border]).reshape(len(reduced.border), *diagonal.shape)
        return Reduced(E, self.restrict(reduced.b), border, reduced.corner, reduced.c)

    def restrict(self, x: Array) -> Array:
        """Z' x (clusters, q nb) of values of the photos (m, nb)."""
        rotated = np.where(self.free, x, 0.0)
        rotated[:, :3] = np.einsum("mba,mb->ma", self.rotation, rotated[:, :3])
        spread = self.functions[self.by_cluster, :, None] * rotated[self.by_cluster, None]
        return np.add.reduceat(spread, self.start).reshape(len(self.start), -1)

    def prolong(self, u: Array) -> Array:
        """Z u (m, nb) of values of the clusters (clusters, q nb)."""
        values = u.reshape(len(u), _FUNCTIONS, -1)[self.cluster]
        x = np.einsum("mk,mka->ma", self.functions, values)
        x[:, :3] = np.einsum("mab,mb->ma", self.rotation, x[:, :3])
        return np.where(self.free, x, 0.0)


def _clusters(graph: scipy.sparse.csr_array, center_w: Array, max_photos: int) -> Index:
    """Cluster of each photo: bisected across the longest side, and where no common points connect the photos."""
    cluster = np.empty(len(center_w), np.int64)
    waiting = [np.arange(len(center_w))]
    num = 0
    while waiting:
        photos = waiting.pop()
        parts, part = connected_components(graph[photos][:, photos], directed=False)
        if parts > 1:
            waiting += [photos[part == k] for k in range(parts)]
        elif len(photos) > max_photos:
            axis = np.argmax(np.ptp(center_w[photos], axis=0))
            halves = np.argsort(center_w[photos, axis], kind="stable")
            waiting += [photos[half] for half in np.array_split(halves, 2)]
        else:
            cluster[photos] = num
            num += 1
    return cluster


def _pairs_of_clusters(pattern: BlockPattern, cluster: Index) -> tuple[BlockPattern, tuple[Index, Index, Index, Index]]:
    """Clusters that share points, and what of the photos' blocks belongs to each pair of them."""
    rows, cols = pattern.rows, pattern.cols
    off = np.flatnonzero(rows != cols)
    block = np.concatenate([np.arange(len(rows)), off])
    left, right = np.concatenate([rows, cols[off]]), np.concatenate([cols, rows[off]])
    upper = cluster[left] <= cluster[right]
    block, left, right = block[upper], left[upper], right[upper]
    order = np.lexsort((right, left, cluster[right], cluster[left]))
    block, left, right = block[order], left[order], right[order]
    num = int(cluster.max()) + 1
    pair = cluster[left] * num + cluster[right]
    start = np.flatnonzero(np.diff(pair, prepend=-1))
    row_start = np.searchsorted(pair[start] // num, np.arange(num + 1))
    return BlockPattern(row_start, pair[start] % num), (np.append(start, len(pair)), block, left, right)


def _smooth_functions(center_w: Array) -> Array:
    """Polynomials (k, q) of the places of k photos along the two longest axes of their cluster, orthonormal; q <= 6."""
    offset = center_w - center_w.mean(0)
    axes = np.linalg.svd(offset, full_matrices=False)[2]
    x, y = (offset @ axes.T / max(np.abs(offset).max(), 1e-300))[:, :2].T if len(offset) > 1 else np.zeros((2, 1))
    powers = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    U, size, _ = np.linalg.svd(powers, full_matrices=False)
    return U[:, size > 1e-6 * size[0]]
