from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium import spaces
from minari_files import Recorded, write_minari
from read_dataset import READERS, read

from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.sources import open_source


@contextmanager
def edited(dataset_id: str) -> Iterator[h5py.File]:
    """Change a dataset's arrays on purpose: without a manifest, as datasets of other programs come."""
    folder = reader.dataset_path(dataset_id)
    (folder / reader.MANIFEST_FILE).unlink(missing_ok=True)
    with h5py.File(folder / reader.DATA_FILE, "r+") as file:
        yield file


def replace_array(dataset_id: str, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    with edited(dataset_id) as file:
        changed = change(file[name][()])
        del file[name]
        file[name] = changed


def change_metadata(dataset_id: str, **values: Any) -> None:
    folder = reader.dataset_path(dataset_id)
    (folder / reader.MANIFEST_FILE).unlink(missing_ok=True)
    metadata = json.loads((folder / reader.METADATA_FILE).read_text())
    (folder / reader.METADATA_FILE).write_text(json.dumps({**metadata, **values}))


# --- reading ----------------------------------------------------------------------------------------------------------


def test_what_is_read_fits_together(collected: str) -> None:
    episodes, states, truths = (
        read(collected, Dataset.episodes),
        read(collected, Dataset.states),
        read(collected, Dataset.truth),
    )
    assert [len(episode) for episode in episodes] == [100] * 4
    for episode, qpos, truth in zip(episodes, states, truths, strict=True):
        assert episode.obs.shape == (101, 59)
        assert episode.actions.shape == (100, 9)
        assert not episode.terminated
        assert qpos.shape == (101, 30)
        assert qpos.dtype == np.float64
        np.testing.assert_array_equal(episode.obs[:, :9], qpos[:, :9].astype(np.float32))
        np.testing.assert_array_equal(episode.rewards, truth.rewards)
        assert truth.success == bool(truth.rewards.max() >= 0.999)


def test_episodes_are_read_in_the_order_of_their_numbers(collected: str) -> None:
    with edited(collected) as file:
        for i in range(4, 11):
            file.copy(f"episode_{i % 4}", f"episode_{i}")
    change_metadata(collected, total_episodes=11, total_steps=1100)
    found = read(collected, Dataset.episodes)
    assert len(found) == 11
    for i, episode in enumerate(found):
        np.testing.assert_array_equal(episode.actions, found[i % 4].actions)
    assert (found[1].actions != found[2].actions).any()


def test_a_gap_in_their_numbers_is_refused_for_minari_could_not_read_it(collected: str) -> None:
    with edited(collected) as file:
        file.move("episode_1", "episode_10")
    with pytest.raises(BadInput, match="must hold episode_0, … episode_3, as Minari needs it, but episode_1 is"):
        read(collected, Dataset.episodes)


def test_only_the_ground_truth_reader_opens_the_ground_truth(collected: str) -> None:
    before = read(collected, Dataset.episodes), read(collected, Dataset.states), read(collected, Dataset.fingerprint)
    with edited(collected) as file:
        for episode in file.values():
            del episode["infos/gt"]
    np.testing.assert_array_equal(read(collected, Dataset.episodes)[0].obs, before[0][0].obs)
    np.testing.assert_array_equal(read(collected, Dataset.states)[0], before[1][0])
    assert read(collected, Dataset.fingerprint) == before[2]
    with pytest.raises(BadInput, match="no 'infos/gt/reward' in /episode_0; record it when the dataset is made"):
        read(collected, Dataset.truth)


def test_the_first_ground_truth_reward_belongs_to_the_reset_and_to_no_action(collected: str) -> None:
    replace_array(collected, "episode_0/infos/gt/reward", lambda reward: np.arange(101, dtype=np.float32))
    np.testing.assert_array_equal(read(collected, Dataset.truth)[0].rewards, np.arange(1, 101))


def test_a_dataset_that_was_not_relabeled_has_no_scores(collected: str) -> None:
    with pytest.raises(BadInput, match=rf"episode_0 of dataset {collected}: .*no 'infos/zest/score'"):
        read(collected, Dataset.scores)


# --- datasets that break a rule ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "change", "rule"),
    [
        ("observations", lambda a: np.where(np.arange(101)[:, None] == 5, np.nan, a), "obs must be finite.*index 5"),
        ("actions", lambda a: np.full_like(a, np.inf), "actions must be finite, but 100 of 100"),
        ("rewards", lambda a: np.full_like(a, np.nan), "rewards must be finite"),
        ("observations", lambda a: a[:-1], r"observations must have T \+ 1 = 101 rows, got shape \(100, 59\)"),
        ("rewards", lambda a: a[:-1], r"rewards must have T = 100 rows, got shape \(99,\)"),
        ("actions", lambda a: a[:0], r"actions must have T = 100 rows, got shape \(0, 9\)"),
        ("actions", lambda a: a[:, 0], r"actions must have shape \(100, \?\)"),
    ],
)
def test_a_broken_episode_is_named_with_its_dataset(
    collected: str, name: str, change: Callable[[np.ndarray], np.ndarray], rule: str
) -> None:
    replace_array(collected, f"episode_2/{name}", change)
    with pytest.raises(BadInput, match=rf"episode_2 of dataset {collected}: {rule}"):
        read(collected, Dataset.episodes)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (lambda a: a[:-1], r"qpos must have T \+ 1 = 101 rows, got shape \(100, 30\)"),
        (lambda a: a[:, 0], r"qpos must have 2 dimensions, got shape \(101,\)"),
        (lambda a: np.full_like(a, np.nan), "qpos must be finite"),
    ],
)
def test_a_broken_recorded_state_is_named(
    collected: str, change: Callable[[np.ndarray], np.ndarray], rule: str
) -> None:
    replace_array(collected, "episode_1/infos/state/qpos", change)
    with pytest.raises(BadInput, match=rf"episode_1 of dataset {collected}: infos/state/{rule}"):
        read(collected, Dataset.states)


@pytest.mark.parametrize(
    ("state", "rule"),
    [
        (np.full((101, 30), np.nan), "qpos must be finite"),
        (np.zeros((100, 30)), r"qpos must have T \+ 1 = 101 rows"),
        ({"left": np.zeros((101, 30))}, "qpos' in /episode_1 must be one flat array, got a group"),
    ],
)
def test_a_fingerprint_takes_no_broken_state(collected: str, state: Any, rule: str) -> None:
    with edited(collected) as file:
        del file["episode_1/infos/state/qpos"]
        for name, values in state.items() if isinstance(state, dict) else [("", state)]:
            file[f"episode_1/infos/state/qpos/{name}".rstrip("/")] = values
    with pytest.raises(BadInput, match=rf"episode_1 of dataset {collected}: '?infos/state/{rule}"):
        read(collected, Dataset.fingerprint)


def test_a_dark_episode_of_pictures_is_read_in_the_form_of_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    box = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    space = spaces.Dict({"arm": box, "camera": spaces.Box(-np.inf, np.inf, (16, 16, 3), np.float32)})
    recorded = [
        Recorded({"arm": np.zeros((3, 3), "f4"), "camera": np.full((3, 16, 16, 3), bright, "f4")}, actions, np.zeros(2))
        for bright, actions in ((200, np.zeros((2, 3), "f4")), (30, np.zeros((2, 3), "f4")))
    ]
    write_minari("some/dark-v0", recorded, space, box)
    assert [episode.obs.shape for episode in read("some/dark-v0", Dataset.episodes)] == [(3, 3)] * 2
    assert read("some/dark-v0", Dataset.fingerprint)


def test_an_episode_without_steps_is_refused(collected: str) -> None:
    replace_array(collected, "episode_1/terminations", lambda ends: ends[:0])
    with pytest.raises(BadInput, match=rf"dataset {collected}: /episode_1 must have at least 1 step, got 0"):
        read(collected, Dataset.states)


SIDE_ARRAYS = {
    "infos/zest/score": Dataset.scores,
    "infos/gt/reward": Dataset.truth,
    "infos/gt/success": Dataset.truth,
    "infos/source/reward": Dataset.source_rewards,
    "infos/source/success": Dataset.successes,
}


@pytest.mark.parametrize(("name", "reads"), SIDE_ARRAYS.items())
@pytest.mark.parametrize(
    ("values", "rule"),
    [
        (np.zeros(97), r"must have T (\+ 1 = 101|= 100) rows, got shape \(97,\)"),
        (np.zeros((97, 1)), "must have T"),
        (np.full(101, np.nan), "must be finite, but 101 of 101 rows"),
        (np.full(101, np.inf), "must be finite"),
        (np.array([b"a"] * 101), "must hold numbers, got values of type"),
        (np.float32(1), "must have T"),
        (h5py.Empty("f4"), "must have T"),
    ],
    ids=["short", "short columns", "NaN", "infinite", "text", "one number", "nothing"],
)
def test_scores_truth_and_success_have_the_length_of_their_episode_and_are_finite(
    name: str, reads: Callable[[Dataset], Any], values: Any, rule: str, collected: str
) -> None:
    with edited(collected) as file:
        for i, episode in enumerate(file.values()):
            if name in episode:
                del episode[name]
            episode[name] = values if i == 2 else np.zeros(101, np.float32)
    if name == "infos/source/reward" and rule.startswith("must be finite"):
        assert not np.isfinite(read(collected, reads)[2]).any(), "as the source had them"
        return
    with pytest.raises(BadInput, match=f"episode_2 of dataset {collected}: .*{rule}"):
        read(collected, reads)


def test_an_export_of_scores_of_another_length_is_refused(
    collected: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    replace_array(collected, "episode_1/infos/gt/reward", lambda rewards: rewards[:97])
    for kind in ("npz", "d4rl", "robomimic", "d3rlpy", "torchrl", "lerobot"):
        code, error = refusal("export", collected, "--to", kind, "--output", tmp_path / kind)
        assert (code, "infos/gt/reward must have T + 1 = 101 rows, got shape (97,)" in error) == (2, True)
        assert not (tmp_path / kind).exists()


@pytest.mark.parametrize("n_rows", [100, 101])
def test_success_of_other_robots_is_of_steps_or_of_frames(n_rows: int, collected: str) -> None:
    assert read(collected, Dataset.successes) is None
    with edited(collected) as file:
        for episode in file.values():
            episode["infos/success"] = np.arange(n_rows) == n_rows - 1
    assert [np.flatnonzero(success).tolist() for success in read(collected, Dataset.successes)] == [[99]] * 4


@pytest.mark.parametrize(
    ("name", "reads"),
    [
        ("observations", Dataset.episodes),
        ("observations", Dataset.fingerprint),
        ("actions", Dataset.episodes),
        ("actions", Dataset.fingerprint),
        ("infos/state/qpos", Dataset.states),
    ],
)
def test_episodes_of_unequal_width_are_refused(name: str, reads: Callable[[Dataset], Any], collected: str) -> None:
    replace_array(collected, f"episode_3/{name}", lambda values: values[:, :-1])
    with pytest.raises(
        BadInput, match=rf"the episodes of dataset {collected} must hold equally many numbers, got .* epis"
    ):
        read(collected, reads)


@pytest.mark.parametrize("name", ["observations", "actions"])
def test_what_training_would_refuse_is_refused_before_anything_is_embedded(
    name: str, collected: str, refusal: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    replace_array(collected, f"episode_3/{name}", lambda values: np.where(values == values[50], np.nan, values))
    code, error = refusal("relabel", collected)
    assert (code, f"episode_3 of dataset {collected}: {name} must be finite" in error) == (2, True)
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("total_episodes", 5),
        ("total_episodes", "4"),
        ("total_steps", 399),
        ("total_steps", 10**12),
        ("total_steps", None),
    ],
)
def test_metadata_that_do_not_agree_with_the_arrays_are_told(key: str, value: Any, collected: str) -> None:
    change_metadata(collected, **{key: value})
    with pytest.raises(
        BadInput, match=rf"has {key} {value}, but data/main_data.hdf5 holds 4.*or, if you changed it on"
    ):
        read(collected, Dataset.episodes)


def test_steps_that_are_declared_but_not_stored_take_no_memory(collected: str) -> None:
    with edited(collected) as file:
        del file["episode_0/terminations"], file["episode_0/actions"]
        file.create_dataset("episode_0/terminations", (10**12,), bool, chunks=(10,))
        file.create_dataset("episode_0/actions", (10**12, 9), "f4", chunks=(10, 9))
    change_metadata(collected, total_steps=10**12 + 300)
    for reads in (Dataset.fingerprint, Dataset.episodes, Dataset.rewards, Dataset.states, Dataset.truth):
        with pytest.raises(BadInput, match=r"episode_0 of dataset .* (must have T|of which 0 are stored)"):
            read(collected, reads)


@pytest.mark.parametrize("name", ["episode_0", "episode_0/observations"])
def test_an_array_in_the_place_of_a_group_is_refused(name: str, collected: str) -> None:
    with edited(collected) as file:
        del file[name]
        file[name] = np.zeros(3)
    with pytest.raises(BadInput, match=r"has no 'terminations' in /episode_0|observations must have T"):
        read(collected, Dataset.episodes)


@pytest.mark.parametrize("name", ["observations", "actions", "rewards", "terminations"])
def test_a_missing_array_is_named(collected: str, name: str) -> None:
    with edited(collected) as file:
        del file[f"episode_0/{name}"]
    with pytest.raises(BadInput, match=rf"no '{name}' in /episode_0"):
        read(collected, Dataset.episodes)


def test_a_dictionary_of_pictures_alone_is_refused(collected: str) -> None:
    with edited(collected) as file:
        del file["episode_0/observations"]
        file["episode_0/observations/camera"] = np.zeros((101, 8, 8, 3), np.uint8)
    with pytest.raises(BadInput, match=r"/episode_0/observations holds pictures only; a policy here needs numbers"):
        read(collected, Dataset.episodes)


def test_a_dataset_without_episodes_is_refused(collected: str) -> None:
    with edited(collected) as file:
        file.clear()
    with pytest.raises(BadInput, match="has no episodes; collect it again"):
        read(collected, Dataset.episodes)


# --- damage and code --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [reader.DATA_FILE, reader.METADATA_FILE])
def test_one_flipped_bit_is_noticed(collected: str, name: str) -> None:
    path = reader.dataset_path(collected) / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    for read_by_id in READERS.values():
        with pytest.raises(
            ZestError, match=rf"{name} of dataset {collected} is missing or was changed since"
        ) as caught:
            read_by_id(collected)
        assert not isinstance(caught.value, BadInput)


def test_a_missing_data_file_is_noticed(collected: str) -> None:
    (reader.dataset_path(collected) / reader.DATA_FILE).unlink()
    with pytest.raises(ZestError, match=r"main_data\.hdf5 .* is missing"):
        read(collected, Dataset.episodes)


def test_a_truncated_file_of_another_program_is_a_clear_error(collected: str) -> None:
    folder = reader.dataset_path(collected)
    (folder / reader.MANIFEST_FILE).unlink()
    content = (folder / reader.DATA_FILE).read_bytes()
    (folder / reader.DATA_FILE).write_bytes(content[: len(content) // 2])
    with pytest.raises(BadInput, match=rf"dataset {collected} cannot be read as HDF5"):
        read(collected, Dataset.episodes)


def test_a_damaged_block_of_a_compressed_file_is_a_clear_error(collected: str) -> None:
    with edited(collected) as file:
        actions = file["episode_1/actions"][()]
        del file["episode_1/actions"]
        stored = file.create_dataset("episode_1/actions", data=actions, compression="gzip")
        block = stored.id.get_chunk_info(0)
    path = reader.dataset_path(collected) / reader.DATA_FILE
    content = bytearray(path.read_bytes())
    content[block.byte_offset : block.byte_offset + block.size] = bytes(block.size)
    path.write_bytes(content)
    with pytest.raises(ZestError, match=rf"episode_1 of dataset {collected} is damaged .*make it again"):
        read(collected, Dataset.episodes)


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Entry point of a package that leaves a file when it is imported."""
    (tmp_path / "sprung").unlink(missing_ok=True)
    (tmp_path / "foreign_package.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'w')\ndef make(**kw): pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "foreign_package:make"
    sys.modules.pop("foreign_package", None)


@pytest.mark.parametrize("key", ["env_spec", "eval_env_spec"])
@pytest.mark.parametrize("hidden_in_wrapper", [False, True])
def test_a_dataset_of_foreign_code_is_read_without_running_it_and_no_environment_is_built_from_it(
    collected: str, trap: str, tmp_path: Path, key: str, hidden_in_wrapper: bool
) -> None:
    spec = json.loads(read(collected, lambda ds: ds.metadata)["env_spec"])
    if hidden_in_wrapper:
        spec["additional_wrappers"] = [{"name": "Trap", "entry_point": trap, "kwargs": {}}]
    else:
        spec["entry_point"] = trap
    change_metadata(collected, **{key: json.dumps(spec)})
    for name in READERS.keys() - {"scores", "kitchen_task"}:  # they need other datasets than this
        READERS[name](collected)
    if key == "env_spec":
        message = rf"the {key} of dataset {collected} would run code of '{trap}'; only"
        if hidden_in_wrapper:  # which is left out
            message = "the model has no camera 'left'"
        with pytest.raises(BadInput, match=message):
            open_source(collected, cameras=["left"])
    assert not (tmp_path / "sprung").exists()
    assert "foreign_package" not in sys.modules


def test_the_trap_does_spring_when_nobody_checks(collected: str, trap: str, tmp_path: Path) -> None:
    import gymnasium

    spec = gymnasium.envs.registration.EnvSpec.from_json(read(collected, lambda ds: ds.metadata)["env_spec"])
    wrapper = gymnasium.envs.registration.WrapperSpec("Trap", trap, {})
    spec.additional_wrappers = (wrapper,)
    with pytest.raises((TypeError, AttributeError)):
        gymnasium.make(spec).reset()
    assert (tmp_path / "sprung").exists()


@pytest.mark.parametrize("spec", ["{", "null", "[]", "{}", '{"entry_point": "zest_rl.x", "additional_wrappers": 3}'])
def test_a_malformed_env_spec_is_refused(collected: str, spec: str) -> None:
    change_metadata(collected, env_spec=spec)
    with pytest.raises(BadInput, match=rf"the env_spec of dataset {collected} is not the JSON of a Gymnasium EnvSpec"):
        read(collected, lambda ds: ds.metadata)


# --- identity ---------------------------------------------------------------------------------------------------------


def test_the_fingerprint_sees_inputs_and_states_but_no_rewards(collected: str) -> None:
    before = read(collected, Dataset.fingerprint)
    replace_array(collected, "episode_0/rewards", lambda rewards: rewards + 1)
    assert read(collected, Dataset.fingerprint) == before
    seen = {before}
    for name in ("observations", "actions", "infos/state/qpos", "terminations"):
        replace_array(collected, f"episode_3/{name}", lambda array: ~array if array.dtype == bool else array + 1e-3)
        seen.add(read(collected, Dataset.fingerprint))
    assert len(seen) == 5


def test_a_description_sees_rewards_and_leaves_out_who_made_it_where(collected: str) -> None:
    collect = {"asked": {"task": "micro"}, "provenance": {"command": "zest collect"}}
    change_metadata(collected, zest={"collect": collect})
    before = read(collected, Dataset.describe)
    assert before["id"] == collected
    assert before["zest"] == {"collect": {"asked": {"task": "micro"}}}
    assert (before["ref_min_score"], before["ref_max_score"]) == (0.0, 70.0)
    assert json.loads(json.dumps(before)) == before
    replace_array(collected, "episode_0/rewards", lambda rewards: rewards + 1)
    after = read(collected, Dataset.describe)
    assert after["rewards_sha256"] != before["rewards_sha256"]
    assert {**after, "rewards_sha256": None} == {**before, "rewards_sha256": None}


@pytest.mark.parametrize("key", ["env_spec", "ref_min_score", "ref_max_score"])
def test_a_dataset_without_environment_or_references_can_be_trained_on(collected: str, key: str) -> None:
    change_metadata(collected, **{key: None})
    assert read(collected, Dataset.describe)[key] is None


def test_the_task_is_that_of_the_environment(collected: str) -> None:
    assert read(collected, Dataset.kitchen_task) == "micro"


@pytest.mark.parametrize("spec", [None, {"id": "Pendulum-v1", "entry_point": "gymnasium.envs.x:Y", "kwargs": {}}])
def test_a_dataset_of_another_environment_has_no_task(collected: str, spec: dict[str, Any] | None) -> None:
    change_metadata(collected, env_spec=spec and json.dumps(spec))
    with pytest.raises(BadInput, match="frames can be rendered for zest/Kitchen-v1 only"):
        read(collected, Dataset.kitchen_task)
