"""What the feature stage's codes and steps cost.

    python bench/features.py code FOLDER... [--card tiny] [--size 576x1024]    # bytes and error of the compact tier
    python bench/features.py speed WORKSPACE DRIVE [--card tiny]                # images/s, busy share of each step

`code` takes up to 12 images of each folder (and its sub-folders), evenly spread, and fits the space on all of them;
`--size` runs the network at another input size than its card's. `speed` takes a drive of an ingested workspace.
"""

import argparse
import hashlib
import tempfile
import time
from pathlib import Path

import numpy as np

from presight_core import feature_codec
from presight_core.config import FeatureSettings
from presight_core.feature_space import FeatureSpace
from presight_core.model_card import ModelCard
from presight_core.progress import Progress
from stages.features import FeatureExtractor, extract_drive
from stages.space_fitting import SpaceImages, fit_space
from storage.features import FeatureCache
from storage.workspace import Workspace

IMAGES = 12  # of a folder


def main() -> None:
    """Measure one of the two."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    code = commands.add_parser("code")
    code.add_argument("folders", type=Path, nargs="+")
    code.add_argument("--size")
    speed = commands.add_parser("speed")
    speed.add_argument("workspace", type=Path)
    speed.add_argument("drive")
    for command in (code, speed):
        command.add_argument("--card", default="tiny")
    arguments = parser.parse_args()
    measure_code(arguments) if arguments.command == "code" else measure_speed(arguments)


def measure_code(arguments: argparse.Namespace) -> None:
    """A line a folder: size, errors, milliseconds."""
    with tempfile.TemporaryDirectory() as folder:
        card = ModelCard.load(arguments.card, "features")
        if arguments.size:
            card = _at_size(card, *map(int, arguments.size.split("x")), Path(folder))
        extractor = FeatureExtractor(None, card)
        images = {path: _images(path) for path in arguments.folders}
        space = fit_space([rgb for part in images.values() for rgb in part], extractor, FeatureSettings())
        for path, part in images.items():
            features = space.encode(np.concatenate([extractor.raw_features([rgb]) for rgb in part]))
            print(f"{path}: {len(part)} images of {features.shape[1:]},", _code_line(features, space), flush=True)


def _code_line(features: np.ndarray, space: FeatureSpace) -> str:
    weights = space.channel_weights
    feature_codec.decode(feature_codec.encode(features[0], weights))  # compiles
    started = time.perf_counter()
    codes = [feature_codec.encode(image, weights) for image in features]
    encoded = time.perf_counter()
    decoded = np.stack([feature_codec.decode(code) for code in codes])
    seconds = encoded - started, time.perf_counter() - encoded
    exact = features.astype(np.float32)
    mean, deviation = exact.mean((0, 1, 2)), exact.std((0, 1, 2))
    a, b, ranges = exact - mean, decoded - mean, space.high - space.low
    error = np.sqrt((((a - b) / deviation) ** 2).mean())
    kilobytes = np.mean([len(code) for code in codes]) / 1000
    milliseconds = "{:.0f} ms to encode, {:.0f} ms to decode".format(*(1000 * part / len(codes) for part in seconds))
    cosines = f"cosine {_cosine(a, b):.4f}, in the model's units {_cosine(a * ranges, b * ranges):.4f}"
    return f"{kilobytes:.1f} kB, {cosines}, error {error:.3f}; {milliseconds}"


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return float(np.median((a * b).sum(-1) / np.maximum(lengths, 1e-9)))


def _images(folder: Path) -> list[np.ndarray]:
    import cv2

    files = sorted(folder.rglob("*.jpg"))
    chosen = files[:: max(1, -(-len(files) // IMAGES))]
    return [cv2.imread(str(file))[..., ::-1] for file in chosen]


def _at_size(card: ModelCard, height_px: int, width_px: int, folder: Path) -> ModelCard:
    """The same fully convolutional network with another input size."""
    import onnx

    model = onnx.load_model_from_string(card.read_model())
    for dimension, size in zip(model.graph.input[0].type.tensor_type.shape.dim[2:], (height_px, width_px), strict=True):
        dimension.dim_value = size
    content, file = model.SerializeToString(), folder / "resized.onnx"
    file.write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    size = {"input_height_px": height_px, "input_width_px": width_px}
    return card.model_copy(update={**size, "file": file, "sha256": digest})


def measure_speed(arguments: argparse.Namespace) -> None:
    """Images a second and the busy share of each step, for both tiers."""
    workspace = Workspace.open(arguments.workspace)
    catalog, index = workspace.catalog(), workspace.drives()
    drives = (drive for city in catalog.cities() for drive in catalog.drives(city))
    drive = next(drive for drive in drives if drive.name == arguments.drive)
    frames = index.frames(drive.drive_id)
    settings = FeatureSettings(feature_model=arguments.card)
    extractor = FeatureExtractor.load(settings, threads=2)
    space = fit_space(SpaceImages([(drive, frames)]), extractor, settings)
    last: list[Progress] = []
    for tier, weights in (("exact", None), ("compact", space.channel_weights)):
        with tempfile.TemporaryDirectory() as folder:
            items = extract_drive(drive, frames, space, extractor, settings, None, last.append)
            started = time.perf_counter()
            FeatureCache(Path(folder)).write("bench", drive.drive_id, frames, items, weights)
            rate = len(frames) / (time.perf_counter() - started)
        shares = ", ".join(f"{name} {share:.2f}" for name, share in last[-1].figures.items() if name != "images/s")
        print(f"{tier}: {len(frames)} images, {rate:.1f} images/s; busy: {shares}", flush=True)


if __name__ == "__main__":
    main()
