"""Learning over trials as a program for this processor, where XLA would dispatch it by parts."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
