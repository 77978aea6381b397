import math

import networkx as nx
import numpy as np
import pytest

from agents import LAWS, make_law
from khop_env.observers import DesignError, Exponential, TargetObservers
from khop_env.physics import (
    DISTURBANCES,
    MODELS,
    BandLimitedNoise,
    Coupling,
    DoubleIntegrator,
    Gust,
    SingleIntegrator,
    Sinusoid,
    SurfaceVessel,
    Term,
    Unicycle,
)
from khop_env.scenarios import LawChoice, Scenario, paper
from khop_env.scenarios.files import ScenarioFileError, read_scenario, write_scenario
from khop_env.scenarios.mixed_fleet import mixed_fleet
from khop_env.scenarios.random_geometric import random_geometric


def everything() -> Scenario:
    """A scenario that uses all that a file can say."""
    ring = nx.cycle_graph(7)
    return Scenario(
        name='it\'s "quoted"\\',
        description="two\nlines, µ",
        models=(
            SingleIntegrator(input_limit=(1.0, 2.0)),
            SingleIntegrator(input_limit=(1.0, 2.0)),
            SingleIntegrator(),
            DoubleIntegrator(damping=0.25),
            Unicycle(),
            SurfaceVessel(mass=(20.0, 30.0, 2.0), input_limit=3.0),
            DoubleIntegrator(damping=0.25),
        ),
        communication=ring,
        task=nx.path_graph(7),
        k=3,
        design_rule="sharp",
        relay=False,
        delta={
            "integrator": Exponential(40.0, 0.1, 4.0),
            "cart": [Exponential(50.0 + i, 0.1, 4.0) for i in range(4)],
            "unicycle": Exponential(40.0, 0.1, 4.0),
            "vessel": [Exponential(40.0, 0.1 + 0.1 * i, 4.0 - 0.5 * i) for i in range(6)],
        },
        theta={kind: Exponential(400.0, 1.0, 5.0) for kind in ("integrator", "cart", "vessel")},
        observers=(
            TargetObservers(),
            TargetObservers(drift=False),
            TargetObservers(),
            TargetObservers(input_observer=False),
            TargetObservers(input_observer=False),
            TargetObservers(drift=False),
            TargetObservers(),
        ),
        disturbance=(
            Sinusoid(0.3, agents=("integrator", "vessel_0"))
            + BandLimitedNoise((0.0, 0.0, 0.1, 0.2), agents="cart", components=3)
            + Gust(0.2, duration=0.5, period=2.0, pulses=4)
            + Coupling((0.1, 0.0), gain=-0.5)
        ),
        center=np.linspace(-1.0, 1.0, 23),
        radius=np.concatenate([np.full(6, 0.5), np.arange(17) / 10.0]),
        law=LawChoice("tanh", {"gain": 0.5}),
        duration=0.3,
        dt=0.02,
        order=1,
    )


def trajectory(scenario: Scenario) -> list[np.ndarray]:
    simulator = scenario.build(law=make_law(scenario.law)).reset(5)
    for _ in range(15):
        simulator.step(scenario.dt)
    return [getattr(simulator, name).copy() for name in ("t", "x", "u", "estimates", "input_estimates")]


@pytest.mark.parametrize("make", [paper, mixed_fleet, random_geometric, everything])
def test_a_round_trip_gives_the_same_bits(make, tmp_path):
    scenario = make()
    path = tmp_path / "mine.toml"
    text = write_scenario(scenario)
    path.write_text(text, encoding="utf-8")
    again = read_scenario(path, laws=LAWS)
    for name in (
        "name",
        "description",
        "k",
        "relay",
        "duration",
        "dt",
        "order",
        "figure_agent",
        "models",
        "observers",
        "disturbance",
    ):
        assert getattr(again, name) == getattr(scenario, name), name
    assert again.law == scenario.law
    assert again.design.design_rule == scenario.design.design_rule
    for ours, theirs in zip(trajectory(scenario), trajectory(again), strict=True):
        assert np.array_equal(ours, theirs)
    assert write_scenario(again) == text


def test_every_section_is_explained():
    text = write_scenario(mixed_fleet())
    lines = text.splitlines()
    for section in ("[[agents]]", "[communication]", "[task]", "[delta.integrator]", "[[disturbance]]", "[law]"):
        assert lines[lines.index(section) - 1].startswith("#"), section
    for name in (*MODELS, *DISTURBANCES):
        assert name in text


def test_a_large_fleet_is_written_quickly_and_read(tmp_path):
    scenario = random_geometric(agents=500)
    (tmp_path / "large.toml").write_text(write_scenario(scenario), encoding="utf-8")
    assert read_scenario(tmp_path / "large.toml").communication.edges == scenario.communication.edges


MINIMAL = """
name = "small"
k = 2
[[agents]]
model = "integrator"
count = 3
[communication]
edges = [[0, 1], [1, 2]]
[task]
edges = [[0, 2]]
[delta]
initial = 10.0
final = 0.1
rate = 5.0
[theta]
initial = 100
final = 1
rate = 5
"""


def read(text: str, tmp_path, **options) -> Scenario:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return read_scenario(path, **options)


def test_what_is_left_out_has_the_scenarios_defaults(tmp_path):
    scenario = read(MINIMAL, tmp_path)
    assert (scenario.relay, scenario.duration, scenario.dt, scenario.order) == (True, 10.0, 0.01, 2)
    assert scenario.disturbance is None
    assert scenario.observers is None
    assert scenario.law == LawChoice("tanh")
    assert scenario.models == (SingleIntegrator(),) * 3
    assert np.array_equal(scenario.initial.radius, np.ones(6))


@pytest.mark.parametrize(
    ("given", "expected"),
    [("2", [2.0] * 6), ("[1, 2.5]", [1.0, 2.5] * 3), ("[[1, 2], [3, 4], [5, 6]]", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])],
)
def test_forms_of_the_initial_set(given, expected, tmp_path):
    scenario = read(MINIMAL.replace("count = 3", f"count = 3\ninitial_radius = {given}"), tmp_path)
    assert scenario.initial.radius.tolist() == expected


def test_an_unlimited_input_can_be_written(tmp_path):
    scenario = read(MINIMAL.replace("count = 3", "count = 3\ninput_limit = inf"), tmp_path)
    assert math.isinf(scenario.models[0].input_limit[0])


NOISE = '[[disturbance]]\nkind = "sinusoid"\n'

REFUSALS = [  # (what is replaced, by what, the key named, what else the message has to say)
    ('model = "integrator"', 'model = "integratr"', "agents[0].model", ["got 'integratr'", "mean 'integrator'?"]),
    ('model = "integrator"', 'modle = "integrator"', "agents[0].model", ["missing", "is 'modle' meant"]),
    ("count = 3", "count = 3\ndamping = 1.0", "agents[0].damping", ["unknown key", "1.0", "input_limit"]),
    ("count = 3", "count = 3\ninput_limt = 1.0", "agents[0].input_limt", ["did you mean 'input_limit'?"]),
    ("count = 3", "count = true", "agents[0].count", ["got True, expected an integer"]),
    ("count = 3", "count = 0", "agents[0].count", ["got 0, expected at least 1"]),
    ("count = 3", "count = 3\ndim = 2.5", "agents[0].dim", ["got 2.5, expected an integer"]),
    ("count = 3", "count = 3\ndim = 4", "agents[0]", ["SingleIntegrator.dim must be 1, 2 or 3; got 4"]),
    ("count = 3", 'count = 3\ninput_limit = "x"', "agents[0].input_limit", ["got 'x', expected a number or a list"]),
    ("count = 3", "count = 3\ninput_limit = [1, 2, 3]", "agents[0]", ["one per input ('vx', 'vy'); got (1, 2, 3)"]),
    ("count = 3", 'count = 3\ndrift_known = "no"', "agents[0].drift_known", ["got 'no', expected true or false"]),
    ("count = 3", "count = 3\ninitial_radius = -1", "agents[0].initial_radius", ["got -1", "none negative"]),
    ("count = 3", "count = 3\ninitial_center = nan", "agents[0].initial_center", ["got nan, expected finite numbers"]),
    (
        "count = 3",
        "count = 3\ninitial_radius = [1, 2, 3]",
        "agents[0].initial_radius",
        ["got 3 numbers, expected a number, 2 numbers (one for each of x, y), or 3 lists of 2"],
    ),
    ("count = 3", "count = 3\ninitial_radius = [[1, 2], [3]]", "agents[0].initial_radius", ["of different lengths"]),
    ("[[agents]]", "[agents]", "agents", ["each under a line [[agents]]"]),
    ("[[0, 1], [1, 2]]", "[[0, 1]]", "communication.edges", ["falls into 2 components: {0, 1}, {2}"]),
    ("[[0, 1], [1, 2]]", "[[0, 1], [1, 3]]", "communication.edges[1]", ["got [1, 3]", "from 0 to 2"]),
    ("[[0, 1], [1, 2]]", "[[0, 1], [1, 1], [1, 2]]", "communication.edges[1]", ["got [1, 1]", "its own neighbour"]),
    ("[[0, 1], [1, 2]]", "[[0, 1, 2]]", "communication.edges[0]", ["got [0, 1, 2], expected two"]),
    ("[communication]", "[comunication]", "communication", ["missing; expected a table; is 'comunication' meant"]),
    ("[communication]", "[communication]\nrange = 3", "communication.range", ["unknown key", "known: edges"]),
    ("[[0, 2]]", '[["a", "b"]]', "task.edges[0]", ["got ['a', 'b']", "integers"]),
    ("[[0, 1], [1, 2]]", "[[0, 1], 3]", "communication.edges[1]", ["got 3, expected two numbers of agents"]),
    ("[[0, 1], [1, 2]]", "[[0, 1], [true, 2]]", "communication.edges[1]", ["got [True, 2]"]),
    ("[[0, 1], [1, 2]]", "3", "communication.edges", ["got 3, expected a list of lists"]),
    ("k = 2", "k = 2\nduration = inf", "scenario 'small'", ["duration must be positive and finite; got inf"]),
    ("k = 2", "k = 1", "k", ["got 1, expected at least 2"]),
    ("k = 2", "k = 2.0", "k", ["got 2.0, expected an integer"]),
    ("k = 2", "k = 2\norder = 4", "order", ["got 4, expected 1, 2 or 3"]),
    ("k = 2", "k = 2\nfigure_agent = 'a'", "figure_agent", ["expected an integer"]),
    ("k = 2", 'k = 2\ndesign_rule = "blunt"', "design_rule", ["got 'blunt', expected \"paper\" or \"sharp\""]),
    ("k = 2", "k = 2\nduraton = 3", "duraton", ["did you mean 'duration'?"]),
    ("k = 2", "k = 2\ndt = -1", "scenario 'small'", ["dt must be positive and finite; got -1"]),
    ("k = 2", "k =", "not a TOML file", ["line 3"]),
    ("initial = 10.0", "initial = 0.01", "delta", ["0 < final <= initial", "initial=0.01"]),
    ("initial = 10.0", "initial = [1, 2]", "delta.initial", ["expected a number"]),
    ("initial = 10.0", "intial = 10.0", "delta.initial", ["missing; expected a number or \"auto\"; is 'intial' m"]),
    ("rate = 5\n", "rate = 5\nslope = 1\n", "theta.slope", ["unknown key"]),
    ("[delta]", "[delta.integrater]", "delta.integrater", ["did you mean 'integrator'?"]),
    ("[delta]\ninitial = 10.0", "[delta.integrator]\ninitial = [1, 2, 3]", "delta.integrator.initial", ["got 3 num"]),
    ("[theta]", '[law]\nname = "tan"\n[theta]', "law.name", ["got 'tan', expected one", "mean 'tanh'?"]),
    ("[theta]", NOISE.replace("sin", "cos") + "[theta]", "disturbance[0].kind", ["got 'cosusoid'", "mean 'sinusoid'?"]),
    ("[theta]", NOISE + "[theta]", "disturbance[0].amplitude", ["missing; expected a number or a list of numbers"]),
    ("[theta]", NOISE + "amplitude = [1]\n[theta]", "disturbance[0]", ["has 1 entries", "integrator_0 (2)"]),
    ("[theta]", NOISE + 'amplitude = 1\nagents = "cart"\n[theta]', "disturbance[0]", ["no agent or type 'cart'"]),
    ("[theta]", NOISE + "amplitude = 1\nfrequency = [1]\n[theta]", "disturbance[0].frequency", ["a list of 2 numbers"]),
    ("[theta]", NOISE + "amplitude = 1\nband = [1, 2]\n[theta]", "disturbance[0].band", ["unknown key", "frequency"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "key", "said"), REFUSALS, ids=[new.split("\n")[-1] for _, new, *_ in REFUSALS])
def test_refusals(old, new, key, said, tmp_path):
    assert MINIMAL.count(old) == 1
    with pytest.raises(ScenarioFileError) as caught:
        read(MINIMAL.replace(old, new), tmp_path, laws=LAWS)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'mine.toml'}: {key}")
    for part in said:
        assert part in message


def wrong(text: str, tmp_path) -> list[str]:
    """The mistakes that a message names, without the file."""
    with pytest.raises(ScenarioFileError) as caught:
        read(text, tmp_path, laws=LAWS)
    first, *more = str(caught.value).split("\n")
    place = f"{tmp_path / 'mine.toml'}: "
    assert first.startswith(place)
    if not more:
        return [first.removeprefix(place)]
    assert first == f"{place}{len(more)} mistakes:"
    return [line.removeprefix("  ") for line in more]


def test_all_mistakes_of_a_file_are_named_at_once(tmp_path):
    text = (
        MINIMAL.replace("k = 2", "k = 1\nduraton = 3")
        .replace("count = 3", "count = 0\ndim = 7.5\ncolour = 1")
        .replace("final = 0.1", "final = -0.1")
        .replace("rate = 5\n", "rat = 5\n")
        + '[[agents]]\nmodel = "crat"\n[law]\nname = "tan"\n'
    )
    found = wrong(text, tmp_path)
    assert [one.partition(":")[0] for one in found] == [
        "k", "agents[0].count", "agents[0].dim", "agents[0].colour", "agents[1].model", "law.name", "delta",
        "theta.rate", "duraton",
    ]  # fmt: skip
    text = MINIMAL.replace("[[0, 1], [1, 2]]", "[[0, 9], [1, 1], [1, 2]]").replace("final = 0.1", "final = -0.1")
    found = wrong(text.replace("[theta]", NOISE + "amplitude = nan\n" + NOISE + "[theta]\nrat = 1"), tmp_path)
    assert [one.partition(":")[0] for one in found] == [
        "communication.edges[0]", "communication.edges[1]", "delta", "theta.rat", "disturbance[0]",
        "disturbance[1].amplitude",
    ]  # fmt: skip


def test_so_many_mistakes_that_nobody_reads_them_are_cut_short(tmp_path):
    edges = ", ".join("[0, 9]" for _ in range(50))
    with pytest.raises(ScenarioFileError, match="50 mistakes:") as caught:
        read(MINIMAL.replace("[0, 1]", edges), tmp_path)
    assert str(caught.value).endswith(
        "communication.edges[19]: got [0, 9], expected two numbers of agents, integers from 0 to 2\n  ... and 30 more"
    )


OUT_OF_RANGE = [  # (what is replaced, by what, the key named, what else the message has to say)
    ("k = 2", "k = 1" + "0" * 400, "k", "an integer of about 10^400"),
    ("k = 2", "k = 0x" + "f" * 9000, "k", "an integer of about 10^10837"),
    ("k = 2", "k = 2\ndt = 1e-300", "dt", "got 1e-300"),
    ("k = 2", "k = 2\ndt = 1e-20", "scenario 'small'", "dt must be from 1e-09"),
    ("k = 2", "k = 2\nduration = 1e12", "scenario 'small'", "duration must be from"),
    ("k = 2", "k = 2\nduration = 1e9\ndt = 1e-9", "scenario 'small'", "1e+18 steps"),
    ("k = 2", 'k = 2\nrelay = "false"', "relay", "got 'false', expected true or false"),
    ("count = 3", "count = 1000000000", "agents[0].count", "at most 100000"),
    ("count = 3", "count = 3\ninput_limit = 1e300", "agents[0].input_limit", "at most 1e+12, and no sm"),
    ("count = 3", "count = 3\ninput_limit = nan", "agents[0]", "must be positive"),
    ("count = 3", "count = 3\ninitial_center = [1e200, 0]", "agents[0].initial_center", "got 1e+200"),
    ("initial = 10.0", "initial = 1e40", "delta.initial", "got 1e+40"),
    ("initial = 10.0", "initial = inf", "delta", "all finite"),
    ("rate = 5.0", "rate = 1e-40", "delta.rate", "got 1e-40"),
    ("[theta]", '[law]\nname = "tanh"\ngain = 10000000000000000000000\n[theta]', "law.gain", "about 10^22"),
    ("[theta]", '[[disturbance]]\nkind = "noise"\namplitude = 1\ncomponents = 1000000000\n[theta]', "disturbance[0]",
     "components must be an integer from 1 to 10000"),
    ("[theta]", '[[disturbance]]\nkind = "gust"\namplitude = 1\nduration = 1e-9\n[theta]', "disturbance[0]", "1e-06"),
    ('name = "small"', 'name = "../../x"', "a scenario's name", "without '/'; got '../../x'"),
    ('name = "small"', 'name = "a\\u001b[31mb"', "scenario 'a", "control characters"),
    ("k = 2", 'k = 2\n"\\u001b[31m" = 1', "'\\x1b[31m'", "unknown key"),
    ("k = 2", "k = " + "[" * 100_000, "lists or tables are nested", "too deeply"),
    ("k = 2", "k = " + "[" * 300 + "]" * 300, "k", "expected an integer"),
    ("k = 2", "k = " + "9" * 5000, "not a TOML file", "Exceeds the limit"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "key", "said"), OUT_OF_RANGE, ids=[new[-40:] for _, new, *_ in OUT_OF_RANGE])
def test_numbers_and_names_out_of_range_are_refused_by_key(old, new, key, said, tmp_path):
    (message,) = wrong(MINIMAL.replace(old, new), tmp_path)
    assert message.startswith(key)
    assert said in message
    assert len(message) < 400
    assert message.isprintable()


def test_carts_and_vessels_have_parameters_that_mean_something(tmp_path):
    for model, line in (
        ("cart", "damping = nan"), ("cart", "damping = inf"), ("cart", "damping = -1e9"),
        ("vessel", "mass = [1, inf, 1]"), ("vessel", "linear_drag = [1, inf, 1]"),
        ("vessel", "quadratic_drag = [nan, 1, 1]"),
    ):  # fmt: skip
        text = MINIMAL.replace('model = "integrator"', f'model = "{model}"\n{line}')
        (message,) = wrong(text, tmp_path)
        assert message.startswith("agents[0]: ")
        assert "finite" in message


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "huge.toml").open("wb") as file:
        file.truncate(2**33)
    with pytest.raises(ScenarioFileError, match=r"huge\.toml: has 8589934592 bytes; 67108864 at most"):
        read_scenario(tmp_path / "huge.toml")


class TestInitialValuesByThemselves:
    def test_are_those_that_the_initial_set_needs(self, tmp_path):
        text = MINIMAL.replace("initial = 10.0", 'initial = "auto"').replace("initial = 100", 'initial = "auto"')
        scenario, given = read(text, tmp_path), read(MINIMAL, tmp_path)
        sized = given.replace(delta=Exponential(0.1, 0.1, 5.0), theta=Exponential(1.0, 1.0, 5.0)).sized()
        assert (scenario.delta, scenario.theta) == (sized.delta, sized.theta)
        assert scenario.design.states.feasible_at_start(scenario.initial.radius).max() == pytest.approx(1.0 / 1.25)
        wide = read(text.replace("count = 3", "count = 3\ninitial_radius = 7"), tmp_path)
        assert wide.delta.initial == pytest.approx(7.0 * scenario.delta.initial)
        assert write_scenario(scenario).count("auto") == 1  # in the comment that explains it

    def test_leave_the_others_as_they_are_given(self, tmp_path):
        text = MINIMAL.replace("initial = 10.0", 'initial = "auto"')
        assert read(text, tmp_path).theta == Exponential(100.0, 1.0, 5.0)
        assert read(text, tmp_path).delta != Exponential(0.1, 0.1, 5.0)

    def test_may_be_those_of_one_type(self, tmp_path):
        text = MINIMAL.replace("count = 3", 'count = 2\n[[agents]]\nmodel = "cart"').replace(
            "[delta]\ninitial = 10.0\nfinal = 0.1\nrate = 5.0",
            '[delta.integrator]\ninitial = "auto"\nfinal = [0.1, 0.2]\nrate = 5.0\n'
            "[delta.cart]\ninitial = 9.0\nfinal = 0.1\nrate = 5.0",
        )
        scenario = read(text, tmp_path)
        assert scenario.delta["cart"] == Exponential(9.0, 0.1, 5.0)
        assert [one.final for one in scenario.delta["integrator"]] == [0.1, 0.2]
        assert all(one.initial == pytest.approx(1.25) for one in scenario.delta["integrator"])

    def test_are_refused_where_nothing_bounds_g(self, tmp_path):
        text = MINIMAL.replace("count = 3", "count = 3\ninput_limit = inf").replace("initial = 100", 'initial = "auto"')
        (message,) = wrong(text, tmp_path)
        assert message.startswith("theta.initial: got \"auto\", but the inputs of 'integrator_0' have no limit")

    def test_any_other_word_is_refused(self, tmp_path):
        (message,) = wrong(MINIMAL.replace("initial = 10.0", 'initial = "automatic"'), tmp_path)
        assert message == "delta.initial: got 'automatic', expected a number or \"auto\""

    def test_a_design_that_is_impossible_is_left_to_those_who_ask_for_it(self, tmp_path):
        text = MINIMAL.replace("initial = 10.0", 'initial = "auto"')
        scenario = read(text[: text.index("[theta]")], tmp_path)
        with pytest.raises(DesignError, match="theta is missing"):
            scenario.build()


def test_a_type_without_a_bound_is_refused(tmp_path):
    text = MINIMAL.replace("count = 3", 'count = 2\n[[agents]]\nmodel = "cart"').replace(
        "[delta]", "[delta.integrator]"
    )
    with pytest.raises(ScenarioFileError, match=r"delta\.cart: missing; there are agents of type 'cart'"):
        read(text, tmp_path)


def test_a_task_edge_beyond_k_hops_is_refused(tmp_path):
    text = (
        MINIMAL.replace("count = 3", "count = 4").replace("[1, 2]]", "[1, 2], [2, 3]]").replace("[[0, 2]]", "[[0, 3]]")
    )
    with pytest.raises(ScenarioFileError, match=r"task\.edges: .*more than k = 2 hops apart: \(0, 3\)"):
        read(text, tmp_path)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ScenarioFileError, match=r"nowhere\.toml: can't be read: No such file"):
        read_scenario(tmp_path / "nowhere.toml")


def test_a_file_that_is_not_text(tmp_path):
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioFileError, match="not a TOML file"):
        read_scenario(tmp_path / "binary.toml")


class TestWhatAFileCannotSay:
    def test_own_models(self):
        class Rover(SingleIntegrator):
            type = "rover"

        models = (*paper().models[:7], Rover())
        with pytest.raises(ValueError, match=r"agent 'rover_0' can't be written to a file: its model Rover"):
            write_scenario(paper().replace(models=models))

    def test_a_subclass_that_keeps_the_name(self):
        class Faster(SingleIntegrator):
            pass

        with pytest.raises(ValueError, match=r"agent 'integrator_0'.*Faster isn't one of the library's"):
            write_scenario(paper().replace(models=(Faster(),) * 8))

    def test_own_disturbances(self):
        class Drizzle(Term):
            pass

        with pytest.raises(ValueError, match=r"the disturbance .*Drizzle.* can't be written"):
            write_scenario(paper().replace(disturbance=Drizzle(0.1)))

    def test_own_performance_functions(self):
        class Constant:
            def __call__(self, t):
                return np.full(np.shape(t), 10.0)

            def infimum(self) -> float:
                return 10.0

        with pytest.raises(ValueError, match=r"delta can't be written to a file: .* isn't an Exponential"):
            write_scenario(paper().replace(delta=Constant()))
