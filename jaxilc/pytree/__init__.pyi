from .fields import leaf, part, pytree, scalar, static
from .named_paths import allowed_at, get_at, interval_at, kind_at, named_leaves, replaced, settable
from .needs import known, need_channels, need_scalars
from .ranges import Interval

__all__ = [
    "Interval",
    "allowed_at",
    "get_at",
    "interval_at",
    "kind_at",
    "known",
    "leaf",
    "named_leaves",
    "need_channels",
    "need_scalars",
    "part",
    "pytree",
    "replaced",
    "scalar",
    "settable",
    "static",
]
