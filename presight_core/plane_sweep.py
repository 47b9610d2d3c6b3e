"""How far the surfaces of an image are, told from images of the same things taken nearby: a plane sweep.

Around a pixel a small patch of surface is put at one distance after the other (Collins, A space-sweep approach to true
multi-image matching, 1996). Where it is right, the other images show the patch as the first one does (`patch_scores`).
Which distance is taken depends on the cells around, too (`semi_global`). Then patches are laid into the planes that the
cells around them lie in, and looked at again.

That is done in images of half the size, where patches hold more and are mistaken less often, and then once more near
what was found there. Nothing is learned, and poses must be known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray

from presight_core.cameras import Camera, pixel_centres
from presight_core.local_planes import planes_around
from presight_core.patch_scores import PatchScores, View
from presight_core.semi_global import best_places

CELL_PX = 4  # a depth is found for every fourth pixel of every fourth row
MIDDLE_PX = CELL_PX // 2 + 0.5  # of a cell: where the middle of that pixel is
NEAREST_M, FARTHEST_M = 2.5, 150.0  # what is farther than can be told should not be taken for near
DEPTH_COUNT = 200  # with 134 the middle error is 1.3 times as large beyond 30 m, in 30 % less time
NEARNESS = np.linspace(1 / NEAREST_M, 1 / FARTHEST_M, DEPTH_COUNT)  # 1 / depth, at even steps
ROUGH_NEARNESS = NEARNESS[::2]  # in images of half the size
MARGIN = 12  # depths beyond those that were found there in the cells around
NEAR = 8  # depths to each side of the one found before that a patch laid anew is put at
MAX_SLOPE = 0.5  # of the nearness of a cell: what grows more to the next is seen edge-on


@dataclass(frozen=True)
class Cells:
    """What is known of the surface in each cell of an image."""

    normals: Float[NDArray, "rows columns 3"]  # in the camera's axes, of any length; 0: nothing is looked for
    is_known: Bool[NDArray, "rows columns"]  # False: the normal is a first guess
    labels: UInt8[NDArray, "rows columns"]  # where they differ, a surface seldom goes on

    def halved(self, shape: tuple[int, int]) -> "Cells":
        """The cells of the image in half the size: one of four."""
        rows, columns = (np.minimum(2 * np.arange(n) + 1, m - 1) for n, m in zip(shape, self.labels.shape, strict=True))
        chosen = np.ix_(rows, columns)
        return Cells(self.normals[chosen], self.is_known[chosen], self.labels[chosen])


@dataclass(frozen=True)
class _Surfaces:
    """What was found in the cells of an image."""

    nearness: Float[NDArray, "rows columns"]  # 1 / depth in their middles; NaN: unknown
    normals: Float[NDArray, "rows columns 3"]  # like those of `Cells`
    labels: UInt8[NDArray, "rows columns"]


def sweep(reference: View, cells: Cells, sources: Sequence[View]) -> Float[NDArray, "rows columns 3"]:
    """The plane in every cell that explains the sources best: 1 / depth at its middle, and how much more it is beside.

    Depths are along the optical axis, metres; beside are the next cells to the right and below. 0 where nothing is
    known. There must be two sources at least, all of one size.
    """
    small = _halved(reference)
    few = cells.halved(grid_shape(small.camera.width_px, small.camera.height_px))
    everywhere = np.broadcast_to((0, len(ROUGH_NEARNESS)), (*few.labels.shape, 2))
    rough = _Search(small, few, [_halved(source) for source in sources], ROUGH_NEARNESS).run(few.normals, everywhere)
    found = _Search(reference, cells, sources, NEARNESS).run(*_near(rough, cells))
    nearness = np.nan_to_num(found.nearness)[..., None]
    return nearness * np.concatenate([np.ones_like(nearness), _slopes(reference.camera, found.normals)], -1)


def grid_shape(width_px: int, height_px: int) -> tuple[int, int]:
    """Rows and columns of the cells of an image."""
    rows, columns = (len(range(CELL_PX // 2, size, CELL_PX)) for size in (height_px, width_px))
    return rows, columns


def _halved(view: View) -> View:
    """In half the size, but a cell at least."""
    width_px, height_px = (max(CELL_PX, size // 2) for size in (view.camera.width_px, view.camera.height_px))
    return view.resized(width_px, height_px)


class _Search:
    """Looks for the surfaces of an image at depths given by 1 / depth."""

    def __init__(
        self, reference: View, cells: Cells, sources: Sequence[View], nearness: Float[NDArray, " depths"]
    ) -> None:
        self._camera, self._cells, self._nearness = reference.camera, cells, nearness
        pixels = pixel_centres(self._camera.width_px, self._camera.height_px, CELL_PX)
        self._scores = PatchScores(reference, pixels, sources, 1 / nearness)

    def run(self, normals: Float[NDArray, "rows columns 3"], reach: Int[NDArray, "rows columns 2"]) -> _Surfaces:
        """What is found within reach by patches with the normals, then by such as lie in the planes around them."""
        self._scores.look(normals.reshape(-1, 3), reach.reshape(-1, 2))
        nearness = self._best(normals, reach)
        normals, is_new = _turned(self._camera, self._cells, nearness)
        known = np.nan_to_num(nearness)
        beside = _reach(known, known, NEAR, self._nearness)
        self._scores.look(np.where(is_new[..., None], normals, 0).reshape(-1, 3), beside.reshape(-1, 2))
        return _Surfaces(self._best(normals, reach), normals, self._cells.labels)

    def _best(
        self, normals: Float[NDArray, "rows columns 3"], reach: Int[NDArray, "rows columns 2"]
    ) -> Float[NDArray, "rows columns"]:
        """1 / depth that suits the cells and those around them; NaN where nothing is known."""
        labels = self._cells.labels
        volume = self._scores.values.reshape(*labels.shape, -1)
        places = best_places(volume, reach, _planes(self._camera, normals), labels, self._nearness)
        return np.interp(places, np.arange(len(self._nearness)), self._nearness)


def _near(rough: _Surfaces, cells: Cells) -> tuple[Float[NDArray, "rows columns 3"], Int[NDArray, "rows columns 2"]]:
    """Normals of what was found in the image of half the size, and the depths near it; all, where nothing was.

    What is too narrow for that image, so that no cell there has its label, may be anywhere.
    """
    shapes = zip(cells.labels.shape, rough.labels.shape, strict=True)
    rows, columns = (np.minimum(np.arange(count) // 2, few - 1) for count, few in shapes)
    around = [np.ix_(rows + down, columns + right) for down, right in np.ndindex(3, 3)]
    nearness, labels = (
        np.stack([np.pad(values, 1, mode="edge")[place] for place in around])
        for values in (np.nan_to_num(rough.nearness), rough.labels)
    )
    nearest = nearness.max(0)
    farthest = np.where(nearness > 0, nearness, nearest).min(0)
    is_known = ((labels == cells.labels) & (nearness > 0)).any(0)
    reach = np.where(is_known[..., None], _reach(nearest, farthest, MARGIN, NEARNESS), (0, DEPTH_COUNT))
    is_alike = labels[len(around) // 2] == cells.labels
    return np.where(is_alike[..., None], rough.normals[np.ix_(rows, columns)], cells.normals), reach


def _reach(
    nearest: Float[NDArray, "rows columns"],
    farthest: Float[NDArray, "rows columns"],
    margin: int,
    nearness: Float[NDArray, " depths"],
) -> Int[NDArray, "rows columns 2"]:
    """From which depth to before which there are depths between two, and a margin; all are given as 1 / depth."""
    step = nearness[0] - nearness[1]
    first, last = ((nearness[0] - end) / step for end in (nearest, farthest))
    return np.stack([first - margin, last + margin + 1], -1).clip(0, len(nearness)).astype(np.int64)


def _turned(
    camera: Camera, cells: Cells, nearness: Float[NDArray, "rows columns"]
) -> tuple[Float[NDArray, "rows columns 3"], Bool[NDArray, "rows columns"]]:
    """Normals of the planes that the cells around each cell lie in, and where there is such a plane.

    Elsewhere, and where they are known, normals stay.
    """
    planes = planes_around(np.nan_to_num(nearness).astype(np.float32), cells.labels)
    is_new = planes.any(-1) & cells.normals.any(-1) & ~cells.is_known
    normals = planes @ np.linalg.inv(_pixel_from_cell()) @ camera.intrinsics
    return np.where(is_new[..., None], normals, cells.normals), is_new


def _planes(camera: Camera, normals: Float[NDArray, "rows columns 3"]) -> Float[NDArray, "rows columns 3"]:
    """The planes with the normals as `best_places` wants them: 1 / depth at the middles of cells."""
    return normals @ np.linalg.inv(camera.intrinsics) @ _pixel_from_cell()


def _slopes(camera: Camera, normals: Float[NDArray, "rows columns 3"]) -> Float[NDArray, "rows columns 2"]:
    """By what share of a cell's nearness the planes with the normals are nearer in the next cells."""
    planes, (row, column) = _planes(camera, normals), np.indices(normals.shape[:2])
    here = planes[..., 0] * column + planes[..., 1] * row + planes[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.nan_to_num(planes[..., :2] / here[..., None], posinf=0, neginf=0)
    return slopes.clip(-MAX_SLOPE, MAX_SLOPE)


def _pixel_from_cell() -> NDArray[np.float64]:
    """Takes a cell's column and row to the pixel in its middle, homogeneous."""
    return np.array([[CELL_PX, 0, MIDDLE_PX], [0, CELL_PX, MIDDLE_PX], [0, 0, 1]])
