"""What passes between machine, scheme and learning: the task with its reference, sample, trial."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
