"""A law for the controller: the traced learning law as a program in C, with its certificate."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
