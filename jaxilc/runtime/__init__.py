"""How JAX is started, how a batch runs, how much RAM there is, and what numbers depend on."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
