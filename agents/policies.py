"""Policies by name, for the command line and the examples."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, get_type_hints

from agents.laws import LAWS
from agents.learning.config import ALGORITHMS
from agents.learning.learned import LearnedPolicy
from agents.learning.pretrained import PretrainedPolicy, load_pretrained
from agents.navigation import GoToGoal, KeepRight
from agents.orca import Orca
from agents.policy import Policy
from agents.robust_barrier import RobustBarrier
from agents.safety import Margin, SafetyFilter
from agents.scripted import BangBangPolicy, LawPolicy, RandomPolicy, ZeroPolicy
from khop_env.network import Network
from khop_env.objects import called, is_object_name, load_object
from khop_env.physics import did_you_mean
from khop_env.registry import parameters_from_text
from khop_env.scenarios import Scenario

FLOOR: dict[str, Callable[..., Policy]] = {
    "zero": ZeroPolicy,
    "random": RandomPolicy,
    "bang_bang": BangBangPolicy,
    "go_to_goal": GoToGoal,
    "keep_right": KeepRight,
    "orca": Orca,
    "robust_barrier": RobustBarrier,
}
FILTER = "filter"
FILTER_OPTIONS = {
    "margin": str,
    "gamma": float,
    "announce": bool,
    "radius": float,
    "bounds": bool,
    "dead_reckoning": bool,
}
"""Options of the safety filter in a policy's name, and their types."""
_LATE = re.compile(f"[:,]((?:{'|'.join(FILTER_OPTIONS)})=[^,:]*)")
POLICIES = (*LAWS, *FLOOR)
"""Names of the scripted policies."""


def make_policy(spec: str) -> Policy:
    """A policy by name, with parameters after a colon.

        make_policy("tanh")                  # shipped tuned parameters if there are any, else the defaults
        make_policy("linear:gain=2,cancel_drift=true")
        make_policy("zero")
        make_policy("orca:horizon=1")        # a baseline in navigation_v0, as robust_barrier:alpha=2
        make_policy("ppo:runs/first")        # written by khop train: its folder, or one of the .npz files in it
        make_policy("ppo:pretrained")        # the shipped policy for the environment, its scenario and network
        make_policy("ppo:pretrained/leader_following_convoy")  # a shipped policy by its name (khop list)
        make_policy("my_file.py:MyPolicy")   # your own class or object; also "my_module:MyPolicy"
        make_policy("filter")                # keep_right in a safety filter, with certified bounds
        make_policy("filter:margin=0.3,gamma=0.5:ppo:runs/first")  # any of these, with options of SafetyFilter

    Raises:
        ValueError: if a name or parameter is unknown (the message suggests the closest match), a value is invalid, or a
            file isn't a policy.
    """
    name, _, argument = spec.partition(":")
    if name == FILTER:
        return _filter(spec, argument)
    if name not in (*POLICIES, *ALGORITHMS) and is_object_name(spec):
        return _user_policy(spec)
    if name in ALGORITHMS:
        if not argument:
            raise ValueError(f"policy {spec!r}: no policy file named; expected {name}:FOLDER or {name}:pretrained")
        if argument == "pretrained":
            if name != "ppo":
                raise ValueError(f"policy {spec!r}: only ppo:pretrained chooses; others by name, ppo:pretrained/NAME")
            return PretrainedPolicy()
        beginning, _, rest = argument.partition("/")
        policy = load_pretrained(rest) if beginning == "pretrained" else LearnedPolicy.load(argument)
        if policy.about["algorithm"] != name:
            raise ValueError(f"policy {spec!r}: {argument} was trained by {policy.about['algorithm']}")
        return policy
    if name in LAWS:
        parameters = parameters_from_text(argument, get_type_hints(LAWS[name]), f"policy {spec!r}")
        return LawPolicy(name, parameters)
    if name not in POLICIES:
        raise ValueError(f"no policy {name!r}; {did_you_mean(name, (*POLICIES, FILTER, *ALGORITHMS))}")
    hints = get_type_hints(FLOOR[name].__init__)
    known = {key: kind for key, kind in hints.items() if key != "return"}
    if argument and not known:
        raise ValueError(f"policy {spec!r}: {name!r} takes no parameters")
    found = _options(argument, known, f"policy {spec!r}")
    try:
        return FLOOR[name](**found)
    except ValueError as error:
        raise ValueError(f"policy {spec!r}: {error}") from error


def shielded(policy: str | Policy, margin: Margin = "certified", **options: Any) -> SafetyFilter:
    """A policy in a safety filter.

    Args:
        policy: a policy, or what `make_policy` takes.
        margin: "certified" for the estimates' certified bounds, "none", or a number of m.
        options: of `SafetyFilter`.

    Raises:
        ValueError: for an unknown policy, or an option out of range.
    """
    return SafetyFilter(make_policy(policy) if isinstance(policy, str) else policy, margin, **options)


def safety_filter(shield: str, policy: Policy | None, bounds: bool | None = None) -> SafetyFilter:
    """The safety filter that `--shield` means.

    Args:
        shield: a margin, and options of `SafetyFilter` after commas: "certified,announce=true".
        policy: inside; None for a filter that only corrects actions.
        bounds: whether the policy observes bounds; None as for `SafetyFilter`.

    Raises:
        ValueError: for a wrong margin or option.
    """
    margin, _, options = shield.partition(",")
    found = {"bounds": bounds, **_options(options, FILTER_OPTIONS, f"shield {shield!r}")}
    return SafetyFilter(policy, margin, **found)


class Needs(NamedTuple):
    """Arguments of an environment that a policy needs.

    Attributes:
        bounds: whether bounds must be in observations.
        message_size: numbers that it adds to messages.
    """

    bounds: bool
    message_size: int

    def among(self, arguments: Mapping[str, Any], scenario: Scenario | None = None) -> dict[str, Any]:
        """These, and then `arguments`, which come first where they say otherwise.

        Args:
            arguments: of the environment.
            scenario: None where its network isn't to be checked.

        Raises:
            ValueError: if a filter announces anchors where there are no messages.
        """
        chosen = arguments.get("network")
        network = chosen if chosen is not None or scenario is None else scenario.network
        if self.message_size and scenario is not None and Network.of(network) is None:
            raise ValueError(
                "announce=true sends anchors in messages, and without a network there are none: leave it out, or "
                "choose a network, e.g. network='wifi'"
            )
        needed: dict[str, Any] = {"bounds": True} if self.bounds else {}
        return needed | ({"message_size": self.message_size} if self.message_size else {}) | dict(arguments)


def needs(policy: Policy) -> Needs:
    """What a policy needs of its environment: bounds that it reads, or was trained with; numbers in messages."""
    if isinstance(policy, SafetyFilter):
        inside = needs(policy.policy)
        return Needs(policy.needs_bounds or inside.bounds, policy.needs_messages + inside.message_size)
    trained = isinstance(policy, LearnedPolicy) and bool(policy.about.get("bounds"))
    return Needs(trained or bool(getattr(policy, "needs_bounds", False)), 0)


def _filter(spec: str, argument: str) -> SafetyFilter:
    """The safety filter of "filter[:OPTION=VALUE,...][:POLICY]"."""
    options, colon, inside = argument.partition(":")
    if "=" not in options:
        options, inside = "", argument
    found = _options(options, FILTER_OPTIONS, f"policy {spec!r}")
    if colon and not inside:
        raise ValueError(f"policy {spec!r}: expected {FILTER}:OPTION=VALUE,...:POLICY; there is no policy")
    order = _in_order(options, inside)
    if order and is_object_name(inside.partition(",")[0]):
        raise ValueError(f"policy {spec!r}: {order}")
    try:
        return shielded(inside or "keep_right", **found)
    except ValueError as error:
        raise ValueError(f"policy {spec!r}: {error}{'; ' * bool(order)}{order}") from error


def _in_order(options: str, inside: str) -> str:
    """What to write where options of the filter come after the policy; "" where none do."""
    late = _LATE.findall(inside)
    if not late or inside.partition(":")[0] in (FILTER, *FLOOR):  # some of which have a margin of their own
        return ""
    options = ",".join(filter(None, [options, *late]))
    return f"options of the filter come before the policy: {FILTER}:{options}:{_LATE.sub('', inside)}"


def _options(text: str, known: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The options in a policy's name; `known` has their types."""
    found = parameters_from_text(text, known, where)
    for key in found:
        if key not in known:
            raise ValueError(f"{where}: no option {key!r}; {did_you_mean(key, known)}")
    return found


def _user_policy(spec: str) -> Policy:
    source, _, name = spec.rpartition(":")
    if source and "=" in name and os.sep not in name:
        known = name.partition(",")[0]
        raise ValueError(
            f"policy {spec!r}: a policy of your own takes no options here; set them in the file, "
            f"policy = {known}(...), and name {source}:policy"
        )
    loaded = load_object(spec)
    policy = called(spec, loaded) if isinstance(loaded, type) else loaded
    if not (callable(getattr(policy, "reset", None)) and callable(getattr(policy, "act", None))):
        raise ValueError(
            f"policy {spec!r}: expected an object with reset(env, seeds) and act(observations); got "
            f"{type(policy).__name__}"
        )
    checked: Policy = policy
    return checked
