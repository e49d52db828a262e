"""Cards: what a relabeled dataset or a policy is and was made of, as a README.md that lies beside it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from zest_rl.data.provenance import DatasetRecord, RelabelRecord
from zest_rl.metrics.reward_quality import value_order
from zest_rl.rewards.learned import TREX
from zest_rl.runtime.privacy import masked
from zest_rl.types import FloatArray

LICENCES = {
    r"efficientnet-lite0": "Apache-2.0",
    r"torchvision:.*": "BSD-3 (torchvision)",
    r"moco:.*": "CC BY-NC 4.0",
    r"open_clip:[^/@]+/openai(@.*)?": "MIT",
    r"timm:vit_base_patch16_siglip_224(@.*)?": "Apache-2.0",
    r"timm:vit_small_patch16_dinov3(@.*)?": "DINOv3 License",
    r"timm:vit_small_patch14_dinov2(@.*)?": "Apache-2.0",
}
"""Embedders' URIs → licence of their published weights; `docs/embedders.md` has the same."""


SCORED = """Rewards are ZeST scores (Cui et al. 2022, https://arxiv.org/abs/2204.11134): how much each frame changed
since the first one as the goal differs from its start."""
LEARNED = """Rewards were learned by T-REX (Brown et al. 2019, https://arxiv.org/abs/1904.06387) from the ranking of
trajectories by their ZeST scores."""
ACTS = "Observations {obs_dim} numbers, actions {act_dim} numbers in [-1, 1]."
MEASURED = """`zest evaluate` on this folder measures it in the dataset's environment and leaves returns with intervals,
success and videos in `evaluations/`."""
REWARDS = "A reward, learned from the ranking of the dataset's trajectories by the sums of their rewards."
RELABELS = "`zest relabel DATASET --reward` with this folder writes a dataset that has this reward."


def licence(uri: str) -> str:
    """Return the licence of an embedder's published weights, or where to look."""
    return next((name for pattern, name in LICENCES.items() if re.fullmatch(pattern, uri)), "see who published them")


def dataset_card(dataset_id: str, record: RelabelRecord, scores: Sequence[FloatArray]) -> str:
    """Describe a relabeled dataset, without ground truth.

    Args:
        dataset_id: its id.
        record: how it was relabeled.
        scores: (T+1,) of every episode.
    """
    order = value_order(scores)
    kept = "" if record.kept_goals is None else f", the {len(record.kept_goals)} that the episodes end nearest to"
    rows = {
        "episodes, steps": f"{len(scores)}, {sum(map(len, scores)) - len(scores)}",
        "source": f"{record.source}, sha256 `{record.source_sha256}`",
        **_scorer_rows(record, kept),
        **_reward_rows(record),
        "value-order correlation": f"{order.value:.2f} ({order.low:.2f} to {order.high:.2f}) of score and time in an "
        "episode; 1 rises at every step",
    }
    if record.learned is None:
        rows["unchanged frames"] = f"{record.n_still_frames} of {sum(map(len, scores))}"
    shuffled = "**A null control: each episode has the scores of another one.** " if record.shuffle is not None else ""
    return f"""# {dataset_id}

{shuffled}{SCORED if record.learned is None else LEARNED} All else is as in {record.source}.

{_table(rows.items())}
`zest inspect {dataset_id}` says whether these rewards are worth training on. Source, goal pictures and weights have
licences of their own.
"""


def _reward_rows(record: RelabelRecord) -> dict[str, str]:
    if record.learned is None:
        return {"reward": f"{record.reward} of the score, mean of {record.n_views} views"}
    return {"reward": f"learned of {record.learned['inputs']} from the ranking of {record.learned['ranked']}"}


def policy_card(meta: Mapping[str, Any]) -> str:
    """Describe the policy of a run from its ``meta.json``."""
    dataset = DatasetRecord.of_run(meta)
    relabel, given = dataset.relabel, dataset.given
    own = "the dataset's own" if given is None else f"{given.label}, given as numbers for {given.source}"
    n_updates, n_params = meta["n_updates"], meta.get("n_params")
    is_reward = meta["agent"] == TREX
    rows = {
        "algorithm": meta["agent"] if n_params is None else f"{meta['agent']}, {n_params} parameters",
        "trained on": f"{dataset.id}, sha256 of the data `{meta['data_sha256']}`",
        **({"rewards": own} if relabel is None else _scorer_rows(relabel)),
        **({"learned from": meta["config"]["reward"]} if "reward" in meta.get("config", {}) else {}),
        **({} if n_updates is None else {"updates": str(n_updates)}),
        "seed": str(meta["seed"]),
        **({"weights": f"sha256 `{meta['model_sha256']}`"} if "model_sha256" in meta else {}),
    }
    return f"""# {meta.get("name", meta["agent"])} on {dataset.id}

{REWARDS if is_reward else ACTS.format(**meta)}

{_table(rows.items())}
{RELABELS if is_reward else MEASURED}
`meta.json` has every setting and the versions. Source, goal pictures and weights have licences of their own.
"""


def _scorer_rows(record: RelabelRecord, kept: str = "") -> dict[str, str]:
    scorer = record.scorer
    return {
        "goal": f"`{masked(scorer.goal)}`{kept}, sha256 `{scorer.goal_sha256}`",
        "embedder": f"`{masked(scorer.embedder)}`, sha256 `{scorer.embedder_sha256}`",
        "licence of its weights": licence(scorer.embedder),
        "score": f"{scorer.similarity} of {scorer.features} features",
    }


def _table(rows: Iterable[tuple[str, str]]) -> str:
    return "".join(f"| {name} | {value} |\n" for name, value in (("", ""), ("---", "---"), *rows))
