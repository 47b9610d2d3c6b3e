"""How well patches of one image look like what other images show where the patches would be.

A patch is a handful of pixels on a plane, put at one depth after the other. Its score there is the correlation of its
grey values with those of the two images that suit it best: neither exposure nor what hides it from others matters.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import prange
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.images import enlarged, resized
from presight_core.semi_global import floats

# (25, 2) offsets, the middle in the middle: the black squares of a board of seven by seven pixels.
PATCH_PX = np.mgrid[-3:4, -3:4][::-1].reshape(2, -1).T[::2]
ALIKE = 15.0  # grey levels: what differs so much from the middle, and may lie on something else, counts a third
LEAST_SHARE = 0.05  # of what the middle counts
MIN_CONTRAST = 2.0  # grey levels, standard deviation in a patch: flatter ones match anything
MAX_TILT = 2.0  # a patch is at most so many times nearer or farther at its rim than at its centre
SOURCE_SCALE = 2  # sources are looked at between their pixels, too: in images of so many times their size
REACH_M = np.float32(0.5)  # nearer to a source's image plane than this nothing is looked for
FLAT = np.float32(0.05)  # grey levels, squared: sources that differ less than that show nothing


@dataclass(frozen=True)
class View:
    """A grey image, and its camera, which counts in the image's own pixels."""

    grey: UInt8[NDArray, "height width"]
    camera: Camera

    def resized(self, width_px: int, height_px: int) -> "View":
        """The same at another size, by area averages where that is smaller."""
        return View(resized(self.grey, width_px, height_px), self.camera.scaled(width_px, height_px))

    def enlarged(self, scale: int) -> "View":
        """The same in so many times as many rows and columns."""
        grey = enlarged(self.grey, scale)
        return View(grey, self.camera.scaled(grey.shape[1], grey.shape[0]))


class PatchScores:
    """How well each depth suits the patch around each pixel, as far as it was looked at."""

    def __init__(
        self,
        reference: View,
        pixels: Float[NDArray, "cells 2"],
        sources: Sequence[View],
        depths_m: Float[NDArray, " depths"],
    ) -> None:
        """Patches are around pixels of `reference`, depths along its axis. Two sources at least, all of one size."""
        sources = [source.enlarged(SOURCE_SCALE) for source in sources]
        self.values = np.zeros((len(pixels), len(depths_m)), np.float32)  # 0..1
        self._camera, self._pixels, self._depths_m = reference.camera, pixels, depths_m.astype(np.float32)
        self._patches, self._has_contrast = _patches(reference.grey, pixels)
        self._motions = _motions(self._camera, [source.camera for source in sources])
        self._sources = np.stack([source.grey.ravel() for source in sources])
        self._size_px = np.array(sources[0].grey.shape[::-1], np.int32)

    def look(self, normals: Float[NDArray, "cells 3"], reach: Int[NDArray, "cells 2"]) -> None:
        """Lay patches into planes with the normals, and look at the depths from `reach` to before its second number.

        Normals are in the camera's axes, of any length; patches whose normal is 0 are left as they are.
        """
        cells = np.flatnonzero(self._has_contrast & normals.any(-1))
        _fill_scores(
            cells,
            self._patches,
            _patch_rays(self._camera, self._pixels[cells], normals[cells]),
            self._sources,
            self._size_px,
            *self._motions,
            self._depths_m,
            reach,
            self.values,
            numba.get_num_threads(),
        )


def _motions(camera: Camera, others: list[Camera]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What takes points (3,) of the camera to homogeneous pixels of others: turns (K, 3, 3) and shifts (K, 3)."""
    world_from_camera = np.stack([other.world_from_camera for other in others])
    pixel_from_world = np.stack([other.intrinsics for other in others]) @ world_from_camera[:, :3, :3].swapaxes(1, 2)
    offsets = camera.world_from_camera[:3, 3] - world_from_camera[:, :3, 3]
    turns = pixel_from_world @ camera.world_from_camera[:3, :3]
    return turns.astype(np.float32), np.einsum("kij,kj->ki", pixel_from_world, offsets).astype(np.float32)


def _patches(
    grey: UInt8[NDArray, "height width"], pixels: Float[NDArray, "cells 2"]
) -> tuple[Float[NDArray, "cells 2 samples"], NDArray[np.bool_]]:
    """Patches around pixels, and where they are inside the image and differ.

    A patch holds two numbers of each sample: the weight with which grey values of a source, whose deviation is 1, add
    up to their correlation with the patch, and the sample's share of all means, which is larger where its grey value is
    like that of the middle (Yoon and Kweon, Adaptive support-weight approach for correspondence search, 2006).
    """
    height, width = grey.shape
    columns, rows = (pixels[:, None] + PATCH_PX).astype(np.int64).transpose(2, 0, 1)
    inside = (columns.min(1) >= 0) & (rows.min(1) >= 0) & (columns.max(1) < width) & (rows.max(1) < height)
    values = grey[rows.clip(0, height - 1), columns.clip(0, width - 1)].astype(np.float32)
    middle = values[:, len(PATCH_PX) // 2, None]
    shares = np.maximum(np.exp(-np.abs(values - middle) / ALIKE), LEAST_SHARE)
    shares /= shares.sum(1, keepdims=True)
    contrast = values.std(1)
    values -= (shares * values).sum(1, keepdims=True)
    spread = np.sqrt((shares * values**2).sum(1, keepdims=True))
    patches = np.stack([shares * values / np.maximum(spread, FLAT**0.5), shares], 1)
    return patches.astype(np.float32), inside & (contrast > MIN_CONTRAST)


def _patch_rays(
    camera: Camera, pixels: Float[NDArray, "cells 2"], normals: Float[NDArray, "cells 3"]
) -> Float[NDArray, "cells samples 3"]:
    """Points of a patch whose centre is at depth 1, in the camera's axes: all on a plane with the normal.

    At another depth the patch has the same form, only larger.
    """
    places = pixels[:, None] + PATCH_PX
    homogeneous = np.concatenate([places, np.ones_like(places[..., :1])], -1, dtype=np.float32)
    rays = homogeneous @ np.linalg.inv(camera.intrinsics).T.astype(np.float32)
    away = np.einsum("nsi,ni->ns", rays, normals.astype(np.float32))
    middle = away[:, len(PATCH_PX) // 2, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        tilt = np.nan_to_num(middle / away, nan=1.0)
    tilt[(tilt <= 0).any(1)] = 1  # a plane that the camera is in: take the patch for one that faces it
    return rays * tilt.clip(1 / MAX_TILT, MAX_TILT)[..., None]


@numba.njit(parallel=True, fastmath=True, cache=True)
def _fill_scores(cells, patches, rays, sources, size_px, turns, shifts, depths_m, reach, scores, worker_count):  # noqa: PLR0913, PLR0917 - numba wants arrays
    """Fill, for the cells of the list and the depths within their reach, how well the best two sources agree (0..1)."""
    for worker in prange(worker_count):
        seen, room = np.empty((patches.shape[2], 3), np.float32), _room(len(depths_m))
        found, best, second = np.empty((3, len(depths_m)), np.float32)
        for place in range(worker, len(cells), worker_count):
            cell = cells[place]
            start, end = reach[cell]
            best[start:end] = second[start:end] = -1
            for source in range(len(turns)):
                shift, image = shifts[source], sources[source]
                _turn(rays[place], turns[source], seen)
                low, high = _shown(seen[len(seen) // 2], shift, size_px, depths_m, start, end)
                _correlate(patches[cell], seen, shift, image, size_px, depths_m[low:high], room, found[low:high])
                for depth in range(low, high):
                    second[depth] = max(second[depth], min(best[depth], found[depth]))
                    best[depth] = max(best[depth], found[depth])
            for depth in range(start, end):  # what hides the patch from others does not count
                scores[cell, depth] = max(best[depth] + second[depth], np.float32(0)) / 2


@numba.njit(fastmath=True)
def _turn(rays, turn, seen):
    """Fill seen (S, 3): the patch in a source's homogeneous pixels, the shift aside."""
    for i in range(len(rays)):
        for axis in range(3):
            seen[i, axis] = turn[axis, 0] * rays[i, 0] + turn[axis, 1] * rays[i, 1] + turn[axis, 2] * rays[i, 2]


@numba.njit(fastmath=True)
def _shown(point, shift, size_px, depths_m, start, end):
    """Of the depths start..end those at which a source's image holds a point: a stretch, for they lie on a line."""
    while start < end and not _is_inside(point, shift, size_px, depths_m[start]):
        start += 1
    while start < end and not _is_inside(point, shift, size_px, depths_m[end - 1]):
        end -= 1
    return start, end


@numba.njit(fastmath=True)
def _is_inside(point, shift, size_px, depth_m):
    x, y, away_m = depth_m * point[0] + shift[0], depth_m * point[1] + shift[1], depth_m * point[2] + shift[2]
    return away_m >= REACH_M and 0 <= x <= size_px[0] * away_m and 0 <= y <= size_px[1] * away_m


@numba.njit
def _room(count):
    """What `_correlate` notes at each depth: three sums, how far outside the patch is, a point's place and its grey.

    Six arrays, for only then the compiler sees that they lie apart, and takes many depths together.
    """
    a, b, c, d = floats(count), floats(count), floats(count), floats(count)
    return a, b, c, d, np.empty(count, np.int32), np.empty(count, np.uint8)


# Below, vector instructions take many depths of a point together: each loop does one thing, so that they can.


@numba.njit(fastmath=True)
def _correlate(patch, seen, shift, image, size_px, depths_m, room, found):  # noqa: PLR0913, PLR0917 - numba wants arrays
    """Fill found (D,): the correlation of a patch with a source's grey values.

    0 where these hardly differ, -1 where the patch is not wholly inside the source.
    """
    total, squares, common, outside, at, grey = room
    count = len(depths_m)
    for depth in range(count):
        total[depth] = squares[depth] = common[depth] = 0
        outside[depth] = -1
    for i in range(patch.shape[1]):
        _project(seen[i], shift, size_px, depths_m, at, outside)
        for depth in range(count):
            grey[depth] = image[np.uint32(at[depth])]
        weight, share = patch[0, i], patch[1, i]
        for depth in range(count):
            value = np.float32(grey[depth])
            total[depth] += value * share
            squares[depth] += value * value * share
            common[depth] += value * weight
    for depth in range(count):
        spread = squares[depth] - total[depth] * total[depth]
        alike = common[depth] / np.sqrt(spread) if spread > FLAT else np.float32(0)
        found[depth] = alike if outside[depth] < 0 else np.float32(-1)


@numba.njit(fastmath=True)
def _project(point, shift, size_px, depths_m, at, outside):
    """Fill at (D,): a point in a source, pixels counted row by row. Beyond the rim outside (D,) becomes 0 or more."""
    (a, b, c), (u, v, w) = (point[0], point[1], point[2]), (shift[0], shift[1], shift[2])
    stride, width, height = size_px[0], np.float32(size_px[0]), np.float32(size_px[1])
    zero, one = np.float32(0), np.float32(1)
    for depth in range(len(depths_m)):
        scale = one / max(depths_m[depth] * c + w, REACH_M)
        x, y = (depths_m[depth] * a + u) * scale, (depths_m[depth] * b + v) * scale
        outside[depth] = max(outside[depth], -x, x - width, -y, y - height)
        column, row = np.int32(min(max(x, zero), width - one)), np.int32(min(max(y, zero), height - one))
        at[depth] = row * stride + column
