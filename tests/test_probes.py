"""Small worlds whose true Q is one line: all three algorithms must learn it.

A critic that learns the truth here bootstraps where it must, stops where it must,
reads its observation, and discounts once and not twice. Each run takes a second.
"""

import numpy as np
import pytest

from dnddpg_minimal import ALGORITHMS, Config, Training, probes

pytestmark = pytest.mark.slow

GAMMA = 0.5
FAST = dict(hidden=(16, 16), batch_size=32, warmup=100, gamma=GAMMA, tau=0.1,
            critic_lr=5e-3, actor_lr=3e-3, sigma=0.3)
ALL_THREE = pytest.mark.parametrize("algorithm", ALGORITHMS)


def learned(probe, steps, algorithm="DN-DDPG", **choices):
    """A finished run on one probe."""
    training = Training(Config(f"{probe}-v0", algorithm, steps=steps, **FAST | choices))
    list(training)
    return training


def at_replay(training):
    """Each critic's Q and the truth, where the run has been: (C, n), (n,)."""
    stored = training.replay.arrays
    task = type(training.env.unwrapped)
    return (training.agent.q_values(stored.obs, stored.action),
            task.true_q(stored.obs, stored.action, GAMMA))


# --- the closed forms, at points that can be worked out on paper ----------------------


def test_the_truths_by_hand():
    """gamma = 1/2, so that every sum is a fraction one can write down."""
    def q(probe, obs, action=0.0):
        return probe.true_q(np.array([obs]), np.array([[action]]), 0.5)[0]

    assert q(probes.ConstantReward, [0]) == 2  # 1 + 1/2 + 1/4 + ...
    assert q(probes.RealEnd, [3 / 5]) == 1 + 1 / 2 + 1 / 4  # three steps are left
    assert q(probes.RealEnd, [0]) == 0
    assert q(probes.ObservedReward, [0.25]) == 0.25 + 0.5 / 2 + 0.5 / 4 * 2
    assert q(probes.TwoSteps, [0, 0], action=0.5) == 0.5  # the best there is, one late
    assert q(probes.TwoSteps, [0, 0], action=-0.5) == 0
    assert q(probes.TwoSteps, [0.5, 1.0], action=-1) == 0.75  # its action is too late


# --- learned --------------------------------------------------------------------------


@ALL_THREE
def test_a_reward_of_1_for_ever_is_worth_1_over_1_minus_gamma(algorithm):
    """The time limit of 20 steps is no end: a critic that stopped there learns less."""
    q, truth = at_replay(learned("ConstantReward", 350, algorithm,
                                 max_episode_steps=20))
    assert truth[0] == pytest.approx(2)
    assert abs(q - truth).max() < 0.25


def test_the_probe_catches_a_time_limit_taken_for_an_end():
    """One end in two steps: Q = 1 + gamma Q / 2, which is 4/3 instead of 2."""
    q, truth = at_replay(learned("ConstantReward", 350, "DDPG", max_episode_steps=2,
                                 ends="any_end"))
    assert abs(q - 4 / 3).mean() < 0.2


@ALL_THREE
def test_a_real_end_is_worth_nothing_afterwards(algorithm):
    q, truth = at_replay(learned("RealEnd", 500, algorithm))
    assert truth.std() > 0.3
    assert (abs(q - truth).mean(axis=1) < 0.2).all()


def test_the_probe_catches_a_bootstrap_through_a_real_end():
    """Then the last reward is followed by more, out of nowhere."""
    training = learned("RealEnd", 500, "DDPG", ends="none")
    q, truth = at_replay(training)
    last = training.replay.arrays.obs[:, 0] < 0.3  # one step is left
    assert truth[last] == pytest.approx(1)
    assert q[0, last].mean() > 1.6  # near 2: a reward for ever


@ALL_THREE
def test_the_critics_read_the_reward_from_the_observation(algorithm):
    training = learned("ObservedReward", 500, algorithm)
    q, truth = at_replay(training)
    assert abs(q.mean(axis=1) - truth.mean()).max() < 0.25
    low, high = training.agent.q_values([[0.0], [1.0]], [[0.0], [0.0]]).T
    assert abs(high - low - 1).max() < 0.3  # the truth rises by 1


@ALL_THREE
def test_a_reward_one_step_later_is_discounted_once_and_the_actor_finds_it(algorithm):
    training = learned("TwoSteps", 650, algorithm)
    q, truth = at_replay(training)
    assert truth.std() > 0.2
    assert (abs(q - truth).mean(axis=1) < 0.08).all()
    start = np.zeros((1, 2))
    assert abs(training.agent.actions(start) - 0.5).max() < 0.4  # every actor


@ALL_THREE
def test_the_critics_learn_what_the_bounded_actors_really_cost(algorithm):
    """On the linear-quadratic task: against 60 further steps of the policy itself.

    The closed form is for the best policy, so it bounds the truth from above.
    """
    agent = learned("LinearQuadratic", 650, algorithm, max_episode_steps=20).agent
    task, rng = probes.LinearQuadratic, np.random.default_rng(0)
    states, first = task.start_states(rng, 200), rng.uniform(-1, 1, (200, 1))
    truth, now, action = np.zeros(200), states, first
    for step in range(60):
        now, reward, _ = task.dynamics(now, action, rng)
        truth += GAMMA**step * reward
        action = agent.act(task.observe(now))
    obs = task.observe(states)
    error = agent.q_values(obs, first) - truth
    assert truth.std() > 0.25
    assert (abs(error).mean(axis=1) < 0.12).all()
    assert (abs(error.mean(axis=1)) < 0.08).all()
    best = task.true_q(obs, first, GAMMA)
    assert (truth < best + 1e-3).all() and (best - truth).mean() < 0.05


# --- the same by autograd -------------------------------------------------------------


def test_pytorch_learns_a_reward_for_ever():
    q, truth = at_replay(learned("ConstantReward", 350, backend="torch",
                                 max_episode_steps=20))
    assert abs(q - truth).max() < 0.3


def test_pytorch_learns_a_real_end():
    q, truth = at_replay(learned("RealEnd", 450, backend="torch", algorithm="DDPG"))
    assert abs(q - truth).mean() < 0.2
