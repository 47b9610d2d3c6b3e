"""One comparison with a golden value: what was compared, how far apart, how far is allowed."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Check:
    """The largest error of one quantity of a golden case."""

    quantity: str
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the error is a number within the tolerance."""
        return bool(self.error <= self.tolerance)


def absolute(quantity: str, found: Any, expected: Any, tolerance: float) -> Check:
    """Largest absolute difference."""
    return Check(quantity, _largest(_difference(found, expected)), tolerance)


def relative(quantity: str, found: Any, expected: Any, tolerance: float) -> Check:
    """Largest difference, each relative to its expected value."""
    scale = np.maximum(np.abs(np.asarray(expected, np.float64)), 1e-30)
    return Check(quantity, _largest(_difference(found, expected) / scale), tolerance)


def of_maximum(quantity: str, found: Any, expected: Any, tolerance: float, axis: int | None = None) -> Check:
    """Largest difference, relative to the largest expected value: of all, or along an axis (of a row: 1)."""
    largest = np.abs(np.asarray(expected, np.float64)).max(axis, keepdims=axis is not None)
    return Check(quantity, _largest(_difference(found, expected) / np.maximum(largest, 1e-30)), tolerance)


def equal(quantity: str, found: Any, expected: Any) -> Check:
    """Number of differing elements; none is allowed."""
    return Check(quantity, float(np.sum(_array(found) != _array(expected))), 0.0)


def _difference(found: Any, expected: Any) -> Any:
    found, expected = _array(found).astype(np.float64), _array(expected).astype(np.float64)
    if found.shape != expected.shape:
        raise AssertionError(f"shape {found.shape}, expected {expected.shape}")
    return np.abs(found - expected)


def _largest(errors: Any) -> float:
    return float(np.max(errors, initial=0.0))


def _array(value: Any) -> Any:
    return value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)
