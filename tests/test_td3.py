"""TD3's two other parts, smoothed targets and delayed actors."""

import numpy as np
import pytest

from dnddpg_minimal import Batch, Config, NumpyAgent, td_target
from dnddpg_minimal.td3 import TD3Agent, TD3Training

CONFIG = dict(task="Pendulum-v1", algorithm="DCN-DDPG", hidden=(16, 16), batch_size=32)


def batches(n, size=32):
    rng = np.random.default_rng(0)
    for _ in range(n):
        yield Batch(rng.normal(size=(size, 3)), rng.uniform(-1, 1, (size, 1)),
                    rng.normal(size=size), rng.normal(size=(size, 3)), np.zeros(size))


class WithoutNoise(TD3Agent):
    sigma = 0.0


class WithoutDelay(TD3Agent):
    every = 1


class WithoutBoth(WithoutNoise, WithoutDelay):
    pass


def learned(kind, updates=20, **choices):
    agent = kind(Config(**CONFIG | choices), 3, 1)
    for batch in batches(updates):
        agent.update(batch)
    return agent


def test_without_noise_and_delay_it_is_dcn_ddpg_bit_for_bit():
    dcn, plain = learned(NumpyAgent), learned(WithoutBoth)
    for name in NumpyAgent.STATE:
        np.testing.assert_array_equal(getattr(dcn, name), getattr(plain, name))


@pytest.mark.parametrize("kind", [TD3Agent, WithoutNoise, WithoutDelay])
def test_each_part_alone_makes_another_agent(kind):
    assert not np.allclose(learned(NumpyAgent).theta, learned(kind).theta)


def test_actors_and_slow_copies_move_at_every_second_update():
    agent = TD3Agent(Config(**CONFIG, target_every=2), 3, 1)
    for n, batch in enumerate(batches(6), start=1):
        before = agent.arrays()
        losses = agent.update(batch)
        now, due = agent.arrays(), n % 2 == 0
        moved = {name: not np.array_equal(before[name], now[name]) for name in now}
        critics = before["theta"][:agent.split] != now["theta"][:agent.split]
        actors = before["theta"][agent.split:] != now["theta"][agent.split:]
        assert critics.any() and actors.any() == due
        assert moved["theta_target"] == due and agent.actor_updates == n // 2
        assert np.isfinite(losses["actor"]).all() == due


def test_the_target_is_that_of_eq_12_5_by_hand():
    agent = learned(TD3Agent, updates=3)
    batch = next(batches(1))
    noise = np.random.default_rng([0, 3]).normal(0, 0.2, (32, 1)).clip(-0.5, 0.5)
    action = (agent.actions(batch.next_obs, slow=True)[0] + noise).clip(-1, 1)
    lowest = agent.q_values(batch.next_obs, action, slow=True).min(axis=0)
    np.testing.assert_allclose(agent.td_target(batch), batch.reward + 0.99 * lowest,
                               rtol=1e-5, atol=1e-6)
    unsmoothed = NumpyAgent.q_next(agent, batch.next_obs)
    plain = td_target(batch.reward, batch.terminated, unsmoothed, 0.99)
    assert not np.allclose(agent.td_target(batch), plain)


class FarNoise(TD3Agent):
    sigma = 1e6


def test_the_noise_ends_at_its_limit_and_the_action_at_its_bounds(monkeypatch):
    agent, seen = FarNoise(Config(**CONFIG), 3, 1), []
    monkeypatch.setattr(agent, "_q", lambda obs, action, slow: seen.append(action))
    next_obs = next(batches(1)).next_obs
    agent.actor_target[-1][:] *= 4  # actions near the bounds, too
    agent.q_next(next_obs)
    greedy = agent.actions(next_obs, slow=True)
    assert (np.abs(greedy) > 0.5).any() and (np.abs(seen[0]) == 1).any()
    expected = np.stack([(greedy + x).clip(-1, 1) for x in (-0.5, 0.5)])
    assert (np.isclose(seen[0], expected).any(axis=0)).all()
    assert (seen[0] > greedy).any() and (seen[0] < greedy).any()


def test_who_measures_on_the_way_changes_nothing():
    quiet, asked = (TD3Agent(Config(**CONFIG), 3, 1) for _ in range(2))
    for batch in batches(5):
        first = asked.q_next(batch.next_obs)
        np.testing.assert_array_equal(first, asked.q_next(batch.next_obs))
        quiet.update(batch)
        asked.update(batch)
    np.testing.assert_array_equal(quiet.theta, asked.theta)


@pytest.mark.parametrize("wrong", [
    dict(algorithm="DN-DDPG"), dict(target_every=1), dict(backend="torch")])
def test_another_config_is_refused(wrong):
    config = Config(**CONFIG | dict(target_every=2, steps=50) | wrong)
    with pytest.raises(ValueError, match="TD3 is DCN-DDPG|'numpy' for a TD3Agent"):
        TD3Training(config)


def test_a_resumed_training_goes_on_bit_for_bit(tmp_path):
    config = Config("Pendulum-v1", "DCN-DDPG", steps=600, warmup=100, hidden=(16, 16),
                    batch_size=32, target_every=2)
    whole = TD3Training(config)
    records = [record for record in whole if record.kind == "episode"]
    first = TD3Training(config)
    for record in first:
        if record.step >= 250:  # in the middle of the second episode
            break
    first.save(tmp_path / "half.npz")
    second = TD3Training.load(tmp_path / "half.npz")
    rest = [record for record in second if record.kind == "episode"]
    assert second.updates == 500 and second.agent.actor_updates == 250
    np.testing.assert_array_equal(second.agent.theta, whole.agent.theta)
    assert [r.episode_return for r in rest] == [r.episode_return for r in records[-2:]]
