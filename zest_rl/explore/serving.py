"""Opens the page of some datasets: the process that embeds them, the server, and its address."""

from __future__ import annotations

import atexit
import importlib.util
import secrets
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from zest_rl.errors import BadInput, ZestError
from zest_rl.explore.background import BackgroundEmbedding, Choice

if TYPE_CHECKING:
    import uvicorn

    from zest_rl.explore.server import Command


@dataclass(frozen=True, eq=False)
class OpenedPage:
    """A page that `run` serves."""

    address: str
    _server: uvicorn.Server
    _listening: socket.socket

    def run(self) -> None:
        """Answer requests until the process is interrupted, or `stop` is called in another thread."""
        self._server.run(sockets=[self._listening])

    def stop(self) -> None:
        """Let `run` return."""
        self._server.should_exit = True


@contextmanager
def opened_page(
    choices: Sequence[Choice], *, goal: str | None, output: Path, port: int, command: Command
) -> Iterator[OpenedPage]:
    """Open a page; its datasets are embedded until the end of the context.

    Args:
        choices: the datasets; all with one embedder.
        goal: spec of pictures or sentences that the page begins with; None: with nothing.
        output: folder of goals that are saved.
        port: of 127.0.0.1; 0: any that is free.
        command: what the page prints to type.

    Raises:
        BadInput: no dataset, or one that does not fit, or its frames, the embedder or the goal; or the port is taken.
        ZestError: the extra ``explore`` is not installed.
    """
    if missing := [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]:
        raise ZestError(f"{' and '.join(missing)} not installed: pip install 'zest-rl[explore]'")
    if not choices:
        raise BadInput("name at least one dataset to explore")
    with ExitStack() as stack:
        background = BackgroundEmbedding(choices)
        stack.callback(background.stop)
        import uvicorn  # these take a second, in which the other process starts, too

        from zest_rl.explore.films import drawing_thread
        from zest_rl.explore.server import Page, make_app
        from zest_rl.explore.session import Session
        from zest_rl.explore.shelf import Shelf
        from zest_rl.rewards.embeddings import shared_embedder
        from zest_rl.rewards.episode_goals import read_source_goal

        shelf = Shelf(shared_embedder(*choices[0].embedding.values()))
        studio = stack.enter_context(drawing_thread())
        sessions = studio.submit(
            lambda: [Session(each, shelf, partial(background.progress, i)) for i, each in enumerate(choices)]
        ).result()
        begun = None if goal is None else studio.submit(read_source_goal, goal, sessions[0].source).result()
        if begun is not None and begun.per_view:
            raise BadInput(f"the goal {goal!r} has a pair for each view; take frames of an episode in the page instead")
        studio.submit(shelf.warm_up)
        listening = stack.enter_context(socket.socket())
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(("127.0.0.1", port))
        except OSError as error:
            raise BadInput(f"port {port} cannot be used ({error.strerror}); leave --port out for a free one") from error
        listening.listen()
        port, token = listening.getsockname()[1], secrets.token_urlsafe(24)
        app = make_app(
            Page(sessions, shelf, studio, output, command, begun),
            token,
            [f"{host}:{port}" for host in ("127.0.0.1", "localhost")],
        )
        settings: dict[str, Any] = {"access_log": False, "log_level": "warning", "lifespan": "off", "ws": "none"}
        server = uvicorn.Server(uvicorn.Config(app, timeout_graceful_shutdown=1, **settings))
        yield OpenedPage(f"http://127.0.0.1:{port}/{token}/", server, listening)


class ServedPage:
    """A page that a thread of this process serves until `close`, the end of a ``with``, or that of the program."""

    def __init__(self, choices: Sequence[Choice], **options: Any) -> None:
        """Open it, with the arguments and errors of `opened_page`."""
        with ExitStack() as stack:
            self._page = stack.enter_context(opened_page(choices, **options))
            self._stack = stack.pop_all()
        self.address = self._page.address
        self._thread = threading.Thread(target=self._page.run, daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def close(self) -> None:
        """End it; what is embedded stays in the cache."""
        self._page.stop()
        self._thread.join()
        self._stack.close()

    def wait(self) -> None:
        """Return when it is closed by another thread, or raise at Ctrl-C: for a script that would end else."""
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<page at {self.address}>"
