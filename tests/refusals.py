"""The test that each mistake of a table is refused with its words."""

import operator

import pytest


def refused(table, call=operator.call):
    """Return a test of what is refused: {words of the ValueError: what `call` is given}.

    call: it must raise; by default the table has functions without arguments
    """

    @pytest.mark.parametrize("said", table)
    def test(said):
        with pytest.raises(ValueError, match=said):
            call(table[said])

    return test
