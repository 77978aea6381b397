"""The gallery: its films are of the policies that ship now, and its page says what they say."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "docs"))

from films import FILMS
from gallery_films import GALLERY, PAGE, numbers_of, page, path_of

from agents.learning import shipped
from agents.learning.pretrained import digest
from khop_env.registry import environments

LARGEST = 1_500_000


@pytest.mark.parametrize("name", GALLERY)
def test_a_film_is_of_the_policy_that_ships(name):
    """After an exchange: python docs/films.py --gallery."""
    from PIL import Image

    episode, found = GALLERY[name], numbers_of(name)
    assert (found["policy"], found["hash"]) == (episode.learned, digest(episode.learned))
    policy = shipped()[episode.learned]
    assert (policy.environment, policy.scenario) == (episode.environment, episode.scenario)
    assert policy.network == episode.network
    assert path_of(name).stat().st_size < LARGEST
    with Image.open(path_of(name)) as film:
        assert film.n_frames >= 20


def test_the_page_says_what_the_films_say():
    assert PAGE.read_text(encoding="utf-8") == page()


def test_every_environment_has_films():
    assert set(FILMS) == set(environments()) == {episode.environment for episode in GALLERY.values()}
