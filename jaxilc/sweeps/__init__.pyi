from .cluster import ChunkFailed
from .runs import history_dataset, run_schemes
from .store import open_dataset
from .summary import SchemeSummary, summarise
from .sweep import Sweep
from .worker import UnlikeWorkers

__all__ = [
    "ChunkFailed",
    "SchemeSummary",
    "Sweep",
    "UnlikeWorkers",
    "history_dataset",
    "open_dataset",
    "run_schemes",
    "summarise",
]
