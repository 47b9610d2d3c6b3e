"""Images that show the same from elsewhere."""

from dataclasses import replace

import numpy as np

from presight_core.drives import FrameTable
from presight_core.frames import planar_transform
from stages.neighbours import MANY, Neighbours
from tests.stages.small_training import EGO_FROM_CAMERA, street


def side_looking(count: int, step_m: float = 0.5) -> FrameTable:
    """Cameras along a street that look across it."""
    poses = [planar_transform(step_m * i, 0, np.pi / 2) @ EGO_FROM_CAMERA for i in range(count)]
    return replace(street(count), world_from_camera=np.stack(poses))


def test_the_best_neighbours_look_from_a_few_degrees_beside():
    distances_m = np.abs(Neighbours(side_looking(41)).of(20) - 20) * 0.5
    assert distances_m[0] >= 1.0  # 11 m away, 0.5 m beside are less than 3 degrees
    assert distances_m[:4].max() <= 3.0
    assert distances_m[-1] > 4


def test_images_without_a_common_view_are_no_neighbours():
    frames = side_looking(3)
    turned = frames.world_from_camera.copy()
    turned[2] = planar_transform(1.0, 0, -np.pi / 2) @ EGO_FROM_CAMERA
    assert Neighbours(replace(frames, world_from_camera=turned)).of(0).tolist() == [1]


def test_images_of_another_size_are_no_neighbours():
    frames = side_looking(3)
    widths = frames.width_px.copy()
    widths[1] *= 2
    assert Neighbours(replace(frames, width_px=widths)).of(0).tolist() == [2]


def test_a_lone_image_has_none_and_a_crowd_is_thinned():
    assert Neighbours(side_looking(1)).of(0).tolist() == []
    assert 0 < len(Neighbours(side_looking(3 * MANY, 0.01)).of(0)) <= MANY
