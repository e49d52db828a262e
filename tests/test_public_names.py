"""What `import zest_rl` offers, and the snippets of docs/python.md and the README, run as they stand."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image, ImageDraw

import zest_rl
from zest_rl import api
from zest_rl.errors import BadInput

ROOT = Path(__file__).parents[1]


def snippets(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working folder with a drawn ``film.mp4``, and its ends as pictures."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ZEST_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    frames = []
    for left in range(8, 56, 8):
        image = Image.new("RGB", (96, 64), "white")
        ImageDraw.Draw(image).rectangle((left, 16, left + 32, 48), fill="navy")
        frames.append(np.array(image))
    imageio.mimwrite("film.mp4", frames, fps=5, codec="libx264", macro_block_size=2)
    Image.fromarray(frames[0]).save("closed.png")
    Image.fromarray(frames[-1]).save("open.png")


@pytest.mark.usefixtures("film")
def test_the_snippets_of_the_python_page_run(monkeypatch: pytest.MonkeyPatch) -> None:
    mpl.use("agg")
    monkeypatch.setattr("zest_rl.kitchen.calibration.N_REFERENCE", 2)  # of 100 episodes, which take a minute
    monkeypatch.setattr("zest_rl.kitchen.calibration.N_NOTHING", 1)
    names: dict[str, Any] = {}
    for snippet in snippets("docs/python.md"):
        exec(compile(snippet, "docs/python.md", "exec"), names)
    curve, result = names["curve"], names["result"]
    assert names["rewards"].shape == (len(curve) - 1,)
    assert (len(names["episodes"]), len(result.episodes)) == (4, 1)
    assert result.episodes[0].zest_return is not None, "the return-to-go falls by online scores"
    assert max(len(repr(each)) for each in (result, names["ds"])) < 1200, "what a notebook prints of them is short"
    assert names["actions"].shape == (1, names["episodes"][0].actions.shape[1])
    assert names["vectors"].shape == (2, 1280)
    assert all(map(Path.is_file, map(Path, ("scores.csv", "report.html", "transitions.npz"))))


@pytest.mark.usefixtures("film")
def test_the_readme_shows_functions_that_exist_with_their_arguments() -> None:
    mpl.use("agg")
    (shown,) = (snippet for snippet in snippets("README.md") if "import zest_rl" in snippet)
    scoring, rest = shown.split("ds = ")
    exec(scoring, {})
    for name, given in re.findall(r"zest_rl\.(\w+)\(([^)]*)\)", f"ds = {rest}"):
        exec(
            f"inspect.signature(zest_rl.{name}).bind({given})",
            {"inspect": inspect, "zest_rl": zest_rl, "ds": "", "run": ""},
        )


def test_importing_the_package_is_quick_and_lists_the_public_names() -> None:
    code = "import sys, zest_rl; print(*dir(zest_rl)); print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    listed, loaded = (set(line.split()) for line in done.stdout.splitlines())
    assert set(zest_rl.__all__) <= listed
    heavy = {"torch", "mujoco", "gymnasium", "gymnasium_robotics", "matplotlib", "tyro", "numpy", "PIL"}
    assert not heavy & loaded


@pytest.mark.parametrize("name", zest_rl.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    assert callable(getattr(zest_rl, name))
    assert getattr(zest_rl, name).__doc__


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="'zest_rl' has no attribute 'rellabel'"):
        zest_rl.rellabel  # noqa: B018


@pytest.mark.parametrize("first", ["import zest_rl.export.transitions, zest_rl.report.html, zest_rl.explore", ""])
def test_rooms_with_the_name_of_a_verb_are_called_like_it_whatever_is_imported_first(
    first: str, tmp_path: Path
) -> None:
    code = f"""
{first}
import zest_rl
for verb in (zest_rl.export, zest_rl.report, zest_rl.explore):
    try:
        verb("x/nothing-v0")
    except zest_rl.errors.BadInput as error:
        print(error)
from zest_rl.export import to_d3rlpy
assert zest_rl.export.to_d3rlpy is to_d3rlpy
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    missing_dataset, missing_run, nothing_to_explore = done.stdout.splitlines()
    assert "x/nothing-v0" in missing_dataset
    assert "x/nothing-v0 is not the folder of a training" in missing_run
    assert "x/nothing-v0" in nothing_to_explore


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: zest_rl.train("dt", "a/b-v0", n_update=3), "unknown argument 'n_update'; did you mean 'n_updates'"),
        (lambda: zest_rl.train("td", "a/b-v0"), "unknown agent 'td'; did you mean 'dt'"),
        (lambda: zest_rl.evaluate("runs/x", n_episode=3), "unknown argument 'n_episode'; did you mean 'n_episodes'"),
        (lambda: zest_rl.evaluate("runs/x"), "runs/x is not the folder of a training"),
        (lambda: zest_rl.collect("micro", levle=3), "unknown argument 'levle'; did you mean 'level'"),
        (lambda: zest_rl.collect("macro"), "unknown task 'macro'"),
    ],
)
def test_a_wrong_argument_is_named(call: Any, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        call()


@pytest.mark.parametrize("verb", ["collect", "evaluate", "explore", "export", "inspect", "push", "relabel", "report"])
def test_the_functions_name_all_flags_of_their_verbs(verb: str) -> None:
    import importlib
    from dataclasses import fields

    module = importlib.import_module(f"zest_rl.cli.{verb}")
    function = getattr(api, verb)
    told = {*inspect.signature(function).parameters, *re.findall(r"\w+", function.__doc__)}
    plural = {"run": "runs"}
    for flag in (field.name for field in fields(module.Config)):
        assert {flag, plural.get(flag, flag)} & told, flag
