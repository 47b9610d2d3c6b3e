"""Model cards: what a segmentation or feature network expects and gives, and which file it is.

A card is a TOML file beside its ONNX file. Cards shipped with PreSight are found by name
("tiny" is `presight_core/models/tiny/<kind>.toml`); any other card by its path.
"""

import hashlib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from presight_core import classes
from presight_core.config import Count, Settings, read_toml, validate
from presight_core.errors import InputError, SettingsError

Kind = Literal["segmentation", "features"]
Channels = tuple[float, float, float]  # red, green, blue

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

MODELS_FOLDER = Path(str(resources.files("presight_core"))) / "models"


class ModelCard(Settings):
    """One network: RGB in, a grid of logits or features out, a cell every `stride` input pixels."""

    name: str
    kind: Kind
    file: Path  # in the TOML a plain name, beside the card; here its full path
    sha256: Sha256
    external_data: dict[str, Sha256] = Field(default_factory=dict)  # more files of weights beside it
    input: str  # name of the (N, 3, H, W) float32 input
    input_height_px: Count  # images are resized to this size
    input_width_px: Count
    resample: Literal["area", "bilinear", "bicubic"] = "area"  # by OpenCV's averages, or as Pillow and transformers do
    mean: Channels  # of RGB scaled to 0..1
    std: Channels
    output: str
    layout: Literal["NCHW", "NTD"]  # NTD: tokens row by row, without a class token
    stride: Count
    channels: Count
    licence: str
    source: str
    note: str = ""

    @property
    def rows(self) -> int:
        """Rows of the output grid."""
        return self.input_height_px // self.stride

    @property
    def columns(self) -> int:
        """Columns of the output grid."""
        return self.input_width_px // self.stride

    @property
    def identity(self) -> dict[str, Any]:
        """Everything that decides the network's output, for recipes: not its names, its place or its licence."""
        return self.model_dump(mode="json", exclude={"name", "file", "licence", "source", "note"})

    @staticmethod
    def load(name_or_path: str, kind: Kind) -> "ModelCard":
        """The checked card of a shipped model (by name) or of a TOML file (by path, or by its folder's path).

        Raises SettingsError for an unknown name or a wrong card, InputError for an ONNX file that is missing or
        is not the one the card names.
        """
        path = _card_path(name_or_path, kind)
        values = read_toml(path)
        for file in (values.get("file"), *dict(values.get("external_data") or {})):
            _refuse_other_folders(file, path)
        card = validate(ModelCard, {**values, "file": path.parent / str(values.get("file", ""))}, str(path))
        if card.kind != kind:
            raise SettingsError(f"{path}: kind: this is a {card.kind} model; name a card of kind {kind}")
        card.read_model()
        return card

    def read_model(self) -> bytes:
        """The ONNX file's bytes. Raises InputError if a file is absent or its SHA-256 is not the card's."""
        for name, digest in self.external_data.items():
            self._read(self.file.parent / name, digest)
        return self._read(self.file, self.sha256)

    def _read(self, file: Path, digest: str) -> bytes:
        try:
            content = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file}: {error.strerror}; put the model of card {self.name} there") from error
        found = hashlib.sha256(content).hexdigest()
        if found != digest:
            raise InputError(
                f"{file}: SHA-256 is {found}, the card says {digest}; "
                "restore the file, or correct the card if the new model is meant"
            )
        return content

    @field_validator("std")
    @classmethod
    def _std_is_positive(cls, std: Channels) -> Channels:
        if min(std) <= 0:
            raise ValueError("every standard deviation must be greater than 0")
        return std

    @model_validator(mode="after")
    def _grid_is_whole(self) -> Self:
        if self.input_height_px % self.stride or self.input_width_px % self.stride:
            size = f"{self.input_height_px} x {self.input_width_px}"
            raise ValueError(f"input {size} px is not a whole number of strides of {self.stride} px")
        if self.kind == "segmentation" and self.channels != len(classes.CITYSCAPES):
            raise ValueError(f"channels: {self.channels}; a segmentation model gives {len(classes.CITYSCAPES)} classes")
        return self


def shipped_models(kind: Kind) -> list[str]:
    """Names of the models that come with PreSight."""
    return sorted(card.parent.name for card in MODELS_FOLDER.glob(f"*/{kind}.toml"))


def _card_path(name_or_path: str, kind: Kind) -> Path:
    """A shipped model's name wins over a folder of that name that happens to lie here; `./name` means the folder."""
    if name_or_path in shipped_models(kind):
        return MODELS_FOLDER / name_or_path / f"{kind}.toml"
    path = Path(name_or_path)
    if path.is_dir():
        return path / f"{kind}.toml"
    if path.suffix == ".toml" or len(path.parts) > 1:
        return path
    names = ", ".join(shipped_models(kind)) or "none"
    raise SettingsError(
        f"{kind} model {name_or_path!r} does not come with PreSight (shipped: {names}); "
        "name one of these, or give the path of a model card"
    )


def _refuse_other_folders(file: Any, card: Path) -> None:
    """A card from elsewhere must not make us read files outside its own folder."""
    if isinstance(file, str) and Path(file).name != file:
        raise SettingsError(f"{card}: file: {file!r} is not a plain file name; put the model beside its card")
