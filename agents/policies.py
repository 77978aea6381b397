"""Policies by name: what the command line and the examples ask for."""

from __future__ import annotations

from typing import get_type_hints

from agents.laws import LAWS
from agents.learning.config import ALGORITHMS
from agents.learning.learned import LearnedPolicy, PretrainedPolicy
from agents.policy import Policy
from agents.scripted import BangBangPolicy, LawPolicy, RandomPolicy, ZeroPolicy
from khop_env.objects import called, is_object_name, load_object
from khop_env.physics import did_you_mean
from khop_env.registry import environments, parameters_from_text

FLOOR: dict[str, type[ZeroPolicy] | type[RandomPolicy]] = {
    "zero": ZeroPolicy,
    "random": RandomPolicy,
    "bang_bang": BangBangPolicy,
}
POLICIES = (*LAWS, *FLOOR)
"""Names of the policies without a file of their own."""


def make_policy(spec: str) -> Policy:
    """A policy by name, with parameters after a colon.

        make_policy("tanh")                  # tuned where there are tuned parameters, otherwise the defaults
        make_policy("linear:gain=2,cancel_drift=true")
        make_policy("zero")
        make_policy("ppo:runs/mine")         # what khop train learned: its folder, or one of the .npz files in it
        make_policy("ppo:pretrained")        # shipped with the library, for some environments and scenarios
        make_policy("ppo:pretrained/consensus_v0")  # the one for this environment
        make_policy("my_file.py:MyPolicy")   # a class of your own, or an object; "my_module:MyPolicy" likewise

    Raises:
        ValueError: for an unknown name or parameter, naming the nearest, a wrong value, or a file that isn't a policy.
    """
    name, _, given = spec.partition(":")
    if name not in (*POLICIES, *ALGORITHMS) and is_object_name(spec):
        return _policy_of_your_own(spec)
    if name in ALGORITHMS:
        if not given:
            raise ValueError(f"policy {spec!r}: say which, {name}:FOLDER or {name}:pretrained")
        if given == "pretrained" or given.startswith("pretrained/"):
            if name != "ppo":
                raise ValueError(f"policy {spec!r}: the shipped policies are ppo:pretrained")
            environment = given.partition("/")[2] or None
            if environment not in (None, *environments()):
                raise ValueError(
                    f"policy {spec!r}: no environment {environment!r}; {did_you_mean(environment, environments())}"
                )
            return PretrainedPolicy(environment)
        policy = LearnedPolicy.load(given)
        if policy.about["algorithm"] != name:
            raise ValueError(f"policy {spec!r}: {given} was trained by {policy.about['algorithm']}")
        return policy
    if name in LAWS:
        parameters = parameters_from_text(given, get_type_hints(LAWS[name]), f"policy {spec!r}")
        return LawPolicy(name, parameters)
    if name not in POLICIES:
        raise ValueError(f"no policy {name!r}; {did_you_mean(name, (*POLICIES, *ALGORITHMS))}")
    if given:
        raise ValueError(f"policy {spec!r}: {name!r} takes no parameters")
    return FLOOR[name]()


def _policy_of_your_own(spec: str) -> Policy:
    found = load_object(spec)
    policy = called(spec, found) if isinstance(found, type) else found
    if not (callable(getattr(policy, "reset", None)) and callable(getattr(policy, "act", None))):
        raise ValueError(
            f"policy {spec!r}: a policy has reset(env, seeds) and act(observations); got {type(policy).__name__}"
        )
    checked: Policy = policy
    return checked
