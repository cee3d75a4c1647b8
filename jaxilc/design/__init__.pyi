from .learned import Learned, LearnedLaw
from .learned_settings import STARTS
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
