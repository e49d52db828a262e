"""Recipes that compare methods are read and checked as a whole before anything runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_comparison import RECIPE, TASK_AND_SIZE, refuse_edited, write

from zest_rl.cli.reproduce.comparison import read_comparison


def test_one_task_may_have_several_datasets(tmp_path: Path) -> None:
    tables = "".join(
        f"[tasks.at-{level}]\ntask = 'micro'\nlevel = {level}\ndataset = 'zest/at-{level}-v0'\n" for level in (60, 95)
    )
    shared = RECIPE.replace('task = "micro"\n', "").replace('dataset = "zest/kitchen-micro-whole-v0"\n', "")
    comparison = read_comparison(write(tmp_path, shared.replace("[relabel]", f"{tables}\n[relabel]")))
    assert {name: (config.task, config.level) for name, config in comparison.tasks.items()} == {
        "at-60": ("micro", 60.0),
        "at-95": ("micro", 95.0),
    }


def test_a_goal_may_be_the_ends_of_an_episode_of_the_kitchen(tmp_path: Path) -> None:
    comparison = read_comparison(write(tmp_path, RECIPE.replace("same-scene", "episode:3")))
    assert comparison.relabel["micro"]["scene"].goal == "episode:3"


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('goal = "same-scene"', 'goal = "same-scene"\ngoal_share = 7.0', "goal_share must be in"),
        ("[evaluate]", "[evalute]", "unknown key 'evalute'; did you mean 'evaluate'"),
        ('title = "A tiny comparison"', "", "'title' is required"),
        ('title = "A tiny comparison"', 'verb = "train dt"', "is for `zest train dt --recipe"),
        ('title = "A tiny comparison"', 'verb = "select goals"', "unknown key 'collect'"),
        ("seeds = [0]", 'seeds = ["0"]', "'seeds' must be a list of an integer, got ['0']"),
        ("seeds = [0]", "seeds = [0, 0]", "seeds must be at least 1 number, all different"),
        ('agent = "bc"', 'agent = "bc"\nseeds = [1]', "seeds must be some of the recipe's seeds [0], got [1]"),
        ('agent = "bc"', 'agent = "bc"\nkeep = 1.0', "keep must be above 0 and below 1, and needs a goal, got 1.0"),
        ('agent = "bc"', 'agent = "bc"\nseeds = []', "[methods.'BC']: seeds must be some of"),
        ("[relabel]", "[relabel.all]", "[goals.'scene']: unknown key 'all'"),
        ("[methods.BC]", "[methods]", "'methods' must be a table of tables"),
        ("[train.dt]", "[train.bcc]", "unknown key 'bcc'"),
        (TASK_AND_SIZE, '[tasks.report]\ntask = "micro"', "the name becomes a file's beside report.html"),
        ("[relabel]", "[tasks.micro]\n[relabel]", "[collect]: 'task' is not for a recipe to set"),
        ('task = "micro"', 'task = "mirco"', "[collect]: unknown task 'mirco'; did you mean 'micro'"),
        ("noise_max = 1.0", "noise_max = 3.0", "[collect]: noise_max must be in [0, 2.0], got 3.0"),
        ("n_episodes = 4", "n_episodes = 4\nlevel = 0", "level must be in (0, 100] percent of the expert, got 0.0"),
        ('goal = "same-scene"', 'goal = "same-scen"', "[goals.'scene']: unknown goal 'same-scen'"),
        ('goal = "same-scene"', 'goal = "visual-tasks:real_imgs"', "set it to your copy of the Visual Tasks Dataset"),
        (TASK_AND_SIZE, "[tasks.micro]\nn_episodes = 3\n[tasks.sdoor]\nn_episodes = 4", "every task needs as many"),
        (TASK_AND_SIZE, '[tasks."a/b"]\ntask = "micro"', "the name becomes a file's"),
        (TASK_AND_SIZE, "[tasks.mirco]", "unknown task 'mirco'; did you mean 'micro'"),
        ("noise_max = 1.0", "noise-maxx = 1.0", "[collect]: unknown key 'noise-maxx'; did you mean 'noise-max'"),
        ("n_updates = 20", 'n_updates = "many"', "'n_updates' must be an integer, got 'many'"),
        ("hidden_size = 32", "hidden_size = 0", "hidden_size must be 1 to 16384, got 0"),
        ('agent = "bc"', "", "[methods.'BC']: a method has either an agent or a policy, got None and None"),
        ('agent = "bc"', 'agent = "bcc"', "unknown agent 'bcc'; did you mean 'bc'"),
        ('kind = "control"', 'kind = "baseline"', "'kind' must be one of 'method', 'control', got 'baseline'"),
        ("context_len = 5", "contextlen = 5", "unknown key 'contextlen'; did you mean 'context-len'"),
        ("context_len = 5", 'dataset = "zest/x-v0"', "'dataset' is not for a recipe to set"),
        ('"dt"\ngoal = "scene"', '"dt"\ngoal = "sceen"', "unknown goal 'sceen'; did you mean 'scene'"),
        ("n_episodes = 2", "horizon = 50", "[methods.'BC']: 'horizon' is not for a recipe to set"),
        ("n_episodes = 2", "n_episodes = 0", "n_episodes must be at least 1, got 0"),
        ("n_episodes = 2", 'rtg = "offline"', "'rtg' must be one of 'online', 'constant', 'schedule', got 'offline'"),
        ('agent = "bc"', 'agent = "bc"\npolicy = "onnx:x"', "either an agent or a policy, got 'bc' and 'onnx:x'"),
        ('agent = "bc"', 'policy = "onnx:x"\nhidden_size = 1', "[methods.'BC']: unknown key 'hidden_size'"),
        ('agent = "bc"', 'policy = "onxn:x"', "[methods.'BC']: unknown kind of policy 'onxn'; did you mean 'onnx'?"),
        ('agent = "bc"', 'policy = "d3rlpy:x.d3"', "[methods.'BC']: a Python belongs to d3rlpy:FILE.d3"),
        ('agent = "bc"', 'policy = "onnx:x"\nseed = 1', "'seed' is not for a recipe to set"),
        (
            "[relabel]",
            '[tasks.micro]\n[tasks.sdoor]\n[methods.A]\npolicy = "onnx:x"\n[relabel]',
            "must hold {task}, got",
        ),
        ("seeds = [0]", 'seeds = [0, 1]\nmethods.A.policy = "onnx:x"', "the policy must hold {seed}, got 'onnx:x'"),
    ],
)
def test_a_bad_recipe_is_refused_before_anything_runs(
    old: str,
    new: str,
    complaint: str,
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recipe, message = refuse_edited(RECIPE, (old, new), refusal, tmp_path, monkeypatch)
    assert complaint in message
    assert str(recipe) in message
    assert list(tmp_path.iterdir()) == [recipe]
