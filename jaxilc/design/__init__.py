"""A learning law for an uncertain machine: chosen, tuned, tested, and judged on new machines."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
