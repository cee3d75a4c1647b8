"""Monte-Carlo sweeps over uncertain machines, on one host or many, into labelled stores."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
