"""``zest explore``: a local page on which pictures become curves at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zest_rl.cli.explore.arguments import Config
from zest_rl.cli.ui import Ui

__all__ = ["Config", "run"]


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Serve until Ctrl-C."""
    import importlib
    import shlex
    import webbrowser

    from zest_rl.cli.arguments import words_of
    from zest_rl.explore.background import OPTIONS, Choice
    from zest_rl.explore.serving import opened_page

    def command(verb: str, arguments: Mapping[str, Any]) -> str:
        config_class = importlib.import_module(f"zest_rl.cli.{verb}").Config
        return shlex.join(["zest", verb, *words_of(config_class(**arguments))])

    choices = [Choice(dataset, {name: getattr(config, name) for name in OPTIONS}) for dataset in config.datasets]
    with opened_page(choices, goal=config.goal, output=config.output, port=config.port, command=command) as page:
        ui.say(f"{page.address}\nthe page is there until Ctrl-C")
        if config.browser:
            webbrowser.open(page.address)
        page.run()
    return {}
