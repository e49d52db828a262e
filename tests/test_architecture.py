"""The rules that keep the package readable: who may import whom, how long a file may be, what is never done."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import zest_rl

PACKAGE = Path(zest_rl.__file__).parent
ROOT = PACKAGE.parent

ORDER = (
    "load_order", "errors", "types", "artifacts", "ray_engine", "parallel", "tasks", "observations", "data",
    "data_writer", "metrics", "quality", "envs", "arm", "experts", "collect",
    "rendering", "videos", "images", "goals", "embedders", "frames", "embed", "scores", "scorer", "looks", "selection",
    "footage", "relabel", "sources", "frame_scorer", "relabel_frames", "export", "agents",
    "checkpoints", "distributed", "training", "adoption", "evaluation", "report", "panels", "comparison", "inspection",
    "inspection_page", "candidates", "multistep",
    "cli.ui", "cli.recipes", "cli", "cli.doctor", "cli.collect", "cli.relabel", "cli.inspect", "cli.select_footage",
    "cli.select", "cli.follow", "cli.export", "cli.train", "cli.adopt", "cli.evaluate", "cli.report", "cli.plans",
    "cli.studies",
    "cli.reproduce",
)  # fmt: skip
"""The pipeline: a module imports only what stands before it. A folder is listed once, its files share the place."""

MAY_READ_GROUND_TRUTH = ("data", "panels", "comparison", "inspection", "export.transitions")
"""`read_ground_truth` and its only callers, which make reports or copies: nothing that chooses or trains anything."""

HEAVY = ("torch", "transformers", "mujoco", "minari", "timm", "open_clip", "gymnasium", "matplotlib", "scipy", "h5py")

SOURCES = sorted(PACKAGE.rglob("*.py"))
RECIPE_FOLDERS = ("datasets", "train", "eval")


def module_name(path: Path) -> str:
    """Name below zest_rl: ``cli.ui``; a package goes by its folder's name."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def place(name: str) -> int | None:
    """Index of a module in `ORDER`, by its own name or by that of the folder it is in; None when not listed."""
    parts = name.split(".")
    names = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    return next((ORDER.index(candidate) for candidate in names if candidate in ORDER), None)


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield full names of all imported modules, wherever the import stands; ``from a import b`` yields ``a.b``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_imports(tree: ast.AST) -> Iterator[str]:
    """Yield the imported modules of this package, by their names below zest_rl."""
    for name in imported(tree):
        if name.startswith("zest_rl."):
            below = name.removeprefix("zest_rl.")
            is_module = (PACKAGE / below.replace(".", "/")).with_suffix(".py").exists()
            is_module = is_module or (PACKAGE / below.replace(".", "/") / "__init__.py").exists()
            owner = below if is_module else below.rpartition(".")[0]
            if owner:  # `from zest_rl import __version__` is of the package itself
                yield owner


def test_every_module_has_its_place_in_the_pipeline() -> None:
    unlisted = [module_name(path) for path in SOURCES if module_name(path) and place(module_name(path)) is None]
    assert not unlisted, f"put them into ORDER where the pipeline needs them: {unlisted}"


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_a_module_imports_only_what_stands_before_it(path: Path) -> None:
    name = module_name(path)
    if not name:
        assert not list(own_imports(ast.parse(path.read_text()))), "zest_rl/__init__.py imports nothing of the package"
        return
    here = place(name)
    assert here is not None
    for other in own_imports(ast.parse(path.read_text())):
        there = place(other)
        assert there is not None, f"{name} imports {other}, which is not in ORDER"
        same_folder = there == here and name.split(".")[0] == other.split(".")[0]
        assert there < here or same_folder, f"{name} imports {other}, which stands after it"


def test_no_file_is_a_drawer_for_odds_and_ends() -> None:
    drawers = {"utils", "common", "helpers", "misc", "util", "helper"}
    assert not [path.name for path in SOURCES if path.stem in drawers]


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_a_file_has_at_most_400_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400, "split it along its jobs"


def test_only_the_env_module_imports_gymnasium_robotics() -> None:
    users = {
        module_name(path)
        for path in SOURCES
        for name in imported(ast.parse(path.read_text()))
        if name.split(".")[0] == "gymnasium_robotics"
    }
    assert users == {"envs"}


@pytest.mark.parametrize("folder", RECIPE_FOLDERS)
def test_a_recipe_folder_holds_no_importable_code(folder: str) -> None:
    assert (ROOT / folder).is_dir()
    assert not list((ROOT / folder).rglob("*.py")), "a package called `datasets` would shadow Hugging Face's"


@pytest.mark.parametrize("module", ["zest_rl", "zest_rl.cli", "zest_rl.cli.doctor"])
def test_importing_the_package_or_its_command_imports_nothing_heavy(module: str) -> None:
    code = f"import sys, {module}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "zest_rl" in loaded
    assert not set(HEAVY) & set(loaded)


def test_the_ground_truth_of_a_dataset_is_read_only_where_reports_are_made() -> None:
    readers = {module_name(path) for path in SOURCES if "read_ground_truth" in path.read_text()}
    assert readers == set(MAY_READ_GROUND_TRUTH)
    for path in SOURCES:
        if "infos/gt" in path.read_text():
            assert module_name(path) in ("data", "data_writer"), "it is read through `read_ground_truth` alone"


def test_ground_truth_read_from_states_is_for_judging_alone() -> None:
    users = {module_name(path) for path in SOURCES if "progress_of" in path.read_text()}
    assert users == {"envs", "candidates"}
    importers = {module_name(path) for path in SOURCES if "zest_rl.analysis.frame_selection import" in path.read_text()}
    assert importers == {"cli.select"}


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_nothing_is_pickled_or_unpickled(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert not {name.split(".")[0] for name in imported(tree)} & {"pickle", "cloudpickle", "joblib", "dill"}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        options = {k.arg: k.value.value for k in call.keywords if isinstance(k.value, ast.Constant)}
        assert options.get("weights_only") is not False
        assert options.get("allow_pickle") is not True
        if ast.unparse(call.func) == "torch.load":
            assert options.get("weights_only") is True, "say weights_only=True"
        assert ast.unparse(call.func) != "torch.save", "weights are written as safetensors"
