"""Datasets and runs travel through a stand-in of the Hugging Face Hub, by huggingface_hub and Minari themselves."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import huggingface_hub
import minari
import numpy as np
import pytest
from hub import OWNER, READER, WRITER, Hub
from huggingface_hub import constants
from read_dataset import read
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from tiny_dataset import COLLECTED

import zest_rl
from zest_rl.data import reader
from zest_rl.data.reader import Dataset
from zest_rl.errors import BadInput, ZestError
from zest_rl.rewards.scorer import SCORER_FILE, Scorer
from zest_rl.runtime import artifacts
from zest_rl.runtime.hub import REWARD_FILES, RUN_FILES


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A hub without repositories, which huggingface_hub takes for the real one, and the token of one who may write."""
    with Hub() as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        monkeypatch.setattr(constants, "ENDPOINT", server.url)
        monkeypatch.setattr(
            constants, "HUGGINGFACE_CO_URL_TEMPLATE", server.url + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hf"))
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no token"))
        monkeypatch.setenv("HF_TOKEN", WRITER)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        monkeypatch.setenv("MINARI_REMOTE", f"hf://{OWNER}")
        huggingface_hub.close_session()
        yield server
        huggingface_hub.close_session()
        server.shutdown()


def scored(runs: Path) -> str:
    """Id of the relabeled dataset that the policies of `trained` learned from."""
    return str(artifacts.read_json(runs / "dt-0" / "meta.json")["dataset"]["id"])


def relabeled_with(runs: Path, goal: str) -> str:
    """Let the relabeled dataset, and its scorer, say that its goal was another one."""
    dataset = scored(runs)
    folder = reader.dataset_path(dataset)
    path, scorer = folder / "data" / "metadata.json", folder / SCORER_FILE
    artifacts.write_bytes(path, path.read_bytes().replace(b'"goal": "same-scene"', f'"goal": "{goal}"'.encode()))
    with safe_open(scorer, framework="numpy") as file:
        header = {"scorer": file.metadata()["scorer"].replace("same-scene", goal)}
    save_file(load_file(scorer), scorer, metadata=header)
    manifest = artifacts.read_json(folder / "zest_manifest.json")
    artifacts.write_json(folder / "zest_manifest.json", {name: artifacts.hash_file(folder / name) for name in manifest})
    return dataset


def test_a_pushed_dataset_is_downloaded_by_minari_alone_with_equal_arrays(
    trained: Path, hub: Hub, zest: Callable[..., dict[str, Any]]
) -> None:
    dataset = scored(trained)
    episodes, scores = read(dataset, Dataset.episodes), read(dataset, Dataset.scores)
    folder = reader.dataset_path(dataset)
    (folder / ".x.lock").touch()
    pushed = zest("push", dataset, f"{OWNER}/zest")
    assert pushed["repository"] == f"{hub.url}/datasets/{OWNER}/zest"
    assert pushed["next"] == f"MINARI_REMOTE=hf://{OWNER} minari download {dataset}"
    files = hub.repositories[f"datasets/{OWNER}/zest"].files
    name = dataset.removeprefix("zest/")
    assert {"namespace_metadata.json", "README.md", f"{name}/README.md", f"{name}/data/main_data.hdf5"} <= files.keys()
    assert not [path for path in files if path.endswith(".lock")]
    assert json.loads(files["namespace_metadata.json"]) == {"datasets": [dataset]}

    shutil.rmtree(folder.parent)
    assert list(minari.list_remote_datasets()) == [dataset]
    minari.download_dataset(dataset)
    again = read(dataset, Dataset.episodes)
    for before, after in zip(episodes, again, strict=True):
        np.testing.assert_array_equal(before.obs, after.obs)
        np.testing.assert_array_equal(before.actions, after.actions)
        np.testing.assert_array_equal(before.rewards, after.rewards)
    np.testing.assert_array_equal(scores, read(dataset, Dataset.scores))
    assert len(minari.load_dataset(dataset)) == len(episodes)
    assert (folder / "zest_goal" / "goal").is_dir(), "renderings of the scene itself are nobody else's"


def test_datasets_of_one_namespace_share_a_repository_and_a_second_push_of_one_changes_nothing(
    trained: Path, hub: Hub
) -> None:
    dataset = scored(trained)
    for each in (dataset, COLLECTED, dataset):
        zest_rl.push(each, f"{OWNER}/zest")
    repository = hub.repositories[f"datasets/{OWNER}/zest"]
    assert len(repository.commits) == 3, "one to make it, one for each dataset"
    assert json.loads(repository.files["namespace_metadata.json"])["datasets"] == sorted([dataset, COLLECTED])


@pytest.mark.parametrize("dataset", ["plain-v0", "mine/doors/left-v0"])
def test_datasets_without_a_namespace_and_in_a_deep_one_are_found_by_minari(
    dataset: str, collected: str, hub: Hub
) -> None:
    folder, source = reader.dataset_path(dataset), reader.dataset_path(collected)
    folder.parent.mkdir(parents=True, exist_ok=True)
    source.rename(folder)
    metadata = artifacts.read_json(folder / "data" / "metadata.json")
    artifacts.write_json(folder / "data" / "metadata.json", {**metadata, "dataset_id": dataset})
    (folder / "zest_manifest.json").unlink()
    zest_rl.push(dataset, f"{OWNER}/{dataset.split('/')[0]}")
    shutil.rmtree(reader.datasets_root())
    reader.datasets_root().mkdir()
    minari.download_dataset(dataset)
    assert len(minari.load_dataset(dataset)) == len(read(dataset, Dataset.episodes))


def test_a_pushed_run_acts_by_its_id_as_it_did(
    trained: Path, hub: Hub, zest: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    pushed = zest("push", trained / "bc-0", f"{OWNER}/micro-bc", "--private")
    assert pushed["n_files"] == 4
    assert pushed["next"] == f"zest evaluate hf://{OWNER}/micro-bc"
    repository = hub.repositories[f"models/{OWNER}/micro-bc"]
    assert repository.private
    of_any_run = set(RUN_FILES) - set(REWARD_FILES)
    assert repository.files.keys() - {".gitattributes"} == of_any_run, "neither checkpoints nor logs"
    assert repository.files["README.md"].startswith(b"---\nlibrary_name: zest-rl")
    local = zest_rl.load_policy(trained / "bc-0")
    shutil.rmtree(trained / "bc-0")
    fetched = zest_rl.load_policy(f"hf://{OWNER}/micro-bc")
    obs = read(COLLECTED, Dataset.episodes)[0].obs[:4]
    for policy in (local, fetched):
        policy.begin(4)
    np.testing.assert_array_equal(local.act(obs), fetched.act(obs))
    evaluated = zest("evaluate", f"hf://{OWNER}/micro-bc", "--n-episodes", "1", "--n-workers", "1", "--no-videos")
    assert Path(evaluated["result"]).is_relative_to(tmp_path / "trained" / "cache" / "hub")
    hub.refuses["main"] = 503
    assert zest_rl.load_policy(f"hf://{OWNER}/micro-bc"), "what was fetched is used while the hub is away"


def test_folders_of_this_machine_and_pictures_of_somebody_else_stay_here(
    trained: Path, hub: Hub, refusal: Callable[..., tuple[int, str]]
) -> None:
    dataset = relabeled_with(trained, "/home/me/my goals/doors")
    with pytest.warns(UserWarning, match=r"goal pictures of …/doors are not uploaded, as their licence may forbid it"):
        zest_rl.push(dataset, f"{OWNER}/zest")
    files = hub.repositories[f"datasets/{OWNER}/zest"].files
    assert not [path for path, content in files.items() if b"/home" in content or b"my goals" in content]
    assert not [path for path in files if "zest_goal" in path]
    shutil.rmtree(reader.dataset_path(dataset))
    minari.download_dataset(dataset)
    assert read(dataset, lambda opened: opened.record.relabel.scorer.goal) == "…/doors"
    scorer = reader.dataset_path(dataset) / SCORER_FILE
    assert Scorer.load(scorer).config.goal == "…/doors", "it scores as before"


def test_what_is_uploaded_is_said_before_and_a_dry_run_needs_no_token(
    trained: Path, hub: Hub, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from zest_rl import cli

    monkeypatch.delenv("HF_TOKEN")
    dataset = relabeled_with(trained, "visual-tasks:real_imgs")
    assert cli.main(["push", dataset, f"{OWNER}/zest", "--goal-pictures", "--dry-run"]) == 0
    out, err = capsys.readouterr()
    assert f"for the dataset repository {OWNER}/zest: " in err
    assert "zest_goal/goal/0.png" in err
    assert "their licence is CC BY-NC 4.0" in err
    assert f"next: zest push {dataset} {OWNER}/zest --goal-pictures" in out
    assert not hub.repositories


def test_what_cannot_be_pushed_or_fetched_says_why_and_nothing_is_left_half_there(
    trained: Path, hub: Hub, refusal: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, name, dataset = trained / "dt-0", f"{OWNER}/micro-dt", scored(trained)

    def refused(*words: str | Path, code: int = 2) -> str:
        got, message = refusal(*words)
        assert got == code, message
        return message

    assert "Minari looks for zest/" in refused("push", dataset, f"{OWNER}/other")
    assert f"push it to {OWNER}/zest" in refused("push", dataset, f"{OWNER}/other")
    assert "must look like OWNER/NAME, got 'micro'" in refused("push", run, "micro")
    assert "push takes the id of a dataset" in refused("push", trained, name)
    assert "`minari download zest/none-v0`" in refused("push", "zest/none-v0", f"{OWNER}/zest")
    assert "the hub says 403 (You don't have the rights" in refused("push", run, "others/micro-dt")
    assert "fetching hf://me/none: the hub says 404 (Repository not found); check" in refused(
        "evaluate", "hf://me/none"
    )
    assert "must look like OWNER/NAME, got 'none'" in refused("evaluate", "hf://none")
    monkeypatch.setenv("HF_TOKEN", READER)
    assert "log in as somebody who may" in refused("push", run, name)
    monkeypatch.setenv("HF_TOKEN", "hf_wrong-0123456789")
    assert "the hub says 401" in refused("push", run, name)
    monkeypatch.delenv("HF_TOKEN")
    assert "needs a token that can write to me/micro-dt, got none" in refused("push", run, name)
    monkeypatch.setenv("HF_TOKEN", WRITER)

    for part in ("lfs", "commit"):
        hub.refuses = {part: 403}
        assert "the hub says 403 (Internal Error" in refused("push", run, name)
        repository = hub.repositories[f"models/{name}"]
        assert list(repository.files) == [".gitattributes"]
    hub.refuses.clear()
    zest_rl.push(run, name)
    assert "is public; make it private there" in refused("push", run, name, "--private")
    assert "has another run (meta.json, model.safetensors" in refused("push", trained / "bc-0", name)
    repository.commit({"config.json": b"{}"})
    assert f"{name} has other content (config.json)" in refused("push", run, name)
    assert "is no run: it holds no meta.json" in refused("evaluate", f"hf://{name}")
    (run / "model.safetensors").write_bytes(b"x")
    artifacts.write_json(trained / "adopted" / "meta.json", {"agent": "foreign"})
    assert "an adopted policy" in refused("push", trained / "adopted", name)
    assert "is damaged" in refused("push", run, name, code=1)


def test_a_commit_of_somebody_else_at_the_same_time_is_not_overwritten(
    collected: str, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    zest_rl.push(collected, f"{OWNER}/zest")
    repository = hub.repositories[f"datasets/{OWNER}/zest"]
    info = huggingface_hub.HfApi.repo_info

    def then_somebody_commits(*args: Any, **options: Any) -> Any:
        found = info(*args, **options)
        repository.commit({**repository.files, "namespace_metadata.json": b"{}"})
        return found

    monkeypatch.setattr(huggingface_hub.HfApi, "repo_info", then_somebody_commits)
    (reader.dataset_path(collected) / "README.md").write_text("mine\n", encoding="utf-8")
    with pytest.raises(ZestError, match=r"412 .*somebody changed it at the same time; type the command again"):
        zest_rl.push(collected, f"{OWNER}/zest")


def test_an_unreachable_hub_is_told_at_once(trained: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")  # nothing listens there
    for call in (lambda: zest_rl.push(trained / "dt-0", "me/x"), lambda: zest_rl.load_policy("hf://me/x")):
        with pytest.raises(ZestError, match=r"127\.0\.0\.1:9 does not answer .* check the network") as caught:
            call()
        assert not isinstance(caught.value, BadInput)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(ZestError, match="HF_HUB_OFFLINE is set; unset it"):
        zest_rl.load_policy("hf://me/x")
