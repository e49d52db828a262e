"""``zest explore``: a local page on which pictures become curves at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zest_rl.cli.explore.arguments import Config
from zest_rl.cli.ui import Ui

__all__ = ["Config", "run"]


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Serve until Ctrl-C."""
    import importlib.util
    import shlex
    import webbrowser

    from zest_rl.cli.arguments import words_of
    from zest_rl.cli.relabel.arguments import Config as RelabelConfig
    from zest_rl.errors import BadInput, ZestError

    if missing := [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]:
        raise ZestError(f"{' and '.join(missing)} not installed: pip install 'zest-rl[explore]'")
    if not config.datasets:
        raise BadInput("name at least one dataset to explore")
    from zest_rl.explore.background import Choice
    from zest_rl.explore.server import serve

    own = ("datasets", "goal", "output", "port", "browser")
    options = {name: value for name, value in vars(config).items() if name not in own}

    def command(arguments: Mapping[str, Any]) -> str:
        return shlex.join(["zest", "relabel", *words_of(RelabelConfig(**arguments))])

    def tell(address: str) -> None:
        ui.say(f"{address}\nthe page is there until Ctrl-C")
        if config.browser:
            webbrowser.open(address)

    choices = [Choice(dataset, options) for dataset in config.datasets]
    serve(choices, goal=config.goal, output=config.output, port=config.port, command=command, on_start=tell)
    return {}
