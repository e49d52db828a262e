"""ZeST scores: how much the robot's frames look like the goal. Pure functions on embeddings; no I/O, no config.

Notation of Cui et al. 2022, §3: ψ(x) is the embedding of x, α the similarity, (G_0, G_f) the start and goal pictures,
x_0 the first frame of the episode (alignment: `zest_rl.types`).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, nearest
from zest_rl.runtime.files import user_path
from zest_rl.runtime.hub import SCHEME
from zest_rl.types import FloatArray

Doubles = NDArray[np.float64]
Features = Literal["raw", "delta", "projection", "progress", "classifier"]
"""The first two are the paper's; the others are rewards to compare with, each with a similarity of its own."""
Similarity = Literal["cos", "l2"]
Reward = Literal["level", "difference"]
PROJECTED = 0.5
"""Default α of `score_projection`."""
LOGIT_SCALE = 100.0
"""Factor by which CLIP multiplies its cosines before a softmax."""
NUMBERS = {"projection": PROJECTED, "classifier": LOGIT_SCALE}
"""Features → the constant that they depend on besides the embeddings."""

ZERO_DELTA = 1e-6
"""A change whose norm is at most this times that of the first embedding has no direction: cosine 0 by definition."""


def check_names(features: str, similarity: str) -> None:
    """Check the names of features and similarity.

    Raises:
        BadInput: an unknown name, or another similarity for features that have their own.
    """
    if features not in get_args(Features):
        raise BadInput(f"unknown features {features!r}; {nearest(features, get_args(Features))}")
    if similarity not in get_args(Similarity):
        raise BadInput(f"unknown similarity {similarity!r}; {nearest(similarity, get_args(Similarity))}")
    if similarity != "cos" and features not in ("delta", "raw"):
        raise BadInput(f"features {features!r} bring a similarity of their own, got {similarity!r}; leave it at 'cos'")


def check_reward(reward: str) -> None:
    """Check what becomes of scores: the name of a `Reward`, or the folder of a learned one, here or on the hub.

    Raises:
        BadInput: it is neither.
    """
    if reward not in get_args(Reward) and not reward.startswith(SCHEME) and not user_path(reward).is_dir():
        raise BadInput(
            f"unknown reward {reward!r}, and there is no folder of that name; {nearest(reward, get_args(Reward))}, or "
            "a folder that `zest train trex` left"
        )


def check_goal_share(share: float) -> None:
    """Check that a share of the goals is in (0, 1]; raises `BadInput`."""
    if not 0 < share <= 1:
        raise BadInput(f"goal_share must be in (0, 1], got {share}")


def _check(name: str, embeddings: FloatArray, dim: int | None = None) -> Doubles:
    array = np.asarray(embeddings)
    if array.ndim != 2 or len(array) == 0:
        raise BadInput(f"{name} must have shape (N >= 1, D), got {array.shape}")
    if dim is not None and array.shape[1] != dim:
        raise BadInput(
            f"{name} must have the frames' dimension D = {dim}, got {array.shape[1]}; "
            "embed frames and goals with the same embedder"
        )
    if not np.isfinite(array).all():
        raise BadInput(f"{name} must be finite, got NaN or infinity; look at the pictures and the embedder's precision")
    return np.asarray(array, dtype=np.float64)


def _cos(a: Doubles, b: Doubles) -> Doubles:
    """(N, D), (M, D) → (N, M) cosines; 0 where a row of either is zero."""
    products = a @ b.T
    lengths = np.outer(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    return np.divide(products, lengths, out=np.zeros_like(products), where=lengths > 0)


def _similarity(a: Doubles, b: Doubles, similarity: Similarity) -> Doubles:
    """(N, D), (M, D) → (N, M)."""
    if similarity == "cos":
        return _cos(a, b)
    if similarity == "l2":
        return -np.stack([np.linalg.norm(a - row, axis=1) for row in b], axis=1)
    raise BadInput(f"unknown similarity {similarity!r}; {nearest(similarity, ('cos', 'l2'))}")


def _change(after: Doubles, before: Doubles) -> Doubles:
    """`after` (N, D) − `before` (D,) or (N, D); changes without a direction (`ZERO_DELTA`) are set to zero."""
    change = after - before
    change[_is_still(change, before)] = 0.0
    return change


def _is_still(change: Doubles, before: Doubles) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(change, axis=1) <= ZERO_DELTA * np.linalg.norm(before, axis=-1))


def _mean_over_goals(similarities: Doubles) -> FloatArray:
    """(N, K) → (N,) float32."""
    return np.asarray(similarities.mean(axis=1), dtype=np.float32)


def score_raw(frame_embeddings: FloatArray, goal_embeddings: FloatArray, similarity: Similarity = "cos") -> FloatArray:
    """φ_t = mean over goals of α(ψ(x_t), ψ(G_f)) (Eq. 1).

    Args:
        frame_embeddings: (T+1, D) embeddings of one episode's frames x_0 … x_T.
        goal_embeddings: (K, D) embeddings of K goal pictures or sentences.
        similarity: ``"cos"``, in [-1, 1]; or ``"l2"``, minus the Euclidean distance, at most 0.

    Returns:
        (T+1,) float32 scores.

    Raises:
        BadInput: shapes do not fit, or a value is not finite.
    """
    return _mean_over_goals(_raw(frame_embeddings, goal_embeddings, similarity))


def _raw(frame_embeddings: FloatArray, goal_embeddings: FloatArray, similarity: Similarity) -> Doubles:
    frames = _check("frame_embeddings", frame_embeddings)
    return _similarity(frames, _check("goal_embeddings", goal_embeddings, frames.shape[1]), similarity)


def pair_starts(starts: Doubles, goals: Doubles) -> NDArray[np.intp]:
    """For each goal the index of the start picture most similar to it, by cosine of raw embeddings (App. B).

    Args:
        starts: (S, D) embeddings.
        goals: (K, D) embeddings.

    Returns:
        (K,) integer indices into the starts.
    """
    return np.asarray(_cos(goals, starts).argmax(axis=1))


def score_delta(
    frame_embeddings: FloatArray,
    start_embeddings: FloatArray,
    goal_embeddings: FloatArray,
    similarity: Similarity = "cos",
) -> FloatArray:
    """φ_t = mean over goals of α(ψ(x_t) − ψ(x_0), ψ(G_f) − ψ(G_0)) (Eq. 2), with G_0 from `pair_starts`.

    A frame with ‖ψ(x_t) − ψ(x_0)‖ ≤ `ZERO_DELTA` · ‖ψ(x_0)‖ counts as unchanged: cosine 0 (see `zero_deltas`).

    Args:
        frame_embeddings: (T+1, D) embeddings of one episode's frames x_0 … x_T.
        start_embeddings: (S, D) embeddings of S start pictures or sentences.
        goal_embeddings: (K, D) embeddings of K goal pictures or sentences.
        similarity: ``"cos"``, in [-1, 1]; or ``"l2"``, minus the Euclidean distance, at most 0.

    Returns:
        (T+1,) float32 scores; the first is 0 for ``"cos"``.

    Raises:
        BadInput: shapes do not fit, or a value is not finite.
    """
    return _mean_over_goals(_delta(frame_embeddings, start_embeddings, goal_embeddings, similarity))


def _delta(
    frame_embeddings: FloatArray, start_embeddings: FloatArray, goal_embeddings: FloatArray, similarity: Similarity
) -> Doubles:
    frames, goals, starts = _checked(frame_embeddings, start_embeddings, goal_embeddings)
    return _similarity(_change(frames, frames[0]), _change(goals, starts), similarity)


def change_beside_goal(ends: FloatArray, starts: FloatArray, goals: FloatArray) -> tuple[float, float]:
    """Compare how one view changes over episodes to how the goal changes; medians over episodes.

    Args:
        ends: (N, 2, D) embeddings of the first and the last frame of N episodes.
        starts: (S, D) embeddings.
        goals: (K, D) embeddings.

    Returns:
        The length of ψ(x_T) − ψ(x_0), in units of that of ψ(G_f) − ψ(G_0); and their cosine, φ_T of `score_delta`.
    """
    cosines = [score_delta(pair, starts, goals)[-1] for pair in ends]
    _, last, first = _checked(ends[0], starts, goals)
    lengths = np.linalg.norm(ends[:, 1].astype(np.float64) - ends[:, 0], axis=1)
    return float(np.median(lengths) / np.median(np.linalg.norm(last - first, axis=1))), float(np.median(cosines))


def _unit(rows: Doubles) -> Doubles:
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0))


def _checked(
    frame_embeddings: FloatArray, start_embeddings: FloatArray, goal_embeddings: FloatArray
) -> tuple[Doubles, Doubles, Doubles]:
    """Return frames (T+1, D), goals (K, D), and the start paired with each goal (K, D)."""
    frames = _check("frame_embeddings", frame_embeddings)
    starts = _check("start_embeddings", start_embeddings, frames.shape[1])
    goals = _check("goal_embeddings", goal_embeddings, frames.shape[1])
    return frames, goals, starts[pair_starts(starts, goals)]


def score_projection(
    frame_embeddings: FloatArray,
    start_embeddings: FloatArray,
    goal_embeddings: FloatArray,
    alpha: float = PROJECTED,
) -> FloatArray:
    """Goal-baseline regularised similarity: 1 − ½ ‖(αP + (1−α)I)(x − g)‖², averaged over goals.

    x and g are unit vectors, b the unit vector of the start that g is paired with, P the projection onto g − b.
    Rocamonde et al. 2023, https://arxiv.org/abs/2310.12921, with pictures or sentences alike.

    Args, Returns, Raises: see `score_delta`; `alpha` must be in [0, 1]: 0 is the plain distance to the goal, 1 sees
    only the direction from start to goal; scores are at most 1.
    """
    if not 0 <= alpha <= 1:
        raise BadInput(f"alpha must be in [0, 1], got {alpha}")
    return _mean_over_goals(_projection(frame_embeddings, start_embeddings, goal_embeddings, alpha))


def _projection(
    frame_embeddings: FloatArray, start_embeddings: FloatArray, goal_embeddings: FloatArray, alpha: float
) -> Doubles:
    frames, goals, starts = (_unit(rows) for rows in _checked(frame_embeddings, start_embeddings, goal_embeddings))
    similarities = []
    for goal, start in zip(goals, starts, strict=True):
        away, way = frames - goal, goal - start
        squared = way @ way
        along = np.outer(away @ way, way) / squared if squared > 0 else np.zeros_like(away)
        rest = alpha * along + (1 - alpha) * away
        similarities.append(1 - (rest**2).sum(axis=1) / 2)
    return np.stack(similarities, axis=1)


def _progress(distances: Doubles) -> FloatArray:
    """Share of the distance to the goal that is covered: 1 − Σ ‖x_t − g‖ / Σ ‖x_0 − g‖, sums over goals and views.

    The distance that VIP rewards (Ma et al. 2023, https://arxiv.org/abs/2210.00030), as a ratio so that embedders and
    goals of different scales compare. Summed over views, so that a view that hardly shows the goal hardly counts.

    Args:
        distances: (T+1, …), summed or averaged over goals, summed over views.

    Returns:
        (T+1, …) float32; the first is 0, 1 is the goal.
    """
    first = np.where(distances[0] > 0, distances[0], 1.0)
    return np.asarray((distances[0] - distances) / first, dtype=np.float32)


def score_classifier(
    frame_embeddings: FloatArray, start_embeddings: FloatArray, goal_embeddings: FloatArray
) -> FloatArray:
    """Probability of the goal against the start it is paired with: softmax of `LOGIT_SCALE` · cosines, mean over goals.

    The plain success classifier by a pair of sentences or pictures.

    Args, Returns, Raises: see `score_delta`; scores are in [0, 1].
    """
    return _mean_over_goals(_classifier(frame_embeddings, start_embeddings, goal_embeddings))


def _classifier(frame_embeddings: FloatArray, start_embeddings: FloatArray, goal_embeddings: FloatArray) -> Doubles:
    frames, goals, starts = _checked(frame_embeddings, start_embeddings, goal_embeddings)
    margin = LOGIT_SCALE * (_cos(frames, goals) - _cos(frames, starts))
    return np.asarray(1 / (1 + np.exp(-margin)))


def zero_deltas(frame_embeddings: FloatArray) -> NDArray[np.bool_]:
    """Which frames of an episode are unchanged against x_0 (`ZERO_DELTA`): (T+1, D) → (T+1,) bool."""
    frames = _check("frame_embeddings", frame_embeddings)
    return _is_still(frames - frames[0], frames[0])


def score_views(
    frame_embeddings: FloatArray,
    start_embeddings: FloatArray,
    goal_embeddings: FloatArray,
    features: Features = "delta",
    similarity: Similarity = "cos",
) -> FloatArray:
    """Score each view on its own and average over views (App. B, "Viewpoints").

    Args:
        frame_embeddings: (T+1, V, D) embeddings of V views of each frame.
        start_embeddings: (S, D), the same for all views, or (V, S, D), each view its own.
        goal_embeddings: (K, D) or (V, K, D).
        features: ``"delta"`` (Eq. 2), ``"raw"`` (Eq. 1, which does not use the starts), or a reward to compare with:
            ``"projection"``, ``"progress"``, ``"classifier"``.
        similarity: as in `score_delta`; leave it at ``"cos"`` for the last three.

    Returns:
        (T+1,) float32 scores.

    Raises:
        BadInput: shapes do not fit, a value is not finite, or the names are unknown or do not go together.
    """
    return averaged(similarities(frame_embeddings, start_embeddings, goal_embeddings, features, similarity), features)


def similarities(
    frame_embeddings: FloatArray,
    start_embeddings: FloatArray,
    goal_embeddings: FloatArray,
    features: Features = "delta",
    similarity: Similarity = "cos",
) -> Doubles:
    """Compare each view of each frame with each goal; `averaged` and `alone` make scores of this.

    Args, Raises: see `score_views`.

    Returns:
        (V, T+1, K) float64; of ``"progress"``, minus the distances.
    """
    frames = np.asarray(frame_embeddings)
    if frames.ndim != 3 or frames.shape[1] == 0:
        raise BadInput(f"frame_embeddings must have shape (T+1, V >= 1, D), got {frames.shape}")
    n_views = frames.shape[1]
    for name, goals in (("start_embeddings", start_embeddings), ("goal_embeddings", goal_embeddings)):
        if goals.ndim == 3 and len(goals) != n_views:
            raise BadInput(f"{name} must hold one set for each of the {n_views} views, got {len(goals)}")
    check_names(features, similarity)
    compared = []
    for view in range(n_views):
        starts = start_embeddings[view] if start_embeddings.ndim == 3 else start_embeddings
        goals = goal_embeddings[view] if goal_embeddings.ndim == 3 else goal_embeddings
        if features == "delta":
            compared.append(_delta(frames[:, view], starts, goals, similarity))
        elif features == "raw":
            compared.append(_raw(frames[:, view], goals, similarity))
        elif features == "projection":
            compared.append(_projection(frames[:, view], starts, goals, PROJECTED))
        elif features == "progress":
            compared.append(_raw(frames[:, view], goals, "l2"))
        else:
            compared.append(_classifier(frames[:, view], starts, goals))
    return np.stack(compared)


def averaged(compared: Doubles, features: Features) -> FloatArray:
    """Average `similarities` (V, T+1, K) over goals and views: (T+1,) float32 scores."""
    total = np.zeros(compared.shape[1], dtype=np.float64)
    for view in compared:
        total += _mean_over_goals(view)
    return _progress(-total) if features == "progress" else np.asarray(total / len(compared), dtype=np.float32)


def alone(compared: Doubles, features: Features) -> FloatArray:
    """Return the scores by one view and one goal alone: `similarities` (V, T+1, K) → (V, T+1, K) float32."""
    if features != "progress":
        return np.asarray(compared, dtype=np.float32)
    return np.swapaxes(_progress(-np.swapaxes(compared, 0, 1)), 0, 1)
