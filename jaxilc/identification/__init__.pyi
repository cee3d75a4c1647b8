from .dead_time import orders_and_delays
from .estimation import identify
from .fitting import Fit, fit
from .orders import Order, best_order, compare_orders, not_significant
from .records import Record, excite, read_record, write_record
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
    "excite",
    "fit",
    "identify",
    "not_significant",
    "orders_and_delays",
    "read_record",
    "write_record",
]
