"""A short training run, shared by the tests of training and of its files."""

import pytest

from agents.learning.training import train
from tests.agents.training import SMALL


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A short run, and its folder."""
    folder = tmp_path_factory.mktemp("run")
    return train(SMALL, folder), folder
