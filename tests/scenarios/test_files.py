import math

import networkx as nx
import numpy as np
import pytest

from agents import LAWS, make_law
from khop_env.observers import Exponential, TargetObservers
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
    for name in ("name", "description", "k", "relay", "duration", "dt", "order", "models", "observers", "disturbance"):
        assert getattr(again, name) == getattr(scenario, name), name
    assert again.law == scenario.law
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
    ("k = 2", "k = 2\norder = 3", "order", ["got 3, expected 1 or 2"]),
    ("k = 2", "k = 2\nduraton = 3", "duraton", ["did you mean 'duration'?"]),
    ("k = 2", "k = 2\ndt = -1", "scenario 'small'", ["dt must be positive and finite; got -1"]),
    ("k = 2", "k =", "not a TOML file", ["line 3"]),
    ("initial = 10.0", "initial = 0.01", "delta", ["0 < final <= initial", "initial=0.01"]),
    ("initial = 10.0", "initial = [1, 2]", "delta.initial", ["expected a number"]),
    ("initial = 10.0", "intial = 10.0", "delta.initial", ["missing; expected a number; is 'intial' meant for it?"]),
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
