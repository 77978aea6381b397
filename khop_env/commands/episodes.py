"""The episode that `khop run` simulates: a scenario under a law, or a policy in an environment."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_type_hints

from khop_env.commands.common import find_environment, load, with_network
from khop_env.commands.folders import digest, sources
from khop_env.terminal import say

if TYPE_CHECKING:
    from agents.running import PolicyRun
    from khop_env.observers import Networked, Observers
    from khop_env.results import Recording
    from khop_env.scenarios import LawChoice, Scenario
    from khop_env.tasks import Task

EXPLICIT_STEP = 1e-5  # s: how the paper samples its example


class IntegratorOption(enum.StrEnum):
    """How the observers are integrated."""

    PROXIMAL = "proximal"
    EXPLICIT = "explicit"


class OrderOption(enum.StrEnum):
    """Order of the proximal integrator."""

    ONE = "1"
    TWO = "2"
    THREE = "3"


@dataclass
class Episode:
    """All that is needed to simulate one, and to recognise it by.

    Attributes:
        simulator: reset; a scenario's closed loop, or a policy in its environment.
        played: the same policy, where one plays an environment.
        observers: how they are stepped.
        controller: name of the law or policy.
        duration: in s.
        dt: in s; None for steps of controlled size.
        content: digest of what the controller is made of.
        tolerance: of steps of controlled size.
    """

    simulator: Any
    played: PolicyRun | None
    observers: Observers
    controller: str
    duration: float
    dt: float | None
    content: str
    tolerance: float | None = None


def resolved(name: str, elsewhere: str | None) -> tuple[Task | type[Task] | None, Scenario]:
    """The task of an environment, or None, and the scenario.

    Raises:
        ValueError: for an unknown name, with the nearest.
    """
    from khop_env.physics import did_you_mean
    from khop_env.registry import SCENARIOS, environments

    task = find_environment(name)
    if task is not None:
        return task, load(elsewhere or task.default_scenario)
    if elsewhere is not None:
        raise ValueError(
            f"--scenario is for environments, and {name!r} isn't one; {did_you_mean(name, environments())}"
        )
    known = (*SCENARIOS, *environments())
    nearest = did_you_mean(name, known)
    if name.isidentifier() and name not in known and any(repr(task_name) in nearest for task_name in environments()):
        raise ValueError(f"no scenario or environment {name!r}; {nearest}")
    return None, load(name)


def is_policy(controller: str | None) -> bool:
    """Whether a controller acts through an environment: everything but a law."""
    from agents.laws import LAWS

    name = (controller or "").partition(":")[0]
    if controller is None or name in LAWS:
        return False
    from agents.learning import ALGORITHMS
    from agents.policies import FILTER, POLICIES
    from khop_env.objects import is_object_name
    from khop_env.physics import did_you_mean

    if name not in (FILTER, *POLICIES, *ALGORITHMS) and not is_object_name(controller):
        raise ValueError(f"no law or policy {name!r}; {did_you_mean(name, (*POLICIES, FILTER, *ALGORITHMS))}")
    return True


def continuous(
    scenario: Scenario,
    controller: str | None,
    observe: Any,
    duration: float | None,
    steps: Mapping[str, Any],
    seed: int,
    over: Networked | None,
) -> Episode:
    """The closed loop under a law that is evaluated at every instant, or over a network at every step."""
    from agents.laws import make_law
    from khop_env.observers import Explicit, Proximal
    from khop_env.scenarios.scenario import number_of_steps
    from khop_env.simulation.plant import parts_of_step
    from khop_env.simulation.step_control import require_tolerance

    for option in ("--order", "--integrator", "--tolerance"):
        if over is not None and steps[option] is not None:
            raise ValueError(f"{option}: over a network estimates follow from rounds of messages; leave it out")
    order, explicit, tolerance = steps["--order"], steps["--integrator"] is not None, steps["--tolerance"]
    if tolerance is not None:
        require_tolerance(tolerance)
        if steps["--dt"] is not None:
            raise ValueError("--dt: the size of steps follows from --tolerance; give one of the two")
        if explicit or order is OrderOption.ONE:
            wrong = "--order 1" if order is OrderOption.ONE else "--integrator explicit"
            raise ValueError(f"{wrong}: --tolerance is for the proximal step of order 2 or 3; leave it out")
        order = order or OrderOption.THREE
    if explicit and order not in (None, OrderOption.ONE):
        raise ValueError(f"--order {order}: the explicit integrator is forward Euler, of order 1; leave --order out")
    duration = scenario.duration if duration is None else duration
    dt: float = steps["--dt"] if steps["--dt"] is not None else EXPLICIT_STEP if explicit else scenario.dt
    number_of_steps(duration, dt if tolerance is None else duration)  # refuses too many before anything is built
    law = law_of(scenario, controller)
    made = make_law(law)
    if tolerance is None:
        longest, stiffest = scenario.longest_step
        parts_of_step(dt, longest, f"the drift of {scenario.fleet.ids[stiffest]!r}")
    own = Explicit() if explicit else Proximal(scenario.order if order is None else int(order.value))
    observers: Observers = own if over is None else over
    simulator = scenario.build(law=made, observe=observe, observers=observers)
    simulator.reset(seed)
    for warning in scenario.warnings:
        say(f"khop: {warning}")
    content, step = digest(law.name, law.parameters), dt if tolerance is None else None
    return Episode(simulator, None, simulator.observers, law.name, duration, step, content, tolerance)


def played_episode(
    name: str,
    task: Task | type[Task] | None,
    scenario: Scenario,
    controller: str | None,
    observe: Any,
    duration: float | None,
    seed: int,
    env: list[str] | None,
    network: str | None,
    estimator: str | None,
) -> Episode:
    """A policy in an environment."""
    from agents.running import environment_for, policy_run
    from agents.safety import SafetyFilter
    from khop_env.registry import find_task
    from khop_env.scenarios.scenario import number_of_steps
    from khop_env.typed import environment_arguments

    if duration is not None or task is None:
        number_of_steps(scenario.duration if duration is None else duration, scenario.dt)
    elsewhere = {"observe": "--observe"} | ({} if duration is None else {"max_cycles": "--duration"})
    spec = controller or (None if task is None else task.default_policy) or scenario.law.name
    acted = task if task is not None else find_task(environment_for(spec, scenario))
    arguments = with_network(environment_arguments(env, acted, elsewhere), network, estimator)
    if task is None and duration is None and "max_cycles" not in arguments:
        duration = scenario.duration
    played = policy_run(spec, scenario, observe, duration, seed, environment=acted, arguments=arguments)
    batched = played.env.batched
    if task is None:
        say(f"khop: {spec} acts in {batched.task.environment} (khop run ENV --scenario {name} chooses another one)")
    policy = played.policy
    if isinstance(policy, SafetyFilter):  # its options are in its name
        policy = policy.policy
    made_of = getattr(policy, "networks", None), getattr(policy, "parameters", None)
    content = digest(spec, made_of, sources([policy, batched.task]))
    return Episode(played, played, played.observers, spec, played.duration, batched.settings.control_period, content)


def configuration_of(scenario: Scenario, episode: Episode, observe: str, seed: int) -> dict[str, Any]:
    """What the numbers of a run depend on, as JSON has it."""
    from agents.learning.fingerprint import plain
    from khop_env.observers import Networked

    found = {
        "scenario": scenario.name,
        "controller": episode.controller,
        "observe": observe,
        "seed": seed,
        "duration": episode.duration,
        "dt": episode.dt,
        "integrator": episode.observers.name,
        "order": episode.observers.order,
        "scenario_content": digest(scenario, sources(scenario.models)),
        "controller_content": episode.content,
    }
    if episode.tolerance is not None:
        found["tolerance"] = episode.tolerance
    if isinstance(episode.observers, Networked):
        estimator = episode.observers.estimator
        found |= {"network": plain(episode.observers.network), "estimator": estimator.name}
        if own := sources([estimator]):
            found["estimator_content"] = digest(own)
    if episode.played is not None:
        batched = episode.played.env.batched
        found |= {"environment": batched.task.environment, "settings": plain(batched.settings)}
        found["task_content"] = digest(batched.task.signature(batched.world))
    return found


def result_of(played: PolicyRun, recording: Recording) -> dict[str, Any]:
    """What an environment adds to a run's summary."""
    from khop_env.results.metrics import finite

    batched, outcomes = played.env.batched, played.outcomes
    assert recording.task_error is not None
    return {
        "environment": batched.task.environment,
        "return": finite(played.episode_return),
        "final_task_error": finite(float(recording.task_error[-1])),
        "task_error_unit": batched.task.error_unit(batched.world),
        "terminated": bool(recording.time[-1] < played.duration - 1e-9) and recording.completed,
        **({"outcomes": {name: finite(value) for name, value in outcomes.items()}} if outcomes else {}),
    }


def law_of(scenario: Scenario, controller: str | None) -> LawChoice:
    """The law that is asked for, with its parameters; by default the scenario's."""
    from agents.laws import LAWS
    from khop_env.registry import parameters_from_text
    from khop_env.scenarios import LawChoice

    if controller in (None, scenario.law.name):
        return scenario.law
    name, _, parameters = str(controller).partition(":")
    return LawChoice(name, parameters_from_text(parameters, get_type_hints(LAWS[name]), f"--controller {controller}"))
