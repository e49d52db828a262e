"""The rules that keep the package readable: who may import whom, how long a file may be, what is never done."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import zest_rl
from zest_rl.cli.verbs import VERBS

PACKAGE = Path(zest_rl.__file__).parent
ROOT = PACKAGE.parent

ROOMS = (
    "errors", "types", "runtime", "metrics", "data", "simulation", "kitchen", "sources", "embedders", "rewards",
    "export", "agents", "training", "evaluation", "online", "analysis", "report", "explore", "api", "cli",
)  # fmt: skip
"""The pipeline: a module imports only from its own room and from those before it."""

MAY_READ_GROUND_TRUTH = (
    "analysis.curation_quality", "analysis.inspection", "analysis.learned_rewards", "explore.session",
    "export.transitions", "report.comparison_page", "report.goals",
)  # fmt: skip
"""The only callers of `Dataset.truth`, which make reports or copies: nothing that chooses or trains anything."""

HEAVY = (
    "stable_baselines3",
    "sb3_contrib",
    "torch",
    "transformers",
    "mujoco",
    "minari",
    "timm",
    "open_clip",
    "gymnasium",
    "matplotlib",
    "scipy",
    "h5py",
)

SOURCES = sorted(PACKAGE.rglob("*.py"))
RECIPE_FOLDERS = ("datasets", "train", "eval")


def module_name(path: Path) -> str:
    """Name below zest_rl: ``cli.ui``; a package goes by its folder's name."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room(name: str) -> str:
    """First part of a module's name: a folder, or a file beside them."""
    return name.split(".")[0]


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
            owner = below if below in MODULES else below.rpartition(".")[0]
            if owner:  # `from zest_rl import __version__` is of the package itself
                yield owner


MODULES = {module_name(path): path for path in SOURCES}


def test_the_package_is_its_rooms_and_four_files() -> None:
    entries = [path for path in PACKAGE.iterdir() if path.name not in ("__pycache__", "py.typed")]
    assert sorted(path.name for path in entries if path.is_file()) == [
        "__init__.py", "api.py", "errors.py", "types.py",
    ]  # fmt: skip
    assert {path.stem for path in entries} - {"__init__"} == set(ROOMS)


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_only_from_its_own_room_and_those_before_it(name: str) -> None:
    imports = list(own_imports(ast.parse(MODULES[name].read_text())))
    if not name:
        typed = next(node for node in ast.parse(MODULES[name].read_text()).body if isinstance(node, ast.If))
        assert ast.unparse(typed.test) == "TYPE_CHECKING"
        assert imports == list(own_imports(typed)), "zest_rl/__init__.py imports the package when it is used"
        return
    allowed = ROOMS[: ROOMS.index(room(name)) + 1]
    assert not [other for other in imports if room(other) not in allowed], f"{room(name)} comes before them"


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {
        name: set(own_imports(ast.parse(path.read_text(encoding="utf-8")))) - {name} for name, path in MODULES.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle: {' ← '.join(error.args[1])}")


def test_no_file_is_a_drawer_for_odds_and_ends() -> None:
    drawers = {"utils", "common", "helpers", "misc", "util", "helper"}
    assert not [path.name for path in SOURCES if path.stem in drawers]


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_a_file_has_at_most_400_lines(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400, "split it along its jobs"


@pytest.mark.parametrize("path", sorted((PACKAGE / "cli").rglob("*.py")), ids=module_name)
def test_a_verb_reads_flags_calls_the_library_and_prints(path: Path) -> None:
    parts = module_name(path).split(".")
    if parts[1:] and parts[1] in set(VERBS) - {"reproduce"}:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 80, "what it does belongs into a room below"


def test_only_the_env_module_imports_gymnasium_robotics() -> None:
    users = {
        module_name(path)
        for path in SOURCES
        for name in imported(ast.parse(path.read_text(encoding="utf-8")))
        if name.split(".")[0] == "gymnasium_robotics"
    }
    assert users == {"kitchen.env"}


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
    readers = {module_name(path) for path in SOURCES if ".truth()" in path.read_text(encoding="utf-8")}
    assert readers == set(MAY_READ_GROUND_TRUTH)
    for path in SOURCES:
        if "infos/gt" in path.read_text(encoding="utf-8"):
            assert room(module_name(path)) == "data", "it is read through `Dataset.truth` alone"


def test_ground_truth_read_from_states_is_for_judging_alone() -> None:
    users = {module_name(path) for path in SOURCES if "progress_of" in path.read_text(encoding="utf-8")}
    assert users == {"kitchen.env", "analysis.frame_selection"}
    importers = {
        module_name(path)
        for path in SOURCES
        if "zest_rl.analysis.frame_selection import" in path.read_text(encoding="utf-8")
    }
    assert importers == {"cli.select.frames"}


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_nothing_is_pickled_or_unpickled(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    pickling = {name.split(".")[0] for name in imported(tree)} & {"pickle", "cloudpickle", "joblib", "dill"}
    assert not pickling or module_name(path) in ("embedders.archives", "embedders.lite0"), "which build tensors alone"
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        options = {k.arg: k.value.value for k in call.keywords if isinstance(k.value, ast.Constant)}
        assert options.get("weights_only") is not False
        assert options.get("allow_pickle") is not True
        if ast.unparse(call.func) == "torch.load":
            assert options.get("weights_only") is True, "say weights_only=True"
        assert ast.unparse(call.func) != "torch.save", "weights are written as safetensors"


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_text_files_are_utf_8_whatever_the_locale(path: Path) -> None:
    for call in (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)):
        name = ast.unparse(call.func)
        reads = isinstance(call.func, ast.Attribute) and call.func.attr in ("read_text", "write_text")
        opens = name.endswith(".open") or name == "open"
        modes = [arg.value for arg in call.args if isinstance(arg, ast.Constant)]
        in_bytes = any("b" in str(mode) for mode in modes) or name in (
            "os.open",
            "Image.open",
            "webbrowser.open",
            "h5d.open",
        )
        if reads or (opens and not in_bytes):
            assert "encoding" in {keyword.arg for keyword in call.keywords}, ast.unparse(call)
