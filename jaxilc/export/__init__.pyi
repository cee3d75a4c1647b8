from .c_files import files_of
from .certificate import check
from .interpreter import interpret
from .law import Law, law_of
from .steps import program_of

__all__ = ["Law", "check", "files_of", "interpret", "law_of", "program_of"]
