"""The Hugging Face Hub: runs by their id there, and what can go wrong on the way.

huggingface_hub finds the token itself (HF_TOKEN, or what `hf auth login` left), and the server (HF_ENDPOINT).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.cache import cache_folder

SCHEME = "hf://"
SCORER_FILE = "zest_scorer.safetensors"
"""Name of a scorer's file in a dataset that it relabeled, and in the runs that were trained on it."""
REWARD_FOLDER = "reward"
"""Folder of a learned reward, a copy of its own run, in a dataset that it relabeled and in the runs trained on that."""
REWARD_FILES = (f"{REWARD_FOLDER}/meta.json", f"{REWARD_FOLDER}/model.safetensors")
RUN_FILES = ("meta.json", "model.safetensors", SCORER_FILE, *REWARD_FILES, "README.md")
"""What a run consists of on the hub; all that is fetched of one. Nothing in them runs."""
_ADVICE = {
    401: "the token is missing or not valid; run `hf auth login`, or set HF_TOKEN",
    403: "the token may not do this; log in as somebody who may, with a token that can write",
    404: "check the name; a private repository is found only with a token that may read it",
    409: "somebody changed it at the same time; type the command again",
    412: "somebody changed it at the same time; type the command again",
}
"""By the status of a refusal."""


def local_run(run: str | Path) -> Path:
    """Return the folder of a run; ``hf://OWNER/NAME`` or ``hf://OWNER/NAME@REVISION`` is fetched into the cache.

    Each revision has a folder of its own. Where the hub does not answer, what was fetched last is taken.

    Raises:
        BadInput: there is no such repository, this user may not read it, or it holds no run.
        ZestError: the hub does not answer.
    """
    if not str(run).startswith(SCHEME):
        return Path(run)
    from huggingface_hub import snapshot_download

    repo_id, _, revision = str(run).removeprefix(SCHEME).partition("@")
    check_repo_id(repo_id)
    cache = cache_folder("hub")
    with hub_errors(f"fetching {run}"):
        folder = Path(
            snapshot_download(repo_id, revision=revision or None, cache_dir=cache, allow_patterns=list(RUN_FILES))
        )
    if not (folder / RUN_FILES[0]).exists():
        raise BadInput(f"{run} is no run: it holds no {RUN_FILES[0]}; give the id of one that `zest push` uploaded")
    return folder


def check_repo_id(repo_id: str) -> None:
    """Refuse what is not of the form ``OWNER/NAME``."""
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", repo_id):
        raise BadInput(f"the id of a repository on the hub must look like OWNER/NAME, got {repo_id!r}")


@contextmanager
def hub_errors(doing: str) -> Iterator[None]:
    """Say what went wrong with the hub, and what to do.

    Args:
        doing: beginning of the message, such as "fetching hf://me/door".

    Raises:
        BadInput: the hub refuses it (no such repository, no right to it, no valid token).
        ZestError: the hub does not answer, or anything else that the block raises.
    """
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled

    bases = cast("tuple[type[Exception], ...]", HfHubHTTPError.__bases__)
    of_http = tuple(base for base in bases if base is not OSError)  # each major version has another HTTP library
    failures: tuple[type[Exception], ...] = (OSError, RuntimeError, ValueError, *of_http)
    try:
        yield
    except ZestError:
        raise
    except failures as error:
        wraps = isinstance(error, LocalEntryNotFoundError | RuntimeError) and isinstance(error.__cause__, failures)
        cause = error.__cause__ if wraps else error
        reason, response = str(cause).partition("\n")[0].strip(), getattr(cause, "response", None)
        if isinstance(cause, OfflineModeIsEnabled):
            raise ZestError(f"{doing} needs the network, but HF_HUB_OFFLINE is set; unset it") from error
        if response is not None:
            code = response.status_code
            told = getattr(cause, "server_message", None) or reason
            kind = BadInput if code in (401, 403, 404) else ZestError
            raise kind(f"{doing}: the hub says {code} ({told}); {_ADVICE.get(code, 'try again later')}") from error
        if isinstance(cause, (ConnectionError, *of_http)):
            raise ZestError(
                f"{doing}: {_endpoint()} does not answer ({reason}); check the network and its proxy, then type the "
                "command again"
            ) from error
        raise ZestError(f"{doing} failed ({type(cause).__name__}: {reason}); type the command again") from error


def _endpoint() -> str:
    from huggingface_hub import constants

    return str(constants.ENDPOINT)
