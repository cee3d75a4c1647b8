from .learned import STARTS, Learned, LearnedLaw
from .search import LAWS, Design, Designed, Recommended, feedback_among

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
