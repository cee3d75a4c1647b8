"""One trial of a machine under a scheme, the scan over trials, and the metrics of a trial."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
