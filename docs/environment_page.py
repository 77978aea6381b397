"""The page of an environment: its module's documentation string, its film, and observations column by column."""

import importlib
import re
from typing import Any

from films import FILMS

from khop_env import scenario
from khop_env.env import KHopEnv, ObservationLayout


def environment_page(name: str) -> str:
    """The page in MyST Markdown.

    Args:
        name: of the environment's module in `khop_env`.
    """
    module = importlib.import_module(f"khop_env.{name}")
    head, *sections = (module.__doc__ or "").strip().split("\n### ")  # PettingZoo's format has ### below #
    title, _, head = head.partition("\n\n")
    page = f"{title}\n\n{film(name)}{head}"
    for section in sections:
        heading, _, text = section.partition("\n")
        if heading == "Observation Space":
            text = re.sub(r"(?m)^\| (?!Columns )(\S.*?) +\|", r"| `\1` |", text)
            text = re.sub(r"(?<![`\w.])\w+\.<\w+>[\w.]*", r"`\g<0>`", text)  # else <state> would be a tag of HTML
            text += observations(module)
        page += f"\n## {heading.capitalize()}\n{text}"
        if heading == "Reward":
            page += policies(name, module)
    return page.rstrip() + "\n"


def film(name: str) -> str:
    """The film, what is in it, and the command that makes it."""
    if name not in FILMS:
        raise KeyError(f"there is no film of {name}: add one to FILMS in docs/films.py, and run it")
    shown = FILMS[name]
    return f"""![A film of {name}: {shown.caption}](../images/{name}.gif)

*{shown.caption}*

```
{shown.command(name, "film.gif")}
```

(`python docs/films.py {name}` makes the smaller one above.)

"""


def observations(module: Any) -> str:
    """Observations of the first agent of the default environment, and with arguments that add columns."""
    name = module.__name__.rpartition(".")[2]
    env = module.parallel_env()
    agent = env.possible_agents[0]
    text = f"""### Column by column

Observations of `{agent}` in the default environment, as `env.layout("{agent}")` describes them:

```python
from khop_env import {name}

env = {name}.parallel_env()
observations, infos = env.reset(seed=0)
layout = env.layout("{agent}")
print(len(layout), layout.fields[0], layout.read(observations["{agent}"]))
```

{columns(env, agent)}
The other slots have the same columns as `{shown_slot(env.layout(agent))}`:

{slots(env, agent)}
"""
    more: list[dict[str, Any]] = [{"bounds": True}]
    if not env.batched.simulator.observers.by_messages:
        more.append({"network": "wifi", "bounds": True})
    for arguments in more:
        spelled = ", ".join(f"{key}={value!r}" for key, value in arguments.items())
        text += f"""::::{{dropdown}} With `parallel_env({spelled.replace("'", '"')})`
{columns(module.parallel_env(**arguments), agent)}
::::

"""
    return text


def shown_slot(layout: ObservationLayout) -> str:
    """The first slot of an agent that isn't a neighbour."""
    return f"slot{next(number for number, slot in enumerate(layout.slots) if not slot.heard)}"


def columns(env: KHopEnv, agent: str) -> str:
    """A table of an agent's columns outside slots and in one slot, with their values after a reset."""
    layout = env.layout(agent)
    shown = shown_slot(layout)
    values = layout.read(env.reset(seed=0)[0][agent])
    lines = ["| Column | Name | Unit | Range | After `reset(seed=0)` |", "|---|---|---|---|---|"]
    for number, field in enumerate(layout.fields):
        if not field.name.startswith("slot") or field.name.startswith(f"{shown}."):
            limits = f"{field.low:g} to {field.high:g}"
            lines.append(f"| {number} | `{field.name}` | {field.unit} | {limits} | {values[field.name] + 0.0:.3g} |")
    return "\n".join(lines) + "\n"


def slots(env: KHopEnv, agent: str) -> str:
    """A table of an agent's slots: which agents they are for."""
    layout, by_messages = env.layout(agent), env.batched.simulator.observers.by_messages
    lines = ["| Slot | Columns | Agent | Hops | State | Task edge |", "|---|---|---|---|---|---|"]
    ranges = []
    while f"slot{len(ranges)}.valid" in layout.names:
        found = layout.columns(f"slot{len(ranges)}")
        ranges.append((found[0], found[-1]))
    for number, (slot, (first, last)) in enumerate(zip(layout.slots, ranges)):  # noqa: B905 -- there may be more ranges
        known, edge = "estimated" if by_messages or not slot.heard else "received", "yes" if slot.task_edge else "no"
        lines.append(f"| {number} | {first} to {last} | `{slot.id}` | {slot.hops} | {known} | {edge} |")
    used = len(layout.slots)
    if used < len(ranges):
        number = f"{used} to {len(ranges) - 1}" if used < len(ranges) - 1 else f"{used}"
        lines.append(f"| {number} | {ranges[used][0]} to {ranges[-1][1]} | none: zeros |  |  |  |")
    return "\n".join(lines) + "\n"


def policies(name: str, module: Any) -> str:
    """Which policies there are for an environment."""
    from agents.learning import shipped

    task = module.parallel_env().batched.task
    default = task.default_policy or scenario(task.default_scenario).law.name
    trained = [each for each in shipped().values() if each.environment == name]
    listed = "\n".join(
        f"- `ppo:pretrained/{each.name}` for `{each.scenario}`" + (f" over `{each.network}`" if each.network else "")
        for each in trained
    )
    measured = "[](../benchmarks/learning.md)" + ", [](../benchmarks/safety.md)" * (task.default_policy is not None)
    return f"""
## Policies

`khop run {name}` plays `{default}`, and another policy with `--controller`. [Trained policies](../pretrained.md) are
shipped; `ppo:pretrained` is the one that fits:

{listed}

```
khop run {name} --controller ppo:pretrained
```

What policies reach: {measured}.

"""
