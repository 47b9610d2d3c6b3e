"""Exporting a local Hugging Face checkpoint as ONNX with its model card.

A checkpoint is untrusted: only its configuration and its weights are read, never code that comes with it.
"""

import hashlib
import json
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from presight_core import classes
from presight_core.config import validate
from presight_core.errors import InputError, MissingDependencyError, SettingsError
from presight_core.model_card import ModelCard
from stages.networks import Network

Family = Literal["segformer", "dino"]
FEATURE_MODELS = ("vit", "dinov2", "dinov2_with_registers", "dinov3_vit")
SEGFORMER_STRIDE = 4  # its decoder works at a quarter of the input
LARGEST_DIFFERENCE = 1e-4  # between torch and ONNX Runtime, of the output's largest value
RESAMPLING = {2: "bilinear", 3: "bicubic"}  # Pillow's numbers, which processors' configurations hold
RESCALE = 1 / 255
CHECKED_IMAGES = 2  # the export is traced with one size of batch and checked with another


@dataclass(frozen=True)
class ExportOptions:
    """What is not in a checkpoint: the input's size, and for DINO what to take from it."""

    height_px: int = 576  # the paper's input; the released code resizes 1600 x 900 to it
    width_px: int = 1024
    output: Literal["keys", "tokens"] = (
        "keys"  # of the last layer: what its attention looks for (released code), or its result
    )
    licence: str = "see the checkpoint's page"
    source: str = ""


def export_model(family: Family, checkpoint: Path, out: Path, options: ExportOptions) -> ModelCard:
    """Write `out` (ONNX) and its card beside it (TOML), checked against torch; returns the card.

    Raises InputError for a checkpoint that is none, or of another class, and where ONNX Runtime and torch disagree;
    MissingDependencyError without transformers.
    """
    config, processor = _read_json(checkpoint / "config.json"), _read_json(checkpoint / "preprocessor_config.json")
    builder = {"segformer": _segformer, "dino": _dino}[family]
    wrapped, values = builder(checkpoint, config, options)
    card = {
        "name": out.stem,
        "file": out.name,
        "input": "image",
        "input_height_px": options.height_px,
        "input_width_px": options.width_px,
        **_preprocessing(processor, checkpoint),
        **values,
        "licence": options.licence,
        "source": options.source or str(config.get("_name_or_path") or checkpoint.name),
        "note": f"{type(wrapped.model).__name__} of {checkpoint.name}, exported by presight models export",
    }
    _refuse_odd_size(card, checkpoint)
    out.parent.mkdir(parents=True, exist_ok=True)
    content = _onnx(wrapped, card)
    out.write_bytes(content)
    card["sha256"] = hashlib.sha256(content).hexdigest()
    _write_card(out.with_suffix(".toml"), card)
    loaded = validate(ModelCard, {**card, "file": out}, str(out.with_suffix(".toml")))
    _compare(wrapped, loaded)
    return loaded


class _Wrapped(nn.Module):
    """A model of one input and one output."""

    def __init__(self, model: nn.Module, run: Callable[[nn.Module, Tensor], Tensor]):
        super().__init__()
        self.model, self._run = model, run

    def forward(self, image: Tensor) -> Tensor:
        return self._run(self.model, image)


def _segformer(checkpoint: Path, config: dict[str, Any], _: ExportOptions) -> tuple[_Wrapped, dict[str, Any]]:
    """Logits of the 19 Cityscapes classes. Raises InputError for other classes."""
    from_pretrained = _class("SegformerForSemanticSegmentation", config, ("segformer",), checkpoint)
    model = from_pretrained(checkpoint)
    names = [str(model.config.id2label[index]) for index in range(model.config.num_labels)]
    is_nameless = all(name == f"LABEL_{index}" for index, name in enumerate(names))
    if len(names) != len(classes.CITYSCAPES) or not (is_nameless or tuple(names) == classes.CITYSCAPES):
        raise InputError(
            f"{checkpoint}: its {len(names)} classes ({', '.join(names[:4])}, ...) are not the 19 of Cityscapes; "
            "take a checkpoint that was finetuned on Cityscapes"
        )
    values = {"kind": "segmentation", "output": "logits", "layout": "NCHW", "stride": SEGFORMER_STRIDE}
    return _Wrapped(model.eval(), lambda model, image: model(image).logits), {**values, "channels": len(names)}


def _dino(checkpoint: Path, config: dict[str, Any], options: ExportOptions) -> tuple[_Wrapped, dict[str, Any]]:
    """Keys or tokens of the last layer for every patch, without class and register tokens."""
    names = {"vit": "ViTModel", "dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"}
    kind = names.get(str(config.get("model_type")), "DINOv3ViTModel")
    from_pretrained = _class(kind, config, FEATURE_MODELS, checkpoint)
    model = from_pretrained(checkpoint, **({"add_pooling_layer": False} if kind == "ViTModel" else {}))
    stride = int(model.config.patch_size)
    count = (options.height_px // stride) * (options.width_px // stride)
    arguments = {"interpolate_pos_encoding": True} if kind == "ViTModel" else {}

    def run(model: nn.Module, image: Tensor) -> Tensor:
        if options.output == "tokens":
            return model(image, **arguments).last_hidden_state[:, -count:]
        with _captured(_last_key(model)) as keys:
            model(image, **arguments)
        return keys[0][:, -count:]

    values = {"kind": "features", "output": options.output, "layout": "NTD", "stride": stride}
    return _Wrapped(model.eval(), run), {**values, "channels": int(model.config.hidden_size)}


def _class(name: str, config: dict[str, Any], allowed: tuple[str, ...], checkpoint: Path) -> Callable[..., Any]:
    """The `from_pretrained` of a class of transformers, for local files only."""
    found = config.get("model_type")
    if found not in allowed:
        raise InputError(
            f"{checkpoint}: the model type is {found!r}, not {' or '.join(allowed)}; take another checkpoint"
        )
    try:
        import transformers
    except ModuleNotFoundError as error:
        raise MissingDependencyError("exporting needs transformers: pip install '.[export]'") from error
    if not hasattr(transformers, name):
        raise MissingDependencyError(f"transformers {transformers.__version__} has no {name}; install a newer one")
    model = getattr(transformers, name)

    def from_pretrained(folder: Path, **arguments: Any) -> Any:
        try:
            return model.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False, dtype=torch.float32, **arguments
            )
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{folder}: transformers cannot load it ({error}); download it again") from error

    return from_pretrained


def _last_key(model: nn.Module) -> nn.Module:
    """The linear layer that makes the keys of the last attention."""
    found = [module for name, module in model.named_modules() if name.rsplit(".", 1)[-1] in ("k_proj", "key")]
    if not found:
        raise InputError(f"{type(model).__name__}: no layer makes keys; export tokens with --output tokens")
    return found[-1]


@contextmanager
def _captured(module: nn.Module) -> Iterator[list[Tensor]]:
    """What the module gives while the block runs."""
    outputs: list[Tensor] = []

    def keep(_module: nn.Module, _inputs: Any, output: Any) -> None:
        outputs.append(output)

    hook = module.register_forward_hook(keep)
    try:
        yield outputs
    finally:
        hook.remove()


def _preprocessing(processor: dict[str, Any], checkpoint: Path) -> dict[str, Any]:
    """How the checkpoint's own image processor makes its input, as far as a card can say it."""
    try:
        mean, std = [float(value) for value in processor["image_mean"]], [float(v) for v in processor["image_std"]]
        resample = RESAMPLING[int(processor["resample"])]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{checkpoint}: preprocessor_config.json lacks image_mean, image_std or a resample of "
            f"{' or '.join(map(str, RESAMPLING))} ({error!r}); download that file again"
        ) from error
    if abs(float(processor.get("rescale_factor", RESCALE)) - RESCALE) > 1e-9:
        raise InputError(f"{checkpoint}: pixels are scaled by {processor['rescale_factor']}, not by 1/255")
    return {"mean": mean, "std": std, "resample": resample}


def _refuse_odd_size(card: dict[str, Any], checkpoint: Path) -> None:
    stride = card["stride"]
    if card["input_height_px"] % stride or card["input_width_px"] % stride:
        height, width = (round(card[f"input_{side}_px"] / stride) * stride for side in ("height", "width"))
        raise SettingsError(
            f"{checkpoint}: {card['input_height_px']}x{card['input_width_px']} px is no whole number of patches of "
            f"{stride} px; use --size {height}x{width}"
        )


def _onnx(wrapped: _Wrapped, card: dict[str, Any]) -> bytes:
    """The model as one ONNX file, any number of images at a time."""
    try:
        import onnxscript  # noqa: F401 - torch's exporter needs it
    except ModuleNotFoundError as error:
        raise MissingDependencyError("exporting needs onnxscript: pip install '.[export]'") from error
    example = torch.zeros(CHECKED_IMAGES, 3, card["input_height_px"], card["input_width_px"])
    with warnings.catch_warnings(), _quiet("torch.onnx"):
        warnings.simplefilter("ignore")  # the exporter's, about its own insides
        program = torch.onnx.export(
            wrapped,
            (example,),
            input_names=[card["input"]],
            output_names=[card["output"]],
            dynamo=True,
            dynamic_shapes=({0: torch.export.Dim("images")},),
            verbose=False,
        )
    assert program is not None
    return program.model_proto.SerializeToString()


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _compare(wrapped: _Wrapped, card: ModelCard) -> None:
    """Raise InputError unless ONNX Runtime gives what torch gives."""
    shape = (1, 3, card.input_height_px, card.input_width_px)
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    with torch.no_grad():
        expected = wrapped(torch.from_numpy(values)).numpy()
    expected = (
        expected.transpose(0, 2, 3, 1) if card.layout == "NCHW" else expected.reshape(1, card.rows, card.columns, -1)
    )
    difference = np.abs(Network(card).infer(values) - expected).max() / max(np.abs(expected).max(), 1e-9)
    if not difference <= LARGEST_DIFFERENCE:
        raise InputError(f"{card.file}: ONNX Runtime and torch differ by {difference:.1e}; update torch and onnxscript")


def _read_json(file: Path) -> dict[str, Any]:
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read ({error}); download the whole checkpoint into this folder") from error
    if not isinstance(value, dict):
        raise InputError(f"{file}: holds no JSON object; download it again")
    return value


def _write_card(file: Path, card: dict[str, Any]) -> None:
    file.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in card.items()), encoding="utf-8")
