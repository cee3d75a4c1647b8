from .estimation import Estimate, Identified, PoleEstimate, identify
from .fitting import Fit, fit
from .records import Record, excite, read_record, write_record

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
