"""The feature stage: every frame gives layers or a reject, and the feature space is the same every time."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from presight_core.config import FeatureSettings
from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import InputError
from presight_core.images import mask_path
from presight_core.model_card import ModelCard
from presight_core.pixels import FrameLayers
from presight_core.progress import Progress
from stages.features import FeatureExtractor, extract_drive
from stages.networks import Network
from stages.space_fitting import SpaceImages, fit_space

WIDTH_PX, HEIGHT_PX = 96, 64
SETTINGS = FeatureSettings(channels=4)


@pytest.fixture
def extractor(write_model) -> FeatureExtractor:
    segmentation = ModelCard.load(str(write_model("segmentation", channels=19)), "segmentation")
    return FeatureExtractor(segmentation, ModelCard.load(str(write_model()), "features"))


@pytest.fixture
def drive(tmp_path) -> tuple[Drive, FrameTable]:
    """Five images of a front and two of a back camera; the second front image is the first keyframe."""
    generator = np.random.default_rng(0)
    paths = [f"sweeps/CAM_FRONT/{i}.jpg" for i in range(5)] + [f"sweeps/CAM_BACK/{i}.jpg" for i in range(2)]
    for path in paths:
        file = tmp_path / "data" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        blocks = generator.integers(0, 256, (8, 12, 3), np.uint8)
        cv2.imwrite(str(file), cv2.resize(blocks, (WIDTH_PX, HEIGHT_PX)))
    count = len(paths)
    frames = FrameTable(
        drive_id=np.full(count, "d0"),
        camera=np.array([path.split("/")[1] for path in paths]),
        timestamp_us=np.arange(count),
        path=np.array(paths),
        file_bytes=np.zeros(count, np.int64),
        width_px=np.full(count, WIDTH_PX, np.int32),
        height_px=np.full(count, HEIGHT_PX, np.int32),
        intrinsics=np.tile(np.eye(3), (count, 1, 1)),
        world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
        is_keyframe=np.array([False, True, False, True, False, False, False]),
    )
    root = str(tmp_path / "data")
    return Drive("d0", "scene-1", "town", root, "v1.0-mini", "2020-01-01", count, 0, count), frames


@pytest.fixture
def space(drive, extractor):
    return fit_space(SpaceImages([drive]), extractor, SETTINGS)


def write_mask(drive, row: int, labels: np.ndarray) -> None:
    file = Path(drive[0].root) / mask_path(str(drive[1].path[row]))
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), labels)


def codes(items) -> list[str]:
    return [item.code for _, item in items if isinstance(item, Reject)]


def layers_of(items, row: int) -> FrameLayers:
    return dict(items)[row]


def test_every_frame_gives_labels_and_features_in_order(drive, extractor, space):
    items = list(extract_drive(*drive, space, extractor, SETTINGS))
    assert [row for row, _ in items] == list(range(7))
    assert all(layers.features.shape == (8, 12, 4) and layers.labels.shape == (8, 12) for _, layers in items)


def test_features_do_not_depend_on_the_batch(drive, extractor, space):
    batched = list(extract_drive(*drive, space, extractor, SETTINGS))
    single = FeatureExtractor(extractor.segmentation_card, extractor.feature_card, threads=2)
    single.__dict__["features"] = Network(extractor.feature_card)
    single.features.batch_size = 1
    for (row, one), (other_row, other) in zip(batched, extract_drive(*drive, space, single, SETTINGS), strict=True):
        assert row == other_row
        assert np.abs(one.features.astype(int) - other.features).max() <= 1  # a last bit may round the other way


def test_a_broken_image_costs_one_reject(drive, extractor, space):
    file = Path(drive[0].root) / str(drive[1].path[2])
    file.write_bytes(file.read_bytes()[:300])
    items = list(extract_drive(*drive, space, extractor, SETTINGS))
    reject = dict(items)[2]
    assert (reject.code, reject.file, reject.drive) == ("image-broken", str(file), "scene-1")
    assert codes(items) == ["image-broken"]


def test_a_missing_image_costs_one_reject(drive, extractor, space):
    (Path(drive[0].root) / str(drive[1].path[6])).unlink()
    items = list(extract_drive(*drive, space, extractor, SETTINGS))
    assert codes(items) == ["image-missing"]


def test_an_image_of_another_size_than_its_table_says_is_rejected(drive, extractor, space):
    frames = replace(drive[1], width_px=np.full(7, WIDTH_PX + 1, np.int32))
    items = list(extract_drive(drive[0], frames, space, extractor, SETTINGS))
    assert set(codes(items)) == {"image-size"}


def test_precomputed_masks_win_where_present_and_the_model_fills_the_rest(drive, extractor, space):
    mask = np.full((32, 48), 10, np.uint8)
    write_mask(drive, 3, mask)
    items = list(extract_drive(*drive, space, extractor, SETTINGS))
    by_model = list(extract_drive(*drive, space, extractor, SETTINGS.model_copy(update={"masks": "model"})))
    np.testing.assert_array_equal(layers_of(items, 3).labels, mask)
    for row in (2, 4):
        np.testing.assert_array_equal(layers_of(items, row).labels, layers_of(by_model, row).labels)


def test_the_model_is_used_where_masks_are_to_be_ignored(drive, extractor, space):
    write_mask(drive, 3, np.full((32, 48), 10, np.uint8))
    items = list(extract_drive(*drive, space, extractor, SETTINGS.model_copy(update={"masks": "model"})))
    assert layers_of(items, 3).labels.shape == (8, 12)


def test_precomputed_masks_need_no_segmentation_model(drive, extractor, space):
    for row in range(6):
        write_mask(drive, row, np.zeros((32, 48), np.uint8))
    bare = FeatureExtractor(None, extractor.feature_card)
    items = list(extract_drive(*drive, space, bare, SETTINGS.model_copy(update={"masks": "precomputed"})))
    assert codes(items) == ["mask-missing"]


@pytest.mark.parametrize(
    ("mask", "code"),
    [(np.full((4, 4), 34, np.uint8), "mask-labels"), (np.zeros((4, 4, 3), np.uint8), "mask-broken")],
)
def test_a_mask_that_holds_no_train_ids_is_rejected(drive, extractor, space, mask, code):
    write_mask(drive, 0, mask)
    row, first = next(extract_drive(*drive, space, extractor, SETTINGS))
    assert row == 0
    assert isinstance(first, Reject)
    assert first.code == code


def test_progress_reaches_the_end_and_tells_the_speed(drive, extractor, space):
    seen: list[Progress] = []
    list(extract_drive(*drive, space, extractor, SETTINGS, None, seen.append))
    assert (seen[-1].done, seen[-1].total) == (7, 7)
    assert seen[-1].figures["images/s"] > 0


def test_a_space_of_another_model_is_refused(drive, extractor, space):
    with pytest.raises(InputError, match="was fitted on model 000000000000"):
        extract_drive(*drive, replace(space, model_sha256="0" * 64), extractor, SETTINGS)


def test_the_space_is_fitted_on_one_keyframe_of_each_camera(drive):
    images = list(SpaceImages([drive]))
    root = Path(drive[0].root)
    expected = [cv2.imread(str(root / path)) for path in ("sweeps/CAM_BACK/0.jpg", "sweeps/CAM_FRONT/1.jpg")]
    assert len(images) == 2
    for image, bgr in zip(images, expected, strict=True):
        np.testing.assert_array_equal(image, bgr[..., ::-1])


def test_no_more_than_three_cameras_of_a_drive_are_used(drive):
    cameras = np.array([f"CAM_{i}" for i in range(7)])
    assert len(list(SpaceImages([(drive[0], replace(drive[1], camera=cameras))]))) == 3


def test_the_space_has_the_wanted_channels_or_the_models(drive, extractor):
    images = list(SpaceImages([drive]))
    assert fit_space(images, extractor, FeatureSettings(channels=3)).channel_count == 3
    assert fit_space(images, extractor, FeatureSettings(channels=64)).channel_count == 8


def test_the_same_images_give_the_same_space(drive, extractor, space):
    assert fit_space(SpaceImages([drive]), extractor, SETTINGS).space_id == space.space_id


def test_directions_are_orthonormal_sorted_by_variance_and_signed(space):
    np.testing.assert_allclose(space.components @ space.components.T, np.eye(4), atol=1e-5)
    assert np.all(np.diff(space.explained) <= 0)
    largest = np.abs(space.components).argmax(-1)
    assert np.all(space.components[np.arange(4), largest] > 0)


def test_the_space_equals_a_plain_decomposition_of_all_patches(drive, extractor):
    images = list(SpaceImages([drive]))
    space = fit_space(images, extractor, SETTINGS)
    raw = extractor.raw_features(images).reshape(-1, 8).astype(np.float64)
    values, vectors = np.linalg.eigh(np.cov(raw.T, bias=True))
    alignment = np.abs(np.sum(space.components * vectors[:, ::-1].T[:4], -1))
    np.testing.assert_allclose(alignment, 1, atol=1e-4)
    np.testing.assert_allclose(space.explained, values[::-1][:4] / values.sum(), rtol=1e-4)
    inside = (raw - space.mean) @ space.components.T
    assert np.mean((inside >= space.low) & (inside <= space.high)) == pytest.approx(0.98, abs=0.02)


def test_the_directions_do_not_depend_on_the_sample_and_its_ranges_hardly(drive, extractor, space):
    small = fit_space(SpaceImages([drive]), extractor, FeatureSettings(channels=4, sample_patches=50))
    np.testing.assert_array_equal(small.components, space.components)
    assert 0 < np.abs(small.high - space.high).max() < 0.5 * (space.high - space.low).max()


def test_channels_without_variance_stay_dark(drive, extractor):
    grey = np.full((HEIGHT_PX, WIDTH_PX, 3), 128, np.uint8)
    space = fit_space([grey], extractor, SETTINGS)
    assert space.encode(extractor.raw_features([grey])).max() == 0


def test_no_images_give_no_space(extractor):
    with pytest.raises(InputError, match="no image"):
        fit_space([], extractor, SETTINGS)


def test_only_the_wanted_rows_are_extracted(drive, extractor, space):
    some = list(extract_drive(*drive, space, extractor, SETTINGS, np.array([1, 4, 6])))
    everything = dict(extract_drive(*drive, space, extractor, SETTINGS))
    assert [row for row, _ in some] == [1, 4, 6]
    for row, layers in some:
        assert np.abs(layers.features.astype(int) - everything[row].features).max() <= 1


def test_every_step_tells_how_busy_it_was(drive, extractor, space):
    seen: list[Progress] = []
    list(extract_drive(*drive, space, extractor, SETTINGS, None, seen.append))
    figures = seen[-1].figures
    assert figures.keys() == {"images/s", "read", "prepare", "networks", "project", "store"}
    assert all(0 <= figures[name] <= 1.01 for name in figures.keys() - {"images/s"})


def test_pictures_show_the_three_strongest_directions(space):
    features = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    np.testing.assert_array_equal(space.picture(features), features[..., :3])


def test_parked_cars_are_kept_where_the_setting_says_so(drive, extractor, space, monkeypatch):
    mask = np.full((32, 48), 13, np.uint8)
    write_mask(drive, 3, mask)
    seen = []

    def everything_stands(labels, now, other):
        seen.append((now.rgb.shape, other.camera.width_px))
        return labels == 13

    monkeypatch.setattr("stages.features.standing_vehicles", everything_stands)
    keep = SETTINGS.model_copy(update={"parked_cars": "keep"})
    assert (layers_of(extract_drive(*drive, space, extractor, keep), 3).labels == 255).all()
    assert seen[3] == (
        (HEIGHT_PX // 2, WIDTH_PX // 2, 3),
        WIDTH_PX // 2,
    )  # decoded at half size, and its camera with it
    np.testing.assert_array_equal(layers_of(extract_drive(*drive, space, extractor, SETTINGS), 3).labels, mask)
