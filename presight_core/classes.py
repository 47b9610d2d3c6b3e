"""The 19 Cityscapes classes of the label maps (train ids), and Occ3D's 18 of voxels; 255 is unknown in both."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # settings name classes, and `presight status` reads settings but has no time for numpy
    from numpy import bool_
    from numpy.typing import NDArray

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation",
    "terrain", "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip
SKY = CITYSCAPES.index("sky")
UNKNOWN = 255
DYNAMIC = ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")  # paper, section 4.2

# Of Occ3D-nuScenes: voxels around a vehicle. Those before driveable_surface move, or could be moved.
OCC3D = (
    "others", "barrier", "bicycle", "bus", "car", "construction_vehicle", "motorcycle", "pedestrian", "traffic_cone",
    "trailer", "truck", "driveable_surface", "other_flat", "sidewalk", "terrain", "manmade", "vegetation", "free",
)  # fmt: skip

# The customary Cityscapes colours, for people.
COLOURS = (
    (128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156), (190, 153, 153), (153, 153, 153),
    (250, 170, 30), (220, 220, 0), (107, 142, 35), (152, 251, 152), (70, 130, 180), (220, 20, 60),
    (255, 0, 0), (0, 0, 142), (0, 0, 70), (0, 60, 100), (0, 80, 100), (0, 0, 230), (119, 11, 32),
)  # fmt: skip


def lookup(names: tuple[str, ...]) -> "NDArray[bool_]":
    """A boolean table (256,): True at the train ids of the named classes."""
    import numpy as np

    table = np.zeros(256, np.bool_)
    table[[CITYSCAPES.index(name) for name in names]] = True
    return table
