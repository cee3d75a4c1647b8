from .function import compiled
from .run import why_not

__all__ = ["compiled", "why_not"]
