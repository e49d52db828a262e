"""``package.module:make``: environments that no file can name, made by a function that the user names.

Only the user may name one, by ``--env`` or, once he did, by what he relabeled with it on this machine
(`zest_rl.runtime.trust`, which keeps the file that the name stood for); data alone never runs code.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import gymnasium

from zest_rl.data.env_specs import is_maker
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime import artifacts
from zest_rl.runtime.trust import is_remembered, remember


def named_by_user(env: str) -> str:
    """Return what ``--env`` holds, and remember that the user named it.

    Raises:
        BadInput: it is not ``package.module:make``.
    """
    if not is_maker(env):
        raise BadInput(f"--env must be package.module:make, a function that makes an environment, got {env!r}")
    remember("environment", _identity(env))
    return env


def is_named(env: str) -> bool:
    """Whether this user named this function, of the file in which it would be found now."""
    return _file(env) is not None and is_remembered("environment", _identity(env))


def check_named(env: str, what: str) -> None:
    """Refuse a function that data name as their environment, unless this user named it on this machine.

    Raises:
        BadInput: it would run code that this user did not name.
    """
    if is_maker(env) and not is_named(env):
        where = _file(env) or f"no such module in {Path.cwd()}: go to the folder that holds it"
        raise BadInput(
            f"{what} names {env} ({where}) as the function that makes its environment, which you did not name on this "
            f"machine; if you know its code, give --env {env}, which runs it"
        )


def source_sha256(env: str) -> str:
    """Return the hash of the code of a function: its module, and what this imports of its own package or folder."""
    return artifacts.hash_json({name: artifacts.hash_file(file) for name, file in sorted(_sources(env).items())})


def _sources(env: str) -> dict[str, Path]:
    """Return the files of a function's code by the names of their modules, found without running any of it."""
    module = env.partition(":")[0]
    file, found, wanted = _file(module), dict[str, Path](), [module]
    is_alone = file is not None and "." not in module and not file.parent.name.endswith("-packages")
    folder = file.parent if file is not None and is_alone else None  # that of installed packages is not its own

    def is_own(name: str) -> bool:
        first = name.partition(".")[0]
        return first == module.partition(".")[0] or (
            folder is not None and ((folder / f"{first}.py").is_file() or (folder / first).is_dir())
        )

    while wanted:
        name = wanted.pop()
        if name in found or not is_own(name) or (file := _file(name)) is None:
            continue
        found[name] = file
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        wanted += [name.rpartition(".")[0], *_imported(file, package)]
    return found


def _imported(file: Path, package: str) -> list[str]:
    """Return the names of all modules that a file of a package may import."""
    names = list[str]()
    for node in ast.walk(ast.parse(file.read_bytes())) if file.suffix == ".py" else ():
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            with suppress(ImportError):  # a script may try a relative import first
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return names


def _identity(env: str) -> dict[str, str | None]:
    file = _file(env)
    return {"function": env, "file": None if file is None else str(file)}


def _file(env: str) -> Path | None:
    """Return the file of a function's module, without running any code; None without any."""
    _look_here()
    first, *rest = env.partition(":")[0].split(".")
    try:
        spec = importlib.util.find_spec(first)
    except ValueError:  # it is __main__, or was put together by hand
        return None
    if spec is None:
        return None
    stems = [Path(folder, *rest) for folder in spec.submodule_search_locations or ()] if rest else []
    files = [file for stem in stems for file in (stem / "__init__.py", stem.parent / f"{stem.name}.py")]
    if not rest and spec.origin:
        files = [Path(spec.origin)]
    return next((file.resolve() for file in files if file.is_file()), None)


def _look_here() -> None:
    """Let modules of the working directory be imported, after those that are installed, which they must not replace."""
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)


def make_named(maker: str) -> gymnasium.Env[Any, Any]:
    """Make an environment by a function of the working directory or an installed package.

    Raises:
        BadInput: there is no such module or function, it needs arguments, or it makes no environment.
        ZestError: its code fails.
    """
    try:
        env: Any = _find(maker)()
    except BadInput:
        raise
    except Exception as error:  # whatever an environment raises
        raise ZestError(
            f"{maker} cannot be made here ({type(error).__name__}: {error}); mend the function, or install what it "
            "needs"
        ) from error
    if not isinstance(env, gymnasium.Env):
        raise BadInput(f"--env {maker} must return a gymnasium.Env, got {type(env).__name__}; return the environment")
    return env


def _find(maker: str) -> Callable[[], Any]:
    module_name, _, name = maker.partition(":")
    _look_here()
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise BadInput(
            f"--env {maker}: there is no module {error.name!r} in {Path.cwd()} or among the installed packages; write "
            "package.module:make, where package/module.py is in this folder or installed"
        ) from error
    make: Any = getattr(module, name, None)
    if not callable(make):
        functions = [known for known, value in vars(module).items() if inspect.isfunction(value)]
        raise BadInput(
            f"--env {maker}: {module_name} ({module.__file__}) has no function {name!r}; {nearest(name, functions)}"
        )
    try:
        inspect.signature(make).bind()
    except TypeError as error:
        raise BadInput(
            f"--env {maker}: {name}{inspect.signature(make)} must be called without arguments ({error}); write a "
            f"function that makes it with the right ones, e.g. def make(): return {name}(…)"
        ) from error
    except ValueError:
        pass  # a builtin, whose arguments are not known
    found: Callable[[], Any] = make
    return found
