"""The examples in docstrings are true."""

import doctest
import importlib

import pytest

MODULES = (
    "rsundistort",
    "rsundistort.io.groups",
    "rsundistort.io.readout_times",
    "rsundistort.model.camera",
    "rsundistort.model.checks",
    "rsundistort.model.motion",
    "rsundistort.model.projection",
    "rsundistort.rectify.maps",
    "rsundistort.testing",
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_docstrings(name):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
