"""``zest doctor``: is everything here that the other verbs need, and how to fix what is not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from zest_rl.cli.ui import Ui

if TYPE_CHECKING:
    from zest_rl.analysis.installation import Check


@dataclass(frozen=True)
class Config:
    """Check that everything is here that the other verbs need, and say how to fix what is not."""


def run(config: Config, ui: Ui) -> dict[str, Any]:
    """Run all checks; ``ok`` is False when one failed."""
    from zest_rl.analysis.installation import check_installation

    checks = []
    for check in check_installation():
        checks.append(check)
        ui.show(_line(check))
    healthy = all(check.status != "fail" for check in checks)
    return {
        "ok": healthy,
        "checks": [asdict(check) for check in checks],
        "next": "zest collect --task micro" if healthy else "zest doctor",
    }


def _line(check: Check) -> str:
    """Write a check and, below it, how to fix it."""
    line = f"{check.status:<5} {check.name:<12} {check.detail}"
    return f"{line}\n{'':<18} → {check.fix}" if check.fix else line


def summary(result: Mapping[str, Any]) -> str:
    """Count the checks, which were shown while they were made."""
    counts = [sum(check["status"] == status for check in result["checks"]) for status in ("ok", "warn", "fail")]
    return "{} ok, {} to look at, {} failed".format(*counts)
