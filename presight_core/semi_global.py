"""Depths of the cells of an image that suit both the cells themselves and those around them.

Semi-global matching (Hirschmüller, Stereo processing by semi-global matching and mutual information, 2008): along paths
from eight sides the depth of a cell may stay on the surface of the cell before it for nothing, step beside it for
little, and leave it for more. So what is plain is filled from what has a pattern. Surfaces are planes of known slant
(Scharstein and others, Semi-global stereo matching with surface orientation priors, 2017): ground goes on as ground.
"""

import numba
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

STEP_COST, LEAP_COST = np.float32(0.3), np.float32(1.4)  # in units of correlation
AT_BORDERS = np.float32(0.5)  # of these costs, where labels differ
# Rows and columns to the cell before, of the four paths that a scan from the first cell to the last follows; a scan
# from the last to the first follows the other four.
BEFORE = np.array([(0, -1), (-1, 0), (-1, -1), (-1, 1)])
MAX_RATIO = np.float32(2)  # of the nearness of cells beside each other on a plane: more is a plane seen edge-on
# Minima of many depths at once, but sums as they are written: fused or in another order they were rounded otherwise by
# code that was just compiled than by the same code from the cache, and cells of equal costs got other depths.
ANY_ORDER_OF_LEAST = {"nnan", "nsz"}
FLAT = 1e-3  # all depths cost the same: nothing is known


def best_places(
    scores: Float[NDArray, "rows columns depths"],
    reach: Int[NDArray, "rows columns 2"],
    planes: Float[NDArray, "rows columns 3"],
    labels: UInt8[NDArray, "rows columns"],
    nearness: Float[NDArray, " depths"],
) -> Float[NDArray, "rows columns"]:
    """The index, with a fraction, of each cell's depth; NaN where nothing is known.

    `scores` (0..1) say how well each depth suits a cell. Only depths from the first number of `reach` to before the
    second count, two at least. A plane (a, b, c) says that on the cell's surface 1 / depth is proportional to
    a * column + b * row + c; cells whose plane is 0 are left out, and no path crosses them. `nearness` is 1 / depth, at
    even steps.
    """
    scores, planes, costs = scores.astype(np.float32), planes.astype(np.float32), np.zeros(scores.shape, np.float32)
    for side in (1, -1):
        _add_paths(scores, reach, planes, labels, nearness.astype(np.float32), side, costs)
    return _cheapest(costs, reach, planes)


@numba.njit(cache=True)
def _cheapest(costs, reach, planes):
    """Where the costs of each cell are least, between depths at the foot of a parabola."""
    places = np.full(planes.shape[:2], np.nan)
    for row in range(planes.shape[0]):
        for column in range(planes.shape[1]):
            first, end = reach[row, column]
            cost = costs[row, column, first:end]
            least = cost.argmin()
            if not planes[row, column].any() or cost.max() - cost[least] <= FLAT:
                continue
            places[row, column] = first + least
            if 0 < least < len(cost) - 1:
                before, after = cost[least - 1], cost[least + 1]
                bend = before - 2 * cost[least] + after
                places[row, column] += (before - after) / (2 * bend) if bend > 0 else 0
    return places


@numba.njit(fastmath=ANY_ORDER_OF_LEAST, cache=True)
def _add_paths(scores, reach, planes, labels, nearness, side, costs):  # noqa: PLR0913, PLR0917 - numba wants arrays
    """Add what the cheapest path costs that ends in a cell at a depth, more than at the best depth, for four paths.

    `side` is 1 for the paths that come from above or the left, -1 for those from below or the right. Of each path only
    two rows are kept: they stay in a core's cache.
    """
    rows, columns, depths = scores.shape
    paths = np.empty((len(BEFORE), 2, columns, depths), np.float32)
    values, room = np.empty(depths, np.float32), _room(depths)
    first_place = nearness[0] / (nearness[1] - nearness[0])  # depths from where nearness is 0 to the first one
    for i in range(rows):
        row = i if side > 0 else rows - 1 - i
        for j in range(columns):
            column = j if side > 0 else columns - 1 - j
            if not planes[row, column].any():
                continue
            first, end = reach[row, column]
            own = values[first:end]
            for path in range(len(BEFORE)):
                above, left = row + side * BEFORE[path, 0], column + side * BEFORE[path, 1]
                for depth in range(len(own)):
                    own[depth] = np.float32(1) - scores[row, column, first + depth]
                if 0 <= above < rows and 0 <= left < columns and planes[above, left].any():
                    ratio = _ratio(planes[row, column], row, column, (above, left))
                    share = np.float32(1) if labels[above, left] == labels[row, column] else AT_BORDERS
                    low, high = reach[above, left]
                    place = first_place * (ratio - np.float32(1)) + np.float32(first) * ratio - np.float32(low)
                    _go_on(paths[path, above % 2, left, low:high], place, ratio, share, room, own)
                _settle(own, paths[path, row % 2, column, first:end], costs[row, column, first:end])


@numba.njit(fastmath=ANY_ORDER_OF_LEAST)
def _settle(own, path, cost):
    """Note what a path costs, more than at its best depth, and add it to the cell's cost."""
    least = own.min()
    for depth in range(len(own)):
        path[depth] = own[depth] - least
        cost[depth] += own[depth] - least


@numba.njit(fastmath=ANY_ORDER_OF_LEAST)
def _ratio(plane, row, column, before):
    """How much nearer the plane of a cell is in the cell before it; 1 where it is seen edge-on."""
    here = plane[0] * column + plane[1] * row + plane[2]
    there = plane[0] * before[1] + plane[1] * before[0] + plane[2]
    ratio = there / here if here != 0 else np.float32(1)
    return ratio if 1 / MAX_RATIO < ratio < MAX_RATIO else np.float32(1)


@numba.njit(fastmath=ANY_ORDER_OF_LEAST)
def _fill_beside(path, beside):
    """Fill, for each place between two depths, what is least of those and of the ones next to them."""
    last = len(path) - 1
    for i in range(1, last - 1):
        beside[i] = min(path[i - 1], path[i], path[i + 1], path[i + 2])
    beside[0] = min(path[0], path[1], path[min(2, last)])
    beside[last - 1] = min(path[max(last - 2, 0)], path[last - 1], path[last])


@numba.njit
def _room(depths):
    """What `_go_on` notes: a place for each depth, and five numbers.

    Six arrays, for only then the compiler sees that they lie apart, and takes many depths together.
    """
    a, b, c, d, e = floats(depths), floats(depths), floats(depths), floats(depths), floats(depths)
    return np.empty(depths, np.int32), a, b, c, d, e


@numba.njit
def floats(count):
    """Room for so many numbers, in an array of its own."""
    return np.empty(count, np.float32)


@numba.njit(fastmath=ANY_ORDER_OF_LEAST)
def _go_on(before, first_place, ratio, share, room, own):
    """Add to each depth's own cost the cheapest way to it from the cell before; `share` of the costs of leaving.

    What is at a depth here is `ratio` as near in the cell before: the first at the place `first_place` there. Vector
    instructions take many depths together: each loop does one thing, so that they can.
    """
    places, fractions, beside, lower, upper, around = room
    last, half = np.int32(len(before) - 1), np.float32(0.5)
    step, leap = share * STEP_COST, share * LEAP_COST
    _fill_beside(before, beside)
    for depth in range(len(own)):
        place = first_place + np.float32(depth) * ratio
        places[depth] = min(max(np.int32(place), np.int32(0)), last - np.int32(1))
        fractions[depth] = place - np.float32(places[depth])
    for depth in range(len(own)):
        place = np.uint32(places[depth])
        lower[depth], upper[depth], around[depth] = before[place], before[place + 1], beside[place]
    for depth in range(len(own)):
        straight = lower[depth] + fractions[depth] * (upper[depth] - lower[depth])
        is_there = abs(fractions[depth] - half) <= half
        own[depth] += min(min(straight, around[depth] + step) if is_there else leap, leap)
