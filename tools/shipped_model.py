"""How a network becomes one of the models that ship with PreSight: an ONNX file and its card."""

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import nn

INPUT_HEIGHT_PX, INPUT_WIDTH_PX = 224, 400  # 16:9 but for one row, and whole strides of 8
MEAN, STD = (0.45, 0.45, 0.45), (0.25, 0.25, 0.25)  # of street pictures, roughly
OPSET = 17  # the newest that torch's own exporter writes alone, and that every runtime since 2022 reads


def write_onnx(module: nn.Module, output: str, file: Path) -> None:
    """Write a network whose input `image` is (N, 3, 224, 400) and whose one output has this name; N is free."""
    example = torch.zeros(1, 3, INPUT_HEIGHT_PX, INPUT_WIDTH_PX)
    file.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # torch's newer exporter needs onnxscript, which nothing else here does.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.filterwarnings("ignore", message="Constant folding")  # of a padding's sizes; it folds them itself
        torch.onnx.export(
            module,
            (example,),
            str(file),
            input_names=["image"],
            output_names=[output],
            dynamic_axes={"image": {0: "images"}, output: {0: "images"}},
            opset_version=OPSET,
            dynamo=False,
        )
    onnx.checker.check_model(str(file), full_check=True)


def write_card(file: Path, **particular: Any) -> None:
    """The model card beside an ONNX file; `particular` is what `presight_core.model_card` asks for besides."""
    card = {
        "name": particular.pop("name"),
        "kind": particular.pop("kind"),
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "input": "image",
        "input_height_px": INPUT_HEIGHT_PX,
        "input_width_px": INPUT_WIDTH_PX,
        "mean": list(MEAN),
        "std": list(STD),
        "layout": "NCHW",
        "licence": "Apache-2.0",
        **particular,
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in card.items()]  # JSON's values are TOML's here
    file.with_suffix(".toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
