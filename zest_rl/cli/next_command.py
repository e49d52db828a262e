"""What may be typed after a verb, where that depends on the dataset."""

from __future__ import annotations

from zest_rl.data.reader import Dataset


def after_inspection(dataset: Dataset) -> str:
    """Name the command that uses rewards: training, or export where the package's agents do not learn from it."""
    import numpy as np

    from zest_rl.data.observations import acts_discretely, entries, is_numbers

    groups = list(dataset.groups.values())
    trains = all(
        any(map(is_numbers, entries(group["observations"]).values()))
        and not acts_discretely(group)
        and np.abs(group["actions"][()]).max() <= 1
        for group in groups
    )
    return f"zest train dt {dataset.id}" if trains else f"zest export {dataset.id} --to npz"
