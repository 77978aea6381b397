"""Results: recordings of runs, tidy tables, metrics, figures, films and design reports."""

from khop_env.results.assumptions import Assumption, assumptions
from khop_env.results.controlled import record_controlled
from khop_env.results.curves import error_over_time, learning_curves, network_figure, set_iss_figure
from khop_env.results.dataset import EpisodeDataset
from khop_env.results.episodes import EpisodeRecorder
from khop_env.results.figures import paper_figure
from khop_env.results.metrics import consensus_error, summarize
from khop_env.results.minari_dataset import write_minari
from khop_env.results.network_report import network_report
from khop_env.results.networks import NetworkRow, measure_networks
from khop_env.results.recording import Recording, record
from khop_env.results.records import MessageRecord, ObserverRecord
from khop_env.results.report import design_report
from khop_env.results.tables import estimates_table, states_table
from khop_env.results.writing import RunFileError, write_run

__all__ = [
    "Assumption",
    "EpisodeDataset",
    "EpisodeRecorder",
    "MessageRecord",
    "NetworkRow",
    "ObserverRecord",
    "Recording",
    "RunFileError",
    "assumptions",
    "consensus_error",
    "design_report",
    "error_over_time",
    "estimates_table",
    "learning_curves",
    "measure_networks",
    "network_figure",
    "network_report",
    "paper_figure",
    "record",
    "record_controlled",
    "set_iss_figure",
    "states_table",
    "summarize",
    "write_minari",
    "write_run",
]
