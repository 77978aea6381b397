import numpy as np
import pytest
from matplotlib.image import imread

from agents import make_law
from khop_env.results import error_over_time, figures, paper_figure, record
from khop_env.scenarios import paper
from khop_env.scenarios.mixed_fleet import mixed_fleet


def recorded(scenario, duration=0.5):
    return record(scenario.build(law=make_law(scenario.law)).reset(0), duration, 0.01)


def texts(recording, scenario, tmp_path, monkeypatch, **options) -> list[str]:
    """All text in the three panels."""
    from matplotlib.figure import Figure

    kept = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **kw: (kept.append(figure), save(figure, *args, **kw)))
    paper_figure(recording, scenario, tmp_path / "figure.png", **options)
    return [
        text.get_text()
        for axes in kept[0].axes
        for text in (*axes.texts, axes.xaxis.label, axes.yaxis.label, axes.title, axes._left_title)
    ]


def test_the_file_shows_three_panels_in_colour(tmp_path):
    scenario = paper()
    path = paper_figure(recorded(scenario), scenario, tmp_path / "figure.png")
    image = imread(path)[:, :, :3]
    assert image.shape[0] > 400
    assert image.shape[1] > 1200
    for third in np.array_split(image, 3, axis=1):
        assert (third < 0.99).any(axis=2).mean() > 0.01  # something is drawn
        assert (np.ptp(third, axis=2) > 0.3).sum() > 500  # in colour


@pytest.mark.parametrize(
    ("changes", "agent"), [({}, 3), ({"name": "renamed"}, 3), ({"figure_agent": 5}, 5), ({"figure_agent": None}, 3)]
)
def test_the_agent_that_the_scenario_names_is_shown(changes, agent, tmp_path, monkeypatch):
    """In `paper` agent 4 of the paper, whatever the scenario's name; without a name the agent with most observers."""
    scenario = paper().replace(**changes)
    found = texts(recorded(scenario), scenario, tmp_path, monkeypatch)
    assert sum(f"drifter_{agent}" in text for text in found) == 2
    assert "time (s)" in found
    assert "first coordinate (m)" in found
    assert any(text.endswith("(m/s)") for text in found)
    assert {str(i) for i in range(8)} <= set(found)  # agents named at their crosses


def test_an_agent_without_an_input_observer_is_explained(tmp_path, monkeypatch):
    scenario = mixed_fleet()
    agent = scenario.fleet.agent("unicycle_0")
    found = texts(recorded(scenario, 0.1), scenario, tmp_path, monkeypatch, agent=agent)
    assert any("unicycle_0 has no input observer" in text for text in found)


def test_components_with_different_bounds_are_named(tmp_path, monkeypatch):
    scenario = mixed_fleet()
    agent = scenario.fleet.agent("vessel_0")
    found = texts(recorded(scenario, 0.1), scenario, tmp_path, monkeypatch, agent=agent)
    assert any(text.partition(":")[0] in scenario.fleet.models[agent].states for text in found)


def test_the_agent_most_observed_is_the_default():
    scenario = mixed_fleet()
    chosen = figures._default_agent(recorded(scenario, 0.05), scenario)
    neighborhoods = scenario.design.neighborhoods
    assert len(neighborhoods[chosen]) == max(map(len, neighborhoods))


def test_pyplot_is_left_alone(tmp_path):
    import subprocess
    import sys

    script = (
        "import sys; from khop_env.scenarios import paper; from khop_env.results import record, paper_figure\n"
        "from agents import make_law; s = paper(); r = record(s.build(law=make_law(s.law)), 0.02, 0.01)\n"
        f"paper_figure(r, s, {str(tmp_path / 'f.png')!r}); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_an_unknown_agent_is_refused(tmp_path):
    scenario = paper()
    with pytest.raises(ValueError, match="no agent 8"):
        paper_figure(recorded(scenario, 0.02), scenario, tmp_path / "figure.png", agent=8)


def legend_of(rows: list[tuple[str, str]], tmp_path, monkeypatch) -> list[str]:
    """Legend entries for rows of policies and observation modes."""
    from matplotlib.figure import Figure

    kept = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **kw: (kept.append(figure), save(figure, *args, **kw)))
    time = np.linspace(0.0, 1.0, 5)
    errors = {row: np.exp(-time)[:, None] * np.ones((1, 3)) for row in rows}
    assert error_over_time(time, errors, tmp_path / "errors.png", "title").exists()
    (legend,) = kept[0].legends
    assert len(kept[0].axes[0].lines) == len(rows)
    return [text.get_text() for text in legend.get_texts()]


def test_errors_of_many_rows_have_an_entry_for_each_policy_and_each_mode(tmp_path, monkeypatch):
    policies, modes = ["leader_following", "linear", "tanh", "zero", "random"], ["estimate", "oracle", "local"]
    rows = [(policy, mode) for policy in policies for mode in modes]
    assert legend_of(rows, tmp_path, monkeypatch) == [*policies, *(f"on {mode}" for mode in modes)]


def test_errors_of_a_single_policy_have_an_entry_for_each_mode(tmp_path, monkeypatch):
    rows = [("tanh", "estimate"), ("tanh", "oracle")]
    assert legend_of(rows, tmp_path, monkeypatch) == ["tanh on estimate", "tanh on oracle"]
