"""``package.module:make``: environments that no file can name, made by a function that the user names.

Only the user may name one, by ``--env`` or, once he did, by what he relabeled with it on this machine
(`zest_rl.runtime.trust`, which keeps the file that the name stood for); data alone never runs code.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zest_rl.data.env_specs import MAKER
from zest_rl.errors import BadInput, nearest
from zest_rl.runtime import artifacts
from zest_rl.runtime.trust import is_remembered, remember


def named_by_user(env: str) -> str:
    """Return what ``--env`` holds, and remember that the user named it.

    Raises:
        BadInput: it is not ``package.module:make``.
    """
    if MAKER.fullmatch(env) is None:
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
    if MAKER.fullmatch(env) and not is_named(env):
        where = _file(env) or f"no such module in {Path.cwd()}: go to the folder that holds it"
        raise BadInput(
            f"{what} names {env} ({where}) as the function that makes its environment, which you did not name on this "
            f"machine; if you know its code, give --env {env}, which runs it"
        )


def source_sha256(env: str) -> str | None:
    """Return the hash of the file of a function's module (not of what it imports); None without any."""
    file = _file(env)
    return None if file is None else artifacts.hash_file(file)


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


def find_maker(maker: str) -> Callable[[], Any]:
    """Import a function of the working directory or an installed package.

    Raises:
        BadInput: there is no such module or function, or it needs arguments.
    """
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
