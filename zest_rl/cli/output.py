"""What a verb's result and its failure look like."""

from __future__ import annotations

import errno
import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from zest_rl.cli.interruption import INTERRUPTED, exit_code
from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.address_space import is_out_of_memory
from zest_rl.training.distributed import launched

SHARES = ("clipped_actions", "expert_success")
"""Figures in [0, 1] that are printed in percent."""


def print_result(
    result: Mapping[str, Any], summary: Callable[[Mapping[str, Any]], str] | None, *, as_json: bool
) -> None:
    """Print a result on stdout, as JSON or for people: by the verb's own `summary`, if any, and the next command."""
    if as_json:
        print(json.dumps(result, indent=2, allow_nan=False))
        return
    shown = {key: value for key, value in result.items() if key not in ("next", "ok")}
    print("\n".join(_listing(shown)) if summary is None else summary(result))
    if result.get("next"):
        print(f"next: {result['next']}")


def print_failure(error: BaseException, *, as_json: bool) -> int:
    """Print what went wrong, on stderr and, as JSON, on stdout; return the exit code."""
    code, message = _explain(error)
    if os.environ.get("ZEST_TRACEBACK"):
        traceback.print_exc()
    print(message if isinstance(error, KeyboardInterrupt) else f"error: {message}", file=sys.stderr)
    if as_json and launched().leads:
        problem = {"type": type(error).__name__, "message": message, "exit_code": code}
        print(json.dumps({"error": problem}, indent=2))
    return code


def _listing(value: Mapping[str, Any], indent: str = "") -> list[str]:
    """Write a result as ``key: value`` lines, nested mappings indented; what does not apply (None) is left out."""
    lines = []
    for key, item in value.items():
        if item is None:
            continue
        if isinstance(item, Mapping) and item.keys() == {"value", "low", "high"}:
            lines.append(f"{indent}{key}: {_estimate(key, item, value.get('n_episodes'))}")
        elif isinstance(item, Mapping):
            lines += [f"{indent}{key}:", *_listing(item, indent + "  ")]
        elif isinstance(item, list) and any(isinstance(entry, Mapping) for entry in item):
            for index, entry in enumerate(item):
                lines += [f"{indent}{key} {index + 1}:", *_listing(entry, indent + "  ")]
        else:
            if key in SHARES:
                item = f"{100 * item:.1f} %"
            elif key == "iqm" and "normalized_return" in value:
                item = f"{item:.1f} %"
            lines.append(f"{indent}{key}: {_cell(item)}")
    return lines


def _estimate(key: str, estimate: Mapping[str, float], n_episodes: int | None) -> str:
    """Write a figure with its unit and its 95 % interval."""
    value, low, high = (estimate[name] for name in ("value", "low", "high"))
    if key == "success" and n_episodes:
        return f"{round(value * n_episodes)} of {n_episodes}, 95 % interval {100 * low:.0f} to {100 * high:.0f} %"
    if key == "normalized_return":
        return f"{value:.1f} % of the expert, 95 % interval {low:.1f} to {high:.1f} %"
    return f"{value:.4g}, 95 % interval {low:.4g} to {high:.4g}"


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(_cell, value))
    return str(value)


def _explain(error: BaseException) -> tuple[int, str]:
    """Return the exit code of a failure and what to tell the user."""
    if isinstance(error, KeyboardInterrupt):
        return exit_code(error), INTERRUPTED
    if isinstance(error, ZestError):
        return 2 if isinstance(error, BadInput) else 1, str(error)
    if is_out_of_memory(error):
        return 1, f"the memory does not suffice ({error}); use fewer --n-workers, or raise the limit (ulimit -v)"
    if isinstance(error, OSError):
        at = f" at {error.filename}" if error.filename else ""
        if error.errno == errno.ENOSPC:
            return 1, f"the disk is full{at}; free some space and run the same command again to go on"
        return 1, f"{error.strerror or error}{at}"
    return 1, f"unexpected {type(error).__name__}: {error}; ZEST_TRACEBACK=1 shows where"
