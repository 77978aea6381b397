"""
# Formation

| Creation             | `make("aec", "khop/Formation-v0")`                 |
|----------------------|----------------------------------------------------|
| Actions              | Continuous                                         |
| Parallel API         | Yes                                                |
| Manual Control       | No                                                 |
| Agents               | `agents= ['drifter_0', ..., 'drifter_7']`          |
| Agents               | 8                                                  |
| Action Shape         | (2,); the most inputs that an agent has            |
| Action Values        | [-1, 1]                                            |
| Observation Shape    | (59,)                                              |
| Observation Values   | [-200, 200]; `limit` chooses them                  |
| State Shape          | (16,)                                              |
| State Values         | [-100, 100]                                        |

Agents of a team are to stand in a formation, anywhere: to keep the displacement d_ij along every edge (i, j) of a task
graph. Most of these edges join agents that aren't neighbours in the communication graph: an agent receives the states
of its neighbours, and estimates those of its k-hop targets, 2 to k hops away, with errors inside bounds that were
chosen in advance.

### Observation Space

An agent observes its own state and a list of slots, one for every other agent within k hops: its neighbours (1 hop),
whose states it receives, and its k-hop targets (2 to k hops), whose states it estimates. Slots are ordered by relevance
to its task: task edges first, then hop distance, then index. With uniform observations the list is padded to the
longest; a slot that isn't in use is all zeros.
`env.layout(agent)` names every column with its unit, and reads and builds observations.

| Columns                     | Content                                                                           |
|-----------------------------|-----------------------------------------------------------------------------------|
| own.<state>                 | own position, then the other states; an angle as own.<state>.cos and .sin         |
| own.input.<input>           | own input in force, as a fraction of its limit; not with actuator="direct"        |
| own.type.<type>             | one-hot of the agent's type; uniform only                                         |
| slot0.valid                 | 1 if the slot is in use                                                           |
| slot0.heard                 | 1 if the agent is a neighbour, 0 if it is estimated                               |
| slot0.hops                  | hop distance in the communication graph                                           |
| slot0.task_edge             | 1 if this agent's task has an edge to it                                          |
| slot0.type.<type>           | one-hot of its type; uniform observations of fleets with several types only       |
| slot0.displacement.x, .y    | its desired position, relative to this agent, in m                                |
| slot0.position.x, .y        | its received or estimated position, relative to this agent, in m                  |
| slot0.<state>               | its other states; an angle as cosine and sine                                     |
| slot0.bound.<state>         | guaranteed bound on the estimate's error, 0 for neighbours; `bounds=True` only    |
| slot1.valid ...             | the next slot                                                                     |

`observe="oracle"` puts true states and `observe="local"` zeros into the slots of k-hop targets; nothing else changes,
and the spaces stay the same.

Under a network (`network="wifi"`) agents know of each other by messages only, one a period, which can be late or lost:
neighbours are estimated, too, and slots say how old the information is that an estimate rests on.

| Columns                     | Content under a network                                                           |
|-----------------------------|-----------------------------------------------------------------------------------|
| slot0.valid                 | 1 once anything about the agent has arrived; before, the slot has the first guess |
| slot0.heard                 | 1 if something newer about it has arrived within this control period              |
| slot0.hops                  | number of links over which the newest has come; 0 before anything has arrived     |
| slot0.age                   | time since the newest was measured, in s; before anything has arrived: since reset |
| slot0.bound.<state>         | certified bound on this very estimate's error, for neighbours, too                |
| slot0.message.0 ...         | data of its policy, as it sent them with that state; `message_size` only          |

With `observe="oracle"` all slots have true states and are valid; with `observe="local"` neighbours are estimated from
messages, and the slots of k-hop targets are zeros.

With links that come and go (`Scenario.schedule`) and no network, a neighbour's state is received while its link is up.
Slots of k-hop targets hold their estimates all the time, which are predictions while an agent is cut off. With
`observe="oracle"` all slots have true states and are valid.

| Columns                     | Content where links come and go, without a network                                |
|-----------------------------|-----------------------------------------------------------------------------------|
| slot0.valid                 | 0 for a neighbour whose link is down: its state is zeros; what is constant stays  |
| slot0.heard                 | 1 if the agent is a neighbour whose link is up                                    |
| slot0.bound.<state>         | the guaranteed bound for the links that are up now, the largest value for none    |

Without relays (`relay = false`) neighbours are estimated, too: while its link is down a neighbour's slot holds the
estimate, with its bound, and is valid (zeros under `observe="local"`). These bounds follow from the whole graph at that
instant, which no agent knows: they are meant for evaluation. Under a network certified bounds use only what was
received.

### Action Space

Each agent's inputs as fractions of their limits, in [-1, 1]; larger values are clipped and counted in the infos. With
uniform observations all agents have as many entries as the largest, and ignore entries without an input.

With `message_size` above 0, an action has as many entries more, at its end: data that the agent sends with its messages
from now on, until its next action. They are passed on with its state, and arrive, or get lost, with it.

### Reward

Every control period an agent gets

    -control_period * (mean over its task edges of |p_j - p_i - d_ij|^2 + effort * |u_i|^2)

with true positions p in m at the end of the period, the displacements d_ij of the formation,
and its input u_i as fractions of the limits. With `reward="team"` all agents get the mean.

Episodes are truncated after `max_cycles` control periods, and terminate only if `success_radius` asks for it.
Infos are numbers under constant keys: `task_error`, the root mean square error along the agent's own task edges in m;
`max_normalized_disagreement` and `max_error_to_bound`, the largest |xi| / rho and |error| / bound of any observer since
the last action, below 1 by guarantee (under a network the bound is the certified one, of estimates of neighbours, too,
and xi is what an agent computes from the messages that it holds); `clipped_observations` and `clipped_actions`.

Initial states and disturbances are drawn per episode from the seed; `reset(options={"initial_state": {"drifter_0":
[0.5, -0.5]}})` gives some or all of them. `get_state()` and `set_state()` save and restore everything, and a pickled or
deep-copied environment continues bit for bit.

### Arguments

```python
from khop_env import formation_v0

formation_v0.parallel_env(scenario="paper", observe="estimate", bounds=False, uniform=True, max_cycles=200,
control_period=0.05, dt=None, order=1, actuator="direct", reward="agent", effort=0.1, success_radius=None,
limit=100.0, threads=1, network=None, estimator=None, message_size=0,
render_mode=None,
points=None, spacing=1.0)
```

`points`: (N, d) where the agents stand in the formation, in m; d_ij = points[j] - points[i]. By default a ring of
up to 12 agents, or a square grid

`spacing`: distance of neighbours in the default formation in m (default 1)

`scenario`: a name (`khop list`), one with parameters ("random_geometric:agents=12"), a path that ends in .toml, or a
`Scenario`

`observe`: content of the slots of k-hop targets: "estimate" (default), "oracle" for true states, "local" for zeros

`bounds`: whether slots also hold the guaranteed bound on the estimate's error (default False)

`uniform`: one padded Box for all agents (default), or with False a Box without padding for each agent

`max_cycles`: control periods in an episode, which is truncated then (default 200)

`control_period`: time between actions in s (default 0.05)

`dt`: the simulator's step in s; the control period has to be a multiple of it, and is one step by default

`order`: order of the simulator's step, 1 (default) or 2: actions are held over a control period, so that the closed
loop is of order 1 in it anyway; 2 integrates the motion between actions more accurately, at twice the time. Under a
network 1

`actuator`: "direct" (default), "lag", "slew", "hold", or one of `khop_env.env` with parameters, e.g.
`Lag(time_constant=0.2)`; all but the first keep the derivative of the inputs bounded, as the input observer's theorem
requires (Assumption 2-ii of the paper)

`reward`: "agent" (default) for each agent's own, "team" for the mean of all

`effort`: weight of the squared input in the reward, in m^2 (default 0.1)

`success_radius`: terminate the episode when no agent's task error exceeds it, in m (default None: never)

`limit`: bound on positions and other states in observations, in their units, and on ages in s (default 100); larger
values are clipped and counted in the infos

`threads`: that share the environments of a batch (default 1), or "auto"; the same results with any number

`network`: how messages are exchanged: a profile ("ideal", "urllc", "factory", "wifi", "lossy", "saturation", "espnow",
"crazyradio", "random"), also with other values ("lossy:period=0.1,loss=0.1..0.3"), a `khop_env.network.Network` or a
mapping of its values; "none" for exchange in continuous time, without messages. By default (None) the scenario's own,
which is that, too, unless its file says otherwise

`estimator`: from messages to estimates under a network: "ppso" for the paper's observers, "relay" for stamped states
that are passed on and predicted, or an object of your own. By default the scenario's own, "ppso"

`message_size`: numbers that a policy adds to its agent's messages, the last entries of its action (default 0); needs a
network

`render_mode`: None (default), "human" or "rgb_array"

### Version History

* v0: Initial version (khop_env 0.1.0, 2026-11)

"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import numpy as np
from pettingzoo import AECEnv

from khop_env.env import BatchedEnv, KHopEnv, SettingsArguments
from khop_env.registry import make, make_aec, make_batched, spelled_out
from khop_env.scenarios import Scenario
from khop_env.tasks import EdgeArguments, Formation

__all__ = ["batched_env", "env", "parallel_env", "raw_env"]


class Arguments(EdgeArguments, SettingsArguments, total=False):
    """Keyword arguments of this environment."""

    points: Sequence[Sequence[float]] | np.ndarray | None
    spacing: float


@spelled_out(Formation)
def batched_env(
    scenario: Scenario | str | Path = "paper", *, num_envs: int = 1, **arguments: Unpack[Arguments]
) -> BatchedEnv:
    """`num_envs` environments as arrays (num_envs, agents, ...); see the top of this module, too."""
    return make_batched(Formation, scenario, num_envs=num_envs, **arguments)


@spelled_out(Formation)
def parallel_env(
    scenario: Scenario | str | Path = "paper", *, render_mode: str | None = None, **arguments: Unpack[Arguments]
) -> KHopEnv:
    """The PettingZoo ParallelEnv; see the top of this module, too."""
    return make(Formation, scenario, render_mode=render_mode, **arguments)


@spelled_out(Formation)
def env(
    scenario: Scenario | str | Path = "paper", *, render_mode: str | None = None, **arguments: Unpack[Arguments]
) -> AECEnv:
    """The AEC environment, by PettingZoo's own conversion; see the top of this module, too.

    `aec.unwrapped.layout(agent)` names the columns of an observation.
    """
    return make_aec(Formation, scenario, render_mode=render_mode, **arguments)


raw_env = env
