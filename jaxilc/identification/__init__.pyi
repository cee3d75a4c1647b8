from .estimation import identify
from .fitting import Fit, fit
from .records import Record, excite, read_record, write_record
from .verdict import Estimate, Identified, PoleEstimate

__all__ = [
    "Estimate",
    "Fit",
    "Identified",
    "PoleEstimate",
    "Record",
    "excite",
    "fit",
    "identify",
    "read_record",
    "write_record",
]
