import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zest_rl.errors import BadInput
from zest_rl.kitchen.arm import bounded_least_squares
from zest_rl.kitchen.env import ACT_DIM, ENV_ID, HORIZON, KitchenEnv
from zest_rl.kitchen.experts import SKILLS, Manner, add_uniform_noise, make_expert
from zest_rl.kitchen.tasks import TASKS

UNSEEN = 10_000  # first seed of the starts used here


def rollout(task, seed, level=0.0):
    """Return the rewards (T,) and actions (T, 9) of one episode."""
    env = gymnasium.make(ENV_ID, task=task)
    expert, rng = make_expert(task, env), np.random.default_rng(seed)
    env.reset(seed=seed)
    rewards, actions, truncated = [], [], False
    while not truncated:
        actions.append(add_uniform_noise(expert.act(), level, rng))
        _, reward, _, truncated, info = env.step(actions[-1])
        rewards.append(reward)
    return np.array(rewards), np.array(actions), info["gt"]["success"]


def success_rate(task, n, level=0.0):
    return np.mean([rollout(task, UNSEEN + i, level)[0].max() >= 0.999 for i in range(n)])


def test_every_task_has_an_expert():
    assert SKILLS.keys() == TASKS.keys()


@pytest.mark.parametrize("task", SKILLS)
def test_it_solves_its_task_from_unseen_starts(task):
    assert success_rate(task, 6) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("task", SKILLS)
def test_it_solves_its_task_from_95_of_100_unseen_starts(task):
    assert success_rate(task, 100) >= 0.95


def test_the_door_is_still_open_when_the_episode_ends():
    rewards, _, success_at_the_end = rollout("micro", UNSEEN)
    assert len(rewards) == HORIZON
    assert success_at_the_end
    assert rewards.sum() > 65


def test_it_recovers_from_moderate_noise_but_full_noise_breaks_it():
    assert success_rate("micro", 4, level=0.2) == 1.0
    assert success_rate("micro", 4, level=1.0) == 0.0


def test_equal_seeds_give_equal_episodes():
    for level in (0.0, 0.5):
        first, second = rollout("micro", 3, level), rollout("micro", 3, level)
        np.testing.assert_array_equal(first[1], second[1])
        np.testing.assert_array_equal(first[0], second[0])


@pytest.mark.parametrize("task", SKILLS)
def test_an_action_depends_on_the_state_alone_and_does_not_change_it(task):
    env = KitchenEnv(task)
    expert = make_expert(task, env)
    env.reset(seed=UNSEEN)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    before, after = np.empty((2, mujoco.mj_stateSize(env.model, kind)))
    for _ in range(65):  # through all that a skill does, to holding
        mujoco.mj_getState(env.model, env.data, before, kind)
        action = expert.act()
        mujoco.mj_getState(env.model, env.data, after, kind)
        np.testing.assert_array_equal(before, after)
        np.testing.assert_array_equal(make_expert(task, env).act(), action)
        assert action.shape == (ACT_DIM,)
        assert action.dtype == np.float32
        assert action in env.action_space
        env.step(action)


def test_once_done_it_holds_the_arm_against_gravity_while_a_zero_action_sags():
    def moved(act):
        env = KitchenEnv("micro", init_noise=0.0)
        expert = make_expert("micro", env)
        env.reset(seed=0)
        env.data.joint("microwave").qpos[0] = 1.1 * env.task.goal
        mujoco.mj_forward(env.model, env.data)
        start = env.data.qpos[:7].copy()
        for _ in range(20):
            env.step(act(expert))
        return np.abs(env.data.qpos[:7] - start).max()

    assert moved(lambda expert: expert.act()) < 0.03
    assert moved(lambda _: np.zeros(ACT_DIM, np.float32)) > 0.2


def test_an_unknown_task_is_refused_with_the_tasks_that_there_are():
    with pytest.raises(BadInput, match=r"no expert for task 'knob4'; .*knob2"):
        make_expert("knob4", KitchenEnv("knob2"))


def test_a_manner_that_makes_no_sense_is_refused():
    with pytest.raises(BadInput, match=r"speed must be in \(0, 1\], got 0"):
        Manner(speed=0.0)
    with pytest.raises(BadInput, match="stop_at and grip_error must be finite"):
        Manner(grip_error=(0.0, float("nan"), 0.0))


def test_a_wrong_grip_moves_the_hand_to_the_wrong_place():
    env = KitchenEnv("micro", init_noise=0.0)
    env.reset(seed=0)
    right, wrong = (make_expert("micro", env, manner).act() for manner in (Manner(), Manner(grip_error=(0.1, 0, 0.1))))
    assert np.abs(right - wrong).max() > 0.01


def test_an_environment_of_another_task_or_kind_is_refused():
    with pytest.raises(BadInput, match="needs a KitchenEnv made with task='micro', got 'rdoor'"):
        make_expert("micro", KitchenEnv("rdoor"))
    with pytest.raises(BadInput, match="got 'CartPoleEnv'"):
        make_expert("micro", gymnasium.make("CartPole-v1"))


@given(st.floats(0, 2), st.integers(0, 1000))
def test_noise_stays_within_its_level_and_the_action_within_its_bounds(level, seed):
    action = np.random.default_rng(seed).uniform(-1, 1, ACT_DIM).astype(np.float32)
    noisy = add_uniform_noise(action, level, np.random.default_rng(seed))
    assert noisy.dtype == np.float32
    assert (np.abs(noisy) <= 1).all()
    assert (np.abs(noisy - action) <= level + 1e-6).all()
    np.testing.assert_array_equal(noisy, add_uniform_noise(action, level, np.random.default_rng(seed)))


def test_noise_of_level_zero_changes_nothing_and_a_level_below_is_refused():
    action = np.linspace(-1, 1, ACT_DIM, dtype=np.float32)
    np.testing.assert_array_equal(add_uniform_noise(action, 0.0, np.random.default_rng(0)), action)
    for level in (-0.1, float("nan")):
        with pytest.raises(BadInput, match="noise level must be a finite number >= 0"):
            add_uniform_noise(action, level, np.random.default_rng(0))


@given(st.integers(0, 10_000))
def test_the_joint_step_stays_inside_its_bounds_and_equals_the_formula_when_they_do_not_bind(seed):
    rng = np.random.default_rng(seed)
    jacobian, task, preferred = rng.normal(size=(6, 7)), rng.normal(size=6), 0.1 * rng.normal(size=7)
    bound, damping = rng.uniform(0.01, 0.5, 7), 0.3
    step = bounded_least_squares(jacobian, task, preferred, -bound, bound, damping)
    assert (np.abs(step) <= bound * (1 + 1e-9)).all()
    loose = bounded_least_squares(jacobian, task, preferred, np.full(7, -1e6), np.full(7, 1e6), damping)
    minimiser = np.linalg.solve(  # of |J x - task|² + damping² |x - preferred|²
        jacobian.T @ jacobian + damping**2 * np.eye(7), jacobian.T @ task + damping**2 * preferred
    )
    np.testing.assert_allclose(loose, minimiser, atol=1e-8)


def test_a_joint_at_its_bound_leaves_the_rest_of_the_task_to_the_others():
    jacobian = np.array([[1.0, 1.0]])
    bound = np.array([0.1, 10.0])
    step = bounded_least_squares(jacobian, np.array([1.0]), np.zeros(2), -bound, bound, damping=1e-6)
    np.testing.assert_allclose(step, [0.1, 0.9], atol=1e-6)
