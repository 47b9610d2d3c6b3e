"""Fixtures of the stage tests: very small networks with cards, made with onnx.helper."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

HEIGHT_PX, WIDTH_PX, STRIDE = 32, 48, 4


def patch_model(channels: int, layout: str, seed: int = 0):
    """An ONNX model: one convolution over patches of 4 x 4 pixels with random weights."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weight = np.random.default_rng(seed).normal(0, 0.3, (channels, 3, STRIDE, STRIDE)).astype(np.float32)
    nodes = [helper.make_node("Conv", ["image", "weight"], ["grid"], kernel_shape=[4, 4], strides=[4, 4])]
    shape = ["N", channels, HEIGHT_PX // STRIDE, WIDTH_PX // STRIDE]
    constants = [numpy_helper.from_array(weight, "weight")]
    if layout == "NTD":
        tokens = HEIGHT_PX * WIDTH_PX // STRIDE**2
        constants.append(numpy_helper.from_array(np.array([0, channels, tokens]), "token_shape"))
        nodes.append(helper.make_node("Reshape", ["grid", "token_shape"], ["flat"]))
        nodes.append(helper.make_node("Transpose", ["flat"], ["out"], perm=[0, 2, 1]))
        shape = ["N", tokens, channels]
    else:
        nodes.append(helper.make_node("Identity", ["grid"], ["out"]))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["N", 3, HEIGHT_PX, WIDTH_PX])
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "patches", [image], [out], constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=onnx.IR_VERSION_2023_5_5)


@pytest.fixture
def write_model(tmp_path: Path) -> Callable[..., Path]:
    """write_model(kind, channels=..., layout=..., content=..., **card values) -> path of the card."""

    def write(kind: str = "features", channels: int = 8, layout: str = "NCHW", content: bytes = b"", **changes) -> Path:
        content = content or patch_model(channels, layout).SerializeToString()
        (tmp_path / f"{kind}.onnx").write_bytes(content)
        card = {"name": "patches", "kind": kind, "file": f"{kind}.onnx", "input": "image", "output": "out"}
        card |= {"input_height_px": HEIGHT_PX, "input_width_px": WIDTH_PX, "layout": layout, "stride": STRIDE}
        card |= {"mean": [0.4, 0.5, 0.6], "std": [0.2, 0.25, 0.3], "channels": channels}
        card |= {"sha256": hashlib.sha256(content).hexdigest(), "licence": "Apache-2.0", "source": "made by the tests"}
        path = tmp_path / f"{kind}.toml"
        path.write_text("\n".join(f"{name} = {json.dumps(value)}" for name, value in (card | changes).items()))
        return path

    return write
