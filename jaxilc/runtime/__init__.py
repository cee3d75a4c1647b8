"""The start of JAX, the execution of batches, the RAM that is free, and provenance of numbers."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
