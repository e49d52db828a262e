"""Choice of the GL backend (``MUJOCO_GL``, else EGL, else OSMesa in software), and a GL context of it."""

from __future__ import annotations

import functools
import importlib
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco

from zest_rl.errors import ZestError
from zest_rl.runtime.address_space import GL, check_address_space

INSTALL_GL = "apt-get install libegl1 libgl1 libosmesa6"
Made = TypeVar("Made")


class cached_in_thread(Generic[Made]):
    """As `functools.cache`, for each thread its own: a GL context, and a simulation, belong to one thread."""

    def __init__(self, make: Callable[..., Made]) -> None:
        functools.update_wrapper(self, make)
        self._make, self._of = make, threading.local()

    def __call__(self, *arguments: Hashable) -> Made:
        """Return what this thread made of these arguments."""
        made: dict[tuple[Hashable, ...], Made] = vars(self._of).setdefault("made", {})
        if arguments not in made:
            made[arguments] = self._make(*arguments)
        return made[arguments]

    def cache_clear(self) -> None:
        """Forget what this thread made."""
        vars(self._of).clear()


def select_gl_backend() -> str:
    """Return the GL backend for this process: the user's ``MUJOCO_GL``, else EGL, else OSMesa.

    The choice is kept in ``MUJOCO_GL``, so that child processes and other renderers agree. It is tested in a child
    process, because PyOpenGL cannot change its backend after a failed attempt.

    Raises:
        ZestError: neither EGL nor OSMesa works.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen:
        return chosen
    if platform.system() != "Linux":
        return "native"
    probe = "import sys, importlib; importlib.import_module('mujoco.' + sys.argv[1]).GLContext(8, 8).make_current()"
    for backend in ("egl", "osmesa"):
        environ = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        if subprocess.run([sys.executable, "-c", probe, backend], env=environ, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
            return backend
    raise ZestError(f"no frame can be rendered: neither EGL nor OSMesa works here; {INSTALL_GL}")


def release_gl() -> None:
    """Leave no GL context current in this thread, which ends: another may then draw with them, or close them."""
    if os.environ.get("MUJOCO_GL") == "egl":
        importlib.import_module("mujoco.egl").EGL.eglReleaseThread()


def open_gl(model: mujoco.MjModel, size: int) -> tuple[Any, mujoco.MjrContext]:
    """Return a GL context, current in this thread, and MuJoCo's drawing context in it, for frames of `size` pixels.

    Raises:
        ZestError: no GL backend works, or ``ulimit -v`` leaves it too little.
    """
    check_address_space("GL", GL)
    backend = select_gl_backend()
    try:
        module = f"mujoco.{backend}" if backend in ("egl", "osmesa") else "mujoco.gl_context"
        gl = importlib.import_module(module).GLContext(size, size)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
    except Exception as error:  # each backend and driver raises another type
        raise ZestError(
            f"the GL backend {backend!r} does not work: {error}; {INSTALL_GL}, or unset MUJOCO_GL"
        ) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context
