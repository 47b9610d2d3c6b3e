"""`presight doctor`: what is installed, what is missing, and how to get it."""

import importlib.metadata
import os
import platform
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from flows.console import print_json, print_table
from presight_core.errors import MissingDependencyError, PresightError
from storage.workspace import Workspace

if TYPE_CHECKING:
    from presight_core.model_card import Kind

PACKAGES = (
    "torch",
    "numba",
    "prefect",
    "onnxruntime",
    "opencv-python-headless",
    "zarr",
    "obstore",
    "sqlalchemy",
    "pyarrow",
)


@dataclass(frozen=True)
class Finding:
    """One thing looked at: its name, whether it is well, what was found, and the cure if it is not."""

    name: str
    ok: bool
    found: str
    cure: str = ""


def examine(workspace: Workspace) -> Iterator[Finding]:
    """Look at the machine, the packages, the models and the workspace."""
    yield Finding("python", platform.python_version_tuple()[:2] == ("3", "11"), platform.python_version(), "use 3.11")
    cores = len(os.sched_getaffinity(0))
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    yield Finding("machine", True, f"{cores} cores, {memory_gib:.0f} GiB of memory")
    for package in PACKAGES:
        yield _package(package)
    yield _gpu()
    yield _model("segmentation")
    yield _model("features")
    yield from _workspace(workspace)


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "not installed", "pip install 'presight[pipeline]' (README, Install)")


def _gpu() -> Finding:
    try:
        import torch
    except ImportError:
        return Finding("gpu", False, "torch is missing", "pip install 'presight[pipeline]'")
    if torch.cuda.is_available():
        return Finding("gpu", True, torch.cuda.get_device_name(0))
    if shutil.which("nvidia-smi"):
        cure = "install torch's CUDA build into this environment, then `make install TORCH=`"
        return Finding("gpu", False, f"torch {torch.__version__} cannot use the NVIDIA driver found here", cure)
    return Finding("gpu", True, "none: tiles train on the processor (presets demo and fast)")


def _model(kind: "Kind") -> Finding:
    from presight_core.model_card import ModelCard

    try:
        card = ModelCard.load("tiny", kind)
    except PresightError as error:
        return Finding(f"{kind} model", False, str(error), "re-install presight, or run tools/train_tiny_models.py")
    return Finding(f"{kind} model", True, f"{card.name}, SHA-256 {card.sha256[:12]}")


def _workspace(workspace: Workspace) -> Iterator[Finding]:
    folder = workspace.root
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    writable = os.access(existing, os.W_OK)
    free_gib = shutil.disk_usage(existing).free / 2**30
    yield Finding(
        "workspace", writable, f"{folder}, {free_gib:.0f} GiB free", "choose a writable folder with --workspace"
    )
    try:
        catalog = workspace.require().catalog()
    except PresightError as error:
        yield Finding("catalog", True, str(error))
        return
    cities = catalog.cities()
    yield Finding("catalog", True, f"{workspace.catalog_url}: {len(cities)} cities ({', '.join(cities) or 'none'})")
    built = "://" in workspace.store_location or Path(workspace.store_location).exists()
    yield Finding("store", True, f"{workspace.store_location}{'' if built else ': nothing built yet'}")


def show_findings(folder: Path, as_json: bool) -> None:
    """Print every finding. Raises MissingDependencyError if something is not well."""
    findings = list(examine(Workspace.open(folder)))
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        rows = [("ok" if f.ok else "MISSING", f.name, f.found, "" if f.ok else f.cure) for f in findings]
        print_table("presight doctor", ("", "what", "found", "cure"), rows)
    bad = [finding.name for finding in findings if not finding.ok]
    if bad:
        raise MissingDependencyError(f"not well: {', '.join(bad)}; see the cures above")
