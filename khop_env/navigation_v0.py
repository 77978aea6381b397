"""
# Navigation

| Creation             | `make("aec", "khop/Navigation-v0")`                |
|----------------------|----------------------------------------------------|
| Actions              | Continuous                                         |
| Parallel API         | Yes                                                |
| Manual Control       | No                                                 |
| Agents               | `agents= ['integrator_0', ..., 'integrator_7']`    |
| Agents               | 8                                                  |
| Action Shape         | (2,); the most inputs that an agent has            |
| Action Values        | [-1, 1]                                            |
| Observation Shape    | (55,)                                              |
| Observation Values   | [-200, 200]; `limit` chooses them                  |
| State Shape          | (16,)                                              |
| State Values         | [-100, 100]                                        |

Each agent is to reach a goal of its own without touching another agent. Agents are discs, and most of those that may be
in the way are out of range of an agent's radio: it knows them by messages that are passed on, late, and partly lost.
What it holds is an estimate with a certified bound on its error, which grows with the age of the information.

| Scenario   | Starts and goals                                                                                   |
|------------|----------------------------------------------------------------------------------------------------|
| `crossing` | random in a square, 1 m apart                                                                      |
| `swap`     | on a circle, goals on the opposite side: all ways lead through the middle                          |
| `corridor` | two halves of a team change sides through a corridor with walls and round obstacles                |

All take the same parameters, e.g. `swap:agents=16,speed=1,radius=0.2,model=cart,graph=ring,loss=0.3,burst=5`; with
`continuous=true` exchange is in continuous time, and the bounds are the paper's. Defaults: 8 single integrators up to
1 m/s on the paper's tree, k = 6, discs of 0.2 m, a disturbance of 0.1 m/s, 30 % of messages lost in bursts of 5, 15 s.
**Hard: `swap:agents=16,duration=30`** (or `crossing:`, `corridor:`), 16 agents for 30 s.

Any other scenario works, too: agents of 0.2 m go to random goals within its initial set, where they may touch at the
start; a certified filter then warns that they may.

### Observation Space

An agent observes its own state, its goal, and a list of slots, one for every other agent within k hops: its neighbours
(1 hop) and its k-hop targets (2 to k hops). Slots are ordered by hop distance, then index. With uniform observations
the list is padded to the longest; a slot that isn't in use is all zeros.
`env.layout(agent)` names every column with its unit, and reads and builds observations.

| Columns                     | Content                                                                           |
|-----------------------------|-----------------------------------------------------------------------------------|
| own.<state>                 | own position, then the other states; an angle as own.<state>.cos and .sin         |
| own.input.<input>           | own input in force, as a fraction of its limit; not with actuator="direct"        |
| own.type.<type>             | one-hot of the agent's type; uniform only                                         |
| goal.x, .y                  | its goal, relative to this agent, in m                                            |
| obstacle0.x, .y ...         | nearest points of all obstacles, relative to this agent, in m; the nearest first  |
| radius                      | of every agent's disc, in m                                                       |
| slot0.valid                 | 1 if the slot is in use                                                           |
| slot0.heard                 | 1 if the agent is a neighbour, 0 if it is estimated                               |
| slot0.hops                  | hop distance in the communication graph                                           |
| slot0.task_edge             | 0: no agent's task depends on another                                             |
| slot0.type.<type>           | one-hot of its type; uniform observations of fleets with several types only       |
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

    (|p_i - q_i| at its beginning) - (|p_i - q_i| at its end) + bonus * (first arrival)
        - control_period * effort * |u_i|^2 - penalty * cost

with true position p_i and goal q_i in m, and its input u_i as fractions of the limits. It has arrived while it is
within `goal_radius` of its goal. Its cost is 1 if it has collided within the period, else 0: the distance to another
agent was below two radii, or that to an obstacle below one. This is checked along the straight lines between the steps
of the simulator, and not at samples. Collisions have no other consequence: agents and obstacles let each other pass.
With `reward="team"` all agents get the mean.

The episode terminates for the whole team when all agents are at their goals at once, with `end_at_collision=True` also
at the first collision, and is truncated after `max_cycles` control periods.
Infos are numbers under constant keys: `task_error`, the distance to the goal in m; `cost`; `arrived`, 1 at the goal;
`min_distance` and `obstacle_distance`, the smallest distances in m to another agent's centre and to an obstacle within
the period, at most `limit`; and as in all environments
`max_normalized_disagreement` and `max_error_to_bound`, the largest |xi| / rho and |error| / bound of any observer since
the last action, below 1 by guarantee (under a network the bound is the certified one, of estimates of neighbours, too,
and xi is what an agent computes from the messages that it holds); `clipped_observations` and `clipped_actions`.

For algorithms of safe reinforcement learning `khop_env.CostsApart(env)` returns the cost as a value of its own, as
Safety-Gymnasium does: `observations, rewards, costs, terminations, truncations, infos = env.step(actions)`.

Initial states, goals and disturbances are drawn per episode from the seed; `reset(options={"initial_state":
{"integrator_0": [0.5, -0.5]}})` gives some or all of the states, which aren't checked for collisions. `get_state()` and
`set_state()` save and restore everything, and a pickled or deep-copied environment continues bit for bit.

Frames show agents as discs, red where they have collided, their goals and obstacles. `env.batched.world.arrows`,
(agents, axes, 1) in m, are drawn from each agent, for what a filter changes; agents of `world.marked`, (agents, 1), are
in a ring, for where its program is infeasible.

### Arguments

```python
from khop_env import navigation_v0

navigation_v0.parallel_env(scenario="crossing", observe="estimate", bounds=False, uniform=True, max_cycles=None,
control_period=0.05, dt=None, order=1, actuator="direct", reward="agent", effort=0.01, bonus=1.0, penalty=0.0,
goal_radius=0.2, end_at_collision=False, limit=100.0, threads=1, network=None, estimator=None, message_size=0,
render_mode=None)
```

`scenario`: a name (`khop list`), one with parameters ("random_geometric:agents=12"), a path that ends in .toml, or a
`Scenario`

`observe`: content of the slots of k-hop targets: "estimate" (default), "oracle" for true states, "local" for zeros

`bounds`: whether slots also hold the guaranteed bound on the estimate's error (default False)

`uniform`: one padded Box for all agents (default), or with False a Box without padding for each agent

`max_cycles`: control periods in an episode, which is truncated then (default None: the scenario's duration, 15 s)

`control_period`: time between actions in s (default 0.05)

`dt`: the simulator's step in s; the control period has to be a multiple of it, and is one step by default

`order`: order of the simulator's step, 1 (default) or 2: actions are held over a control period, so that the closed
loop is of order 1 in it anyway; 2 integrates the motion between actions more accurately, at twice the time. Under a
network 1

`actuator`: "direct" (default), "lag", "slew", "hold", or one of `khop_env.env` with parameters, e.g.
`Lag(time_constant=0.2)`; all but the first keep the derivative of the inputs bounded, as the input observer's theorem
requires (Assumption 2-ii of the paper)

`reward`: "agent" (default) for each agent's own, "team" for the mean of all

`effort`: weight of the squared input in the reward, in m/s (default 0.01)

`bonus`: reward for an agent's first arrival in an episode, in m (default 1)

`penalty`: taken from the reward in every control period in which the agent has collided, in m (default 0)

`goal_radius`: distance to the goal up to which an agent has arrived, in m (default 0.2, the radius of its disc)

`end_at_collision`: whether the first collision terminates the episode (default False)

`limit`: bound on positions and other states in observations, in their units, and on ages in s (default 100); larger
values are clipped and counted in the infos

`threads`: that share the environments of a batch (default 1), or "auto"; the same results with any number

`network`: how messages are exchanged: a profile ("ideal", "urllc", "factory", "wifi", "lossy", "saturation", "espnow",
"crazyradio", "random"), also with other values ("lossy:period=0.1,loss=0.1..0.3"), a `khop_env.network.Network` or a
mapping of its values. By default the scenario's own: 30 % lost in bursts of 5

`estimator`: from messages to estimates under a network: "ppso" for the paper's observers, "relay" for stamped states
that are passed on and predicted, or an object of your own. By default the scenario's own, "relay" in the scenarios for
navigation

`message_size`: numbers that a policy adds to its agent's messages, the last entries of its action (default 0); needs a
network

`render_mode`: None (default), "human" or "rgb_array"

### Version History

* v0: Initial version (khop_env 0.1.0, 2026-11)

"""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from pettingzoo import AECEnv

from khop_env.env import BatchedEnv, KHopEnv, SettingsArguments
from khop_env.registry import make, make_aec, make_batched, spelled_out
from khop_env.scenarios import Scenario
from khop_env.tasks import Navigation, NavigationArguments

__all__ = ["batched_env", "env", "parallel_env", "raw_env"]


class Arguments(NavigationArguments, SettingsArguments, total=False):
    """Keyword arguments of this environment."""


@spelled_out(Navigation)
def batched_env(
    scenario: Scenario | str | Path = "crossing", *, num_envs: int = 1, **arguments: Unpack[Arguments]
) -> BatchedEnv:
    """`num_envs` environments as arrays (num_envs, agents, ...); see the top of this module, too."""
    return make_batched(Navigation, scenario, num_envs=num_envs, **arguments)


@spelled_out(Navigation)
def parallel_env(
    scenario: Scenario | str | Path = "crossing", *, render_mode: str | None = None, **arguments: Unpack[Arguments]
) -> KHopEnv:
    """The PettingZoo ParallelEnv; see the top of this module, too."""
    return make(Navigation, scenario, render_mode=render_mode, **arguments)


@spelled_out(Navigation)
def env(
    scenario: Scenario | str | Path = "crossing", *, render_mode: str | None = None, **arguments: Unpack[Arguments]
) -> AECEnv:
    """The AEC environment, by PettingZoo's own conversion; see the top of this module, too.

    `aec.unwrapped.layout(agent)` names the columns of an observation.
    """
    return make_aec(Navigation, scenario, render_mode=render_mode, **arguments)


raw_env = env
