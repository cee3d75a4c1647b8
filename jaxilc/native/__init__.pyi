from .run import why_not

__all__ = [
    "why_not",
]
