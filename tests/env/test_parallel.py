"""Errors of the PettingZoo environment: helpful messages, and no change of its state."""

import math
import re
from types import MappingProxyType

import numpy as np
import pytest

from khop_env import consensus_v0, formation_v0, leader_following_v0
from khop_env.observers import DesignError
from khop_env.physics import SingleIntegrator
from khop_env.scenarios.files import ScenarioFileError
from tests.env.playing import EVERY, built, parallel, play, random_actions, same, state


def good(env):
    return {agent: np.full(env.action_space(agent).shape, 0.5, np.float32) for agent in env.possible_agents}


def with_action(env, agent, value):
    return {**good(env), agent: value}


def without(env, *agents):
    return {agent: action for agent, action in good(env).items() if agent not in agents}


# convoy: the leaders are drifter_0, drifter_3 and drifter_6
BAD_ACTIONS = {
    "missing": (lambda e: without(e, "drifter_2"), "actions are missing for 1 agent: drifter_2"),
    "missing two": (lambda e: without(e, "drifter_2", "drifter_4"), "missing for 2 agents: drifter_2, drifter_4"),
    "none": (lambda e: {}, "actions are missing for 5 agents: drifter_1, drifter_2, drifter_4"),
    "unknown only": (lambda e: {"agent_0": np.zeros(2)}, "no agent 'agent_0'; known: drifter_1, drifter_2"),
    "unknown": (lambda e: with_action(e, "drifter_11", np.zeros(2)), "no agent 'drifter_11'; did you mean 'drifter_1'"),
    "leader": (lambda e: with_action(e, "drifter_3", np.zeros(2)), "no agent 'drifter_3'; it is a leader"),
    "long": (
        lambda e: with_action(e, "drifter_1", np.zeros(3)),
        r"the action of 'drifter_1' must have shape \(2,\); got \(3,\)",
    ),
    "scalar": (lambda e: with_action(e, "drifter_1", 0.5), r"'drifter_1' must have shape \(2,\); got \(\)"),
    "matrix": (lambda e: with_action(e, "drifter_1", np.zeros((1, 2))), r"must have shape \(2,\); got \(1, 2\)"),
    "nan": (
        lambda e: with_action(e, "drifter_4", np.array([0.1, np.nan])),
        "the action of 'drifter_4' isn't finite: entry 1 is nan",
    ),
    "infinite": (
        lambda e: with_action(e, "drifter_7", np.array([-np.inf, 0.0])),
        "the action of 'drifter_7' isn't finite: entry 0 is -inf",
    ),
    "text": (lambda e: with_action(e, "drifter_1", "left"), "the action of 'drifter_1' isn't numbers: 'left'"),
    "nothing": (lambda e: with_action(e, "drifter_1", None), "'drifter_1'"),
    "mapping": (lambda e: with_action(e, "drifter_1", {"vx": 1.0}), "the action of 'drifter_1' isn't numbers: {'vx'"),
}


@pytest.mark.parametrize("actuator", ["direct", "slew"])
@pytest.mark.parametrize("case", BAD_ACTIONS)
def test_bad_actions_are_refused_and_change_nothing(case, actuator):
    """The run with refused calls in between is the run without them, bit for bit, over the episode's end."""
    make, message = BAD_ACTIONS[case]
    env, clean = (parallel("leader_following_v0", "convoy", max_cycles=3, actuator=actuator) for _ in range(2))
    rng = np.random.default_rng(0)
    for seed in (2, None):
        assert same(env.reset(seed=seed), clean.reset(seed=seed))
        for _ in range(3):
            before = state(env)
            with pytest.raises(ValueError, match=message):
                env.step(make(env))
            assert same(state(env), before)
            actions = random_actions(env, rng)
            assert same(env.step(actions), clean.step(actions))


@pytest.mark.parametrize("given", [None, 3, [np.zeros(2)] * 5, np.zeros((5, 2)), "left", {"drifter_1"}])
def test_what_is_no_mapping_is_refused_and_changes_nothing(given):
    env, clean = parallel("leader_following_v0", "convoy"), parallel("leader_following_v0", "convoy")
    message = rf"mapping with an action for each agent, {{'drifter_1': .*\({type(given).__name__}\); arrays"
    for seed in (1, None):
        with pytest.raises(TypeError, match=message):  # outside of an episode, too
            env.step(given)
        assert same(env.reset(seed=seed), clean.reset(seed=seed))
        with pytest.raises(TypeError, match=message):
            env.step(given)
        assert same(play(env, 2), play(clean, 2))


@pytest.mark.parametrize(("environment", "name"), EVERY)
def test_a_bad_action_of_any_agent_names_that_agent(environment, name):
    """Also where agents differ in their inputs; entries that stand for no input are ignored."""
    for uniform in (True, False):
        env = parallel(environment, name, uniform=uniform)
        env.reset(seed=0)
        for agent in env.possible_agents:
            model = env.batched.fleet.models[env.batched.fleet.agent(agent)]
            last = good(env)[agent]
            last[model.m - 1] = np.nan
            with pytest.raises(ValueError, match=f"the action of '{agent}' isn't finite: entry {model.m - 1} is nan"):
                env.step(with_action(env, agent, last))
            padded = good(env)[agent]
            padded[model.m :] = np.nan
            env.step(with_action(env, agent, padded))


def test_padded_entries_are_ignored():
    """Whatever stands where an agent has no input, the step is the same, and nothing is counted as clipped."""
    one, other = parallel("consensus_v0", "mixed_fleet"), parallel("consensus_v0", "mixed_fleet")
    actions, padded = good(one), good(one)
    for agent, action in padded.items():
        action[one.batched.fleet.models[one.batched.fleet.agent(agent)].m :] = -7.0
    assert same(one.reset(seed=1), other.reset(seed=1))
    assert same(one.step(actions), other.step(padded))


def test_steps_outside_an_episode_are_refused():
    """Before the first reset, and after the end until the next one; a saved state brings an episode back."""
    env = parallel("consensus_v0", max_cycles=2)
    for _ in range(2):
        before = state(env)
        with pytest.raises(ValueError, match=r"no episode is running: it is over, or none has begun; call reset\(\)"):
            env.step(good(env))
        assert same(state(env), before)
        env.reset(seed=0)
        env.step(good(env))
        saved = env.get_state()
        env.step(good(env))
    env.set_state(saved)
    env.step(good(env))


BAD_INITIAL = {
    "unknown": ({"drifter_9": [0.0, 0.0]}, "option initial_state: no agent 'drifter_9'; did you mean 'drifter_"),
    "long": ({"drifter_1": [0.0] * 3}, "option initial_state: 'drifter_1' has the states x1, x2, which must be finite"),
    "nan": ({"drifter_1": [0.0, np.nan]}, "option initial_state: 'drifter_1' has the states x1, x2, .*nan"),
    "array": (np.zeros(15), r"must .*finite.*\(16,\).*got.*\(15,\)"),
    "nan in an array": (np.r_[np.zeros(15), np.nan], "finite"),
    "infinite": (np.full(16, np.inf), "finite"),
}


@pytest.mark.parametrize("case", BAD_INITIAL)
def test_bad_initial_states_are_refused_and_change_nothing(case):
    """In the middle of an episode, with and without a seed: it goes on, and so do the resets after it."""
    given, message = BAD_INITIAL[case]
    env, clean = parallel("leader_following_v0", "convoy"), parallel("leader_following_v0", "convoy")
    assert same(env.reset(seed=1), clean.reset(seed=1))
    for seed in (None, 7):
        with pytest.raises(ValueError, match=message):
            env.reset(seed=seed, options={"initial_state": given})
        assert same(play(env, 2), play(clean, 2))
    assert same(env.reset(), clean.reset())
    assert same(state(env), state(clean))


def test_initial_states_outside_the_funnels_are_refused_and_change_nothing():
    """The observers' own error says what would fit."""
    env, clean = parallel("consensus_v0", "mixed_fleet"), parallel("consensus_v0", "mixed_fleet")
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(DesignError, match=r"can't start inside their funnel.*or a smaller initial set"):
        env.reset(options={"initial_state": {"cart_1": [50.0, 0.0, 0.0, 0.0]}})
    assert same(play(env, 2), play(clean, 2))
    assert same(env.reset(), clean.reset())


def test_unknown_options_are_ignored_with_a_warning():
    """It names the nearest, and the rest of the options holds."""
    env = parallel("consensus_v0")
    with pytest.warns(UserWarning, match=r"reset\(\) ignores the option 'inital_state'; did you mean 'initial_state'"):
        warned = env.reset(seed=1, options={"inital_state": np.ones(16)})
    assert same(warned, env.reset(seed=1))


@pytest.mark.parametrize(
    ("seed", "got"), [(-1, "-1"), (np.int64(-3), r".*-3\)?"), (1.5, "1.5"), ("ab", "'a'"), ([-2], "-2")]
)
def test_bad_seeds_are_refused_and_change_nothing(seed, got):
    env, clean = parallel("consensus_v0"), parallel("consensus_v0")
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match=f"a seed must be a non-negative integer, or None; got {got}$"):
        env.reset(seed=seed)
    assert same(play(env, 2), play(clean, 2))


def test_an_aec_environment_s_layouts_are_within():
    env, aec = parallel("formation_v0"), formation_v0.env(built("paper"))
    for agent in env.possible_agents:
        assert aec.unwrapped.layout(agent).names == env.layout(agent).names


def test_unknown_agents_have_no_spaces():
    env = parallel("leader_following_v0", "convoy")
    for method in (env.observation_space, env.action_space, env.layout, env.observe):
        with pytest.raises(ValueError, match="no agent 'driftr_1'; did you mean 'drifter_1'"):
            method("driftr_1")
        with pytest.raises(ValueError, match="no agent 'drifter_0'; it is a leader, which takes no part"):
            method("drifter_0")


@pytest.mark.parametrize(
    "form",
    [
        lambda actions: dict(reversed(actions.items())),
        lambda actions: MappingProxyType(actions),
        lambda actions: {agent: action.tolist() for agent, action in actions.items()},
        lambda actions: {agent: action.astype(object) for agent, action in actions.items()},
        lambda actions: {agent: action.astype(np.int8) for agent, action in actions.items()},
        lambda actions: {agent: action.astype(str) for agent, action in actions.items()},
    ],
)
def test_actions_in_any_form_are_the_same(form):
    """In another order, in another mapping, and as other numbers; -1, 0 and 1 are exact in all of them."""
    seen = []
    for change in (dict, form):
        env = parallel("consensus_v0")
        env.reset(seed=3)
        rng = np.random.default_rng(0)
        for _ in range(3):
            actions = {agent: rng.integers(-1, 2, 2).astype(np.float32) for agent in env.agents}
            result = env.step(change(actions))
        seen.append(result)
    assert same(*seen)
    assert env.batched.world.inputs.any()


WRONG_SETTINGS = {
    "observe": (
        "estimated",
        "observe must be one of estimate, oracle, local; got 'estimated'; did you mean 'estimate'",
    ),
    "reward": ("mean", "reward must be 'agent' or 'team'; got 'mean'"),
    "bounds": (1, "bounds must be True or False; got 1"),
    "uniform": ("yes", "uniform must be True or False; got 'yes'"),
    "max_cycles": (0, "max_cycles must be a positive integer; got 0"),
    "control_period": (0.0, "control_period must be a positive, finite number of at most 1e30; got 0.0"),
    "dt": (-0.01, "dt must be a positive, finite number of at most 1e30; got -0.01"),
    "success_radius": (float("nan"), "success_radius must be a positive, finite number of at most 1e30; got nan"),
    "limit": (float("inf"), "limit must be a positive, finite number of at most 1e30; got inf"),
    "effort": (-0.1, "effort must be finite and not negative; got -0.1"),
    "order": (4, "exists at order 1, 2 and 3; got order=4"),
    "threads": (0, "threads must be a positive integer or 'auto'; got 0"),
    "actuator": ("lagg", r"no actuator 'lagg'; did you mean 'lag'.*Lag\(time_constant=0.2\)"),
    "render_mode": ("rgb", "render_mode must be None, 'human' or 'rgb_array'; got 'rgb'$"),
    "scenario": ("convoi", "no scenario 'convoi'; did you mean 'convoy'"),
}


@pytest.mark.parametrize("name", WRONG_SETTINGS)
def test_wrong_settings_are_refused(name):
    """The message has the value and the valid range."""
    value, message = WRONG_SETTINGS[name]
    with pytest.raises(ValueError, match=message):
        consensus_v0.parallel_env(**{name: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"threads": 10**6}, "threads must be at most 256; got 1000000"),
        ({"control_period": 1e-300}, "control_period must be from 1e-9 to 1e9 s.* got control_period = 1e-300 s"),
        ({"control_period": 1e20}, "from 1e-9 to 1e9 s"),
        ({"control_period": 10**400}, "control_period must be a positive, finite number of at most 1e30"),
        ({"dt": 1e-300}, "a million simulator steps; got control_period = 0.05 s and dt = 1e-300 s"),
        ({"limit": 1e39}, "limit must be a positive, finite number of at most 1e30"),
    ],
)
def test_settings_of_any_size_are_refused_before_anything_is_built(settings, message):
    with pytest.raises(ValueError, match=message):
        consensus_v0.parallel_env(**settings)


@pytest.mark.parametrize("max_cycles", [True, 2.0, "5", 0])
def test_cycles_are_whole_numbers(max_cycles):
    with pytest.raises(ValueError, match="max_cycles must be a positive integer; got"):
        parallel("consensus_v0", max_cycles=max_cycles)


def test_a_period_that_is_no_whole_number_of_steps_is_refused_with_one_that_is():
    with pytest.raises(
        ValueError, match=r"control_period = 0.05 s isn't a whole number of simulator steps dt = 0.02 s"
    ):
        parallel("consensus_v0", dt=0.02)
    with pytest.raises(ValueError, match=r"dt = 0.05 would make it 1"):
        parallel("consensus_v0", dt=0.06)
    assert parallel("consensus_v0", control_period=0.3, dt=0.1).batched.settings.substeps == 3  # 0.1 * 3 != 0.3


def test_a_line_over_one_step_is_refused():
    with pytest.raises(ValueError, match=r"a control period is one: give dt below control_period = 0\.05 s"):
        parallel("consensus_v0", actuator="hold")
    assert parallel("consensus_v0", actuator="hold", dt=0.025).batched.settings.substeps == 2


@pytest.mark.parametrize("module", [consensus_v0, formation_v0, leader_following_v0])
def test_unknown_settings_are_refused_with_the_nearest(module):
    for make in (module.parallel_env, module.env, module.batched_env):
        with pytest.raises(
            TypeError, match="unexpected keyword argument 'controlperiod'; did you mean 'control_period'"
        ):
            make(controlperiod=0.1)


def test_a_missing_scenario_file_is_named(tmp_path):
    with pytest.raises((ScenarioFileError, OSError), match=r"nowhere\.toml"):
        consensus_v0.parallel_env(tmp_path / "nowhere.toml")


def test_agents_without_input_limits_are_refused():
    """Unless they lead: then nobody gives them fractions of a limit."""
    models = list(built("paper").models)
    models[3] = SingleIntegrator(input_limit=math.inf)
    scenario = built("paper").replace(models=tuple(models)).sized()
    with pytest.raises(ValueError, match="and integrator_0 has none: give its model an input_limit"):
        consensus_v0.parallel_env(scenario)
    env = leader_following_v0.parallel_env(scenario, leaders=["drifter_0", "integrator_0", "drifter_5"])
    env.reset(seed=0)
    assert all(np.isfinite(observation).all() for observation in play(env, 1)[0][0].values())


def test_several_copies_are_no_parallel_environment():
    with pytest.raises(ValueError, match="a ParallelEnv is one environment; got num_envs=2: use make_vec for several"):
        parallel("consensus_v0", num_envs=2)


def test_rendering_needs_a_mode_and_an_episode():
    env = parallel("consensus_v0")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"render\(\) needs a render mode: make the environment with render_mode="):
        env.render()
    env.close()
    with pytest.raises(ValueError, match=r"there is nothing to render yet: call reset\(\) first"):
        parallel("consensus_v0", render_mode="rgb_array").render()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"leader": 2}, "got an unexpected keyword argument 'leader'; did you mean 'leaders'"),
        ({"render_mod": None}, "got an unexpected keyword argument 'render_mod'; did you mean 'render_mode'"),
        ({"scenari": "paper"}, "got an unexpected keyword argument 'scenari'; did you mean 'scenario'"),
    ],
)
def test_the_environment_s_own_arguments_are_among_the_nearest(arguments, said):
    with pytest.raises(TypeError, match=re.escape(said)):
        leader_following_v0.parallel_env(**arguments)


def test_a_huge_action_is_clipped_like_any_other():
    env = consensus_v0.parallel_env()
    env.reset(seed=0)
    infos = env.step({agent: np.array([1e300, -1e300]) for agent in env.agents})[-1]
    assert all(info["clipped_actions"] == 2 for info in infos.values())
