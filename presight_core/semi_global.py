"""Depths of the cells of an image that suit both the cells themselves and those around them.

Semi-global matching (Hirschmüller, Stereo processing by semi-global matching and mutual information, 2008): along paths
from eight sides the depth of a cell may stay on the surface of the cell before it for nothing, step beside it for
little, and leave it for more. So what is plain is filled from what has a pattern. Surfaces are planes of known slant
(Scharstein and others, Semi-global stereo matching with surface orientation priors, 2017): ground goes on as ground.
"""

import numba
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

STEP_COST, LEAP_COST = np.float32(0.2), np.float32(1.0)  # in units of correlation
AT_BORDERS = np.float32(0.25)  # of these costs, where labels differ
PATHS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])  # rows and columns a step
MAX_RATIO = np.float32(2)  # of the nearness of cells beside each other on a plane: more is a plane seen edge-on
FLAT = 1e-3  # all depths cost the same: nothing is known


def best_places(
    scores: Float[NDArray, "rows columns depths"],
    planes: Float[NDArray, "rows columns 3"],
    labels: UInt8[NDArray, "rows columns"],
    nearness: Float[NDArray, " depths"],
) -> Float[NDArray, "rows columns"]:
    """The index, with a fraction, of each cell's depth; NaN where nothing is known.

    `scores` (0..1) say how well each depth suits a cell. A plane (a, b, c) says that on the cell's surface 1 / depth is
    proportional to a * column + b * row + c; cells whose plane is 0 are left out, and no path crosses them. `nearness`
    is 1 / depth, at even steps.
    """
    costs = np.zeros(scores.shape, np.float32)
    _add_paths(scores.astype(np.float32), planes.astype(np.float32), labels, nearness.astype(np.float32), costs)
    chosen = costs.argmin(-1)
    middle = chosen.clip(1, len(nearness) - 2)
    before, least, after = (np.take_along_axis(costs, (middle + i)[..., None], -1)[..., 0] for i in (-1, 0, 1))
    bend = before - 2 * least + after
    inside = (chosen == middle) & (bend > 0)
    places = chosen + np.where(inside, (before - after) / (2 * np.where(inside, bend, 1)), 0)  # the foot of a parabola
    return np.where(planes.any(-1) & (np.ptp(costs, -1) > FLAT), places, np.nan)


@numba.njit(fastmath=True, cache=True)
def _add_paths(scores, planes, labels, nearness, costs):
    """Add what the cheapest path from each side costs that ends in a cell at a depth, more than at the best depth."""
    rows, columns, depths = scores.shape
    path, beside = np.empty_like(scores), np.empty(depths, np.float32)
    for down, right in PATHS:
        for i in range(rows):
            row = i if down >= 0 else rows - 1 - i
            for j in range(columns):
                column = j if right >= 0 else columns - 1 - j
                own, before = path[row, column], (row - down, column - right)
                own[:] = 1 - scores[row, column]
                if 0 <= before[0] < rows and 0 <= before[1] < columns and planes[before].any():
                    ratio = _ratio(planes[row, column], row, column, before)
                    share = np.float32(1) if labels[before] == labels[row, column] else AT_BORDERS
                    _fill_beside(path[before], beside)
                    _go_on(path[before], beside, ratio, share, nearness, own)
                own -= own.min()
        costs += path


@numba.njit(fastmath=True)
def _ratio(plane, row, column, before):
    """How much nearer the plane of a cell is in the cell before it; 1 where it is seen edge-on."""
    here = plane[0] * column + plane[1] * row + plane[2]
    there = plane[0] * before[1] + plane[1] * before[0] + plane[2]
    ratio = there / here if here != 0 else np.float32(1)
    return ratio if 1 / MAX_RATIO < ratio < MAX_RATIO else np.float32(1)


@numba.njit(fastmath=True)
def _fill_beside(path, beside):
    """Fill, for each place between two depths, what is least of those and of the ones next to them."""
    last = len(path) - 1
    for i in range(1, last - 1):
        beside[i] = min(path[i - 1], path[i], path[i + 1], path[i + 2])
    beside[0] = min(path[0], path[1], path[min(2, last)])
    beside[last - 1] = min(path[max(last - 2, 0)], path[last - 1], path[last])


@numba.njit(fastmath=True)
def _go_on(before, beside, ratio, share, nearness, own):
    """Add to each depth's own cost the cheapest way to it from the cell before; `share` of the costs of leaving."""
    last = len(before) - 1
    step, leap, drift = share * STEP_COST, share * LEAP_COST, ratio - np.float32(1)
    start = nearness[0] * drift / (nearness[1] - nearness[0])  # where the first depth lies in the cell before
    depth = 0
    while depth <= last:
        place = start + depth * ratio
        if place < 0 or place > last:  # nothing there to go on from
            own[depth] += leap
            depth += 1
            continue
        low = min(int(place), last - 1)
        fraction = place - low
        # The depths from here on that lie as many places from theirs: vector instructions take them together.
        left = (1 - fraction) / drift if drift > 0 else (fraction / -drift if drift < 0 else np.float32(last))
        end = depth + max(1, min(int(left), last + 1 - depth, last - low))
        there = low + end - depth
        _add_cheapest(before[low : there + 1], beside[low:there], fraction, drift, (step, leap), own[depth:end])
        depth = end


@numba.njit(fastmath=True)
def _add_cheapest(before, beside, fraction, drift, costs, own):
    """`_go_on` for depths each between one of `before` and the next: `fraction` of the way, and ever `drift` more."""
    step, leap = costs
    for i in range(len(own)):
        straight = before[i] + (fraction + np.float32(i) * drift) * (before[i + 1] - before[i])
        own[i] += min(straight, beside[i] + step, leap)
