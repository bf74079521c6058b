"""The probes as environments, and their closed forms against rollouts and by hand."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

import dnddpg_minimal  # noqa: F401  (registers the tasks)
from dnddpg_minimal import probes
from dnddpg_minimal.probes import (
    ConstantReward,
    LinearQuadratic,
    ObservedReward,
    RealEnd,
    TwoSteps,
    lyapunov,
    riccati,
)

ALL = [ConstantReward, RealEnd, ObservedReward, TwoSteps, LinearQuadratic]
GAMMA = 0.9


def discounted_return(probe, states, first_action, policy, gamma, steps, rng):
    """Sum of gamma^t reward from these states, ends respected: (N,)."""
    total = np.zeros(len(states))
    weight = np.ones(len(states))  # gamma^t, and 0 after the end
    action = first_action
    for _ in range(steps):
        states, rewards, terminated = probe.dynamics(states, action, rng)
        total += weight * rewards
        weight *= gamma * ~terminated
        action = policy(probe.observe(states))
    return total


def random_policy(rng):
    return lambda obs: rng.uniform(-1, 1, (len(obs), 1))


# ----------------------------------------------------------- the closed forms, by hand


def test_one_for_ever_at_a_half_is_two():
    q = ConstantReward.true_q(np.zeros((3, 1)), np.zeros((3, 1)), gamma=0.5)
    np.testing.assert_allclose(q, [2.0, 2.0, 2.0])


def test_two_steps_before_a_real_end_are_worth_one_and_a_half_at_a_half():
    obs = np.array([[2 / 5], [1 / 5], [0.0], [1.0]])
    q = RealEnd.true_q(obs, np.zeros((4, 1)), gamma=0.5)
    np.testing.assert_allclose(q, [1.5, 1.0, 0.0, 1.9375])


def test_an_observed_reward_counts_once_and_the_rest_is_the_mean():
    # 0.3 now, then 1/2 for ever: 0.3 + 0.5 (1/2 + 1/4 + ...) = 0.8
    q = ObservedReward.true_q(np.array([[0.3]]), np.zeros((1, 1)), gamma=0.5)
    np.testing.assert_allclose(q, [0.8])


def test_a_late_payment_is_discounted_once():
    obs = np.array([[0.0, 0.0], [0.5, -0.5], [1.0, -0.5]])
    action = np.array([[0.5], [0.9], [0.9]])
    q = TwoSteps.true_q(obs, action, gamma=0.8)
    # The best first action pays 1, a step late; -0.5 pays 1 - 1 = 0; the end 0
    np.testing.assert_allclose(q, [0.8, 0.0, 0.0], atol=1e-15)


def test_without_a_future_the_linear_quadratic_value_is_its_cost():
    q = LinearQuadratic.true_q(np.array([[2.0, 1.0]]), np.array([[1.0]]), gamma=0.0)
    np.testing.assert_allclose(q, [-(4.0 + 0.1 + 0.5)])


def test_the_linear_quadratic_step_by_hand():
    after, rewards, terminated = LinearQuadratic.dynamics(
        np.array([[1.0, 0.5]]), np.array([[-1.0]])
    )
    np.testing.assert_allclose(after, [[0.9 + 0.15, 0.35 - 0.3]])
    np.testing.assert_allclose(rewards, [-(1.0 + 0.025 + 0.5)])
    assert not terminated[0]


# ---------------------------------------------------- the closed forms against rollouts


@pytest.mark.parametrize("probe", [ConstantReward, RealEnd, TwoSteps])
def test_the_closed_form_equals_a_long_rollout(probe):
    rng = np.random.default_rng(0)
    states = probe.start_states(rng, 200)
    if probe is RealEnd:
        states[:, 0] = rng.integers(1, 6, 200)
    if probe is TwoSteps:  # half of them in the second step
        states[::2] = np.stack([np.ones(100), rng.uniform(-1, 1, 100)], axis=1)
    action = rng.uniform(-1, 1, (200, 1))
    found = discounted_return(
        probe, states, action, random_policy(rng), GAMMA, 400, rng
    )
    true = probe.true_q(probe.observe(states), action, GAMMA)
    np.testing.assert_allclose(found, true, atol=1e-6)


def test_the_observed_rewards_value_is_the_mean_of_many_rollouts():
    rng = np.random.default_rng(0)
    states = ObservedReward.start_states(rng, 20_000)
    action = np.zeros((len(states), 1))
    found = discounted_return(
        ObservedReward, states, action, random_policy(rng), GAMMA, 200, rng
    )
    error = found - ObservedReward.true_q(states, action, GAMMA)
    standard_error = error.std() / np.sqrt(len(error))
    assert abs(error.mean()) < 4 * standard_error
    assert standard_error < 0.01


@pytest.mark.parametrize("gain", [None, [[-0.3, -0.2]], [[0.1, 0.4]]])
@pytest.mark.parametrize("gamma", [0.5, 0.9, 0.99])
def test_the_linear_quadratic_value_equals_a_long_rollout(gain, gamma):
    rng = np.random.default_rng(0)
    states = LinearQuadratic.start_states(rng, 100)
    action = rng.uniform(-0.8, 0.8, (100, 1))
    used = riccati(gamma)[0] if gain is None else np.array(gain)
    total, weight = np.zeros(100), 1.0
    x, a = states, action
    for _ in range(2_000):
        total -= weight * LinearQuadratic.cost(x, a)
        x = LinearQuadratic.move(x, a)
        a = x @ used.T
        weight *= gamma
    true = LinearQuadratic.true_q(states, action, gamma, gain)
    np.testing.assert_allclose(total, true, atol=1e-6)


# -------------------------------------------------------- the linear-quadratic solution


@pytest.mark.parametrize("gamma", [0.5, 0.9, 0.99])
def test_riccati_agrees_with_scipy(gamma):
    gain, P = riccati(gamma)
    root = np.sqrt(gamma)
    oracle = solve_discrete_are(
        root * LinearQuadratic.A,
        root * LinearQuadratic.B,
        LinearQuadratic.C,
        LinearQuadratic.R,
    )
    np.testing.assert_allclose(P, oracle, atol=1e-9)
    np.testing.assert_allclose(P, lyapunov(gain, gamma), atol=1e-9)


def test_lyapunov_agrees_with_scipy():
    gain, gamma = np.array([[-0.3, -0.2]]), 0.9
    closed = np.sqrt(gamma) * (LinearQuadratic.A + LinearQuadratic.B @ gain)
    one_step = LinearQuadratic.C + gain.T @ LinearQuadratic.R @ gain
    oracle = solve_discrete_lyapunov(closed.T, one_step)
    np.testing.assert_allclose(lyapunov(gain, gamma), oracle, atol=1e-9)


def test_no_neighbouring_gain_is_better_than_riccatis():
    gain, P = riccati(GAMMA)
    for change in ([[0.05, 0]], [[-0.05, 0]], [[0, 0.05]], [[0, -0.05]]):
        worse = lyapunov(gain + np.array(change), GAMMA) - P
        assert np.linalg.eigvalsh(worse).min() > -1e-12  # from every state
        assert np.linalg.eigvalsh(worse).max() > 1e-6


def test_the_best_action_is_at_the_top_of_q():
    gain, _ = riccati(GAMMA)
    obs = np.array([[0.6, -0.3]])
    best = obs @ gain.T
    q = LinearQuadratic.true_q
    middle = q(obs, best, GAMMA)
    assert middle > q(obs, best + 0.01, GAMMA)
    assert middle > q(obs, best - 0.01, GAMMA)


@pytest.mark.parametrize("gamma", [0.5, 0.9, 0.99])
def test_the_best_policy_stays_within_eight_tenths(gamma):
    gain, _ = riccati(gamma)
    # Everything is linear, so the corners of the box of starts are the worst
    position, velocity = LinearQuadratic.start
    x = np.array([[position, velocity], [position, -velocity]])
    for _ in range(200):
        assert np.abs(x @ gain.T).max() <= 0.8
        x = LinearQuadratic.move(x, x @ gain.T)


def test_a_gain_that_lets_the_cost_grow_for_ever_is_refused():
    with pytest.raises(ValueError, match="infinite cost"):
        lyapunov([[3.0, 3.0]], 0.99)
    with pytest.raises(ValueError, match=r"shape \(1, 2\)"):
        lyapunov([1.0, 2.0], 0.9)


@pytest.mark.parametrize("gamma", [1.0, -0.1, 1.5])
def test_a_gamma_that_gives_no_finite_sum_is_refused(gamma):
    for probe in ALL:
        env = probe()
        obs, _ = env.reset(seed=0)
        with pytest.raises(ValueError, match="gamma"):
            probe.true_q(obs[None], np.zeros((1, 1)), gamma)


# -------------------------------------------------------------------- as environments


@pytest.mark.parametrize("probe", ALL)
def test_gymnasiums_checker_is_content(probe):
    env = gym.make(f"{probe.__name__}-v0", disable_env_checker=True)
    assert isinstance(env.unwrapped, probe)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("probe", ALL)
def test_the_vector_api_runs_several_copies(probe):
    envs = gym.make_vec(f"{probe.__name__}-v0", num_envs=3, vectorization_mode="sync")
    obs, _ = envs.reset(seed=0)
    obs, rewards, _, _, _ = envs.step(envs.action_space.sample())
    assert obs.shape[0] == 3 and rewards.shape == (3,)
    envs.close()


@pytest.mark.parametrize("probe", [ConstantReward, RealEnd, TwoSteps, LinearQuadratic])
def test_many_steps_at_once_equal_single_steps(probe):
    rng = np.random.default_rng(0)
    states = probe.start_states(rng, 500)
    if probe is RealEnd:
        states[:, 0] = rng.integers(1, 6, 500)
    if probe is TwoSteps:
        states[::2] = np.stack([np.ones(250), rng.uniform(-1, 1, 250)], axis=1)
    actions = rng.uniform(-1, 1, (500, 1))
    after, rewards, terminated = probe.dynamics(states, actions)
    env = probe()
    env.reset(seed=0)
    singles = []
    for state, action in zip(states, actions):
        env.state = state
        obs, reward, ended, truncated, _ = env.step(action)
        assert not truncated
        singles.append((env.state, obs, reward, ended))
    one_after, one_obs, one_reward, one_ended = map(np.array, zip(*singles))
    np.testing.assert_allclose(one_after, after, atol=1e-12)
    np.testing.assert_allclose(one_obs, probe.observe(after), atol=1e-6)
    np.testing.assert_allclose(one_reward, rewards, atol=1e-12)
    np.testing.assert_array_equal(one_ended, terminated)


@pytest.mark.parametrize("probe", ALL)
def test_a_rollout_never_leaves_the_observation_space(probe):
    env = probe()
    rng = np.random.default_rng(0)
    for seed in range(5):
        obs, _ = env.reset(seed=seed)
        push = rng.choice([-1.0, 1.0])  # always to one side: the farthest
        for _ in range(50):
            assert obs in env.observation_space
            obs, _, terminated, _, _ = env.step(np.array([push], np.float32))
            if terminated:
                break
        assert obs in env.observation_space


@pytest.mark.parametrize(
    "name", ["ConstantReward", "ObservedReward", "LinearQuadratic"]
)
def test_endless_probes_are_stopped_by_the_clock_only(name):
    env = gym.make(f"{name}-v0", disable_env_checker=True)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


@pytest.mark.parametrize(("name", "length"), [("RealEnd", 5), ("TwoSteps", 2)])
def test_probes_with_a_real_end_terminate(name, length):
    env = gym.make(f"{name}-v0", disable_env_checker=True)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(length)]
    assert ends == [(False, False)] * (length - 1) + [(True, False)]


def test_the_reward_was_read_from_the_observation():
    env = ObservedReward()
    obs, _ = env.reset(seed=0)
    for _ in range(10):
        seen = obs[0]
        obs, reward, _, _, _ = env.step(np.zeros(1))
        assert abs(reward - seen) < 1e-7


def test_the_first_action_is_kept_and_paid_for_in_the_second_step():
    env = TwoSteps()
    env.reset(seed=0)
    obs, reward, terminated, _, _ = env.step(np.array([0.25]))
    np.testing.assert_allclose(obs, [0.5, 0.25])
    assert reward == 0.0 and not terminated
    _, reward, terminated, _, _ = env.step(np.array([-1.0]))
    assert reward == 1.0 - 0.25**2 and terminated


@pytest.mark.parametrize("probe", ALL)
def test_the_same_seed_gives_the_same_episode(probe):
    episodes = []
    for _ in range(2):
        env = probe()
        seen = [env.reset(seed=7)[0]]
        seen += [env.step(np.array([0.3]))[0] for _ in range(2)]
        episodes.append(np.array(seen))
    np.testing.assert_array_equal(*episodes)


def test_a_wrong_state_or_a_step_without_reset_is_refused():
    env = probes.TwoSteps()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(1))
    with pytest.raises(ValueError, match="2 finite numbers"):
        env.state = [1.0]
    with pytest.raises(ValueError, match="render_mode='human'"):
        probes.TwoSteps(render_mode="human")
