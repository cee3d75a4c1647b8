"""Dataclasses that are JAX pytrees: their fields, the intervals that values must lie in, and their
fields by name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
