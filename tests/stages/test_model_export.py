"""Export: ONNX Runtime gives what the checkpoint gives in torch, and our input is what its processor makes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from presight_core.errors import InputError, SettingsError
from presight_core.model_card import ModelCard
from stages.model_export import ExportOptions, export_model
from stages.networks import Network, prepare

transformers = pytest.importorskip("transformers", reason="the extra `export` is not installed")
pytest.importorskip("onnxscript", reason="the extra `export` is not installed")

SMALL = {"hidden_size": 24, "num_hidden_layers": 2, "num_attention_heads": 3}
IMAGES = [np.random.default_rng(seed).integers(0, 256, (90, 160, 3), np.uint8) for seed in range(3)]
SEGFORMER = {
    "depths": [1, 1, 1, 1],
    "hidden_sizes": [8, 8, 16, 16],
    "num_attention_heads": [1, 1, 2, 2],
    "decoder_hidden_size": 16,
    "num_labels": 19,
}


def models() -> dict:
    """A small model of each class with random weights, and its patch size."""
    torch.manual_seed(0)
    t, mlp = transformers, {"intermediate_size": 48}
    return {
        "vit8": (t.ViTModel(t.ViTConfig(**SMALL, **mlp, patch_size=8, image_size=32), add_pooling_layer=False), 8),
        "vit16": (t.ViTModel(t.ViTConfig(**SMALL, **mlp, patch_size=16, image_size=32)), 16),
        "dinov2": (t.Dinov2Model(t.Dinov2Config(**SMALL, mlp_ratio=2, patch_size=14, image_size=42)), 14),
        "dinov3": (t.DINOv3ViTModel(t.DINOv3ViTConfig(**SMALL, **mlp, patch_size=16, num_register_tokens=2)), 16),
    }


def saved(model, folder: Path, processor: dict | None = None) -> Path:
    model.eval().save_pretrained(folder)
    values = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225], "resample": 2}
    (folder / "preprocessor_config.json").write_text(json.dumps(values | (processor or {})))
    return folder


def keys_of(model, values: torch.Tensor) -> np.ndarray:
    """Keys of the last layer, from the attention's input: what the released code takes from DINO."""
    layers = (
        model.layers if hasattr(model, "layers") else getattr(model, "encoder", getattr(model, "model", None)).layer
    )
    inputs = []
    attention = layers[-1].attention
    attention.register_forward_pre_hook(lambda _m, args, kwargs: inputs.append((args, kwargs)), with_kwargs=True)
    with torch.no_grad():
        model(values, **({"interpolate_pos_encoding": True} if isinstance(model, transformers.ViTModel) else {}))
    (arguments, named), linear = (
        inputs[0],
        next(m for n, m in attention.named_modules() if n.endswith(("k_proj", "key"))),
    )
    hidden = arguments[0] if arguments else named["hidden_states"]
    return linear(hidden).detach().numpy()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vit8", "vit16", "dinov2", "dinov3"])
def test_keys_of_the_last_layer_are_those_of_torch(tmp_path, name):
    model, patch = models()[name]
    options = ExportOptions(4 * patch, 7 * patch)
    card = export_model("dino", saved(model, tmp_path / name), tmp_path / "out" / "model.onnx", options)
    values = prepare(IMAGES, card)
    expected = keys_of(model, torch.from_numpy(values))[:, -28:].reshape(3, 4, 7, 24)
    np.testing.assert_allclose(Network(card).infer(values), expected, atol=1e-4)
    assert (card.stride, card.channels, card.output) == (patch, 24, "keys")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vit8", "dinov3"])
def test_tokens_are_those_of_torch(tmp_path, name):
    model, patch = models()[name]
    options = ExportOptions(4 * patch, 7 * patch, output="tokens")
    card = export_model("dino", saved(model, tmp_path / name), tmp_path / "model.onnx", options)
    values = prepare(IMAGES, card)
    arguments = {"interpolate_pos_encoding": True} if name == "vit8" else {}
    with torch.no_grad():
        expected = model(torch.from_numpy(values), **arguments).last_hidden_state[:, -28:].numpy()
    np.testing.assert_allclose(Network(card).infer(values), expected.reshape(3, 4, 7, 24), atol=1e-4)


@pytest.mark.slow
def test_segformer_gives_the_logits_of_torch_and_a_card_that_loads(tmp_path):
    torch.manual_seed(0)
    model = transformers.SegformerForSemanticSegmentation(transformers.SegformerConfig(**SEGFORMER))
    export_model("segformer", saved(model, tmp_path / "b0"), tmp_path / "b0.onnx", ExportOptions(64, 96, licence="MIT"))
    card = ModelCard.load(str(tmp_path / "b0.toml"), "segmentation")
    values = prepare(IMAGES, card)
    with torch.no_grad():
        expected = model(torch.from_numpy(values)).logits.permute(0, 2, 3, 1).numpy()
    np.testing.assert_allclose(Network(card).infer(values), expected, atol=1e-4)
    assert (card.licence, card.source, card.stride) == ("MIT", "b0", 4)


@pytest.mark.parametrize(
    ("processor", "resample", "code"),
    [
        ("SegformerImageProcessorPil", "bilinear", 2),
        ("ViTImageProcessorPil", "bilinear", 2),
        ("BitImageProcessorPil", "bicubic", 3),
    ],
)
def test_our_input_is_what_the_image_processor_makes(write_model, processor, resample, code):
    path = write_model(resample=resample, mean=[0.485, 0.456, 0.406], std=[0.229, 0.224, 0.225])
    card = ModelCard.load(str(path), "features")
    size = {"height": card.input_height_px, "width": card.input_width_px}
    theirs = getattr(transformers, processor)(
        size=size, resample=code, do_center_crop=False, do_rescale=True, do_normalize=True,
        image_mean=list(card.mean), image_std=list(card.std),
    )  # fmt: skip
    expected = theirs(images=[Image.fromarray(image) for image in IMAGES], return_tensors="np")["pixel_values"]
    np.testing.assert_allclose(prepare(IMAGES, card), expected, atol=1e-5)


def test_other_classes_than_those_of_cityscapes_are_refused(tmp_path):
    config = transformers.SegformerConfig(**SEGFORMER, id2label={i: f"thing {i}" for i in range(19)})
    folder = saved(transformers.SegformerForSemanticSegmentation(config), tmp_path / "ade")
    with pytest.raises(InputError, match="not the 19 of Cityscapes"):
        export_model("segformer", folder, tmp_path / "x.onnx", ExportOptions(64, 96))


def test_a_checkpoint_of_another_kind_is_refused(tmp_path):
    folder = saved(models()["vit8"][0], tmp_path / "vit")
    with pytest.raises(InputError, match="model type is 'vit', not segformer"):
        export_model("segformer", folder, tmp_path / "x.onnx", ExportOptions())


def test_a_folder_without_a_checkpoint_is_refused(tmp_path):
    with pytest.raises(InputError, match="download the whole checkpoint"):
        export_model("dino", tmp_path, tmp_path / "x.onnx", ExportOptions())


def test_a_size_that_is_no_whole_number_of_patches_names_the_nearest(tmp_path):
    folder = saved(models()["dinov2"][0], tmp_path / "dinov2")
    with pytest.raises(SettingsError, match="use --size 574x1022"):
        export_model("dino", folder, tmp_path / "x.onnx", ExportOptions())


def test_a_processor_that_a_card_cannot_describe_is_refused(tmp_path):
    folder = saved(models()["vit8"][0], tmp_path / "vit", {"resample": 1})
    with pytest.raises(InputError, match="a resample of 2 or 3"):
        export_model("dino", folder, tmp_path / "x.onnx", ExportOptions(32, 32))
