"""Which environments may be made from what a file says."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import pytest

from zest_rl.data.env_specs import check_env_spec, check_model_files, check_registered, entry_points, without_wrappers
from zest_rl.errors import BadInput, Notice


@pytest.mark.parametrize("name", ["gymnasium.envs.x:Y", "gymnasium_robotics.envs.x:Y", "zest_rl.envs:KitchenEnv"])
def test_known_packages_are_trusted(name: str) -> None:
    check_env_spec(json.dumps({"entry_point": name, "additional_wrappers": []}), "it", "stop")
    with pytest.raises(BadInput, match="it would run code of"):
        check_env_spec(json.dumps({"entry_point": name.replace(".", "_evil.", 1)}), "it", "stop")


def test_the_code_of_wrappers_counts_too() -> None:
    spec = {"entry_point": "gymnasium.envs.x:Y", "additional_wrappers": [{"entry_point": "evil:make"}]}
    assert entry_points(json.dumps(spec), "it") == ["gymnasium.envs.x:Y", "evil:make"]
    with pytest.raises(BadInput, match=r"it would run code of 'evil:make'; only .* are trusted; stop"):
        check_env_spec(json.dumps(spec), "it", "stop")


@pytest.mark.parametrize(
    "spec", ["{", "null", "[]", "{}", "[" * 100_000, '{"entry_point": "zest_rl.x", "additional_wrappers": 3}']
)
def test_what_is_no_env_spec_is_refused(spec: str) -> None:
    with pytest.raises(BadInput, match="it is not the JSON of a Gymnasium EnvSpec"):
        entry_points(spec, "it")


def test_an_id_stands_for_the_code_that_is_registered_under_it() -> None:
    spec = gymnasium.spec("CartPole-v1")
    check_registered(spec)
    with pytest.raises(BadInput, match=r"would run code of 'gymnasium\.spaces:Box', but is registered as"):
        check_registered(replace(spec, entry_point="gymnasium.spaces:Box"))
    with pytest.raises(
        BadInput, match="Nowhere-v1 is not registered by the packages that are installed here; install the version"
    ):
        check_registered(replace(spec, id="Nowhere-v1"))


def test_an_id_of_an_old_version_is_told_with_the_versions_that_are_there() -> None:
    with pytest.raises(BadInput, match=r"CartPole-v9 is not registered .* here, which have CartPole-v0, CartPole-v1; "):
        check_registered(replace(gymnasium.spec("CartPole-v1"), id="CartPole-v9"))


@pytest.mark.parametrize("path", ["/dev/zero", "./nowhere.xml", "~/nowhere.xml", "a/../../nowhere.xml"])
def test_a_model_that_is_no_file_is_refused(path: str) -> None:
    with pytest.raises(BadInput, match=r"is not a file|does not exist"):
        check_model_files({"id": "HalfCheetah-v5", "kwargs": {"xml_file": path}})


def test_a_model_that_is_a_file_of_yours_is_told_and_one_of_the_package_is_not(tmp_path: Path) -> None:
    (tmp_path / "own.xml").write_text("<mujoco/>")
    with pytest.warns(Notice, match=r"HalfCheetah-v5 is made from /.*own\.xml, which the dataset names"):
        check_model_files({"id": "HalfCheetah-v5", "kwargs": {"xml_file": str(tmp_path / "own.xml")}})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_model_files({"id": "HalfCheetah-v5", "kwargs": {"xml_file": "half_cheetah.xml", "n": 1}})


def test_no_wrappers_may_be_written_as_null() -> None:
    spec = json.dumps({"entry_point": "gymnasium.envs.x:Y", "additional_wrappers": None})
    assert entry_points(spec, "it") == ["gymnasium.envs.x:Y"]
    assert json.loads(without_wrappers(spec))["additional_wrappers"] == []
