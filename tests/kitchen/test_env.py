import copy
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium_robotics.envs.franka_kitchen import KitchenEnv as FrankaKitchen

from zest_rl.errors import BadInput, ZestError
from zest_rl.kitchen.env import (
    ACT_DIM,
    ARM_DIM,
    ENV_ID,
    HORIZON,
    KitchenEnv,
    check_mujoco,
)
from zest_rl.kitchen.tasks import SUCCESS_PROGRESS, TASKS


@pytest.fixture(scope="module")
def env():
    return KitchenEnv("micro")


def random_actions(n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, ACT_DIM)).astype(np.float32)


def episode_bytes(env, seed, actions):
    obs, info = env.reset(seed=seed)
    parts = [obs.tobytes(), info["state"]["qpos"].tobytes(), info["state"]["qvel"].tobytes()]
    for action in actions:
        obs, reward, _, _, info = env.step(action)
        parts += [obs.tobytes(), np.float64(reward).tobytes(), info["state"]["qpos"].tobytes()]
    return b"".join(parts)


def simulator_state(env):
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, state, kind)
    return state


def model_bytes(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def set_progress(env, progress):
    env.data.joint(env.task.joint).qpos[0] = progress * env.task.goal
    mujoco.mj_forward(env.model, env.data)


def test_it_is_a_valid_gymnasium_environment(env):
    check_env(env, skip_render_check=True)


def test_observation_is_flat_float32_and_lies_in_its_space(env):
    obs, _ = env.reset(seed=0)
    assert obs.shape == (59,)
    assert obs.dtype == np.float32
    assert obs in env.observation_space


def test_every_step_equals_franka_kitchen_without_noise(env):
    _, info = env.reset(seed=3)
    reference = FrankaKitchen(
        tasks_to_complete=["microwave"],
        terminate_on_tasks_completed=False,
        robot_noise_ratio=0.0,
        object_noise_ratio=0.0,
    )
    reference.robot_env.init_qpos = info["state"]["qpos"]
    reference.reset(seed=0)
    for action in 1.5 * random_actions(60):  # some components beyond the bounds
        obs, _, _, _, info = env.step(action)
        expected = reference.step(action)[0]["observation"]
        np.testing.assert_array_equal(obs, expected.astype(np.float32))
        np.testing.assert_array_equal(info["state"]["qpos"], reference.data.qpos)
        np.testing.assert_array_equal(info["state"]["qvel"], reference.data.qvel)


def test_equal_seeds_and_actions_give_equal_bytes_and_other_seeds_do_not(env):
    actions = random_actions(30)
    first = episode_bytes(env, 7, actions)
    assert episode_bytes(env, 7, actions) == first
    assert episode_bytes(KitchenEnv("micro"), 7, actions) == first
    assert episode_bytes(env, 8, actions) != first


def test_the_state_at_reset_does_not_depend_on_what_ran_before(env):
    fresh = KitchenEnv("micro")
    fresh.reset(seed=5)
    env.reset(seed=11)
    for action in random_actions(20, seed=1):
        env.step(action)
    env.data.ctrl[:], env.data.xfrc_applied[:] = 1.0, 1.0
    env.reset(seed=5)
    np.testing.assert_array_equal(simulator_state(env), simulator_state(fresh))


def test_starts_spread_over_the_arm_joints_only_and_stay_within_the_joints_ranges(env):
    starts = np.array([env.reset(seed=seed)[1]["state"]["qpos"] for seed in range(40)])
    limited = np.flatnonzero(env.model.jnt_limited)
    joints, ranges = starts[:, env.model.jnt_qposadr[limited]], env.model.jnt_range[limited]
    assert (joints >= ranges[:, 0]).all()
    assert (joints <= ranges[:, 1]).all()
    assert (np.abs(starts - env.start_qpos)[:, :ARM_DIM] <= env.init_noise + 0.006).all()  # 0.006: start out of range
    assert (np.ptp(starts[:, :ARM_DIM], axis=0) > env.init_noise / 2).all()
    assert (np.ptp(starts[:, ARM_DIM:], axis=0) == 0).all()


def test_objects_start_at_rest(env):
    _, info = env.reset(seed=0)
    start = info["state"]["qpos"]
    assert np.linalg.norm(start[26:30]) == pytest.approx(1, abs=1e-6)  # the kettle's orientation
    for _ in range(5):
        _, _, _, _, info = env.step(np.zeros(ACT_DIM, np.float32))
        np.testing.assert_allclose(info["state"]["qpos"][ACT_DIM:], start[ACT_DIM:], atol=1e-4)


def test_without_init_noise_every_seed_starts_alike():
    still = KitchenEnv("micro", init_noise=0.0)
    np.testing.assert_array_equal(still.reset(seed=0)[0], still.reset(seed=1)[0])


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize(("progress", "succeeds"), [(0.5, False), (1.04, True)])
def test_reward_is_the_clipped_progress_of_the_tasks_own_joint_after_the_step(name, progress, succeeds):
    env = KitchenEnv(name)
    _, info = env.reset(seed=0)
    assert 0 <= info["gt"]["reward"] < 0.01
    assert not info["gt"]["success"]
    set_progress(env, progress)
    _, reward, terminated, truncated, info = env.step(np.zeros(ACT_DIM, np.float32))
    expected = info["state"]["qpos"][env.model.joint(env.task.joint).qposadr[0]] / env.task.goal
    assert env.progress == pytest.approx(expected)
    assert reward == info["gt"]["reward"] == np.float32(np.clip(expected, 0, 1))
    assert reward == pytest.approx(min(progress, 1), abs=0.1)
    assert info["gt"]["success"] == (expected >= SUCCESS_PROGRESS) == succeeds
    assert not terminated
    assert not truncated


def test_a_door_moved_the_wrong_way_earns_zero_not_less(env):
    env.reset(seed=0)
    set_progress(env, -0.1)
    _, reward, *_ = env.step(np.zeros(ACT_DIM, np.float32))
    assert env.progress < 0
    assert reward == 0


def test_info_holds_numbers_in_fresh_arrays_at_reset_and_step(env):
    _, at_reset = env.reset(seed=0)
    kept = copy.deepcopy(at_reset)
    _, _, _, _, at_step = env.step(np.ones(ACT_DIM, np.float32))
    for info in (at_reset, at_step):
        assert info["state"]["qpos"].shape == (30,)
        assert info["state"]["qvel"].shape == (29,)
        assert info["state"]["qpos"].dtype == info["state"]["qvel"].dtype == np.float64
        assert isinstance(info["gt"]["reward"], np.float32)
        assert isinstance(info["gt"]["success"], bool)
    np.testing.assert_array_equal(at_reset["state"]["qpos"], kept["state"]["qpos"])
    before = env.data.qpos.copy()
    at_step["state"]["qpos"][:] = 99.0
    np.testing.assert_array_equal(env.data.qpos, before)


def test_an_episode_is_truncated_at_the_horizon_and_never_terminated():
    env = gymnasium.make(ENV_ID, task="micro")
    env.reset(seed=0)
    ends = [env.step(np.zeros(ACT_DIM, np.float32))[2:4] for _ in range(HORIZON)]
    assert ends == [(False, False)] * (HORIZON - 1) + [(False, True)]


@pytest.mark.parametrize("action", [np.full(9, np.nan), np.full(9, np.inf), np.zeros(8), np.zeros((1, 9))])
def test_an_action_that_is_not_nine_finite_numbers_is_refused_before_the_simulation_moves(env, action):
    env.reset(seed=0)
    before = simulator_state(env)
    with pytest.raises(BadInput, match="9 finite numbers"):
        env.step(action.astype(np.float32))
    np.testing.assert_array_equal(simulator_state(env), before)


def test_bad_arguments_are_refused_with_the_valid_ones():
    with pytest.raises(BadInput, match="did you mean 'micro'"):
        KitchenEnv("mikro")
    for init_noise in (-0.1, float("nan")):
        with pytest.raises(BadInput, match="init_noise must be a finite number"):
            KitchenEnv("micro", init_noise=init_noise)


def test_its_spec_as_json_rebuilds_it_in_a_process_that_has_not_imported_the_package():
    env = gymnasium.make(ENV_ID, task="rdoor", init_noise=0.02)
    program = (
        "import sys, gymnasium\n"
        "from gymnasium.envs.registration import EnvSpec\n"
        "env = gymnasium.make(EnvSpec.from_json(sys.argv[1]))\n"
        "obs, _ = env.reset(seed=4)\n"
        "print(env.unwrapped.task.name, env.spec.max_episode_steps, obs.tobytes().hex())\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", program, env.spec.to_json()], capture_output=True, text=True, timeout=120, check=True
    )
    obs, _ = env.reset(seed=4)
    assert run.stdout.split() == ["rdoor", str(HORIZON), obs.tobytes().hex()]


def test_instances_share_one_model_that_no_episode_writes_to_and_have_their_own_state(env):
    other = KitchenEnv("sdoor")
    assert other.model is env.model
    before = model_bytes(env.model)
    actions = random_actions(10)
    alone = episode_bytes(env, 0, actions)
    env.reset(seed=0)
    other.reset(seed=1)
    for action in actions:
        env.step(action)
        other.step(-action)
    interleaved = env.data.qpos.tobytes()
    assert alone.endswith(interleaved)
    assert other.data.qpos.tobytes() != interleaved
    assert model_bytes(env.model) == before


@pytest.mark.parametrize("version", ["3.3.7", "3.5.0", "3.11.0"])
def test_mujoco_versions_that_run_the_kitchen_are_accepted(version):
    assert check_mujoco(version) is None


@pytest.mark.parametrize("version", ["2.3.7", "3.3.6", "3.12.0", "4.0.0"])
def test_other_mujoco_versions_are_refused_with_what_to_install(version):
    with pytest.raises(ZestError, match=rf"found mujoco {version}; run: pip install 'mujoco>=3.3.7,<3.12'"):
        check_mujoco(version)


@pytest.mark.parametrize(
    "code",
    [
        "import zest_rl.envs; print(zest_rl.envs.KitchenEnv.__module__); gymnasium.spec('zest/Kitchen-v1')",
        "gymnasium.make('zest_rl.envs:zest/Kitchen-v1', task='micro'); print('zest_rl.kitchen.env')",
    ],
)
def test_the_module_that_datasets_name_registers_the_environment(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", f"import gymnasium; {code}"], capture_output=True, text=True)
    assert done.stdout.strip() == "zest_rl.kitchen.env", done.stderr
