"""The paper's metrics. Each takes one sample at a time, and keeps counts and scores but no prediction."""

from presight_perception.metrics.occupancy_iou import Mask, OccupancyIou, OccupancyScores
from presight_perception.metrics.raster_iou import RasterIou, RasterScores
from presight_perception.metrics.vector_precision import (
    MAPTR_SETTINGS,
    ScoredLines,
    VectorPrecision,
    VectorScores,
    VectorSettings,
)

__all__ = [
    "MAPTR_SETTINGS",
    "Mask",
    "OccupancyIou",
    "OccupancyScores",
    "RasterIou",
    "RasterScores",
    "ScoredLines",
    "VectorPrecision",
    "VectorScores",
    "VectorSettings",
]
