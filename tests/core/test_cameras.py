import numpy as np
import pytest

from presight_core import frames
from presight_core.cameras import Camera, pixel_centres, ray_directions


@pytest.fixture
def camera() -> Camera:
    intrinsics = np.array([[1266.4, 0, 816.3], [0, 1266.4, 491.5], [0, 0, 1]])
    rotation = frames.rotation_from_quaternion([0.5, -0.5, 0.5, -0.5])  # looks along world x
    return Camera(intrinsics, frames.transform(rotation, [1.7, 0.0, 1.5]), 1600, 900)


def test_projecting_a_point_on_a_ray_gives_its_pixel_back(camera):
    pixels = np.random.default_rng(0).uniform([0, 0], [1600, 900], (100, 2))
    origin, directions = camera.rays(pixels)
    projected, _ = camera.project(origin + directions * 37.0)
    np.testing.assert_allclose(projected, pixels, atol=1e-8)


def test_depth_is_measured_along_the_optical_axis(camera):
    _, depth_m = camera.project([[11.7, 3.0, 1.5]])
    np.testing.assert_allclose(depth_m, [10.0])


def test_a_point_behind_the_camera_has_no_pixel(camera):
    pixels, _ = camera.project([[-5.0, 0.0, 1.5]])
    assert np.isnan(pixels).all()
    assert not camera.sees([[-5.0, 0.0, 1.5]]).any()


def test_left_in_the_world_is_left_in_the_image(camera):
    pixels, _ = camera.project([[20.0, 2.0, 1.5], [20.0, -2.0, 1.5]])
    assert pixels[0, 0] < pixels[1, 0]


def test_a_smaller_image_sees_the_same_rays(camera):
    small = camera.scaled(400, 225)
    _, full_rays = camera.rays([[800.0, 450.0]])
    _, small_rays = small.rays([[200.0, 112.5]])
    np.testing.assert_allclose(small_rays, full_rays)


def test_the_first_pixel_centre_is_half_a_pixel_in():
    np.testing.assert_array_equal(pixel_centres(2, 2), [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]])


def test_rays_of_many_cameras_equal_rays_of_each(camera):
    pixels = pixel_centres(1600, 900, 400)
    many = ray_directions(
        pixels, np.stack([camera.intrinsics] * len(pixels)), np.stack([camera.world_from_camera] * len(pixels))
    )
    np.testing.assert_allclose(many, camera.rays(pixels)[1])
