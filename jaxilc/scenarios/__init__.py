"""The scenarios: a module for each paper, and the files that describe a user's own machine."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
