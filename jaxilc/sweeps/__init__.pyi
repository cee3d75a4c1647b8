from .cluster import ChunkFailed, UnlikeWorkers
from .points import BestPoint, at_best, best_points, point_of
from .runs import history_dataset, run_schemes
from .store import open_dataset
from .summary import SchemeSummary, summarise
from .sweep import Sweep

__all__ = [
    "BestPoint",
    "ChunkFailed",
    "SchemeSummary",
    "Sweep",
    "UnlikeWorkers",
    "at_best",
    "best_points",
    "history_dataset",
    "open_dataset",
    "point_of",
    "run_schemes",
    "summarise",
]
