"""The 19 Cityscapes classes of the label maps (train ids; 255 is unknown)."""

import numpy as np

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation",
    "terrain", "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip
SKY = CITYSCAPES.index("sky")
UNKNOWN = 255
DYNAMIC = ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")  # paper, section 4.2

# The customary Cityscapes colours, for people.
COLOURS = np.array(
    [
        (128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156), (190, 153, 153), (153, 153, 153),
        (250, 170, 30), (220, 220, 0), (107, 142, 35), (152, 251, 152), (70, 130, 180), (220, 20, 60),
        (255, 0, 0), (0, 0, 142), (0, 0, 70), (0, 60, 100), (0, 80, 100), (0, 0, 230), (119, 11, 32),
    ],
    np.uint8,
)  # fmt: skip


def lookup(names: tuple[str, ...]) -> np.ndarray:
    """A boolean table (256,): True at the train ids of the named classes."""
    table = np.zeros(256, np.bool_)
    table[[CITYSCAPES.index(name) for name in names]] = True
    return table
