"""Recipes with anything in them are read, or refused with a rule."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
from fuzzing import damaged_bytes, faults, outcomes

from zest_rl.cli.config import parse_config, read_recipe
from zest_rl.cli.relabel.arguments import Config as Relabel
from zest_rl.cli.reproduce.comparison import read_comparison
from zest_rl.cli.train import CONFIGS
from zest_rl.errors import BadInput

RECIPES = Path(__file__).resolve().parents[2]
VALUES = (
    "-1", "0", "1e400", "nan", "inf", "true", '""', '"x"', "[]", "{}", "[[1]]", "10_000_000_000_000_000", "1979-05-27",
    '"../../etc/passwd"', '"{x.__class__}"', "[1, 'a']", "{a = 1}", '"\\u0000"', "9" * 400, '"command:sh"',
)  # fmt: skip


def damaged_toml(text: str, rng: random.Random) -> str:
    """Give one to three keys another value, or damage the bytes."""
    if rng.random() < 0.3:
        return damaged_bytes(text.encode(), rng).decode(errors="replace")
    lines = text.splitlines()
    keys = [i for i, line in enumerate(lines) if re.match(r"\w[\w-]* *=", line)]
    for i in rng.sample(keys, min(len(keys), rng.choice((1, 1, 2, 3)))):
        lines[i] = f"{lines[i].partition('=')[0]}= {rng.choice(VALUES)}"
    return "\n".join(lines)


@pytest.mark.parametrize("n", [60, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("recipe", ["eval/table1.toml", "eval/demo.toml", "relabel", "train"])
def test_a_damaged_recipe_is_read_or_refused(recipe: str, n: int, tmp_path: Path) -> None:
    written = {
        "relabel": 'goal = "same-scene"\nviews = 8\nframes = ["a"]\ntolerance = 0.1\nembedder = "x"\nn-workers = 2\n',
        "train": 'dataset = "zest/x-v0"\nhidden_size = 32\nn-layers = 1\nn-updates = 10\nseed = 0\nbatch-size = 4\n',
    }
    text = written[recipe] if recipe in written else (RECIPES / recipe).read_text(encoding="utf-8")
    text = text.replace("visual-tasks:real_imgs", "same-scene")  # a data set that is not here
    path, rng = tmp_path / "r.toml", random.Random(0)
    damaged = [text, *(damaged_toml(text, rng) for _ in range(n))]

    def read(i: int) -> str:
        path.write_text(damaged[i], encoding="utf-8")
        if recipe == "relabel":
            return repr(parse_config(Relabel, ["a/b-v0", "--recipe", str(path)], "relabel"))
        if recipe == "train":
            return repr(parse_config(CONFIGS["dt"], ["--recipe", str(path)], "train dt"))
        return repr(read_comparison(path))

    first, *others = outcomes(read, n + 1)
    counts, bad = faults(others)
    print(recipe, n, dict(counts))
    assert first.kind == "read", first.detail
    assert not bad, bad[0].detail


def test_deep_nesting_in_a_recipe_is_refused(tmp_path: Path) -> None:
    (tmp_path / "deep.toml").write_text("x = " + "[" * 100_000 + "]" * 100_000)
    with pytest.raises(BadInput, match=r"recipe .*deep.toml is not TOML"):
        read_recipe(tmp_path / "deep.toml")
