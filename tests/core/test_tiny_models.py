"""The shipped networks: their cards, their size, and what they can do."""

import hashlib
import importlib
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import onnxruntime
import pytest
import torch

from presight_core.classes import CITYSCAPES
from presight_core.model_card import MODELS_FOLDER, ModelCard
from presight_core.synthetic.lighting import KINDS

REPOSITORY = Path(__file__).resolve().parents[2]
MODELS = ("segmentation", "features")
SIZE_LIMIT = 2_500_000  # bytes; the pair travels in the wheel


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the scripts of tools/ importable, as they are to each other."""
    monkeypatch.syspath_prepend(str(REPOSITORY / "tools"))


def module(name: str) -> ModuleType:
    return importlib.import_module(name)


def card_of(kind: str) -> dict:
    return tomllib.loads((MODELS_FOLDER / "tiny" / f"{kind}.toml").read_text(encoding="utf-8"))


def session_of(file: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])


def shipped_session(kind: str) -> onnxruntime.InferenceSession:
    return session_of(MODELS_FOLDER / "tiny" / f"{kind}.onnx")


def run(session: onnxruntime.InferenceSession, batch: np.ndarray) -> np.ndarray:
    return np.asarray(session.run(None, {"image": batch})[0])


def images(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(0, 1, (count, 3, 224, 400)).astype(np.float32)


@pytest.mark.parametrize("kind", MODELS)
def test_a_card_names_its_file_by_digest(kind: str):
    content = (MODELS_FOLDER / "tiny" / card_of(kind)["file"]).read_bytes()
    assert hashlib.sha256(content).hexdigest() == card_of(kind)["sha256"]
    assert len(content) < SIZE_LIMIT


@pytest.mark.parametrize("kind", MODELS)
def test_a_card_says_what_the_model_is_not(kind: str):
    note = card_of(kind)["note"]
    assert "stand-in" in note
    assert "not DINO" in note


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("count", [1, 3])
def test_a_network_gives_the_grid_its_card_promises(kind: str, count: int):
    card = card_of(kind)
    session = shipped_session(kind)
    assert (session.get_inputs()[0].name, session.get_outputs()[0].name) == (card["input"], card["output"])
    rows, columns = card["input_height_px"] // card["stride"], card["input_width_px"] // card["stride"]
    assert run(session, images(count)).shape == (count, card["channels"], rows, columns)


def test_an_image_gives_the_same_logits_alone_as_in_a_batch():
    session = shipped_session("segmentation")
    together, alone = run(session, images(3)), run(session, images(3)[1:2])
    np.testing.assert_allclose(together[1:2], alone, atol=1e-4)


def test_features_are_bounded_and_many_directions_of_them_are_used():
    features = run(shipped_session("features"), images(2))
    assert np.abs(features).max() <= 1
    flat = features.transpose(0, 2, 3, 1).reshape(-1, features.shape[1])
    assert np.linalg.matrix_rank(flat - flat.mean(0)) >= 32


@pytest.mark.parametrize("kind", MODELS)
def test_an_exported_network_computes_what_torch_computes(tools: None, tmp_path: Path, kind: str):
    tiny_network = module("tiny_network")
    torch.manual_seed(0)
    network = tiny_network.TinyNetwork()
    with torch.no_grad():
        for _ in range(2):  # moves the batch statistics away from 0 and 1, which the export folds away
            network(torch.randn(2, 3, 64, 96) + 0.5)
    file = tmp_path / f"{kind}.onnx"
    tiny_network.export(network, kind, file)
    with torch.no_grad():
        expected = network.eval()(torch.from_numpy(images(2)))[MODELS.index(kind)].numpy()
    np.testing.assert_allclose(run(session_of(file), images(2)), expected, atol=1e-4)


def test_the_colour_model_says_what_is_in_a_patch_and_around_it():
    card = ModelCard.load("colours", "features")
    grey = np.zeros((1, 3, 224, 400), np.float32)
    grey[:, :, 104:112, 200:208] = np.arange(8) % 4 // 2  # a patch of upright stripes, two pixels wide
    seen = run(session_of(card.file), grey)[0]
    assert seen.shape == (card.channels, card.rows, card.columns)
    patch, empty = seen[:8, 13, 25], seen[:8, 0, 0]
    np.testing.assert_allclose(patch[:4], 0.5, atol=1e-3)  # mean red, green, blue; deviation of brightness
    assert patch[4] > 4 * patch[5]  # edges are met along x, and along y only where the patch ends
    np.testing.assert_allclose(empty, 0, atol=1e-6)
    np.testing.assert_allclose(seen[8, 12:15, 24:27], 0.5 / 9, atol=1e-3)  # the window around it has nine patches


def test_the_colour_model_is_what_its_script_writes(tools: None):
    colours = module("write_colour_model").ColourStatistics()
    with torch.no_grad():
        expected = colours(torch.from_numpy(images(2))).numpy()
    shipped = ModelCard.load("colours", "features").file
    np.testing.assert_allclose(run(session_of(shipped), images(2)), expected, atol=1e-4)


def test_a_crop_keeps_image_and_labels_together(tools: None):
    tiny_augment = module("tiny_augment")
    rng = np.random.default_rng(0)
    columns = np.linspace(0, 18, 400).round().astype(np.uint8)
    labels = np.tile(columns, (225, 1))
    rgb = np.repeat(labels[..., None] * np.uint8(10), 3, axis=2)
    for _ in range(20):
        crop, crop_labels = tiny_augment.random_crop(rgb, labels, (224, 192), rng)
        assert crop_labels.shape == (224, 192)
        known = crop_labels != 255
        assert known.mean() > 0.97  # all but a border
        differences = np.abs(crop[..., 0][known] / 10 - crop_labels[known])
        assert differences.max() <= 1  # edges are interpolated


def test_another_camera_stays_in_range_and_may_be_grey(tools: None):
    tiny_augment = module("tiny_augment")
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (24, 32, 3), np.uint8)
    pictures = [tiny_augment.another_camera(rgb, rng) for _ in range(40)]
    assert all(picture.min() >= 0 and picture.max() <= 1 for picture in pictures)
    assert any(np.ptp(picture, axis=2).max() < 1e-6 for picture in pictures)
    assert any(np.array_equal(picture, rgb.astype(np.float32) / 255) for picture in pictures)


def test_a_crop_shows_the_place_it_was_asked_for(tools: None):
    tiny_augment = module("tiny_augment")
    rng = np.random.default_rng(0)
    for _ in range(20):
        row, column = int(rng.integers(8, 217)), int(rng.integers(8, 392))
        labels = np.zeros((225, 400), np.uint8)
        labels[row - 4 : row + 5, column - 4 : column + 5] = 11
        rgb = np.zeros((225, 400, 3), np.uint8)
        _, crop_labels = tiny_augment.random_crop(rgb, labels, (112, 96), rng, focus=(row, column))
        assert (crop_labels == 11).any()


def test_a_finder_looks_at_rare_classes_where_they_are(tools: None):
    tiny_augment = module("tiny_augment")
    labels = np.zeros((5, 50, 100), np.uint8)
    labels[3, 20:30, 40:50] = 12
    finder = tiny_augment.Finder(labels, 1.0, np.random.default_rng(0))
    for image, focus in (finder.place() for _ in range(20)):
        assert labels[image][focus] == 12
    anywhere = tiny_augment.Finder(labels, 0.0, np.random.default_rng(0))
    assert {anywhere.place()[0] for _ in range(60)} == set(range(5))


def test_missed_overlap_is_none_for_the_truth_and_all_for_another_class(tools: None):
    tiny_losses = module("tiny_losses")
    truth = torch.tensor([[[0, 0, 1, 255]]])
    right = 50.0 * torch.nn.functional.one_hot(torch.tensor([[[0, 0, 1, 5]]]), 19)
    assert tiny_losses.missed_overlap(right, truth) < 1e-6
    assert tiny_losses.missed_overlap(right.roll(1, dims=-1), truth) > 1 - 0.2  # class 0's cells are called 1
    half = 50.0 * torch.nn.functional.one_hot(torch.tensor([[[0, 1, 1, 5]]]), 19)
    torch.testing.assert_close(tiny_losses.missed_overlap(half, truth), torch.tensor(0.5))


def test_rare_classes_weigh_more_but_pixels_weigh_one_on_average(tools: None):
    labels = np.zeros((1, 10, 10), np.uint8)
    labels[0, 0] = 11
    weights = module("tiny_losses").class_weights(labels, 0.5).numpy()
    assert weights[11] > weights[0]
    np.testing.assert_allclose(weights[labels].mean(), 1, rtol=1e-6)


def test_scores_of_a_perfect_prediction_are_one(tools: None):
    tiny_scores = module("tiny_scores")
    labels = np.repeat(np.repeat(np.arange(19, dtype=np.uint8)[None, :, None], 4, 1), 8, 2)
    perfect = tiny_scores.scores({"day": tiny_scores.confusion(labels[:, ::4, ::4], labels)}, 1.0)
    assert perfect.mean_iou == perfect.light_iou["day"] == 1
    assert len(perfect.class_iou) == len(CITYSCAPES)


def test_a_class_predicted_for_all_scores_its_share(tools: None):
    tiny_scores = module("tiny_scores")
    labels = np.zeros((1, 8, 8), np.uint8)
    labels[:, :2] = 10
    guess = tiny_scores.scores({"night": tiny_scores.confusion(np.zeros((1, 2, 2), np.uint8), labels)}, 0.0)
    assert guess.class_iou == {"road": 0.75, "sky": 0.0}
    assert guess.class_share == {"road": 0.75, "sky": 0.25}
    assert guess.pixel_accuracy == guess.constant_guess_accuracy == 0.75


def test_lights_are_scored_apart_and_together(tools: None):
    tiny_scores = module("tiny_scores")
    road, sky = np.zeros((1, 8, 8), np.uint8), np.full((1, 8, 8), 10, np.uint8)
    right, wrong = tiny_scores.confusion(road[:, ::4, ::4], road), tiny_scores.confusion(road[:, ::4, ::4], sky)
    both = tiny_scores.scores({"day": right, "night": wrong}, 0.0)
    assert both.light_iou == {"day": 1, "night": 0}
    assert both.class_iou == {"road": 0.5, "sky": 0.0}


def test_every_light_has_its_quarter_of_the_views(tools: None, monkeypatch: pytest.MonkeyPatch):
    tiny_views = module("tiny_views")
    asked = []

    def place(city: object, lights: list[str], rng: np.random.Generator) -> list[str]:
        asked.append(list(lights))
        return asked[-1]

    shot = SimpleNamespace(rgb=np.zeros((6, 1, 1, 3), np.uint8), labels=np.zeros((6, 1, 1), np.uint8))
    monkeypatch.setattr(tiny_views, "City", lambda *_: None)
    monkeypatch.setattr(tiny_views, "Renderer", lambda _: None)
    monkeypatch.setattr(tiny_views, "_shoot", lambda *_: shot)
    parts = list(tiny_views._rendered(8, 3, 0, 1, place))
    assert [len(lights) for lights in asked] == [3, 3, 2]
    assert [KINDS[part.lights[0]] for part in parts] == 2 * list(KINDS)


@pytest.mark.slow
def test_training_views_of_one_traffic_differ_in_place_and_light(tools: None):
    first, second = module("tiny_views").training_views(2, seed=0, threads=1)
    assert first.rgb.shape == second.rgb.shape == (6, 225, 400, 3)
    assert (first.lights[0], second.lights[0]) == (0, 1)
    assert (first.labels != second.labels).mean() > 0.2  # another view, not only another light


@pytest.mark.slow
def test_shipped_networks_know_streets_they_never_saw(tools: None):
    tiny_views, tiny_scores = module("tiny_views"), module("tiny_scores")
    card = card_of("segmentation")
    by_light, features, truth = {}, [], []
    for views in tiny_views.unseen_views(4, threads=2):
        labels = views.labels[:, :224]  # the network's size, less one row
        normalised = (views.rgb[:, :224] / 255 - card["mean"]) / card["std"]
        batch = normalised.transpose(0, 3, 1, 2).astype(np.float32)
        logits = run(shipped_session("segmentation"), batch)
        by_light[KINDS[views.lights[0]]] = tiny_scores.confusion(logits.argmax(1).astype(np.uint8), labels)
        features.append(run(shipped_session("features"), batch))
        truth.append(labels)
    neighbours = tiny_scores.neighbour_accuracy(
        np.concatenate(features), np.concatenate(truth), np.random.default_rng(0)
    )
    measured = tiny_scores.scores(by_light, neighbours)
    assert measured.pixel_accuracy > measured.constant_guess_accuracy + 0.3
    assert measured.mean_iou > 0.36  # measured in full: the card's note
    assert measured.light_iou["night"] > 0.24  # the pair of the city before nights had 0.10
    assert measured.neighbour_accuracy > measured.constant_guess_accuracy + 0.3
