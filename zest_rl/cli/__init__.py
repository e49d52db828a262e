"""The ``zest`` command: one verb is one stage, and one module here.

A verb's module holds a frozen dataclass ``Config`` (its arguments) and ``run(config, ui) -> dict`` (a JSON-ready
result). A verb with sub-verbs holds ``CONFIGS``, from sub-verb to config class, instead of ``Config``. Of a result,
``next`` is the command to type next and ``ok: False`` makes the exit code 1; an empty result is not printed. A module's
own ``summary(result) -> str`` replaces the plain listing. Verb modules are imported when their verb is typed, and
import heavy packages in ``run`` only, so that help answers at once.

stdout carries the result, stderr everything else.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from zest_rl.cli import streams
from zest_rl.cli.interruption import interruptible

BROKEN_PIPE = 141
"""Exit code when nobody reads what is printed, as shells have it for SIGPIPE."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``zest`` with `argv` (default: the process's own arguments) and return its exit code."""
    # NumPy's threads beside busy workers make small products many times slower; it reads this when it is loaded
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    streams.print_in_any_encoding()
    words = list(sys.argv[1:] if argv is None else argv)
    with interruptible() as received:
        try:
            code = _main(words, received)
        except BrokenPipeError:
            streams.drop_output()
            code = BROKEN_PIPE
    if argv is None and "TORCHELASTIC_RUN_ID" in os.environ:
        os._exit(
            code
        )  # of torchrun's processes: gloo's threads may still run, and abort Python where it takes itself down
    return code


def _main(words: list[str], received: Sequence[int]) -> int:
    try:
        from zest_rl.cli.dispatch import dispatch  # takes a moment, in which the command can be interrupted, too

        code = dispatch(words)
    except SystemExit as stop:  # tyro has printed the help
        code = int(stop.code or 0)
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, BrokenPipeError) and not streams.are_read():
            raise
        from zest_rl.cli.output import print_failure

        code = print_failure(KeyboardInterrupt(*received) if received else error, as_json="--json" in words)
    print(end="", flush=True)
    return code
