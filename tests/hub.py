"""A stand-in for the Hugging Face Hub on this machine: as much of its HTTP as huggingface_hub asks for here.

Repositories are kept in memory, whole commit by whole commit; small files lie in git, others in LFS.
"""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

WRITER, READER = "hf_writer-0123456789", "hf_reader-0123456789"
"""Tokens of one who may write, and of one who may not."""
OWNER = "me"


@dataclass
class Repository:
    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    """Commit → path → content, oldest first."""

    @property
    def head(self) -> str:
        return list(self.commits)[-1]

    @property
    def files(self) -> dict[str, bytes]:
        return self.commits[self.head]

    def commit(self, files: dict[str, bytes]) -> str:
        name = hashlib.sha1(f"{len(self.commits)}".encode()).hexdigest()
        self.commits[name] = files
        return name


class Hub(ThreadingHTTPServer):
    """A hub whose repositories are ``datasets/OWNER/NAME`` and ``models/OWNER/NAME``."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.repositories: dict[str, Repository] = {}
        self.large: dict[str, bytes] = {}
        """sha256 → content that was uploaded to LFS."""
        self.refuses: dict[str, int] = {}
        """Last part of a path → the status of its refusal."""


class _Handler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def answer(self, content: Any, status: int = 200, **headers: str) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def refuse(self, status: int, message: str, code: str = "") -> None:
        self.answer({"error": message}, status, X_Error_Message=message, X_Error_Code=code)

    def do_GET(self) -> None:
        self.route(b"")

    do_HEAD = do_GET

    def do_POST(self) -> None:
        self.route(self.rfile.read(int(self.headers.get("Content-Length", 0))))

    do_PUT = do_POST

    def route(self, body: bytes) -> None:
        url = urlsplit(self.path)
        words, query = [unquote(word) for word in url.path.strip("/").split("/")], parse_qs(url.query)
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if token not in ("", WRITER, READER):
            return self.refuse(401, "Invalid credentials in Authorization header")
        if token != WRITER and (words[-1] in ("create", "batch") or words[-2] in ("commit", "preupload")):
            return self.refuse(403, f"You don't have the rights to write to {OWNER}")
        for word in words:
            if word in self.server.refuses:
                return self.refuse(self.server.refuses[word], "Internal Error - We're working on it")
        if words == ["api", "repos", "create"]:
            return self.create(json.loads(body))
        if words == ["api", "validate-yaml"]:
            return self.answer({"errors": [], "warnings": []})
        if words == ["api", "datasets"]:
            return self.search(query["author"][0], query.get("search", [""])[0])
        if words[0] == "lfs":
            self.server.large[words[1]] = body
            return self.answer({})
        if words[-3:] == ["lfs", "objects", "batch"]:
            return self.batch(json.loads(body)["objects"])
        if words[0] == "api" and len(words) < 4:
            return self.refuse(404, "Not found")
        if words[0] == "api":
            kind, owner, name, *rest = words[1:]
        else:
            kind = "datasets" if words[0] == "datasets" else "models"
            owner, name, *rest = words[words[0] == "datasets" :]
        repository = self.server.repositories.get(f"{kind}/{owner}/{name}")
        if repository is None or (repository.private and not token):
            return self.refuse(404 if token else 401, "Repository not found", "RepoNotFound")
        what, revision, *path = rest or ["revision", "main"]
        revision = repository.head if revision == "main" else revision
        if what == "commit":
            return self.commit(repository, f"{self.server.url}/{owner}/{name}", body)
        if what == "preupload":
            return self.preupload(repository, json.loads(body)["files"])
        if revision not in repository.commits:
            return self.refuse(404, "Revision not found", "RevisionNotFound")
        if what == "revision":
            return self.answer({"id": f"{owner}/{name}", "sha": revision, "private": repository.private})
        files = repository.commits[revision]
        if what == "tree":
            return self.answer([_entry(path, content) for path, content in files.items()])
        assert what == "resolve"
        place = "/".join(path)
        if place not in files:
            return self.refuse(404, "Entry not found", "EntryNotFound")
        return self.answer(files[place], ETag=f'"{_oid(place, files[place])}"', X_Repo_Commit=revision)

    def create(self, asked: dict[str, Any]) -> None:
        id_ = f"{asked['organization']}/{asked['name']}"
        if asked["organization"] != OWNER:
            return self.refuse(403, f"You don't have the rights to create a repository of {asked['organization']}")
        key, url = f"{asked['type']}s/{id_}", f"{self.server.url}/{'datasets/' * (asked['type'] == 'dataset')}{id_}"
        if key in self.server.repositories:
            return self.answer({"error": "You already created this repo", "url": url}, 409)
        self.server.repositories[key] = Repository(asked.get("visibility") == "private" or asked.get("private", False))
        self.server.repositories[key].commit({".gitattributes": b"*.safetensors filter=lfs\n"})
        return self.answer({"url": url})

    def search(self, author: str, text: str) -> None:
        ids = [
            key.removeprefix("datasets/") for key in self.server.repositories if key.startswith(f"datasets/{author}/")
        ]
        self.answer([{"id": id_} for id_ in ids if text in id_])

    def batch(self, objects: list[dict[str, Any]]) -> None:
        for each in objects:
            if each["oid"] not in self.server.large:
                each["actions"] = {"upload": {"href": f"{self.server.url}/lfs/{each['oid']}"}}
        self.answer({"transfer": "basic", "objects": objects})

    def preupload(self, repository: Repository, files: list[dict[str, Any]]) -> None:
        answers = []
        for file in files:
            there = repository.files.get(file["path"])
            mode = "lfs" if _is_large(file["path"]) else "regular"
            oid = {} if there is None else {"oid": _oid(file["path"], there)}
            answers.append({"path": file["path"], "uploadMode": mode, "shouldIgnore": False, **oid})
        self.answer({"files": answers})

    def commit(self, repository: Repository, url: str, body: bytes) -> None:
        lines = [json.loads(line) for line in body.splitlines()]
        parent = lines[0]["value"].get("parentCommit", repository.head)
        if parent != repository.head:
            return self.refuse(412, "A commit has happened since. Please refresh and try again.")
        added = {}
        for line in lines[1:]:
            value, is_large = line["value"], line["key"] == "lfsFile"
            content = self.server.large[value["oid"]] if is_large else base64.b64decode(value["content"])
            added[value["path"]] = content
        name = repository.commit({**repository.files, **added})
        return self.answer({"commitUrl": f"{url}/commit/{name}", "commitOid": name})


def _is_large(path: str) -> bool:
    return path.endswith((".safetensors", ".hdf5", ".png"))


def _oid(path: str, content: bytes) -> str:
    """Of a large file its sha256, else git's sha1."""
    if _is_large(path):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _entry(path: str, content: bytes) -> dict[str, Any]:
    oid, size = _oid(path, content), len(content)
    large = {"lfs": {"oid": oid, "size": size, "pointerSize": 130}} if _is_large(path) else {}
    return {"type": "file", "path": path, "size": size, "oid": oid, **large}
