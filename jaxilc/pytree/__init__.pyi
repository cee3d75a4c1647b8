from .aliases import Leaf
from .fields import child, leaf, pytree, scalar, static
from .named_paths import allowed_at, get_at, interval_at, kind_at, named_leaves, replaced, settable
from .needs import known, need_channels, need_scalars
from .ranges import Interval

__all__ = [
    "Interval",
    "Leaf",
    "allowed_at",
    "child",
    "get_at",
    "interval_at",
    "kind_at",
    "known",
    "leaf",
    "named_leaves",
    "need_channels",
    "need_scalars",
    "pytree",
    "replaced",
    "scalar",
    "settable",
    "static",
]
