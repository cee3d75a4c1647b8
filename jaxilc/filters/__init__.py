"""Filters for whole trials: zero-phase, switched from segment to segment, inverses of a plant."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
