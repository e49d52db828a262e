"""Compare speeds with other implementations: ``python -m benchmarks [NAME …] [--json]``.

Every file beside this one is a benchmark: its docstring says what is compared, and its ``run()`` returns the numbers,
``passed`` among them. Each runs in a process of its own, one after the other. Run them on a quiet machine.
``scale`` takes most of an hour and ``gpu`` needs a GPU, so they run only when they are named.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from pathlib import Path

from zest_rl.errors import BadInput

NAMES = sorted(path.stem for path in Path(__file__).parent.glob("[a-z]*.py"))
ONLY_NAMED = ("gpu", "scale")


def run_here(name: str, as_json: bool, output: Path | None, **options: str) -> bool:
    """Run one benchmark and print its numbers; return whether the requirement is met."""
    start = time.monotonic()
    result = importlib.import_module(f"benchmarks.{name}").run(**options)
    result |= {"seconds": round(time.monotonic() - start, 1)}
    if as_json:
        print(json.dumps({name: result}))
    else:
        print(name, *(f"  {key:44} {value}" for key, value in result.items()), sep="\n")
    if output is not None:
        output.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return bool(result["passed"])


def main() -> None:
    """Run the named benchmarks, or all but the longest; exit with 1 when a requirement is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = f"of {', '.join(NAMES)} (default: all but {', '.join(ONLY_NAMED)})"
    parser.add_argument("names", nargs="*", metavar="NAME", help=known)
    parser.add_argument("--json", action="store_true", help="print one JSON object per benchmark")
    parser.add_argument("--output", type=Path, metavar="FILE", help="also write the JSON of one benchmark to a file")
    parser.add_argument("--device", help="of the benchmark gpu: cuda (its default), cuda:1, or cpu for a dry run")
    arguments = parser.parse_args()
    names = arguments.names or [name for name in NAMES if name not in ONLY_NAMED]
    if unknown := set(names) - set(NAMES):
        parser.error(f"unknown benchmark {', '.join(sorted(unknown))}; choose from {', '.join(NAMES)}")
    if arguments.output is not None and len(names) > 1:
        parser.error(f"--output takes the numbers of one benchmark, got {len(names)}; name one")
    if arguments.device is not None and names != ["gpu"]:
        parser.error(f"--device is for the benchmark gpu alone, got {', '.join(names)}; leave it out")
    if len(names) == 1:
        options = {} if arguments.device is None else {"device": arguments.device}
        try:
            sys.exit(0 if run_here(names[0], arguments.json, arguments.output, **options) else 1)
        except BadInput as error:
            parser.exit(2, f"error: {error}\n")
    as_json = ["--json"] if arguments.json else []
    codes = {name: subprocess.run([sys.executable, "-m", "benchmarks", name, *as_json]).returncode for name in names}
    for name, code in codes.items():
        print(f"{name}: {'reaches' if code == 0 else 'MISSES'} what is required", file=sys.stderr)
    sys.exit(max(codes.values()))


if __name__ == "__main__":
    main()
