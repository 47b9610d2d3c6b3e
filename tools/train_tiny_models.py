"""Train the tiny segmentation and feature networks that come with PreSight, and write them with their cards.

    python tools/train_tiny_models.py --out presight_core/models/tiny

Everything is drawn: the networks learn the classes of the procedural city from many small cities. They stand in
for SegFormer and DINO in the demo and in tests, and say so on their cards.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from shipped_model import INPUT_HEIGHT_PX, INPUT_WIDTH_PX, MEAN, STD, write_card
from tiny_augment import COARSE_CROP_PX, WHOLE_CROP_PX, Finder, another_camera, random_crop
from tiny_losses import class_weights, segmentation_loss
from tiny_network import (
    CLASS_COUNT,
    FEATURE_CHANNELS,
    FEATURE_STRIDE,
    LOGIT_STRIDE,
    TinyNetwork,
    export,
)
from tiny_scores import Scores, confusion, neighbour_accuracy, scores
from tiny_views import LabelledImages, training_views, unseen_views
from torch import Tensor

from presight_core.synthetic.lighting import KINDS

OUTPUTS = {  # name of the output, input pixels a cell, channels
    "segmentation": ("logits", LOGIT_STRIDE, CLASS_COUNT),
    "features": ("features", FEATURE_STRIDE, FEATURE_CHANNELS),
}


@dataclass(frozen=True)
class Course:
    """One rise and fall of the learning rate."""

    steps: int
    coarse_share: float  # of the steps, the first ones, see images at half scale: the same learned in half the time
    learning_rate: float  # at its highest
    class_weight_power: float  # 0: every pixel counts alike; 1: every class


@dataclass(frozen=True)
class Recipe:
    """One training; the defaults are the shipped pair's."""

    # The second course weighs rare classes more: after the first, poles and riders are hardly ever predicted.
    # The long last two are what quality costs: mIoU is 0.45 without them, 0.53 without the last.
    courses: tuple[Course, ...] = (
        Course(2400, 0.5, 5e-3, 0.25),
        Course(2200, 0.0, 4e-3, 0.4),
        Course(1500, 0.0, 3e-3, 0.3),
        Course(6500, 0.0, 4e-3, 0.35),
        Course(9000, 0.0, 4e-3, 0.35),
    )
    rigs: int = 360  # six images each
    unseen_rigs: int = 96  # with fewer, two night frames were all the buses there were
    batch_size: int = 4  # many small steps beat few large ones in a training of minutes
    rare_share: float = 0.5  # of the crops are taken around a class that fills little of the images
    overlap_loss_weight: float = 0.5  # this and the share above were set once, not tuned
    feature_loss_weight: float = 0.4
    seed: int = 0
    threads: int = 1

    @property
    def steps(self) -> int:
        return sum(course.steps for course in self.courses)


def train(views: LabelledImages, recipe: Recipe, report: Callable[[float], None]) -> TinyNetwork:
    """A network trained on labelled images; `report(loss)` is called at every step."""
    torch.manual_seed(recipe.seed)
    torch.set_num_threads(recipe.threads)
    network = TinyNetwork()
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] - torch's stubs do not know it
    for number in range(len(recipe.courses)):
        take_course(network, views, recipe, number, report)
    return network.eval()


def take_course(
    network: TinyNetwork, views: LabelledImages, recipe: Recipe, number: int, report: Callable[[float], None]
) -> None:
    """Train a network further, by one of the recipe's courses."""
    course, rng = recipe.courses[number], np.random.default_rng([recipe.seed, number])
    weights = class_weights(views.labels, course.class_weight_power)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=0.02, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, course.learning_rate, total_steps=course.steps, pct_start=0.15
    )
    for images, labels in _batches(views, recipe, course, rng):
        logits, features = network(images)
        loss = segmentation_loss(logits, labels, weights, rng, recipe.overlap_loss_weight)
        patches = network.feature_classifier(features)
        loss = loss + recipe.feature_loss_weight * segmentation_loss(patches, labels, weights, rng)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        report(loss.item())


def _batches(
    views: LabelledImages, recipe: Recipe, course: Course, rng: np.random.Generator
) -> Iterator[tuple[Tensor, Tensor]]:
    finder = Finder(views.labels, recipe.rare_share, rng)
    for step in range(course.steps):
        size_px = COARSE_CROP_PX if step < course.coarse_share * course.steps else WHOLE_CROP_PX
        places = [finder.place() for _ in range(recipe.batch_size)]
        crops = [random_crop(views.rgb[k], views.labels[k], size_px, rng, focus) for k, focus in places]
        images = np.stack([another_camera(rgb, rng) for rgb, _ in crops])
        labels = np.stack([labels for _, labels in crops]).astype(np.int64)
        yield _network_input(images), torch.from_numpy(labels)


def _network_input(images: NDArray[np.float32]) -> Tensor:
    """Normalised images (N, 3, H, W) of RGB (N, H, W, 3) in 0..1, laid out channels last, which is faster."""
    normalised = (images - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
    return torch.from_numpy(normalised).permute(0, 3, 1, 2)


def measure(network: TinyNetwork, views: LabelledImages) -> Scores:
    """Scores on images in the order of their cities."""
    size = INPUT_WIDTH_PX, INPUT_HEIGHT_PX
    labels = np.stack([cv2.resize(each, size, interpolation=cv2.INTER_NEAREST) for each in views.labels])
    by_light = {KINDS[k]: np.zeros((CLASS_COUNT, CLASS_COUNT), np.int64) for k in np.unique(views.lights)}
    features = []
    for rgb, truth, light in zip(views.rgb, labels, views.lights, strict=True):
        image = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        with torch.inference_mode():
            logits, feature = network(_network_input(image[None]))
        by_light[KINDS[light]] += confusion(logits.argmax(1)[0].numpy().astype(np.uint8), truth)
        features.append(feature[0].numpy())
    neighbours = neighbour_accuracy(np.stack(features), labels, np.random.default_rng(0))
    return scores(by_light, neighbours)


def write_models(network: TinyNetwork, note: str, folder: Path) -> None:
    """The ONNX pair and its cards."""
    for kind, (output, stride, channels) in OUTPUTS.items():
        file = folder / f"{kind}.onnx"
        export(network, kind, file)
        shape = {"output": output, "stride": stride, "channels": channels}
        source = "tools/train_tiny_models.py of PreSight"
        write_card(file, name=f"tiny-{kind}", kind=kind, **shape, source=source, note=note)


def card_note(measured: Scores, steps: int) -> str:
    """What the pair is, what it is not, and how good it is."""
    return (
        "A stand-in for the demo and for tests: a small U-Net supervised on the procedural city's own classes for "
        f"{steps} steps. It is not DINO or SegFormer; use such models for real drives, because on photographs this "
        f"one's labels are rough. {measured.summary()}"
    )


def rendered(parts: Iterator[LabelledImages], total: int, what: str, kept: Path | None) -> LabelledImages:
    """All views in one, with a line of progress; `kept` is a file that holds them from an earlier run, or will."""
    if kept and kept.is_file():
        with np.load(kept) as arrays:
            return LabelledImages(**arrays)
    started, views = time.process_time(), []
    for done, part in enumerate(parts, 1):
        views.append(part)
        print(f"\r{what}: {done} of {total} rigs, {time.process_time() - started:.0f} CPU s", end="", flush=True)
    print()
    columns = {name: np.concatenate([getattr(part, name) for part in views]) for name in ("rgb", "labels", "lights")}
    whole = LabelledImages(**columns)
    if kept:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez(kept, rgb=whole.rgb, labels=whole.labels, lights=whole.lights)
    return whole


class _Progress:
    """Prints the running mean of the loss now and then."""

    def __init__(self, steps: int):
        self._steps, self._started, self._step, self._mean = steps, time.process_time(), 0, 0.0

    def __call__(self, loss: float) -> None:
        self._step += 1
        keep = min(0.98, 1 - 1 / self._step)  # the mean of the last 50 steps or so
        self._mean = keep * self._mean + (1 - keep) * loss
        if self._step % 20 == 0 or self._step == self._steps:
            done = f"{self._step} of {self._steps}, loss {self._mean:.3f}"
            print(f"\rtraining: {done}, {time.process_time() - self._started:.0f} CPU s", end="", flush=True)
        if self._step == self._steps:
            print()


def main() -> None:
    parser = argparse.ArgumentParser(description="Train the tiny segmentation and feature networks.")
    parser.add_argument("--rigs", type=int, default=Recipe.rigs, help="places to render for training, six images each")
    parser.add_argument("--unseen-rigs", type=int, default=Recipe.unseen_rigs, help="places to render for measuring")
    parser.add_argument("--seed", type=int, default=Recipe.seed)
    parser.add_argument("--threads", type=int, default=Recipe.threads)
    parser.add_argument("--haste", type=int, default=1, help="take this many times fewer steps, for a trial")
    parser.add_argument("--out", type=Path, default=Path("presight_core/models/tiny"), help="folder of the models")
    parser.add_argument(
        "--views", type=Path, help="folder that keeps the views for other runs; empty it when the city changes"
    )
    arguments = vars(parser.parse_args())
    folder, kept, haste = (arguments.pop(name) for name in ("out", "views", "haste"))
    courses = tuple(replace(course, steps=max(course.steps // haste, 4)) for course in Recipe.courses)
    recipe = Recipe(courses, **arguments)
    views = rendered(
        training_views(recipe.rigs, recipe.seed, recipe.threads),
        recipe.rigs,
        "training views",
        kept and kept / f"training-{recipe.rigs}-{recipe.seed}.npz",
    )
    network = train(views, recipe, _Progress(recipe.steps))
    unseen = rendered(
        unseen_views(recipe.unseen_rigs, recipe.threads),
        recipe.unseen_rigs,
        "unseen views",
        kept and kept / f"unseen-{recipe.unseen_rigs}.npz",
    )
    measured = measure(network, unseen)
    print(measured.summary())
    print(f"Share of the pixels: {measured.frequencies()}")
    write_models(network, card_note(measured, recipe.steps), folder)


if __name__ == "__main__":
    main()
