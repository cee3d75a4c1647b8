"""What each command finds, as one object: numbers, tables, sentences, verdict, figures."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
