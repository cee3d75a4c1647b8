from .candidates import LAWS
from .search import Design, Designed, Recommended, feedback_among

__all__ = ["LAWS", "Design", "Designed", "Recommended", "feedback_among"]
