"""``zest doctor``: is everything here that the other verbs need, and how to fix what is not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from zest_rl.cli.ui import Ui


@dataclass(frozen=True)
class Config:
    """Check that everything is here that the other verbs need, and say how to fix what is not."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Run all checks; ``ok`` is False when one failed."""
    from zest_rl.analysis.installation import CHECKS, check_installation

    with ui.progress("checking", len(CHECKS)) as advance:
        checks = check_installation(advance)
    healthy = all(check.status != "fail" for check in checks)
    return {
        "ok": healthy,
        "checks": [asdict(check) for check in checks],
        "next": "zest collect --task micro" if healthy else "zest doctor",
    }


def summary(result: Mapping[str, Any]) -> str:
    """Write one line per check, and below it how to fix it."""
    lines = []
    for check in result["checks"]:
        lines.append(f"{check['status']:<5} {check['name']:<12} {check['detail']}")
        if check["fix"]:
            lines.append(f"{'':<18} → {check['fix']}")
    counts = [sum(check["status"] == status for check in result["checks"]) for status in ("ok", "warn", "fail")]
    return "\n".join([*lines, "{} ok, {} to look at, {} failed".format(*counts)])
