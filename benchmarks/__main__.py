"""Compare speeds with other implementations: ``python -m benchmarks [NAME …] [--json]``.

Every file beside this one is a benchmark: its docstring says what is compared, and its ``run()`` returns the numbers,
``passed`` among them. Each runs in a process of its own, one after the other. Run them on a quiet machine.
``scale`` takes most of an hour and runs only when it is named.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from pathlib import Path

NAMES = sorted(path.stem for path in Path(__file__).parent.glob("[a-z]*.py"))
ONLY_NAMED = {"scale"}


def run_here(name: str, as_json: bool) -> bool:
    """Run one benchmark and print its numbers; return whether the requirement is met."""
    start = time.monotonic()
    result = importlib.import_module(f"benchmarks.{name}").run() | {"seconds": round(time.monotonic() - start, 1)}
    if as_json:
        print(json.dumps({name: result}))
    else:
        print(name, *(f"  {key:44} {value}" for key, value in result.items()), sep="\n")
    return bool(result["passed"])


def main() -> None:
    """Run the named benchmarks, or all but the longest; exit with 1 when a requirement is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = f"of {', '.join(NAMES)} (default: all but {', '.join(ONLY_NAMED)})"
    parser.add_argument("names", nargs="*", metavar="NAME", help=known)
    parser.add_argument("--json", action="store_true", help="print one JSON object per benchmark")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - set(NAMES)
    if unknown:
        parser.error(f"unknown benchmark {', '.join(sorted(unknown))}; choose from {', '.join(NAMES)}")
    names = arguments.names or [name for name in NAMES if name not in ONLY_NAMED]
    if len(names) == 1:
        sys.exit(0 if run_here(names[0], arguments.json) else 1)
    options = ["--json"] if arguments.json else []
    codes = [subprocess.run([sys.executable, "-m", "benchmarks", name, *options]).returncode for name in names]
    sys.exit(max(codes))


if __name__ == "__main__":
    main()
