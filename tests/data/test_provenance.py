"""Records of how datasets were made: what is written today is read unchanged, and what was written before is read."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from zest_rl.data.provenance import CollectRecord, DatasetRecord, RelabelRecord
from zest_rl.errors import BadInput

SCORER = {
    "config": {
        "views": {"task": "micro", "n_views": 8, "size": 224, "robot": False, "tolerance": 0.001},
        "goal": "same-scene", "embedder": "efficientnet-lite0", "features": "delta", "similarity": "cos",
        "precision": "auto", "goal_share": 0.5,
    },
    "goal_sha256": "1" * 64, "embedder_sha256": "2" * 64, "views_sha256": "3" * 64,
}  # fmt: skip
KITCHEN: dict[str, Any] = {
    "source": "zest/kitchen-micro-noisy-v0", "source_sha256": "4" * 64, "reward": "level", "shuffle": None,
    "kept_goals": [0, 2], "scorer": SCORER, "n_still_frames": 7, "provenance": {"command": "zest relabel"},
}  # fmt: skip
PICTURES: dict[str, Any] = {
    "source": "room/some-v0", "source_sha256": "4" * 64,
    "frames": {"kind": "pictures", "views": ["observations/left", "observations/right"]}, "frames_sha256": "5" * 64,
    "reward": "difference", "shuffle": 3, "kept_goals": None,
    "scorer": {
        "config": {key: value for key, value in SCORER["config"].items() if key != "views"},  # type: ignore[union-attr]
        "goal_sha256": "1" * 64, "embedder_sha256": "2" * 64,
    },
    "n_still_frames": 0, "provenance": {"command": "zest relabel"},
}  # fmt: skip


def with_views(**changes: Any) -> dict[str, Any]:
    config: Any = SCORER["config"]
    scorer = {**SCORER, "config": {**config, "views": {**config["views"], **changes}}}
    return {"zest": {"relabel": {**KITCHEN, "scorer": scorer}}}


@pytest.mark.parametrize("values", [KITCHEN, PICTURES], ids=["kitchen", "pictures"])
@pytest.mark.parametrize("of_run", [False, True])
def test_a_record_becomes_the_json_that_it_was_read_from(values: dict[str, Any], of_run: bool) -> None:
    told = {key: value for key, value in values.items() if not of_run or key != "provenance"}
    assert json.dumps(RelabelRecord.from_json(told).to_json()) == json.dumps(told)


def test_frames_that_are_not_rendered_from_kitchen_states_are_foreign() -> None:
    kitchen, pictures = RelabelRecord.from_json(KITCHEN), RelabelRecord.from_json(PICTURES)
    assert (kitchen.is_foreign, kitchen.n_views, kitchen.kept_goals) == (False, 8, (0, 2))
    assert (pictures.is_foreign, pictures.n_views, pictures.scorer.views) == (True, 2, None)
    assert DatasetRecord.from_metadata("room/some-v0", {"zest": {"relabel": PICTURES}}).is_foreign
    assert not DatasetRecord.from_metadata("room/some-v0", {}).is_foreign


def test_what_earlier_versions_did_not_record_has_its_default_and_what_later_ones_do_is_ignored() -> None:
    config = {key: value for key, value in SCORER["config"].items() if key != "goal_share"}  # type: ignore[union-attr]
    before = {key: KITCHEN[key] for key in ("source", "source_sha256", "reward")} | {
        "scorer": {**SCORER, "config": config}
    }
    record = RelabelRecord.from_json(before)
    assert (record.shuffle, record.kept_goals, record.n_still_frames) == (None, None, None)
    assert record.scorer.goal_share == 1
    assert RelabelRecord.from_json({**KITCHEN, "unheard_of": 1}) == RelabelRecord.from_json(KITCHEN)


def test_a_run_s_description_and_a_dataset_s_metadata_are_read_alike() -> None:
    spec = {"id": "zest/Kitchen-v1", "entry_point": "zest_rl.envs:KitchenEnv", "kwargs": {"task": "micro"}}
    collect = {"asked": {"task": "micro"}, "result": {"n_failed": 1}, "provenance": {"command": "zest collect"}}
    metadata = {
        "env_spec": json.dumps(spec), "ref_min_score": 0.0, "ref_max_score": 70.0, "total_episodes": 3,
        "zest": {"collect": collect, "recorded": {"fps": 10}, "relabel": KITCHEN},
    }  # fmt: skip
    record = DatasetRecord.from_metadata("zest/x-v0", metadata)
    assert (record.task, record.env["id"], record.fps) == ("micro", "zest/Kitchen-v1", 10)
    assert record.collect == CollectRecord({"task": "micro"}, {"n_failed": 1})
    assert DatasetRecord.of_run({"dataset": {"id": "zest/x-v0", "sha256": "6" * 64, **metadata}}) == record


@pytest.mark.parametrize("relabel", [{"a": 1}, {**KITCHEN, "scorer": {}}, {**KITCHEN, "scorer": 1}, [1], "x"])
def test_a_record_of_another_program_is_named_with_its_dataset(relabel: Any) -> None:
    with pytest.raises(BadInput, match="the record of how zest/x-v0 was made is not ours"):
        DatasetRecord.from_metadata("zest/x-v0", {"zest": {"relabel": relabel}})


@pytest.mark.parametrize(
    ("metadata", "problem"),
    [
        ({"ref_min_score": "0"}, "ref_min_score must be float | None, got '0'"),
        ({"ref_max_score": [70.0]}, "ref_max_score must be float"),
        ({"ref_max_score": float("nan")}, "ref_max_score must be float"),
        ({"ref_max_score": 10**400}, "ref_max_score must be float"),
        ({"env_spec": 7}, "env_spec must be str | None, got 7"),
        ({"env_spec": "[]"}, "env_spec must be an object with an object of kwargs"),
        ({"env_spec": '{"kwargs": 1}'}, "env_spec must be an object with an object of kwargs"),
        ({"env_spec": "[" * 100_000}, "RecursionError"),
        ({"zest": []}, "AttributeError"),
        ({"zest": None}, "AttributeError"),
        ({"zest": {"collect": "x"}}, "collect must be an object, got 'x'"),
        ({"zest": {"stage": ""}}, "stage must be an object"),
        ({"zest": {"collect": {"asked": 3}}}, "asked must be Mapping"),
        ({"zest": {"recorded": {"fps": "10"}}}, "fps must be float | None, got '10'"),
        ({"zest": {"recorded": 10}}, "TypeError"),
        ({"zest": {"relabel": {**KITCHEN, "source": 1}}}, "source must be str, got 1"),
        (with_views(task=3), "task must be str, got 3"),
        (with_views(n_views="8"), "n_views must be int, got '8'"),
        (with_views(more=1), "unexpected keyword argument 'more'"),
        ({"zest": {"relabel": {**KITCHEN, "reward": "both"}}}, "reward must be Literal"),
        ({"zest": {"relabel": {**KITCHEN, "kept_goals": [0.5]}}}, "kept_goals must be tuple"),
        ({"zest": {"relabel": {**KITCHEN, "shuffle": True}}}, "shuffle must be int | None, got True"),
        ({"zest": {"relabel": {**PICTURES, "frames": {"views": []}}}}, "there must be 1 view or more"),
        ({"zest": {"relabel": {**PICTURES, "frames": {}}}}, "KeyError: 'views'"),
        ({"zest": {"relabel": {**PICTURES, "frames": None}}}, "KeyError: 'views'"),
    ],
)
def test_a_value_of_another_type_is_named(metadata: dict[str, Any], problem: str) -> None:
    with pytest.raises(BadInput, match=f"the record of how zest/x-v0 was made is not ours .*{re.escape(problem)}"):
        DatasetRecord.from_metadata("zest/x-v0", metadata)


def test_a_run_that_names_no_dataset_is_refused_and_an_empty_record_is_none() -> None:
    with pytest.raises(BadInput, match="does not say which dataset it was trained on; train it by `zest train`"):
        DatasetRecord.of_run({"agent": "bc"})
    record = DatasetRecord.of_run({"dataset": {"zest": {"relabel": {}, "collect": {}}}})
    assert (record.relabel, record.collect, record.is_foreign) == (None, None, False)
