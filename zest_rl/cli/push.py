"""``zest push``: a dataset or a run → a repository on the Hugging Face Hub."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from zest_rl.cli.ui import Ui

if TYPE_CHECKING:
    from zest_rl.export.push import Upload


@dataclass(frozen=True)
class Config:
    """Upload a dataset, which `minari download` fetches, or a run, which is evaluated as hf://OWNER/NAME. Only data are
    uploaded, without folders of this machine; the token is that of `hf auth login` or HF_TOKEN.
    """

    what: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET|RUN")]
    """Id of a dataset, or folder that `zest train` left."""
    repo_id: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OWNER/NAME")]
    """Repository on the hub; of a dataset, NAME is the first part of its id, as Minari wants it."""
    private: bool = False
    """Make a new repository a private one, and refuse one that is public."""
    goal_pictures: bool = False
    """Upload pictures of a goal that come from elsewhere, too: you may publish them."""
    dry_run: bool = False
    """Say what would be uploaded, and stop."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Choose the files, say so, upload them."""
    from zest_rl.export.push import push

    def announce(upload: Upload) -> None:
        size = f"{len(upload.files)} files, {upload.n_bytes / 2**20:.1f} MB"
        ui.say(f"{size}, for the {upload.repo_type} repository {upload.repo_id}: {', '.join(upload.files)}")
        if upload.hidden:
            ui.say(f"folders of this machine and secrets are hidden in {', '.join(upload.hidden)}")

    flags = {name: getattr(config, name) for name in ("private", "goal_pictures", "dry_run")}
    upload = push(config.what, config.repo_id, **flags, on_start=announce)
    again = [f"--{name.replace('_', '-')}" for name in ("private", "goal_pictures") if flags[name]]
    upload_it = f"zest push {shlex.join([config.what, config.repo_id, *again])}"
    return {
        **({} if upload.url is None else {"repository": upload.url}),
        "n_files": len(upload.files),
        "bytes": upload.n_bytes,
        "next": upload_it if config.dry_run else fetching(upload),
    }


def fetching(upload: Upload) -> str:
    """Return the command by which anybody gets what was uploaded."""
    if upload.dataset_id is None:
        return f"zest evaluate hf://{upload.repo_id}"
    return f"MINARI_REMOTE=hf://{upload.repo_id.split('/')[0]} minari download {upload.dataset_id}"
