from .start import setup
from .tiles import tiled

__all__ = ["setup", "tiled"]
