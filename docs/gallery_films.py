"""The films of docs/gallery.md: one episode twice, under a script and under the policy that ships for it.

`python docs/films.py --gallery` makes them and writes the page. A film holds its numbers as a comment of its file, with
the policy's hash, so that page and films can't disagree.
"""

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

IMAGES = Path(__file__).parent / "images"
PAGE = Path(__file__).parent / "gallery.md"
HEAD = """# Gallery

<!-- written by python docs/films.py --gallery; the sentences are in docs/gallery_films.py -->

Each film is one episode twice: the same starts, disturbances and lost messages, on the left under a
[script](guides/policy.md), on the right under the learned policy that ships for it
([how each was trained, what it reaches, where it fails](pretrained.md)). Both know agents that aren't their neighbours
by estimates only. Both maps show the same part of the plane. The episodes weren't chosen: all have seed 0. Films show
their beginning, the tables below them have the whole episode. What policies reach on average is in their cards, and in
[](benchmarks/learning.md).

The ring marks the agent whose estimates are drawn, as hollow markers in boxes that are guaranteed to hold the target.
"""


@dataclass(frozen=True)
class Episode:
    """A film of the gallery.

    Attributes:
        title: heading on the page.
        environment: name of the environment.
        scenario: name of the scenario.
        script: the policy on the left.
        learned: name of the shipped policy on the right.
        caption: what to look at.
        step: simulated time between pictures in s.
        shown: time for which a picture is shown, in ms.
        duration: of the film in s; None for the whole episode.
        network: over which agents exchange messages; None for the scenario's own.
        inside: "filter:..." where both policies act in a safety filter.
        seed: of the episode.
    """

    title: str
    environment: str
    scenario: str
    script: str
    learned: str
    caption: str
    step: float
    shown: int
    duration: float | None = None
    network: str | None = None
    inside: str = ""
    seed: int = 0

    @property
    def policies(self) -> dict[str, str]:
        """Both policies by the titles of their maps."""
        before = f"{self.inside}:" if self.inside else ""
        return {
            f"script: {self.script}": f"{before}{self.script}",
            "learned": f"{before}ppo:pretrained/{self.learned}",
        }

    @property
    def arguments(self) -> dict[str, Any]:
        """Of the environment."""
        return {} if self.network is None else {"network": self.network}

    @property
    def command(self) -> str:
        """The command that measures both in this episode."""
        where = ["khop", "evaluate", self.environment, "--scenario", self.scenario]
        over = [] if self.network is None else ["--network", self.network]
        chosen = ["--observe", "estimate", "--episodes", "1", "--seed", str(self.seed)]
        return shlex.join([*where, *over, *chosen, "--policies", ",".join(self.policies.values())])


GALLERY: Mapping[str, Episode] = {
    "consensus": Episode(
        "Consensus",
        "consensus_v0",
        "paper",
        "leader_following",
        "consensus_paper",
        "Eight agents with unstable drifts meet; most task edges (dashed) join agents that don't communicate (solid). "
        "Look at where they meet: the reward counts distances and effort, and no place is better.",
        step=0.1,
        shown=120,
        duration=3.0,
    ),
    "formation": Episode(
        "Formation",
        "formation_v0",
        "paper",
        "leader_following",
        "formation_paper",
        "The same team forms an octagon. Look at how straight the agents go to their places, and how still they stand.",
        step=0.1,
        shown=120,
        duration=3.0,
    ),
    "convoy": Episode(
        "A convoy with fast leaders",
        "leader_following_v0",
        "convoy",
        "leader_following",
        "leader_following_convoy",
        "Followers keep their places around leaders (stars) that they don't communicate with, and whose inputs may be "
        "twice as large as theirs. Look at the turns: who goes straight after a leader falls behind there.",
        step=0.1,
        shown=100,
        duration=4.0,
    ),
    "mixed_fleet": Episode(
        "A mixed fleet",
        "leader_following_v0",
        "mixed_fleet",
        "leader_following",
        "leader_following_mixed_fleet",
        "Integrators, carts, unicycles and vessels; a marker's shape is its type. Look at the vessels and unicycles, "
        "which have to turn before they go.",
        step=0.1,
        shown=100,
        duration=4.0,
    ),
    "navigation": Episode(
        "Navigation in the safety filter",
        "navigation_v0",
        "crossing",
        "keep_right",
        "navigation_crossing",
        "Agents go to their goals (green), each knowing of most others by late messages of which 30 % are lost. Both "
        "sides are in the filter that keeps bodies apart; arrows are what it changes. Look at who waits for whom, and "
        "who arrives first. Twice as fast as real time.",
        step=0.3,
        shown=150,
        inside="filter:announce=true",
    ),
    "lossy_convoy": Episode(
        "The convoy over a lossy network",
        "leader_following_v0",
        "convoy",
        "leader_following",
        "leader_following_convoy_lossy",
        "The convoy again, where neighbours, too, are known by messages only, and 30 % of them are lost in bursts of "
        "5: links fade, boxes grow with the age of what has arrived. Look at followers that haven't heard of their "
        "leader for a while.",
        step=0.1,
        shown=100,
        duration=4.0,
        network="lossy:loss=0.3,burst=5",
    ),
}


def path_of(name: str) -> Path:
    """The film's file."""
    return IMAGES / f"gallery_{name}.gif"


def make(name: str) -> None:
    """Write a film, with its numbers in its comment."""
    from gif import shrunk, write_film  # docs/gif.py
    from PIL import Image

    from agents.learning.pretrained import digest
    from benchmarks.side_by_side import INK, Side, side_by_side

    episode = GALLERY[name]
    unit = ""

    def status(side: Side) -> tuple[str, str]:
        return f"return {side.run.episode_return:.3g}, error {side.run.task_error():.2f} {unit}", INK

    film = side_by_side(
        episode.environment,
        episode.policies,
        status,
        scenario_name=episode.scenario,
        seed=episode.seed,
        every=episode.step,
        duration=episode.duration,
        arguments=episode.arguments,
    )
    batched = film.sides[0].run.env.batched
    unit = batched.task.error_unit(batched.world)
    pictures = shrunk(Image.fromarray(frame) for frame in film.frames)
    for side in film.sides:  # the film may be shorter than the episode
        while not side.run.ended():
            side.step()
    numbers = {
        "policy": episode.learned,
        "hash": digest(episode.learned),
        "unit": unit,
        "return": [side.run.episode_return for side in film.sides],
        "error": [side.run.task_error() for side in film.sides],
        "collisions": [side.collisions for side in film.sides],
    }
    write_film(path_of(name), pictures, episode.shown, json.dumps(numbers))


def numbers_of(name: str) -> dict[str, Any]:
    """What a film's comment says of its episode."""
    from PIL import Image

    with Image.open(path_of(name)) as film:
        found: dict[str, Any] = json.loads(film.info["comment"])
    return found


def page() -> str:
    """The page, from the films.

    Raises:
        FileNotFoundError: if one isn't there.
    """
    text = HEAD
    for name, episode in GALLERY.items():
        found = numbers_of(name)
        left, right = episode.policies.values()
        rows = [
            ("return", [f"{value:.3g}" for value in found["return"]]),
            ("task error at the end", [f"{value:.2g} {found['unit']}" for value in found["error"]]),
        ]
        if episode.environment == "navigation_v0":
            rows.append(("agents that collided", [str(value) for value in found["collisions"]]))
        table = "".join(f"| {label} | {' | '.join(values)} |\n" for label, values in rows)
        text += f"""
## {episode.title}

![{episode.title}: {episode.script} on the left, learned on the right](images/{path_of(name).name})

{episode.caption}

| | left, `{left}` | right, `{right}` |
|---|---|---|
{table}
```
{episode.command}
```
"""
    return text
