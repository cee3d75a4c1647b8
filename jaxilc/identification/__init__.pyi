from .dead_time import orders_and_delays
from .estimation import identify
from .fitting import Fit, fit
from .frequency_response import read_frequency_response
from .orders import Order, best_order, compare_orders, not_significant
from .record_files import read_record
from .records import Record, excite, write_record
from .response_estimation import compare_response_orders, identify_response
from .verdict import Estimate, Identified, PoleEstimate

__all__ = [
    "Estimate",
    "Fit",
    "Identified",
    "Order",
    "PoleEstimate",
    "Record",
    "best_order",
    "compare_orders",
    "compare_response_orders",
    "excite",
    "fit",
    "identify",
    "identify_response",
    "not_significant",
    "orders_and_delays",
    "read_frequency_response",
    "read_record",
    "write_record",
]
