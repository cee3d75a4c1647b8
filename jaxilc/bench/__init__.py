"""The benchmark: the same learning by jaxilc and by other programs, timed after a comparison."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
