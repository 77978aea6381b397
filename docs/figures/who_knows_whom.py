"""Draw docs/images/who_knows_whom.png: what agent 0 of the scenario `paper` knows of the others.

python docs/figures/who_knows_whom.py
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import networkx as nx

from khop_env import scenario

PLACES = {0: (0, 0), 1: (1, 0), 2: (2, 0), 3: (3, 0), 4: (4, 0), 5: (5, 0.45), 6: (6, 0.45), 7: (5, -0.45)}
ME = 0
OWN, HEARD, ESTIMATED, UNKNOWN = "#E69F00", "#0072B2", "#56B4E9", "#BBBBBB"


def main() -> None:
    """Write the figure."""
    paper = scenario("paper")
    hops = nx.single_source_shortest_path_length(paper.communication, ME)
    colours = [
        OWN if hop == 0 else HEARD if hop == 1 else ESTIMATED if hop <= paper.k else UNKNOWN
        for _, hop in sorted(hops.items())
    ]
    figure, axes = plt.subplots(figsize=(8.0, 2.6), layout="constrained")
    nx.draw_networkx_edges(paper.communication, PLACES, ax=axes, width=2.0)
    nx.draw_networkx_nodes(paper.communication, PLACES, ax=axes, nodelist=sorted(hops), node_color=colours)
    nx.draw_networkx_labels(paper.communication, PLACES, ax=axes, font_size=9)
    mine = [(ME, other) for other in sorted(paper.task[ME])]
    nx.draw_networkx_edges(
        paper.task.to_directed(),
        PLACES,
        ax=axes,
        edgelist=mine,
        arrows=True,
        arrowstyle="-",
        style=(0, (4, 3)),
        edge_color="#D55E00",
        connectionstyle="arc3,rad=-0.35",
    )
    for name, colour in (
        ("the agent itself", OWN),
        ("neighbour: its state is received", HEARD),
        (f"k-hop target, 2 to {paper.k} hops: estimated", ESTIMATED),
        ("farther away: unknown", UNKNOWN),
    ):
        axes.plot([], [], "o", markersize=9, color=colour, label=name)
    axes.plot([], [], "-", color="black", linewidth=2.0, label="communication")
    axes.plot([], [], color="#D55E00", dashes=(4, 3), label=f"task edges of agent {ME}")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02), ncols=3, frameon=False, fontsize=8)
    axes.set_axis_off()
    axes.margins(0.04, 0.3)
    figure.savefig(Path(__file__).parents[1] / "images" / "who_knows_whom.png", dpi=150)


if __name__ == "__main__":
    main()
