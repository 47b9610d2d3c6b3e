"""Running the segmentation and the feature network of two model cards with ONNX Runtime."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from presight_core.config import FeatureSettings
from presight_core.errors import InputError
from presight_core.images import resized
from presight_core.model_card import ModelCard

BATCH_PIXELS = 1 << 20  # input pixels a batch: 11 images of the tiny models, one of DINO; activations stay small
STANDARD_DOMAINS = ("", "ai.onnx")
REFUSED_OPERATORS = {"Loop", "Scan", "RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike"}
REFUSED_OPERATORS |= {"Bernoulli", "Multinomial"}
ERRORS_ONLY = 3  # ONNX Runtime's log level; its warnings are about graph optimisation


class Network:
    """One model card's network, ready to run. Safe to use from several threads."""

    def __init__(self, card: ModelCard, threads: int = 1):
        """Verify the model of `card` and open it on the GPU where ONNX Runtime has one, else on `threads` cores.

        Raises InputError if the file is not the card's, keeps data in files that the card does not list, uses
        operators that it may not, or takes or gives other arrays than the card says.
        """
        self.card = card
        content = card.read_model()
        refuse_what_no_hash_covers(content, card)
        self._session = _session(content, card, threads)
        _check_shape(card, "input", card.input, self._session.get_inputs(), (1, 3, *_input_size(card)))
        _check_shape(card, "output", card.output, self._session.get_outputs(), (1, *_output_shape(card)))
        batch = next(array.shape[0] for array in self._session.get_inputs() if array.name == card.input)
        pixels = card.input_height_px * card.input_width_px
        self.batch_size = 1 if isinstance(batch, int) else max(1, BATCH_PIXELS // pixels)

    def run(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The network's output (N, rows, columns, channels) for RGB images of any size."""
        return self.infer(self.prepare(images))

    def prepare(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The network's input (N, 3, H, W) for RGB images of any size."""
        return prepare(images, self.card)

    def infer(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """The network's output (N, rows, columns, channels) for its input."""
        parts = [self._infer_batch(values[i : i + self.batch_size]) for i in range(0, len(values), self.batch_size)]
        return np.concatenate(
            [np.zeros((0, self.card.rows, self.card.columns, self.card.channels), np.float32), *parts]
        )

    def _infer_batch(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        output: Any = self._session.run([self.card.output], {self.card.input: values})[0]
        expected = (len(values), *_output_shape(self.card))
        if output.shape != expected:
            raise InputError(f"{self.card.file}: output {output.shape}, the card says {expected}; correct the card")
        if not np.isfinite(output).all():
            raise InputError(f"{self.card.file}: the output holds NaN or infinity; export the model in float32")
        if self.card.layout == "NCHW":
            return output.transpose(0, 2, 3, 1)
        return output.reshape(len(values), self.card.rows, self.card.columns, self.card.channels)


class FeatureExtractor:
    """The two networks of the feature stage; each is opened when it is first used."""

    def __init__(self, segmentation: ModelCard | None, features: ModelCard, threads: int = 1):
        """`segmentation` may be None where every image has a precomputed label map."""
        self.segmentation_card, self.feature_card, self.threads = segmentation, features, threads

    @staticmethod
    def load(settings: FeatureSettings, threads: int = 1) -> "FeatureExtractor":
        """The networks that `settings` name. Raises SettingsError or InputError as ModelCard.load does."""
        with_model = settings.masks != "precomputed"
        segmentation = ModelCard.load(settings.segmentation_model, "segmentation") if with_model else None
        return FeatureExtractor(segmentation, ModelCard.load(settings.feature_model, "features"), threads)

    def labels(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Label maps (N, rows, columns) of Cityscapes train ids, at the network's output resolution."""
        return self.segmentation.run(images).argmax(-1).astype(np.uint8)

    def raw_features(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Features (N, rows, columns, D) as the network gives them, not yet in the shared feature space."""
        return self.features.run(images)

    @property
    def batch_size(self) -> int:
        """How many images make a good batch."""
        return self.features.batch_size

    @property
    def least_px(self) -> tuple[int, int]:
        """Width and height that an image should keep when it is decoded; (0, 0) where every pixel counts."""
        cards = [card for card in (self.segmentation_card, self.feature_card) if card is not None]
        if any(card.resample != "area" for card in cards):
            return 0, 0
        return max(card.input_width_px for card in cards), max(card.input_height_px for card in cards)

    @cached_property
    def segmentation(self) -> Network:
        """The segmentation network. Raises InputError if there is none."""
        if self.segmentation_card is None:
            raise InputError("there is no segmentation model; set features.masks to auto or model")
        return Network(self.segmentation_card, self.threads)

    @cached_property
    def features(self) -> Network:
        """The feature network."""
        return Network(self.feature_card, self.threads)


def prepare(images: Sequence[NDArray[np.uint8]], card: ModelCard) -> NDArray[np.float32]:
    """The network's input (N, 3, H, W): images resized, scaled to 0..1, less the mean, over the deviation."""
    height, width = _input_size(card)
    batch = np.empty((len(images), 3, height, width), np.float32)
    scale = (1 / (255 * np.array(card.std))).astype(np.float32)
    shift = (np.array(card.mean) / np.array(card.std)).astype(np.float32)
    for image, place in zip(images, batch, strict=True):
        place[:] = (_resized(image, card) * scale - shift).transpose(2, 0, 1)
    return batch


def _resized(image: NDArray[np.uint8], card: ModelCard) -> NDArray[np.uint8]:
    """The image at the network's input size, by the method that the network was trained with."""
    height, width = _input_size(card)
    if card.resample == "area":
        return resized(image, width, height)
    from PIL import Image

    method = Image.Resampling[card.resample.upper()]  # as transformers does it: with a filter as wide as it shrinks
    return np.asarray(Image.fromarray(image).resize((width, height), method))


def refuse_what_no_hash_covers(content: bytes, card: ModelCard) -> None:
    """Raise InputError if an ONNX model is unreadable, or if more than the card's files would decide its output.

    Such are weights in files that the card does not list, operators of other domains (code of their own), loops (no
    bound on time) and random numbers (the cache holds what a recipe gives, once and for all).
    """
    import onnx
    from google.protobuf.message import DecodeError

    try:
        model = onnx.load_model_from_string(content)
    except DecodeError as error:
        raise InputError(f"{card.file}: not an ONNX model ({error}); export it again") from error
    for tensor in _messages(model, "TensorProto"):
        external = {entry.key: entry.value for entry in tensor.external_data}
        is_external = tensor.data_location == onnx.TensorProto.EXTERNAL or external
        if is_external and external.get("location") not in card.external_data:
            raise InputError(
                f"{card.file}: tensor {tensor.name!r} is kept in another file, which the card's external_data does not "
                "list; save the model as one file (onnx.save(..., save_as_external_data=False))"
            )
    for node in _messages(model, "NodeProto"):
        if node.domain not in STANDARD_DOMAINS or node.op_type in REFUSED_OPERATORS:
            name = f"{node.domain}.{node.op_type}".removeprefix(".")
            raise InputError(f"{card.file}: operator {name} is refused; export the model with standard operators")


def _messages(message: Any, name: str) -> Iterator[Any]:
    """Every message of a name inside a protobuf message: in sub-graphs, constants and functions, too."""
    from google.protobuf.message import Message

    if message.DESCRIPTOR.name == name:
        yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for child in [value] if isinstance(value, Message) else value:
                yield from _messages(child, name)


def _session(content: bytes, card: ModelCard, threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads leave the cores to others
    wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
    providers = [provider for provider in wanted if provider in onnxruntime.get_available_providers()]
    try:
        model = str(card.file) if card.external_data else content  # other files are found beside a path only
        return onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # ONNX Runtime's errors have no common base but this
        raise InputError(f"{card.file}: ONNX Runtime refuses the model ({error}); export it again") from error


def _check_shape(card: ModelCard, role: str, name: str, arrays: Sequence[Any], expected: tuple) -> None:
    """Names must match, and so must every dimension that the model fixes; it may fix the batch to 1 only."""
    found = {array.name: array for array in arrays}
    cure = f"correct the card, or export the model with a float32 {role} of that shape"
    if name not in found or (role == "input" and len(found) > 1):
        raise InputError(f"{card.file}: the model's {role}s are {sorted(found)}, the card says {name!r}; {cure}")
    shape, kind = found[name].shape, found[name].type
    fits = len(shape) == len(expected) and all(
        have == want for have, want in zip(shape, expected, strict=True) if isinstance(have, int)
    )
    if not fits or kind != "tensor(float)":
        raise InputError(f"{card.file}: {role} {name!r} is {kind} {shape}, the card says {list(expected)}; {cure}")


def _input_size(card: ModelCard) -> tuple[int, int]:
    return card.input_height_px, card.input_width_px


def _output_shape(card: ModelCard) -> tuple[int, ...]:
    """The output's shape without the batch."""
    if card.layout == "NCHW":
        return card.channels, card.rows, card.columns
    return card.rows * card.columns, card.channels
