"""Classes of parameters: fields with intervals, and values by their paths."""

import jaxilc
from jaxilc.pytree import *
from jaxilc.pytree import pytree
from jaxilc.schemes import PIDType

jaxilc.setup()


# %% pytree, leaf, Leaf, scalar, static, child
@pytree
class Spring:
    """A class of your own: frozen, checked, and a pytree of JAX."""

    stiffness: Leaf = leaf(interval="(0, inf)")  # differentiated, of any shape
    damping: Leaf = scalar(default=0.1, interval="[0, inf)")  # the same, one number
    steps: int = static(default=1, interval="[1, inf)", whole=True)  # compiled in
    next: "Spring | None" = child(default=None)  # a part with fields of its own


try:
    Spring(stiffness=-1.0)
except ValueError as error:
    print(error)
# Spring: stiffness = -1 is outside its allowed range (0, inf)

# %% get_at, replaced
law = PIDType(gamma_p=1.0)
print(get_at(replaced(law, {"gamma_p": 0.5}), "gamma_p"))
# 0.5

# %% named_leaves, settable
print(*named_leaves(law))
print(*settable(law))
# gamma_p gamma_i gamma_d leak
# gamma_p gamma_i gamma_d leak limit lead

# %% Interval, interval_at, allowed_at, kind_at
print(isinstance(interval_at(law, "leak"), Interval), allowed_at(law, "leak"))
print(kind_at(law, "lead")[0])
# True [0, 1)
# static

# %% known
print(known(law))  # False of values that JAX traces
# True

# %% need_scalars, need_channels
need_scalars(law)  # raises ValueError for a number that is none
need_channels(law, 1, "gamma_p")  # and for one that has neither one value nor one for each channel
