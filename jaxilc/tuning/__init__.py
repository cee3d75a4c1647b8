"""Tuning by gradients through the whole learning process, and the worst machine of a set."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
