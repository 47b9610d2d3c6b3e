"""Networks: what ONNX Runtime may run, and that it runs what the card says."""

import hashlib

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from presight_core.errors import InputError
from presight_core.model_card import ModelCard
from stages.networks import FeatureExtractor, Network, prepare

IMAGE = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)


def card_at(path, kind="features"):
    return ModelCard.load(str(path), kind)


def convolved(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    """The plain twin: patches (8, 12, 48) of the prepared image (3, 32, 48) times the weights."""
    weight = numpy_helper.to_array(model.graph.initializer[0]).reshape(-1, 48)
    patches = image.reshape(3, 8, 4, 12, 4).transpose(1, 3, 0, 2, 4).reshape(8, 12, 48)
    return patches @ weight.T


@pytest.mark.parametrize("layout", ["NCHW", "NTD"])
def test_the_output_is_a_grid_of_patches_in_both_layouts(write_model, layout):
    card = card_at(write_model(layout=layout))
    model = onnx.load(card.file)
    out = Network(card).run([IMAGE])
    np.testing.assert_allclose(out[0], convolved(model, prepare([IMAGE], card)[0]), atol=1e-5)


def test_an_image_is_the_same_alone_and_in_a_batch(write_model):
    network = Network(card_at(write_model()))
    network.batch_size = 2
    images = [IMAGE, IMAGE[::-1].copy(), IMAGE[:, ::-1].copy()]
    together = network.run(images)
    alone = np.concatenate([network.run([image]) for image in images])
    np.testing.assert_allclose(together, alone, atol=1e-6)


def test_prepared_images_have_the_cards_mean_taken_away(write_model):
    card = card_at(write_model())
    grey = np.full((64, 96, 3), 255, np.uint8)
    expected = (1 - np.array(card.mean)) / np.array(card.std)
    np.testing.assert_allclose(prepare([grey], card)[0, :, 5, 5], expected, rtol=1e-5)


def test_red_comes_first(write_model):
    card = card_at(write_model(mean=[0.0, 0.0, 0.0], std=[1.0, 1.0, 1.0]))
    red = np.zeros((32, 48, 3), np.uint8)
    red[..., 0] = 255
    assert prepare([red], card)[0].max((1, 2)).tolist() == pytest.approx([1, 0, 0])


def test_labels_are_the_strongest_logits(write_model):
    segmentation = card_at(write_model("segmentation", channels=19), "segmentation")
    extractor = FeatureExtractor(segmentation, card_at(write_model()))
    labels = extractor.labels([IMAGE])
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, Network(segmentation).run([IMAGE]).argmax(-1))


def test_weights_in_another_file_are_refused(write_model, tmp_path):
    model = onnx.load(card_at(write_model()).file)
    onnx.save(model, tmp_path / "split.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    card = card_at(write_model(content=(tmp_path / "split.onnx").read_bytes()))
    with pytest.raises(InputError, match="'weight' is kept in another file"):
        Network(card)


def test_weights_of_a_sub_graph_in_another_file_are_refused(write_model):
    model = onnx.load(card_at(write_model()).file)
    inner = onnx.GraphProto(name="inner")
    inner.initializer.add(name="hidden", data_location=onnx.TensorProto.EXTERNAL)
    model.graph.node.add(op_type="If").attribute.add(name="then_branch", type=onnx.AttributeProto.GRAPH, g=inner)
    with pytest.raises(InputError, match="'hidden' is kept in another file"):
        Network(card_at(write_model(content=model.SerializeToString())))


def test_weights_in_a_file_that_the_card_lists_are_read(write_model, tmp_path):
    model = onnx.load(card_at(write_model()).file)
    expected = Network(card_at(write_model())).run([IMAGE])
    onnx.save(model, tmp_path / "split.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    digest = hashlib.sha256((tmp_path / "weights.bin").read_bytes()).hexdigest()
    path = write_model(content=(tmp_path / "split.onnx").read_bytes())
    path.write_text(path.read_text() + f'\nexternal_data = {{"weights.bin" = "{digest}"}}\n')
    np.testing.assert_array_equal(Network(card_at(path)).run([IMAGE]), expected)
    (tmp_path / "weights.bin").write_bytes(bytes(len((tmp_path / "weights.bin").read_bytes())))
    with pytest.raises(InputError, match=r"weights\.bin: SHA-256 is"):
        card_at(path)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"op_type": "Loop"}, "Loop"),
        ({"op_type": "RandomUniform"}, "RandomUniform"),
        ({"domain": "evil"}, "evil.Identity"),
    ],
)
def test_operators_that_could_do_anything_are_refused(write_model, change, name):
    model = onnx.load(card_at(write_model()).file)
    for field, value in change.items():
        setattr(model.graph.node[-1], field, value)
    with pytest.raises(InputError, match=f"operator {name} is refused"):
        Network(card_at(write_model(content=model.SerializeToString())))


def test_a_file_that_is_no_model_is_refused(write_model):
    with pytest.raises(InputError, match=r"not an ONNX model|refuses the model"):
        Network(card_at(write_model(content=b"\xff\xff\xff\xff")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"input": "picture"}, "inputs are \\['image'\\], the card says 'picture'"),
        ({"output": "logits"}, "outputs are \\['out'\\], the card says 'logits'"),
        ({"input_width_px": 64}, "input 'image' is tensor\\(float\\)"),
        ({"stride": 2}, "output 'out' is tensor\\(float\\)"),
        ({"channels": 6}, "output 'out' is tensor\\(float\\)"),
        ({"layout": "NTD"}, "output 'out' is tensor\\(float\\)"),
    ],
)
def test_a_card_that_disagrees_with_its_model_is_refused(write_model, changes, message):
    model = card_at(write_model()).read_model()
    card = card_at(write_model(content=model, **changes))
    with pytest.raises(InputError, match=message):
        Network(card)


def test_an_output_that_is_not_finite_is_refused(write_model):
    model = onnx.load(card_at(write_model()).file)
    weight = numpy_helper.to_array(model.graph.initializer[0]).copy()
    weight[0, 0, 0, 0] = np.nan
    model.graph.initializer[0].CopyFrom(numpy_helper.from_array(weight, "weight"))
    network = Network(card_at(write_model(content=model.SerializeToString())))
    with pytest.raises(InputError, match="NaN"):
        network.run([IMAGE])
