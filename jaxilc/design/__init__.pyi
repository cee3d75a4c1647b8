from .candidates import LAWS
from .learned import STARTS, Learned, LearnedLaw
from .search import Design, Designed, Recommended, feedback_among

__all__ = [
    "LAWS",
    "STARTS",
    "Design",
    "Designed",
    "Learned",
    "LearnedLaw",
    "Recommended",
    "feedback_among",
]
