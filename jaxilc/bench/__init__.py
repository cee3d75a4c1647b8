"""What `jaxilc bench` measures: the same learning run by peers and by jaxilc, numbers compared
before times.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
