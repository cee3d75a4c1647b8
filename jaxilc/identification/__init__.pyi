from .estimation import Order, best_order, compare_orders, identify, not_significant
from .fitting import Fit, fit
from .frequency_response import read_frequency_response
from .grown import Grown, Tried, grow, orders_and_delays
from .grown_response import grow_response, identified_response
from .not_linear import FrictionModel, Suspicion, friction_of, suspicions
from .pitch import Pitch, pitch_of
from .potential import Potential, potential_of
from .record_files import Repeats, read_record, read_repeats, write_record
from .records import Record, excite
from .response_estimation import compare_response_orders, identify_response
from .verdict import Estimate, Identified, PoleEstimate

__all__ = [
    "Estimate",
    "Fit",
    "FrictionModel",
    "Grown",
    "Identified",
    "Order",
    "Pitch",
    "PoleEstimate",
    "Potential",
    "Record",
    "Repeats",
    "Suspicion",
    "Tried",
    "best_order",
    "compare_orders",
    "compare_response_orders",
    "excite",
    "fit",
    "friction_of",
    "grow",
    "grow_response",
    "identified_response",
    "identify",
    "identify_response",
    "not_significant",
    "orders_and_delays",
    "pitch_of",
    "potential_of",
    "read_frequency_response",
    "read_record",
    "read_repeats",
    "suspicions",
    "write_record",
]
