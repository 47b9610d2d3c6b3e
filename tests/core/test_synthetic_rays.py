"""Ray casting, lidar, surface points and occupancy of the synthetic city."""

from pathlib import Path

import numpy as np
import pytest

from presight_core.cameras import pixel_centres
from presight_core.classes import CITYSCAPES, OCC3D
from presight_core.frames import apply, invert
from presight_core.synthetic import lidar, occupancy
from presight_core.synthetic.actors import FIRST_ACTOR, Actor, actor_mesh
from presight_core.synthetic.city import City
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import BOX_FACES, Box, MeshBuilder, Surface
from presight_core.synthetic.occupancy import FREE, SHAPE, CitySurfaces, Moment, Occupancy, label_occupancy
from presight_core.synthetic.raster import draw_perspective
from presight_core.synthetic.raycast import RayCaster, Rays
from presight_core.synthetic.renderer import ground_truth, pinhole_view
from presight_core.synthetic.rig import RIG, rig_cameras
from presight_core.synthetic.style import CityStyle
from presight_core.synthetic.surface_points import (
    Bounds,
    exposed,
    read_surface_points,
    sample_surface,
    write_surface_points,
)
from presight_core.synthetic.views import View, random_view


@pytest.fixture(scope="module")
def city() -> City:
    return City(seed=1, style=CityStyle(size_m=200.0, spacing_m=90.0))


@pytest.fixture(scope="module")
def view(city: City) -> View:
    return random_view(city, np.random.default_rng(4), 200, "day")


@pytest.fixture(scope="module")
def world_from_ego(view: View) -> np.ndarray:
    return view.cameras[0].world_from_camera @ invert(RIG[0].ego_from_camera)


@pytest.fixture(scope="module")
def moment(city: City, view: View) -> Moment:
    return Moment(CitySurfaces(city), view.actors)


@pytest.fixture(scope="module")
def views(moment: Moment, view: View) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth and instances (H * W,) of each camera, as the renderer has them; nothing here needs colours."""
    drawn = []
    city_mesh, actors = moment.surfaces.mesh, moment.actor_mesh
    for camera in view.cameras:
        shape = 2 * camera.height_px + 1, 2 * camera.width_px + 1
        nearness, faces = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
        draw_perspective(city_mesh, pinhole_view(camera), 0, nearness, faces)
        draw_perspective(actors, pinhole_view(camera), len(city_mesh.faces), nearness, faces)
        depth_m, _, instances = ground_truth(city_mesh, actors, nearness[1::2, 1::2], faces[1::2, 1::2])
        drawn.append((depth_m.reshape(-1).astype(np.float64), instances.reshape(-1)))
    return drawn


@pytest.fixture(scope="module")
def sweep(moment: Moment, world_from_ego: np.ndarray) -> lidar.Sweep:
    return lidar.sweep(moment.caster, world_from_ego @ lidar.ego_from_lidar(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def labels(moment: Moment, view: View, world_from_ego: np.ndarray, sweep: lidar.Sweep) -> Occupancy:
    rays = [occupancy.camera_rays(moment.caster, camera) for camera in view.cameras]
    return label_occupancy(moment, world_from_ego, rays, sweep.rays)


def wall_caster(east_m: float) -> RayCaster:
    """A wall 20 m wide and 10 m high whose near side stands at x = `east_m`."""
    builder = MeshBuilder()
    wall = Box(east_m + 0.5, 0, -2, 1, 20, 10)
    builder.add(wall.vertices(), BOX_FACES, Surface(Material.GARDEN_WALL, (0.5, 0.5, 0.5), instance=7))
    return RayCaster(builder.build())


# ---- rays --------------------------------------------------------------------------------------------------------


def test_a_ray_stops_at_the_nearest_wall_of_any_mesh():
    far, near = wall_caster(30.0), MeshBuilder()
    near.add(Box(10.5, 0, -2, 1, 20, 10).vertices(), BOX_FACES, Surface(Material.FENCE, (0.5, 0.5, 0.5), instance=8))
    both = far.joined_by(near.build())
    for caster, distance_m, instance in ((far, 30, 7), (both, 10, 8)):
        hits = caster.cast([0, 0, 0], [[1.0, 0, 0]])
        assert hits.distance_m[0] == pytest.approx(distance_m, abs=1e-4)
        assert caster.instances[hits.faces[0]] == instance
    assert far.cast([0, 0, 0], [[1.0, 0, 0]]).distance_m[0] == pytest.approx(30, abs=1e-4)  # joining left it alone


def test_a_ray_into_the_open_has_no_end():
    hits = wall_caster(5.0).cast([0, 0, 0], [[-1.0, 0, 0]])
    assert np.isinf(hits.distance_m[0])
    assert hits.faces[0] == -1


def test_a_caster_of_nothing_hits_nothing():
    hits = RayCaster(actor_mesh([])).cast([0, 0, 0], [[1.0, 0, 0]])
    assert np.isinf(hits.distance_m[0])


def test_rays_through_pixels_are_as_long_as_the_rendered_depth(moment: Moment, view: View, views: list):
    for camera, (depth_m, _) in zip(view.cameras, views, strict=True):
        origin, directions = camera.rays(pixel_centres(camera.width_px, camera.height_px))
        along_m = depth_m / (directions @ camera.world_from_camera[:3, 2])
        cast_m = moment.caster.cast(origin, directions).distance_m
        near = (along_m > 0) & (along_m < 100)
        off_m = np.abs(cast_m - along_m)[near]
        assert np.mean(off_m < 1e-3) > 0.999  # the rest are silhouettes, where one of the two slips past
        assert np.median(off_m) < 1e-4


# ---- lidar -------------------------------------------------------------------------------------------------------


def test_the_lidar_looks_along_its_y_axis():
    np.testing.assert_allclose(lidar.ego_from_lidar()[:3, 1], [1, 0, 0], atol=0.03)
    np.testing.assert_allclose(lidar.ego_from_lidar()[:3, 0], [0, -1, 0], atol=0.03)


def test_lidar_points_lie_on_surfaces(moment: Moment, world_from_ego: np.ndarray, sweep: lidar.Sweep):
    world_from_lidar = world_from_ego @ lidar.ego_from_lidar()
    range_m = np.linalg.norm(sweep.points[:, :3], axis=1)
    directions = sweep.points[:, :3] / range_m[:, None] @ world_from_lidar[:3, :3].T
    hits = moment.caster.cast(world_from_lidar[:3, 3], directions)
    off_m = np.abs(hits.distance_m - range_m)
    assert np.mean(off_m < 5 * lidar.NOISE_M) > 0.995  # rounding moves some rays past an edge
    assert np.median(off_m) == pytest.approx(0.67 * lidar.NOISE_M, rel=0.1)  # the median of a normal error
    assert np.mean(moment.caster.labels[hits.faces] == sweep.labels) > 0.995


def test_a_sweep_has_about_as_many_points_as_a_real_one(sweep: lidar.Sweep):
    assert 20_000 < len(sweep.points) < lidar.BEAM_COUNT * lidar.AZIMUTH_COUNT
    assert set(np.unique(sweep.points[:, 4])) == set(range(lidar.BEAM_COUNT))
    assert sweep.points[:, 3].min() >= 0
    assert sweep.points[:, 3].max() <= 255


def test_low_rings_are_steep(sweep: lidar.Sweep):
    elevation = np.arcsin(sweep.points[:, 2] / np.linalg.norm(sweep.points[:, :3], axis=1))
    means = [np.rad2deg(elevation[sweep.points[:, 4] == ring].mean()) for ring in (0, 31)]
    np.testing.assert_allclose(means, [lidar.LOWEST_DEG, lidar.HIGHEST_DEG], atol=0.01)


def test_rays_go_out_in_the_order_of_a_real_sweep(shared_data: Path):
    path = next((shared_data / "nuscenes-keyframe" / "samples" / "LIDAR_TOP").glob("*.pcd.bin"))
    real = np.fromfile(path, np.float32).reshape(-1, 5)
    directions, rings = lidar._directions()
    np.testing.assert_array_equal(real[:, 4], rings)
    range_m = np.linalg.norm(real[:, :3], axis=1, keepdims=True)
    far = range_m[:, 0] > 5  # nearer, the laser's own offset turns the direction
    cosine = np.einsum("ni,ni->n", real[:, :3] / np.maximum(range_m, 0.1), directions)
    assert np.rad2deg(np.arccos(np.quantile(cosine[far], 0.05))) < 10  # the laser's start wanders by some degrees


def test_a_sweep_comes_back_with_its_seed(moment: Moment, world_from_ego: np.ndarray, sweep: lidar.Sweep):
    world_from_lidar = world_from_ego @ lidar.ego_from_lidar()
    again = lidar.sweep(moment.caster, world_from_lidar, np.random.default_rng(0))
    other = lidar.sweep(moment.caster, world_from_lidar, np.random.default_rng(1))
    np.testing.assert_array_equal(again.points, sweep.points)
    assert other.points.shape != sweep.points.shape or not np.array_equal(other.points, sweep.points)


def test_a_written_sweep_is_read_as_nuscenes_reads_it(tmp_path: Path, sweep: lidar.Sweep):
    path = tmp_path / "sweep.pcd.bin"
    lidar.write_sweep(path, sweep.points)
    np.testing.assert_array_equal(np.fromfile(path, np.float32).reshape(-1, 5), sweep.points)


# ---- surface points ----------------------------------------------------------------------------------------------


def test_small_faces_get_their_share_of_points():
    builder = MeshBuilder()
    grid = np.stack(np.meshgrid(np.arange(101) / 100, np.arange(101) / 100), -1).reshape(-1, 2)
    corner = (np.arange(100)[:, None] * 101 + np.arange(100)).reshape(-1, 1, 1)
    faces = (corner + np.array([[0, 1, 101], [1, 102, 101]])).reshape(-1, 3)  # 20,000 faces of half a square centimetre
    builder.add(np.c_[grid, np.zeros(len(grid))], faces, Surface(Material.GRASS, (0, 0, 0)))
    builder.add([[2, 0, 0], [3, 0, 0], [3, 1, 0], [2, 1, 0]], [[0, 1, 2], [0, 2, 3]], Surface(Material.ROOF, (0, 0, 0)))
    samples = sample_surface(builder.build(), 0.05)
    counts = np.bincount(samples.labels, minlength=19)
    assert counts[CITYSCAPES.index("terrain")] == pytest.approx(400, abs=1)
    assert counts[CITYSCAPES.index("building")] == pytest.approx(400, abs=1)


def test_points_are_spread_evenly_over_a_face():
    builder = MeshBuilder()
    builder.add([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], Surface(Material.ROOF, (0, 0, 0)))
    points = sample_surface(builder.build(), 0.02).points
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=10, range=[[0, 1], [0, 1]])[0]
    assert counts.min() >= 15  # 25 on average; independent draws would leave some cell with 12
    assert counts.max() <= 35


def test_only_points_inside_the_bounds_come_back(city: City):
    bounds = Bounds((50, 50, -1), (70, 70, 3))
    samples = sample_surface(city.mesh, 0.5, bounds)
    assert len(samples.points) > 1000
    assert (samples.points >= bounds.low).all()
    assert (samples.points < bounds.high).all()
    everywhere = sample_surface(city.mesh, 0.5, Bounds((0, 0, -5), (200, 200, 60))).points
    inside = ((everywhere >= bounds.low) & (everywhere < bounds.high)).all(1).sum()
    assert len(samples.points) == pytest.approx(inside, rel=0.02)  # clipping changes places, not density


def test_ground_inside_buildings_and_under_the_road_is_not_exposed(city: City, moment: Moment):
    samples = sample_surface(city.mesh, 0.5, Bounds((0, 0, -5), (200, 200, 60)))
    is_open = exposed(samples, moment.surfaces.caster)
    materials = city.mesh.materials[samples.faces]
    assert is_open[materials == Material.FAR_GROUND].mean() < 1e-4  # the underlay shows in cracks at most
    assert is_open[np.isin(materials, [Material.WHITE_PAINT, Material.YELLOW_PAINT])].all()
    assert is_open[materials == Material.ASPHALT].mean() > 0.9  # not under paint
    assert 0.4 < is_open[np.isin(materials, [Material.PLAZA, Material.GRASS])].mean() < 0.9  # not under buildings


def test_surface_points_survive_their_file(tmp_path: Path, city: City):
    samples = sample_surface(city.mesh, 1.0, Bounds((0, 0, -5), (200, 200, 60)))
    write_surface_points(tmp_path / "surface.npz", samples)
    points, labels = read_surface_points(tmp_path / "surface.npz")
    np.testing.assert_array_equal(points, samples.points)
    np.testing.assert_array_equal(labels, samples.labels)


# ---- occupancy ---------------------------------------------------------------------------------------------------


def voxels_of(points_world: np.ndarray, world_from_ego: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (N, 3) of the voxels of points, and which lie in the grid."""
    points_ego = apply(invert(world_from_ego), points_world)
    voxels = np.floor((points_ego - occupancy.LOW_M) / occupancy.VOXEL_M).astype(int)
    return voxels, np.all((voxels >= 0) & (voxels < SHAPE), axis=1)


def test_what_cameras_see_is_occupied_and_of_its_class(
    moment: Moment, view: View, views: list, world_from_ego: np.ndarray, labels: Occupancy
):
    expected, found, observed = [], [], []
    classes = occupancy.static_classes(moment.surfaces.mesh)
    for camera, (depth_m, instances) in zip(view.cameras, views, strict=True):
        origin, directions = camera.rays(pixel_centres(camera.width_px, camera.height_px))
        points = origin + directions * (depth_m / (directions @ camera.world_from_camera[:3, 2]))[:, None]
        voxels, inside = voxels_of(points, world_from_ego)
        faces = moment.caster.cast(origin, directions).faces
        inside &= (depth_m > 0) & (instances < FIRST_ACTOR)
        inside &= (faces >= 0) & (faces < len(classes))
        place = tuple(voxels[inside].T)
        expected.append(classes[faces[inside]])
        found.append(labels.semantics[place])
        observed.append(labels.mask_camera[place])
    expected, found, observed = (np.concatenate(column) for column in (expected, found, observed))
    assert np.mean(found != FREE) > 0.99
    assert np.mean(found == expected) > 0.95  # the rest share a voxel: curbs with the road, walls with the ground
    assert np.mean(observed) > 0.99


def test_lidar_returns_are_observed_by_the_lidar(world_from_ego: np.ndarray, sweep: lidar.Sweep, labels: Occupancy):
    points = apply(world_from_ego @ lidar.ego_from_lidar(), sweep.points[:, :3])
    voxels, inside = voxels_of(points, world_from_ego)
    place = tuple(voxels[inside].T)
    assert labels.mask_lidar[place].mean() > 0.97  # range noise carries some into the next voxel


def test_nothing_behind_a_wall_is_observed():
    caster = wall_caster(10.0)
    world_from_ego = np.eye(4)
    rays = occupancy.camera_rays(caster, rig_cameras(world_from_ego, 400, 225)[0])
    seen = occupancy._observed(occupancy._voxel_from_ego() @ invert(world_from_ego), [rays])
    ahead = seen[100:, 95:105, 6]  # 10 voxels abreast, 1.4 to 1.8 m up; the camera is 1.7 m ahead of the origin
    assert ahead[13:26].all()  # all in the image: free space, and the wall's face in the voxel from 10.0 to 10.4 m
    assert not ahead[26:].any()
    assert seen[110:, 0, 6].sum() == 0  # outside the image


def test_rays_that_hit_nothing_observe_free_space_to_the_end_of_the_grid():
    rays = Rays(np.array([0.1, 0.1, 0.1]), np.array([[1.0, 0, 0]]), np.array([np.inf], np.float32))
    seen = occupancy._observed(occupancy._voxel_from_ego(), [rays])
    assert seen.sum() == 100
    assert seen[100:, 100, 2].all()


def test_an_actor_takes_its_voxels_from_the_ground(moment: Moment, world_from_ego: np.ndarray):
    x, y = (world_from_ego @ [8.0, 0, 0, 1])[:2]
    yaw_rad = float(np.arctan2(world_from_ego[1, 0], world_from_ego[0, 0]))
    cyclist = Actor("cyclist", x, y, yaw_rad, (0.5, 0.5, 0.5), FIRST_ACTOR)
    moment = Moment(moment.surfaces, [cyclist])
    nothing = Rays(np.zeros(3), np.zeros((0, 3)), np.zeros(0, np.float32))
    semantics = label_occupancy(moment, world_from_ego, [], nothing).semantics
    place = semantics[117:123, 98:102, 2:7]
    assert np.isin(OCC3D.index("bicycle"), place[:, :, 0])  # where its wheels stand
    assert set(np.unique(semantics[117:123, 98:102, 3:])) == {OCC3D.index("bicycle"), FREE}


@pytest.mark.parametrize(
    ("category", "name"),
    [
        ("vehicle.bus.bendy", "bus"), ("human.pedestrian.child", "pedestrian"), ("vehicle.trailer", "trailer"),
        ("movable_object.trafficcone", "traffic_cone"), ("vehicle.construction", "construction_vehicle"),
        ("animal", "others"),
    ],
)  # fmt: skip
def test_nuscenes_categories_have_their_occ3d_class(category: str, name: str):
    assert OCC3D[occupancy._class_of_category(category)] == name


def test_written_labels_have_the_three_arrays_of_occ3d(tmp_path: Path, labels: Occupancy):
    occupancy.write_occupancy(tmp_path / "labels.npz", labels)
    with np.load(tmp_path / "labels.npz") as file:
        assert sorted(file.files) == ["mask_camera", "mask_lidar", "semantics"]
        for name in file.files:
            assert file[name].shape == SHAPE
            assert file[name].dtype == np.uint8
        np.testing.assert_array_equal(file["semantics"], labels.semantics)


def test_an_empty_street_has_labels_too(moment: Moment, world_from_ego: np.ndarray):
    nothing = Rays(np.zeros(3), np.zeros((0, 3)), np.zeros(0, np.float32))
    labels = label_occupancy(Moment(moment.surfaces, []), world_from_ego, [], nothing)
    assert labels.semantics[labels.semantics != FREE].min() >= occupancy.FIRST_STATIC
    assert not labels.mask_camera.any()
