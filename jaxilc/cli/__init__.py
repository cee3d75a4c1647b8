"""The command line: a command reads its options, calls the library, and prints the result."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
