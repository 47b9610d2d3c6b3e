"""Trees: a trunk, a lumpy crown, and loose leaf clusters that break its outline."""

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.blocks import Site
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import Surface, cylinder, sphere

CROWN_COUNT = 6  # different crowns of a city; turned and scaled, more would not be noticed
CLUSTER_COUNT = 100  # leaf clusters of a crown


def plant_trees(site: Site) -> None:
    """Append a tree at every spot in `site.trees`."""
    rng = site.rng
    crowns = [_crown(rng) for _ in range(CROWN_COUNT)]
    trunk_vertices, trunk_faces = cylinder(6)
    for spot in site.trees:
        instance = site.next_instance()
        foot_m = float(site.terrain.height_m(*spot)) + 0.1
        radius_m = rng.uniform(*site.style.tree_radius_m)
        trunk_m = rng.uniform(2.2, 3.1) * max(1.0, radius_m / 2.0)  # wide crowns hang over the bays: room for vans
        bark = Surface(Material.TRUNK, (0.22, 0.16, 0.11), instance)
        trunk = trunk_vertices * [0.07 * radius_m, 0.07 * radius_m, trunk_m + 0.8 * radius_m] + [*spot, foot_m]
        site.builder.add(trunk, trunk_faces, bark)
        vertices, faces = crowns[int(rng.integers(CROWN_COUNT))]
        turn = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(turn), np.sin(turn)
        turned = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, rng.uniform(*site.style.tree_stretch)]])
        leaf = np.array(site.style.foliage) * rng.uniform(0.7, 1.25) + rng.uniform(-0.02, 0.03, 3)
        surface = Surface(Material.FOLIAGE, tuple(np.clip(leaf, 0.02, 0.4)), instance)
        crown = turned * radius_m
        crown[:, 2] += foot_m + trunk_m - 0.3 - crown[:, 2].min()  # the lowest leaves hide the end of the trunk
        site.builder.add(crown + np.array([*spot, 0]), faces, surface)


def _crown(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces of a crown of radius about 1 around the origin."""
    ball, ball_faces = sphere(1)
    parts, faces, start = [], [], 0
    for _ in range(3):
        lumps = 1 + 0.16 * rng.standard_normal((len(ball), 1))
        centre = rng.normal(0, 0.28, 3)
        parts.append(ball * lumps * rng.uniform(0.55, 0.8) + centre)
        faces.append(ball_faces + start)
        start += len(ball)
    clusters = _leaf_clusters(rng)
    parts.append(clusters)
    corner = start + 4 * np.arange(CLUSTER_COUNT)[:, None]
    faces += [corner + np.array([0, 1, 2]), corner + np.array([0, 2, 3])]
    return np.concatenate(parts), np.concatenate(faces)


def _leaf_clusters(rng: np.random.Generator) -> NDArray[np.float64]:
    """Corners (CLUSTER_COUNT * 4, 3) of quads scattered over the crown, facing anywhere."""
    centres = rng.standard_normal((CLUSTER_COUNT, 3))
    centres *= rng.uniform(0.75, 1.12, (CLUSTER_COUNT, 1)) / np.linalg.norm(centres, axis=1, keepdims=True)
    first = rng.standard_normal((CLUSTER_COUNT, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(first, rng.standard_normal((CLUSTER_COUNT, 3)))
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    size = rng.uniform(0.08, 0.2, (CLUSTER_COUNT, 1))
    corners = [centres + a * first * size + b * second * size for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return np.stack(corners, 1).reshape(-1, 3)
