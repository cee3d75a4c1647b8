"""Learning on a real machine: campaigns, their journal, and the files of machines."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
