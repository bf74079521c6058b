"""Three algorithms are one code path, so that some of them must be equal, bit for bit.

A difference in the last bit would be harmless for learning. It is asked for because it
is the one answer that needs no tolerance: any slip in what belongs to whom shows.
"""

from functools import cache

import numpy as np
import plain_ddpg
import pytest

from dnddpg_minimal import ALGORITHMS, Config, NumpyAgent, Training, read_npz

SHORT = dict(steps=250, warmup=50, max_episode_steps=50, hidden=(16, 8),
             batch_size=16)


@cache
def trained(algorithm, **choices):
    """A short run on Pendulum, to its end."""
    training = Training(Config("Pendulum-v1", algorithm, seed=3, **SHORT | choices))
    assert [record.step for record in training][-1] == 250
    return training


def returns(training):
    return [r.episode_return for r in training.records if r.kind == "episode"]


def some_obs(obs_dim=3, size=50):
    return np.random.default_rng(0).normal(size=(size, obs_dim))


def some_actions(action_dim=1, size=50):
    return np.random.default_rng(1).uniform(-1, 1, (size, action_dim))


# --- C = K = 1 against sixty lines without the leading axis ---------------------------


@pytest.mark.parametrize("batch_size", [16, 17])
def test_one_critic_and_one_actor_are_plain_ddpg(batch_size, tmp_path):
    config = Config("Pendulum-v1", "DDPG", seed=3, steps=450, warmup=100,
                    hidden=(16, 8), batch_size=batch_size)
    plain, plain_returns = plain_ddpg.train(config)
    ours = Training(config)
    last = [*ours][-1]
    assert [*returns(ours), last.episode_return] == plain_returns
    ours.agent.save(tmp_path / "agent.npz")
    arrays = read_npz(tmp_path / "agent.npz")
    for name, layers in dict(theta=plain.theta, theta_target=plain.slow,
                             adam_m=plain.m, adam_v=plain.v).items():
        flat = np.concatenate([layer.ravel() for layer in layers])
        assert np.array_equal(arrays[name], flat), name


# --- the second critic and the second actor, when they have nothing to add ------------


@pytest.mark.parametrize("batch_size", [16, 17])
def test_dcn_with_tied_critics_is_ddpg(batch_size):
    ddpg = trained("DDPG", batch_size=batch_size)
    dcn = trained("DCN-DDPG", init="tied_critics", batch_size=batch_size)
    assert returns(dcn) == returns(ddpg)
    assert np.array_equal(dcn.agent.actions(some_obs()), ddpg.agent.actions(some_obs()))
    q = dcn.agent.q_values(some_obs(), some_actions())
    assert np.array_equal(q[0], q[1])
    assert np.array_equal(q[:1], ddpg.agent.q_values(some_obs(), some_actions()))


def test_three_tied_critics_are_ddpg_too():
    ddpg, three = trained("DDPG"), trained("C3-K1", init="tied_critics")
    assert returns(three) == returns(ddpg)


def test_dn_with_tied_actors_that_climb_one_critic_is_dcn():
    dcn = trained("DCN-DDPG")
    dn = trained("DN-DDPG", init="tied_actors", climbs="first")
    assert returns(dn) == returns(dcn)
    action = dn.agent.actions(some_obs())
    assert np.array_equal(action[0], action[1])
    assert np.array_equal(action[:1], dcn.agent.actions(some_obs()))
    assert np.array_equal(dn.agent.q_values(some_obs(), some_actions()),
                          dcn.agent.q_values(some_obs(), some_actions()))


def test_tied_actors_part_at_once_when_each_climbs_its_own_critic():
    dn = trained("DN-DDPG", init="tied_actors", warmup=249)  # one update
    assert dn.updates == 1
    first, second = dn.agent.actions(some_obs())
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("rule", ["single", "paired_min", "selected"])
def test_with_one_actor_and_one_critic_there_is_nothing_to_choose(rule):
    chosen = trained("DDPG", target_rule=rule, act_rule="max_min", climbs="first",
                     init="tied_actors")
    assert returns(chosen) == returns(trained("DDPG"))


# --- the same seed gives the three algorithms the same start --------------------------


def test_critic_1_and_actor_1_start_equal_in_all_three_algorithms():
    agents = [NumpyAgent(Config("Hopper-v5", name, seed=5), 11, 3)
              for name in ALGORITHMS]
    obs, actions = some_obs(11), some_actions(3)
    for agent in agents[1:]:
        assert np.array_equal(agent.actions(obs)[0], agents[0].actions(obs)[0])
        assert np.array_equal(agent.q_values(obs, actions)[0],
                              agents[0].q_values(obs, actions)[0])
    dcn, dn = agents[1:]
    assert np.array_equal(dcn.q_values(obs, actions), dn.q_values(obs, actions))
    first, second = dn.q_values(obs, actions)
    assert not np.isclose(first, second).any()
    first, second = dn.actions(obs)
    assert not np.isclose(first, second).any()


def test_tied_means_equal_at_the_start_and_only_what_is_named():
    obs, actions = some_obs(), some_actions()
    tied = NumpyAgent(Config(init="tied_critics"), 3, 1)
    assert np.array_equal(*tied.q_values(obs, actions))
    assert not np.array_equal(*tied.actions(obs))
    tied = NumpyAgent(Config(init="tied_actors"), 3, 1)
    assert np.array_equal(*tied.actions(obs))
    assert not np.array_equal(*tied.q_values(obs, actions))


def test_the_slow_copies_start_as_copies():
    agent = NumpyAgent(Config(), 3, 1)
    obs, actions = some_obs(), some_actions()
    assert np.array_equal(agent.actions(obs, slow=True), agent.actions(obs))
    assert np.array_equal(agent.q_values(obs, actions, slow=True),
                          agent.q_values(obs, actions))


def test_a_second_critic_or_actor_moves_nobody_elses_draws():
    """Starts, warm-up, the first noise, the rows drawn from replay: all unmoved."""
    runs = [trained.__wrapped__(name, act_rule="first") for name in ALGORITHMS]
    for run in runs[1:]:
        ours, theirs = run.replay.arrays, runs[0].replay.arrays
        starts = slice(0, None, 50)
        assert np.array_equal(ours.obs[starts], theirs.obs[starts])
        assert np.array_equal(ours.action[:51], theirs.action[:51])
        assert not np.array_equal(ours.action[51:], theirs.action[51:])
    rows = []
    for run in runs:
        run.replay.arrays.reward[:] = np.arange(250)  # a reward is now its row's number
        rows.append(run.replay.sample(40).reward)
    assert np.array_equal(rows[0], rows[1]) and np.array_equal(rows[0], rows[2])


def test_another_seed_is_another_run():
    obs, actions = some_obs(), some_actions()
    agents = [NumpyAgent(Config(seed=seed), 3, 1) for seed in (0, 1)]
    assert not np.isclose(*(agent.actions(obs)[0] for agent in agents)).any()
    assert not np.isclose(*(a.q_values(obs, actions)[0] for a in agents)).any()
