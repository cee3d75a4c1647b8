"""The tests of this folder need the compiler."""

import pytest


@pytest.fixture(autouse=True, scope="module")
def compiler():
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install 'jaxilc[native]'")
