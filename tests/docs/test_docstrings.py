"""Links of source pages, which docs/docstrings.py corrects."""

import sys
from pathlib import Path
from types import SimpleNamespace

sys.path.append(str(Path(__file__).parents[2] / "docs"))

import docstrings  # of docs


def test_source_leads_back_to_the_entry_of_its_name():
    entries = {"khop_env.Network": 0, "khop_env.network.Range": 0, "khop_env.results.recording.StoppedError": 0}
    app = SimpleNamespace(env=SimpleNamespace(get_domain=lambda name: SimpleNamespace(objects=entries)))

    def anchor(page: str, name: str) -> str:
        link = (
            f'<div class="viewcode-block" id="{name}">\n<a class="viewcode-back" href="../api/x.html#khop_env.{name}">'
        )
        context = {"body": link}
        docstrings.back_links(app, page, "page.html", context, None)
        return context["body"].partition("#")[2].removesuffix('">')

    assert anchor("_modules/khop_env/network/schedules", "Range") == "khop_env.network.Range"
    assert anchor("_modules/khop_env/network/messages", "Network") == "khop_env.Network"
    assert anchor("_modules/khop_env/results/recording", "StoppedError") == "khop_env.results.recording.StoppedError"
    assert anchor("guides/network", "Range") == "khop_env.Range", "other pages are left alone"
