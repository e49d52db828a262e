"""How a dataset was made: typed records of the entry "zest" in its metadata, which a run's ``meta.json`` repeats.

Stages that leave a record: ``collect`` (`CollectRecord`), ``recorded`` (steps per second of an imported dataset), what
made the rewards, ``relabel`` (`RelabelRecord`) or ``given`` (`GivenRecord`), and which episodes were kept, ``curate``
(`CurateRecord`). Fields that an earlier version did not write have defaults; unknown ones are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

from zest_rl.data.env_specs import is_maker
from zest_rl.errors import BadInput
from zest_rl.runtime.records import field_values, from_json


@dataclass(frozen=True)
class CollectRecord:
    """How a dataset was collected (`zest_rl.kitchen.collect`)."""

    asked: Mapping[str, Any] = field(default_factory=dict)
    """The arguments, without names and numbers of processes."""
    result: Mapping[str, Any] = field(default_factory=dict)
    """Calibrated numbers, returns of the references, normalized return."""


@dataclass(frozen=True)
class ViewsRecord:
    """Fields of `zest_rl.kitchen.views.Views`, which says what they mean."""

    task: str
    n_views: int
    size: int
    robot: bool
    tolerance: float
    framing: int = 1


@dataclass(frozen=True)
class ScorerRecord:
    """The scorer: a goal, an embedder, and how they are compared."""

    goal: str
    """Goal spec, see `zest_rl.rewards.goals`."""
    embedder: str
    features: str
    similarity: str
    goal_sha256: str
    embedder_sha256: str
    precision: str = "auto"
    goal_share: float = 1.0
    """Share of the goals that were used."""
    backend: str = "torch"
    """What computed the embeddings of the goal and, unless a GPU did, of the frames; before there was a choice, torch.
    It is no part of a dataset's name: "torch" and "onnxruntime" agree to 1e-5 of an embedding's length."""
    vectors: str = "float32"
    """Type to which all embeddings were rounded."""
    views: Mapping[str, Any] | None = None
    """Of a `ViewsRecord`, from which kitchen states were rendered; of a scorer's file, also those of another scene."""
    views_sha256: str | None = None
    """Hash of everything that such a frame depends on besides the state."""

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_json` returned."""
        record = cls(**field_values(cls, {**values, **values["config"]}))
        if record.views is not None and "env_spec" not in record.views:
            from_json(ViewsRecord, record.views)
        return record

    def to_json(self) -> dict[str, Any]:
        """Config and content hashes, as a dataset's metadata hold them."""
        names = ("goal", "embedder", "features", "similarity", "precision", "goal_share")
        hashes = {"goal_sha256": self.goal_sha256, "embedder_sha256": self.embedder_sha256}
        config = {name: getattr(self, name) for name in names}
        if self.backend != "torch":  # so that records of torch stay as they were
            config["backend"] = self.backend
        if self.vectors != "float32":  # likewise of those that were not rounded
            config["vectors"] = self.vectors
        if self.views is None:
            return {"config": config, **hashes}
        return {"config": {"views": dict(self.views), **config}, **hashes, "views_sha256": self.views_sha256}


@dataclass(frozen=True)
class RelabelRecord:
    """How a dataset was relabeled (`zest_rl.rewards.relabel`)."""

    source: str
    """Id of the dataset that was relabeled."""
    source_sha256: str
    """Its fingerprint: everything that training may see, except the rewards."""
    reward: Literal["level", "difference"]
    """The score after each action, or its change."""
    scorer: ScorerRecord
    shuffle: int | None = None
    """Seed of the null control, in which each episode has the scores of another one; None: its own."""
    kept_goals: tuple[int, ...] | None = None
    """Indices of the goals that were used; None: all."""
    n_still_frames: int | None = None
    """Number of unchanged frames: equal to the first of their episode in every view."""
    frames: Mapping[str, Any] | None = None
    """Origin of frames that were not rendered from kitchen states (`sources.base.EpisodeFrames.describe`)."""
    frames_sha256: str | None = None
    view_cannot_tell: bool = False
    """See `zest_rl.rewards.scorer.Scorer.view_cannot_tell`; only of one view in which the robot is not hidden."""
    learned: Mapping[str, Any] | None = None
    """The rewards are those that T-REX learned from these scores' ranking (`zest_rl.rewards.learned`): the run's
    identity, by ``ranked`` (dataset), ``inputs``, ``sha256``, ``held_out``. None: they are the scores themselves."""
    provenance: Mapping[str, Any] | None = None
    """Command, versions and machine; left out of a run's ``meta.json``."""

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_json` returned."""
        record = cls(**field_values(cls, {**values, "scorer": ScorerRecord.from_json(values["scorer"])}))
        if record.n_views < 1:
            raise ValueError("there must be 1 view or more, got 0")
        return record

    @property
    def is_foreign(self) -> bool:
        """Whether the frames were not rendered from kitchen states."""
        return self.frames is not None

    @property
    def n_views(self) -> int:
        """Number of views that scores were averaged over; in the kitchen of the whole ring."""
        return int(self.scorer.views["n_views"]) if self.scorer.views is not None else len((self.frames or {})["views"])

    def to_json(self) -> dict[str, Any]:
        """The record as a dataset's metadata hold it."""
        frames = {} if self.frames is None else {"frames": dict(self.frames), "frames_sha256": self.frames_sha256}
        of_view = {"view_cannot_tell": True} if self.view_cannot_tell else {}
        learned = {} if self.learned is None else {"learned": dict(self.learned)}
        provenance = {} if self.provenance is None else {"provenance": dict(self.provenance)}
        return {
            "source": self.source,
            "source_sha256": self.source_sha256,
            **frames,
            "reward": self.reward,
            "shuffle": self.shuffle,
            "kept_goals": None if self.kept_goals is None else list(self.kept_goals),
            "scorer": self.scorer.to_json(),
            "n_still_frames": self.n_still_frames,
            **of_view,
            **learned,
            **provenance,
        }


@dataclass(frozen=True)
class GivenRecord:
    """Rewards that somebody gave as numbers (`zest_rl.rewards.given`)."""

    label: str
    """What reports call them."""
    source: str
    """Id of the dataset that they were given for."""
    source_sha256: str
    """Its fingerprint: everything that training may see, except the rewards."""
    provenance: Mapping[str, Any] | None = None
    """Command, versions and machine; left out of a run's ``meta.json``."""


@dataclass(frozen=True)
class CurateRecord:
    """Which episodes were kept (`zest_rl.analysis.curation`)."""

    source: str
    """Id of the dataset that the others were dropped from."""
    episodes: tuple[int, ...]
    """Of each episode its index before any were dropped, over all times that some were."""
    provenance: Mapping[str, Any] | None = None
    """Command, versions and machine; left out of a run's ``meta.json``."""


@dataclass(frozen=True)
class DatasetRecord:
    """Environment and scale of a dataset, and how it was made."""

    id: str
    env_spec: str | None
    """Gymnasium EnvSpec as JSON; check it before anything is built from it (`zest_rl.data.env_specs`)."""
    ref_min_score: float | None
    """Ground-truth return that is 0 on the normalized scale."""
    ref_max_score: float | None
    """Ground-truth return that is 100 on the normalized scale."""
    collect: CollectRecord | None
    relabel: RelabelRecord | None
    """None: its rewards are no ZeST scores."""
    given: GivenRecord | None
    """None: nobody gave its rewards."""
    curate: CurateRecord | None
    """None: it has all episodes."""
    fps: float | None
    """Steps per second of the recording that it was imported from, if known."""

    @classmethod
    def from_metadata(cls, dataset_id: str, metadata: Mapping[str, Any]) -> Self:
        """Read Minari's metadata of a dataset.

        Raises:
            BadInput: the record of a stage is not in our format.
        """
        try:
            stages = metadata.get("zest", {})
            for stage, record in stages.items():
                if not isinstance(record, Mapping):
                    raise TypeError(f"{stage} must be an object, got {record!r:.80}")
            collect, relabel, given, curate = map(stages.get, ("collect", "relabel", "given", "curate"))
            made = {
                "id": dataset_id,
                **{name: metadata.get(name) for name in ("env_spec", "ref_min_score", "ref_max_score")},
                "collect": CollectRecord(**field_values(CollectRecord, collect)) if collect else None,
                "relabel": RelabelRecord.from_json(relabel) if relabel else None,
                "given": GivenRecord(**field_values(GivenRecord, given)) if given else None,
                "curate": CurateRecord(**field_values(CurateRecord, curate)) if curate else None,
                "fps": stages.get("recorded", {}).get("fps"),
            }
            read = cls(**field_values(cls, made))
            if not isinstance(read.env, dict) or not isinstance(read.env.get("kwargs", {}), dict):
                raise TypeError(f"env_spec must be an object with an object of kwargs, got {read.env_spec:.80}")
            return read
        except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
            raise BadInput(
                f"the record of how {dataset_id} was made is not ours ({type(error).__name__}: {error}); make the "
                "dataset again with this version"
            ) from error

    @classmethod
    def of_run(cls, meta: Mapping[str, Any]) -> Self:
        """Read a run's ``meta.json``, which holds `zest_rl.data.reader.Dataset.describe` of its dataset.

        Raises:
            BadInput: it says nothing of a dataset, or a record in it is not in our format.
        """
        described = meta.get("dataset")
        if not isinstance(described, Mapping):
            raise BadInput(
                "the run does not say which dataset it was trained on; train it by `zest train`, or from Python by "
                "zest_rl.training.runs.train"
            )
        return cls.from_metadata(str(described.get("id", "(unnamed)")), described)

    @property
    def env(self) -> dict[str, Any]:
        """The EnvSpec's fields; empty without one."""
        spec: dict[str, Any] = json.loads(self.env_spec or "{}")
        return spec

    @property
    def task(self) -> str | None:
        """The kitchen task; None for another environment."""
        name = self.env.get("kwargs", {}).get("task")
        return None if name is None or not str(self.env.get("entry_point")).startswith("zest_rl.") else str(name)

    @property
    def maker(self) -> str | None:
        """``package.module:make`` that the user named when it was relabeled; None without any."""
        env = None if self.relabel is None else (self.relabel.frames or {}).get("env_id")
        return env if isinstance(env, str) and is_maker(env) else None

    @property
    def has_recorded_rewards(self) -> bool:
        """Whether its rewards are those that it was recorded with."""
        return self.relabel is None and self.given is None

    @property
    def source_id(self) -> str:
        """Id of the dataset whose rewards were replaced; its own where they were not."""
        made = self.relabel or self.given
        return self.id if made is None else made.source

    @property
    def is_foreign(self) -> bool:
        """Whether it was relabeled with frames that were not rendered from kitchen states."""
        return self.relabel is not None and self.relabel.is_foreign
