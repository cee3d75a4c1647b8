from .candidates import LAWS
from .search import Design, Recommended, design_law, feedback_among

__all__ = ["LAWS", "Design", "Recommended", "design_law", "feedback_among"]
