"""The page's server: for this machine alone, for those who know the address with its random token.

Pictures come as the body of a request and are read by `zest_rl.data.images`. Datasets, episodes, steps, views are
numbers; nothing that the page sends is a path, or makes the server read another file than those of its datasets.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp

from zest_rl.data.images import decode_image
from zest_rl.errors import BadInput, ZestError
from zest_rl.explore.guard import Guard
from zest_rl.explore.session import Ask, Session
from zest_rl.explore.shelf import Shelf
from zest_rl.kitchen.videos import FPS
from zest_rl.metrics.reward_quality import order_in_time
from zest_rl.rewards.goals import GoalSpec
from zest_rl.runtime.records import from_json

T = TypeVar("T")
Command = Callable[[str, Mapping[str, Any]], str]
"""Name of a verb and its arguments → what to type to do the same."""

MAX_PICTURE, MAX_JSON = 40_000_000, 1_000_000
"""Bytes of a request."""
_ASSETS = {
    "": ("zest_rl.explore", "page.html", "text/html"),
    "page.css": ("zest_rl.explore", "page.css", "text/css"),
    "report.css": ("zest_rl.report", "style.css", "text/css"),
    **{
        f"{name}.js": ("zest_rl.explore", f"{name}.js", "text/javascript")
        for name in ("page", "goal", "episode", "charts", "elements", "server", "state")
    },
}


@dataclass(frozen=True, eq=False)
class Page:
    """What the page's requests do."""

    sessions: Sequence[Session]
    shelf: Shelf
    studio: Executor
    """One thread, in which frames are drawn: a GL context belongs to the thread that opened it."""
    output: Path
    """Folder of goals that are saved."""
    command: Command
    goal: GoalSpec | None = None
    """That the page begins with."""

    def routes(self) -> list[Route]:
        """Return the addresses below the token."""
        gets = {
            "/state/{dataset:int}": self.state,
            "/pictures/{name:str}": self.picture,
            "/frames/{dataset:int}/{episode:int}/{step:int}/{view:int}": self.frame,
        }
        posts = {
            "/pictures": self.drop,
            "/take/{dataset:int}/{episode:int}/{step:int}": self.take,
            "/scores/{dataset:int}": self.scores,
            "/verdict/{dataset:int}": self.verdict,
            "/proposal/{dataset:int}": self.proposal,
            "/curves/{dataset:int}/{episode:int}": self.curves,
            "/goal/{dataset:int}": self.save_goal,
            "/save/{dataset:int}": self.save,
        }
        assets = [Route(f"/{name}", _asset(*place)) for name, place in _ASSETS.items()]
        return [
            *assets,
            *(Route(path, answer, methods=["GET"]) for path, answer in gets.items()),
            *(Route(path, answer, methods=["POST"]) for path, answer in posts.items()),
        ]

    async def state(self, request: Request) -> Response:
        """What there is, and how much of it is ready."""
        session = self._session(request)
        share, problem = await self._in_studio(session.advance)
        truth = session.truth
        begun = {} if self.goal is None else {"goal": self._shown(self.goal)}
        return JSONResponse(
            {
                "datasets": [each.choice.dataset for each in self.sessions],
                "steps": session.n_steps,
                "views": list(session.source.frames.views),
                "fps": getattr(session.source.trajectories, "fps", None) or FPS,
                "reads_text": self.shelf.embedder.reads_text,
                "success": None if truth is None else [each.success for each in truth],
                "true_returns": None if truth is None else _numbers([each.episode_return for each in truth]),
                "ready": len(session.ready),
                "share": share,
                "problem": problem,
                **begun,
            }
        )

    async def drop(self, request: Request) -> Response:
        """Keep a picture that is the body of the request."""
        if not request.headers.get("content-type", "").startswith("image/"):
            raise HTTPException(415, "only pictures can be dropped here")
        data = await _body(request, MAX_PICTURE)
        picture = await run_in_threadpool(decode_image, data, "this picture")
        return JSONResponse({"names": [self.shelf.add(picture)]})

    async def picture(self, request: Request) -> Response:
        """Show a picture that is kept."""
        return Response(self.shelf.thumbnail(request.path_params["name"]), media_type="image/png")

    async def frame(self, request: Request) -> Response:
        """Show a frame."""
        session, episode, step = self._step(request)
        view = _below(request.path_params["view"], len(session.source.frames.views), "view")
        jpeg = await self._in_studio(lambda: session.film(episode).jpeg(step, view))
        return Response(jpeg, media_type="image/jpeg")

    async def take(self, request: Request) -> Response:
        """Keep a frame as a picture, of one view or of all."""
        session, episode, step = self._step(request)
        view = (await _json(request)).get("view")
        if view is not None:
            view = _below(view, len(session.source.frames.views), "view")
        return JSONResponse({"names": await self._in_studio(lambda: session.take(episode, step, view))})

    async def scores(self, request: Request) -> Response:
        """Score all episodes that are ready."""
        session, ask = self._session(request), await _ask(request)

        def work() -> dict[str, Any]:
            scored, episodes = session.score(ask), []
            for ranked in sorted(scored.ranking(), key=lambda each: each.index):
                curve, rewards = scored.scores(ranked.index), scored.rewards(ranked.index)
                figures = {
                    "return": rewards.sum(dtype=np.float64),
                    "end": curve[-1],
                    "order": order_in_time(curve[1:]),
                    "worth": ranked.worth,
                    "disagreement": scored.disagreement(ranked.index),
                }
                numbers = {name: _number(value) for name, value in figures.items()}
                episodes.append({"episode": ranked.index, "curve": _numbers(curve), "words": ranked.words, **numbers})
            return {"episodes": episodes, "kept": list(scored.kept)}

        return JSONResponse(await run_in_threadpool(work))

    async def verdict(self, request: Request) -> Response:
        """Judge the rewards of all episodes that are ready."""
        session, ask = self._session(request), await _ask(request)
        judged = await run_in_threadpool(session.judge, ask)
        if judged is None:
            return JSONResponse({"advice": None})
        verdict, warnings = judged
        figures = {
            name: [_number(estimate.value), _number(estimate.low), _number(estimate.high)]
            for name, estimate in verdict.figures.items()
        }
        return JSONResponse({"advice": verdict.advice, "why": verdict.why, "figures": figures, "warnings": warnings})

    async def proposal(self, request: Request) -> Response:
        """Name the episodes to drop, and what to type to drop them once the relabeled dataset is saved."""
        session, values = self._session(request), await _json(request)
        keep, ask = values.pop("keep", None), _ask_of(values)
        if not isinstance(keep, int | float) or not 0 < keep <= 1:
            raise BadInput(f"keep must be above 0 and at most 1, got {keep!r}")
        dropped, saved = await run_in_threadpool(session.proposal, ask, keep)
        command = self.command("curate", {"dataset": saved, "keep": keep}) if saved and dropped else None
        return JSONResponse({"dropped": dropped, "command": command})

    async def curves(self, request: Request) -> Response:
        """Score one episode by all views and goals together, and by each of them alone."""
        session, ask = self._session(request), await _ask(request)
        episode = _below(request.path_params["episode"], len(session.n_steps), "episode")
        scored = await run_in_threadpool(session.score, ask)
        if episode not in scored.compared:
            raise BadInput(f"episode {episode} is not embedded yet; wait a moment")
        truth = None if session.truth is None else session.truth[episode]
        return JSONResponse(
            {
                "scores": _numbers(scored.scores(episode)),
                "by_view": list(map(_numbers, scored.by_view(episode))),
                "by_goal": list(map(_numbers, scored.by_goal(episode))),
                "truth": None if truth is None else [None, *_numbers(truth.rewards)],
            }
        )

    async def save_goal(self, request: Request) -> Response:
        """Write the goal's pictures as a folder."""
        session, ask = self._session(request), await _ask(request)
        goal = await run_in_threadpool(session.save_goal, ask, self.output)
        return JSONResponse({"goal": goal, "command": self.command("relabel", session.relabel_options(ask, goal))})

    async def save(self, request: Request) -> Response:
        """Write the goal and the relabeled dataset."""
        session, ask = self._session(request), await _ask(request)
        if len(session.ready) < len(session.n_steps):
            raise BadInput("a dataset is saved when all of its episodes are embedded; wait a moment")
        dataset, options = await self._in_studio(lambda: session.save(ask, self.output))
        return JSONResponse({"dataset": dataset, "command": self.command("relabel", options)})

    async def _in_studio(self, work: Callable[[], T]) -> T:
        return await asyncio.wrap_future(self.studio.submit(work))

    def _session(self, request: Request) -> Session:
        return self.sessions[_below(request.path_params["dataset"], len(self.sessions), "dataset")]

    def _step(self, request: Request) -> tuple[Session, int, int]:
        session, chosen = self._session(request), request.path_params
        episode = _below(chosen["episode"], len(session.n_steps), "episode")
        return session, episode, _below(chosen["step"], session.n_steps[episode] + 1, "step")

    def _shown(self, goal: GoalSpec) -> dict[str, Any]:
        sides: list[list[Any]] = [list(goal.starts), list(goal.goals)]
        starts, goals = sides if goal.is_text else [list(map(self.shelf.add, side)) for side in sides]
        return {"starts": starts, "goals": goals, "are_sentences": goal.is_text}


def _below(index: Any, n: int, what: str) -> int:
    """Return an index in 0 … n − 1; anything else does not exist."""
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < n:
        raise HTTPException(404, f"there is no {what} {index}; give 0 to {n - 1}")
    return index


def _number(value: float) -> float | None:
    """Return a number with the digits that are shown; None for NaN, which JSON lacks."""
    return round(float(value), 5) if np.isfinite(value) else None


def _numbers(values: Any) -> list[float | None]:
    return [_number(value) for value in values]


async def _body(request: Request, most: int) -> bytes:
    """Read a request's body; what is larger than `most` bytes is refused before it is all here."""
    data = bytearray()
    async for chunk in request.stream():
        data += chunk
        if len(data) > most:
            raise HTTPException(413, f"too large: at most {most / 1e6:.0f} MB are read")
    return bytes(data)


async def _json(request: Request) -> dict[str, Any]:
    if request.headers.get("content-type") != "application/json":
        raise HTTPException(415, "send JSON")
    try:
        values = json.loads(await _body(request, MAX_JSON))
    except (ValueError, RecursionError) as error:
        raise BadInput(f"this is no JSON: {error}") from error
    if not isinstance(values, dict):
        raise BadInput("send a JSON object")
    return values


async def _ask(request: Request) -> Ask:
    return _ask_of(await _json(request))


def _ask_of(values: Mapping[str, Any]) -> Ask:
    try:
        asked = from_json(Ask, values)
        return replace(asked, goal_share=float(asked.goal_share))  # 1 and 1.0 have other hashes
    except TypeError as error:
        raise BadInput(f"this is no goal: {error}") from error


def _asset(package: str, name: str, kind: str) -> Callable[[Request], Response]:
    content = (files(package) / name).read_bytes()
    return lambda request: Response(content, media_type=kind)


def _explain(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 400 if isinstance(error, BadInput) else 500
    return JSONResponse({"error": str(getattr(error, "detail", error))}, status)


def make_app(page: Page, token: str, hosts: Sequence[str]) -> ASGIApp:
    """Return the application; `hosts` as in `Guard`."""
    handlers: dict[Any, Any] = {HTTPException: _explain, ZestError: _explain}
    app = Starlette(routes=[Mount(f"/{token}", routes=page.routes())], exception_handlers=handlers)
    return Guard(app, token, hosts)
