"""The scenarios of published papers, and yours from a file."""

import jaxilc
from jaxilc.scenarios import *

jaxilc.setup()

# %% load, Scenario
s = load("cao-2019")
print(isinstance(s, Scenario), s.trials, list(s.schemes))
# True 80 ['pid', 'cfdl-mfailc', 'pfdl-mfailc', 'ffdl-mfailc', 'ilc-mfapc']

# %% load_scenario
print(load_scenario("li-2020").title)  # or the name of a plant file
# CNC axis along a butterfly, simulation (Li 2020)

# %% options
print(list(options("cao-2019")))  # what can be chosen
# ['plant', 'reference', 'frequency', 'reading']

# %% Published, Quantity
one = s.published[0]
print(isinstance(one, Published), one.scheme, one.trial, one.quantity, one.value)
print(all(isinstance(quantity, Quantity) for quantity in s.quantities.values()))
# True cfdl-mfailc 20 settled_error 18.0
# True

# %% Fit
print(Fit(names=("phi0",), to="Table 1"))  # what was fitted to the print, and to which part
# 1 free number (phi0) fitted to Table 1; this row is predicted

# %% Listed
print(isinstance(LISTED["cao-2019"], Listed), LISTED["cao-2019"].trials)
# True 80

# %% reproduce (slow)
rows = reproduce(["li-2020"])
print(len(rows), rows[0].published.quantity)
# 14 max_error
