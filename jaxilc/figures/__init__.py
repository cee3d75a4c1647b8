"""Figures: each function draws a dataset or another result, and returns the axes.

A figure is described once, by a function from results to a `Figure` of `description`: panels, axes,
layers. `paper` draws it with Matplotlib, and saves it; `page` draws it with Bokeh for a page. Of a
public function such as `error_by_trial`, `error_by_trial.described(...)` is the description.

    grid_map      a grid at a glance: a map over two axes, or a line over one, also of how the error
                  contracts and where the bounds say so; on a page a click shows how a point learns
    by_trial      errors against the trial: one machine, theory against simulation, and a sweep at a
                  glance, one panel a scheme, with the yield against the tolerance
    within_trial  signals against time with a zoom, and the contour of two axes
    by_frequency  spectrum and time-frequency map of the error, |Q (keep - L P)|, whether a Q-filter
                  is safe, and a learned law beside the inverse of the plant
    published     the numbers of a paper and ours
    searches      tunings, trade-offs, worst machines
    browsers      pages with a choice: a trial, a parameter, a paper
    experiments   the record, the model against it, repeats of a motion, a campaign on a machine
    report        one HTML page with figures and tables
    style         colours, dashes and marks, and numbers with SI prefixes

A scheme has the same colour, line style and mark in all figures of a dataset. The colours of trials
run from light to dark, so that both can be distinguished in print and by readers who are blind to
some colours. Figures do not use the global state of pyplot.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
