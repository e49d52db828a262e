"""Datasets and runs → repositories on the Hugging Face Hub, each in one commit.

A dataset goes where Minari looks for it: ``zest/door-v0`` is the folder ``door-v0`` of the dataset repository
``OWNER/zest``, whose ``namespace_metadata.json`` lists what is in it. So `MINARI_REMOTE=hf://OWNER minari download
zest/door-v0` fetches it, without this package. A run is a model repository of `zest_rl.runtime.hub.RUN_FILES`.

Files are uploaded by name, those of a dataset by its manifest: no cache, lock, checkpoint or log is among them. Folders
of this machine, passwords and tokens are hidden in them (`zest_rl.runtime.privacy`).
"""

from __future__ import annotations

import hashlib
import json
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from zest_rl.data.folders import (
    CARD_FILE,
    DATA_FILE,
    DATASET_ID,
    GOAL_FOLDER,
    MANIFEST_FILE,
    METADATA_FILE,
    dataset_path,
    verified_metadata,
)
from zest_rl.data.provenance import DatasetRecord
from zest_rl.errors import BadInput, Notice, ZestError
from zest_rl.runtime import artifacts
from zest_rl.runtime.cache import cache_folder
from zest_rl.runtime.files import check_file
from zest_rl.runtime.hub import REWARD_FILES, RUN_FILES, SCORER_FILE, check_repo_id, hub_errors
from zest_rl.runtime.privacy import masked
from zest_rl.runtime.records import reading_record

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoFile

INDEX_FILE = "namespace_metadata.json"
"""Minari's list of the datasets in a repository; of a namespace below it, an empty object."""
OWN_GOAL = re.compile(r"same-scene|toys|drawings|episode:\d+")
"""Goals whose pictures this package made, or took out of the dataset; others are of somebody else."""
VISUAL_TASKS = "visual-tasks:"
ABOUT = """---
viewer: false
task_categories: [robotics, reinforcement-learning]
tags: [minari, zest-rl]
---
# {namespace}

Datasets of [Minari](https://minari.farama.org), each in a folder of its own with a card.

    MINARI_REMOTE=hf://{owner} minari download {namespace}/…
"""
RUN_TAGS = "---\nlibrary_name: zest-rl\npipeline_tag: robotics\ntags: [zest-rl]\n---\n"
"""What the hub wants to know at the top of a policy's card."""


@dataclass(frozen=True)
class Upload:
    """What `push` uploads, or has uploaded."""

    repo_id: str
    repo_type: Literal["dataset", "model"]
    dataset_id: str | None
    """None: it is a run."""
    files: Mapping[str, Path | bytes]
    """Path in the repository → the file, or its content where that is not the file's."""
    hidden: tuple[str, ...] = ()
    """Those of them in which folders of this machine or secrets are hidden."""
    url: str | None = None
    """Where it is; None: it was not uploaded."""

    @property
    def n_bytes(self) -> int:
        """Size of all files."""
        sizes = (len(file) if isinstance(file, bytes) else file.stat().st_size for file in self.files.values())
        return sum(sizes)


def push(
    what: str,
    repo_id: str,
    *,
    private: bool = False,
    goal_pictures: bool = False,
    dry_run: bool = False,
    on_start: Callable[[Upload], None] | None = None,
) -> Upload:
    """Upload a dataset or a run to the Hugging Face Hub, in one commit; files that are there already are left out.

    Args:
        what: id of a dataset, or folder of a run that `zest train` finished.
        repo_id: ``OWNER/NAME``; of a dataset, NAME is the first part of its id.
        private: make a new repository a private one, and refuse one that is public.
        goal_pictures: also upload the pictures of a goal that come from elsewhere: you may publish them.
        dry_run: stop before anything is uploaded.
        on_start: called with what will be uploaded.

    Raises:
        BadInput: neither a dataset nor a run, a wrong `repo_id`, a repository with other content, no valid token.
        ZestError: a file is damaged, or the hub does not answer. Nothing is half uploaded.
    """
    check_repo_id(repo_id)
    is_run = (Path(what) / "meta.json").exists()
    upload = _of_run(Path(what), repo_id) if is_run else _of_dataset(what, repo_id, goal_pictures)
    if on_start is not None:
        on_start(upload)
    return upload if dry_run else _send(upload, private)


def _of_run(run: Path, repo_id: str) -> Upload:
    meta, path = artifacts.read_json(run / "meta.json"), run / "model.safetensors"
    with reading_record(run / "meta.json"):
        sha256 = meta.get("model_sha256")
    if sha256 is None:
        raise BadInput(f"{run} holds an adopted policy, a program; push takes those that `zest train` made")
    check_file(path)
    if artifacts.hash_file(path) != sha256:
        raise ZestError(
            f"{path} is damaged: meta.json has another sha256; restore it, or train again into a new folder"
        )
    paths = {name: run / name for name in RUN_FILES if (run / name).exists()}
    hidden = _hide(paths)
    files: dict[str, Path | bytes] = {**paths, **hidden}
    if CARD_FILE in files:
        card = (run / CARD_FILE).read_text(encoding="utf-8")
        files[CARD_FILE] = (card if card.startswith("---") else RUN_TAGS + card).encode()
    return Upload(repo_id, "model", None, files, tuple(hidden))


def _of_dataset(dataset_id: str, repo_id: str, goal_pictures: bool) -> Upload:
    if not DATASET_ID.fullmatch(dataset_id):
        raise BadInput(
            "push takes the id of a dataset, such as zest/kitchen-micro-noisy-v0, or the folder of a finished run, got "
            f"{dataset_id!r}"
        )
    record = DatasetRecord.from_metadata(dataset_id, verified_metadata(dataset_id))
    (owner, name), (namespace, _, rest) = repo_id.split("/"), dataset_id.partition("/")
    if name != namespace:
        raise BadInput(
            f"Minari looks for {dataset_id} in a repository called {namespace}, got {repo_id}; push it to "
            f"{owner}/{namespace}"
        )
    folder = dataset_path(dataset_id)
    has_manifest = (folder / MANIFEST_FILE).exists()
    digests = artifacts.read_json(folder / MANIFEST_FILE) if has_manifest else {}
    left_out = _goal_pictures_to_leave_out(record, digests, goal_pictures)
    listed = [name for name in digests or (DATA_FILE, METADATA_FILE) if name not in left_out]
    paths = {name: folder / name for name in listed}
    hidden = _hide(paths)
    files: dict[str, Path | bytes] = {**paths, **hidden}
    if has_manifest:
        hashes = {name: artifacts.hash_bytes(content) for name, content in hidden.items()}
        kept = {name: hashes.get(name, digests[name]) for name in listed}
        files[MANIFEST_FILE] = folder / MANIFEST_FILE if kept == digests else _as_json(kept)
    if (folder / CARD_FILE).exists():
        files[CARD_FILE] = folder / CARD_FILE
    inside = f"{rest}/" if rest else ""
    placed = {inside + name: file for name, file in files.items()}
    return Upload(repo_id, "dataset", dataset_id, placed, tuple(hidden))


def _goal_pictures_to_leave_out(record: DatasetRecord, names: Iterable[str], asked: bool) -> list[str]:
    """Return the pictures of a goal of somebody else, unless they were asked for; tell of the licences."""
    if record.collect is None:
        warnings.warn(f"the episodes are those of {record.source_id}, which may have a licence of its own", Notice, 4)
    goal = "" if record.relabel is None else record.relabel.scorer.goal
    pictures = [name for name in names if name.startswith(f"{GOAL_FOLDER}/")]
    if not pictures or OWN_GOAL.fullmatch(goal):
        return []
    if asked:
        licence = "CC BY-NC 4.0" if goal.startswith(VISUAL_TASKS) else "their author's"
        warnings.warn(
            f"{len(pictures)} goal pictures of {masked(goal)} are uploaded; their licence is {licence}", Notice, 4
        )
        return []
    warnings.warn(
        f"{len(pictures)} goal pictures of {masked(goal)} are not uploaded, as their licence may forbid it; "
        "--goal-pictures uploads them",
        Notice,
        4,
    )
    return pictures


def _hide(paths: Mapping[str, Path]) -> dict[str, bytes]:
    """Return, of the files that name folders of this machine or hold secrets, the content without these."""
    hidden = {}
    for name in (METADATA_FILE, "meta.json", REWARD_FILES[0]):
        if name in paths:
            value = artifacts.read_json(paths[name])
            if masked(value) != value:
                hidden[name] = _as_json(masked(value))
    if SCORER_FILE in paths and (content := _hidden_header(paths[SCORER_FILE])) is not None:
        hidden[SCORER_FILE] = content
    return hidden


def _hidden_header(path: Path) -> bytes | None:
    """Return a scorer's file with a masked header; None if there is nothing to hide."""
    from safetensors import safe_open
    from safetensors.numpy import save

    with reading_record(path), safe_open(path, framework="numpy") as file:
        header = file.metadata() or {}
        if masked(header) == header:
            return None
        return save({name: file.get_tensor(name) for name in file.keys()}, metadata=masked(header))  # noqa: SIM118


def _as_json(value: Any) -> bytes:
    return (json.dumps(value, indent=2) + "\n").encode()


def _send(upload: Upload, private: bool) -> Upload:
    from huggingface_hub import CommitOperationAdd, HfApi, constants, get_token
    from huggingface_hub.hf_api import RepoFile

    repo_id, repo_type = upload.repo_id, upload.repo_type
    if get_token() is None:
        raise BadInput(
            f"uploading needs a token that can write to {repo_id}, got none; make one at {constants.ENDPOINT}"
            "/settings/tokens, and run `hf auth login` or set HF_TOKEN to it"
        )
    api = HfApi(library_name="zest-rl")
    with hub_errors(f"uploading to {repo_id}"):
        url = api.create_repo(repo_id, repo_type=repo_type, private=private or None, exist_ok=True)
        head = api.repo_info(repo_id, repo_type=repo_type)
        if private and not head.private:
            raise BadInput(f"{url} is public; make it private there, or leave --private out")
        tree = api.list_repo_tree(repo_id, repo_type=repo_type, revision=head.sha, recursive=True)
        there = {entry.path: entry for entry in tree if isinstance(entry, RepoFile)}
        _check_content(upload, there)
        files = dict(upload.files)
        if upload.dataset_id is not None:
            index = None
            if INDEX_FILE in there:
                index = api.hf_hub_download(
                    repo_id, INDEX_FILE, repo_type=repo_type, revision=head.sha, cache_dir=cache_folder("hub")
                )
            files |= _beside(upload, upload.dataset_id, None if index is None else Path(index), there)
        additions = [
            CommitOperationAdd(path, file if isinstance(file, bytes) else str(file)) for path, file in files.items()
        ]
        api.create_commit(
            repo_id,
            additions,
            commit_message=f"{upload.dataset_id or repo_id} by zest push",
            repo_type=repo_type,
            parent_commit=head.sha,
        )
    return replace(upload, files=files, url=str(url))


def _check_content(upload: Upload, there: Mapping[str, RepoFile]) -> None:
    """Refuse a repository with other content; cards and manifests may change."""
    others = sorted(there.keys() - {".gitattributes", CARD_FILE})
    if others and (INDEX_FILE if upload.dataset_id else "meta.json") not in there:
        raise BadInput(f"{upload.repo_id} has other content ({', '.join(others[:3])}); choose another repository")
    differing = [
        path
        for path, file in upload.files.items()
        if path in there and Path(path).name not in (CARD_FILE, MANIFEST_FILE) and not _is_equal(file, there[path])
    ]
    if differing:
        raise BadInput(
            f"{upload.repo_id} has another {upload.dataset_id or 'run'} ({', '.join(differing[:3])} differ); choose "
            "another name, or delete it there first"
        )


def _is_equal(file: Path | bytes, there: RepoFile) -> bool:
    """Compare by hash: sha256 of large files, git's sha1 of others."""
    if there.lfs is not None:
        sha256 = artifacts.hash_bytes(file) if isinstance(file, bytes) else artifacts.hash_file(file)
        return there.lfs.sha256 == sha256
    content = file if isinstance(file, bytes) else file.read_bytes()
    return there.blob_id == hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _beside(upload: Upload, dataset_id: str, index: Path | None, there: Iterable[str]) -> dict[str, bytes]:
    """Return what a dataset needs around its folder: Minari's list, with the dataset in it, and a page about it all."""
    listed: dict[str, Any] = {} if index is None else artifacts.read_json(index)
    namespace, *below = dataset_id.split("/")[:-1] or [dataset_id]
    parents = ["/".join(below[: n + 1]) for n in range(len(below))]
    with reading_record(Path(INDEX_FILE), f"mend it in {upload.repo_id}"):
        datasets = sorted({*listed.get("datasets", ()), dataset_id})
        namespaces = sorted({*listed.get("namespaces", ()), *(f"{namespace}/{parent}" for parent in parents)})
        listed = {**listed, "datasets": datasets, **({"namespaces": namespaces} if namespaces else {})}
    files = {INDEX_FILE: _as_json(listed)}
    about = ABOUT.format(namespace=namespace, owner=upload.repo_id.split("/")[0]).encode()
    new = {**{f"{parent}/{INDEX_FILE}": b"{}\n" for parent in parents}, CARD_FILE: about}
    return files | {path: content for path, content in new.items() if path not in {*there, *upload.files}}
