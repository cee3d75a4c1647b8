"""How JAX is started, how a batch is spread over devices, how much memory there is, and what
numbers depend on.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
