from . import contour, paths, references
from .contour import contour_error
from .task import Limit, Sample, Task, Trial

__all__ = [
    "Limit",
    "Sample",
    "Task",
    "Trial",
    "contour",
    "contour_error",
    "paths",
    "references",
]
