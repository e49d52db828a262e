"""Pages of the documentation site that nobody writes: hooks of `mkdocs`, see ``mkdocs.yml``.

- Pages beside ``docs/`` (recipes, changelog, …) come in under their own path. Links are written as GitHub needs them;
  the site has docs/NAME.md as NAME.md.
- What GitHub reads otherwise than Python-Markdown, lists without an empty line before them, is put right.
- A notebook becomes a page with its outputs.
- ``<!-- every verb -->`` becomes what each ``zest VERB --help`` says, ``<!-- every public name -->`` the docstrings.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import posixpath
import re
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import zest_rl

ROOT = Path(__file__).resolve().parents[1]
BESIDE = (
    "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "datasets/README.md", "train/README.md", "eval/README.md",
    "eval/*.toml", "eval/results/*.json", "benchmarks/README.md", "benchmarks/gpu.json",
    "benchmarks/metaworld/README.md",
)  # fmt: skip
"""What the site takes from outside of ``docs/``."""
FENCED = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)
GLUED = re.compile(r"^(#+ .*|(?! |[-*|] |\d+\. ).+)\n(?=[-*] |\d+\. |    )", re.MULTILINE)
"""A line before a list or an indented block, from which GitHub tells it without an empty line."""
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies outside of ``docs/``, and the notebooks."""
    for path in (path for pattern in BESIDE for path in sorted(ROOT.glob(pattern))):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    for path in sorted((ROOT / "docs").glob("tutorials/*.ipynb")):
        name = path.relative_to(ROOT / "docs").with_suffix(".md").as_posix()
        files.append(File.generated(config, name, content=notebook_page(json.loads(path.read_text("utf-8")))))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in what is generated, and turn links within the repository into links within the site."""
    for marker, parts in (("<!-- every verb -->", verbs), ("<!-- every public name -->", public_names)):
        if marker in markdown:
            markdown = markdown.replace(marker, "\n\n".join(parts()))
    path = page.file.src_uri
    in_repository = path if (ROOT / path).is_file() else f"docs/{path}"

    def on_site(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(in_repository), link[1])).removeprefix("docs/")
        return posixpath.relpath(re.sub(r"\.ipynb$", ".md", target), posixpath.dirname(path) or ".")

    parts = FENCED.split(markdown)
    parts[::2] = (GLUED.sub(r"\1\n\n", LINK.sub(on_site, part)) for part in parts[::2])
    return "".join(parts)


def notebook_page(notebook: Mapping[str, Any]) -> str:
    """Return a notebook with its outputs as Markdown."""
    return "\n\n".join(part for cell in notebook["cells"] for part in _cell(cell))


def _cell(cell: Mapping[str, Any]) -> Iterator[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield f"```python\n{source}\n```"
    for output in cell["outputs"]:
        shown = output.get("data", {"text/plain": output.get("text", "")})
        if "image/png" in shown:
            picture = "".join(shown["image/png"]).replace("\n", "")
            yield f'<img alt="" src="data:image/png;base64,{picture}">'
        else:
            yield f"```text\n{''.join(shown['text/plain']).rstrip()}\n```"


def verbs() -> Iterator[str]:
    """Write the help of every verb, as ``zest VERB --help`` prints it 88 columns wide."""
    os.environ["COLUMNS"] = "88"
    from zest_rl.cli.verbs import VERBS

    for verb, summary in VERBS.items():
        yield f"## zest {verb}\n\n{summary[0].upper()}{summary[1:]}."
        configs = getattr(importlib.import_module(f"zest_rl.cli.{verb}"), "CONFIGS", {})
        yield from (f"### zest {verb} {name}\n\n{_help(verb, name)}" for name in configs)
        if not configs:
            yield _help(verb)


def _help(*words: str) -> str:
    from zest_rl.cli import main

    with redirect_stdout(io.StringIO()) as printed:
        main([*words, "--help"])
    lines = "\n".join(map(str.rstrip, printed.getvalue().splitlines()))
    return f"```text\n{lines.strip()}\n```"


def public_names() -> Iterator[str]:
    """Write what `mkdocstrings` replaces by the docstring of each name that ``import zest_rl`` offers."""
    for name in zest_rl.__all__:
        home = zest_rl._MODULES.get(name, "api")
        yield f"::: zest_rl.{home}.{name}\n    options:\n      heading: zest_rl.{name}\n      heading_level: 2"
