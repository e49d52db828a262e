"""Import this before mujoco, or else before anything is rendered.

GL's software drivers and Triton (which torch, timm and transformers load) each bring an LLVM; with that of GL loaded
first, Triton finds its functions there, and loading it crashes Python (seen with Mesa 22.3 and Triton 3). So Triton's
library is loaded first, without its Python modules, which take four times as long; where a script has rendered already,
it is told to look for its functions in itself (RTLD_DEEPBIND). mujoco may load GL when it is imported, and fails there
where ``MUJOCO_GL`` is not one of its values or names a library that is missing: a `ZestError` here.
"""

import ctypes
import importlib
import os
import sys
from importlib.machinery import PathFinder
from pathlib import Path

from zest_rl.errors import ZestError

_triton = PathFinder.find_spec("triton")
_library = _triton and PathFinder.find_spec(
    "libtriton", [f"{folder}/_C" for folder in _triton.submodule_search_locations or ()]
)
if _library and _library.origin and "triton" not in sys.modules:
    _maps = Path("/proc/self/maps")
    _gl_is_loaded = _maps.exists() and b"libLLVM" in _maps.read_bytes()
    ctypes.CDLL(_library.origin, os.RTLD_NOW | (os.RTLD_DEEPBIND if _gl_is_loaded else 0))
try:
    importlib.import_module("mujoco")
except (AttributeError, ImportError, OSError, RuntimeError) as error:
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise ZestError(
        f"MuJoCo cannot be loaded with MUJOCO_GL={os.environ['MUJOCO_GL']} ({error}); unset it, so that what works is "
        "chosen, or set it to egl (libegl1), osmesa (software, libosmesa6), glfw (a display) or disable (no pictures)"
    ) from error
