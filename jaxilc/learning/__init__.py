"""Learning: one trial of a machine under a scheme, the scan over trials, and what a trial is judged
by.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
