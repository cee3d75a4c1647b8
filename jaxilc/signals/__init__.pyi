from . import contour, gcode, paths, references, tool_path
from .contour import contour_error
from .task import Limit, Sample, Task, Trial

__all__ = [
    "Limit",
    "Sample",
    "Task",
    "Trial",
    "contour",
    "contour_error",
    "gcode",
    "paths",
    "references",
    "tool_path",
]
