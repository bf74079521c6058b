"""A rule, an agent, a task of one's own: what a reader adds, the file unchanged."""

import contextlib
import re
import textwrap
import types
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dnddpg_minimal import (
    Batch,
    Config,
    NumpyAgent,
    TorchAgent,
    Training,
    bias,
    choose_actor,
    make_env,
    next_value,
)

PENDULUM = dict(task="Pendulum-v1", hidden=(8, 8), batch_size=8, warmup=20, steps=300)


class Largest(NumpyAgent):
    """The largest of all numbers: as far as one can be from the config's rule."""

    def next_value(self, q_next):
        return q_next.max(axis=(0, 1))


class Delayed(NumpyAgent):
    """The actors climb at every second update."""

    def update(self, batch, climb=True):
        return super().update(batch, climb and self.updates % 2 == 1)


class DelayedTorch(TorchAgent):
    """The same for PyTorch."""

    def update(self, batch, climb=True):
        return super().update(batch, climb and self.updates % 2 == 1)


class LargestTraining(Training):
    agent_class = Largest


def batches(n=40, size=16):
    rng = np.random.default_rng(0)
    for _ in range(n):
        yield Batch(rng.normal(size=(size, 3)), rng.uniform(-1, 1, (size, 1)),
                    rng.normal(size=size), rng.normal(size=(size, 3)), np.zeros(size))


def test_a_rule_of_ones_own_reaches_the_target_and_both_instruments():
    config = Config(**PENDULUM, gamma=0.9)
    own, plain = Largest(config, 3, 1), NumpyAgent(config, 3, 1)
    (batch,) = batches(1)
    q_next = plain.q_next(batch.next_obs)
    expected = batch.reward + 0.9 * q_next.max(axis=(0, 1))
    assert np.allclose(own.td_target(batch), expected)
    assert not np.allclose(plain.td_target(batch), expected)

    delta = bias.measure_operator(own, batch.obs)["delta"]
    q = own.q_next(batch.obs).astype(float)
    assert np.isclose(delta, q.max(axis=(0, 1)).mean() - q.mean())

    world = bias.dynamics(config)
    states = world.reset(np.random.default_rng(0), 5)
    found = bias.take_apart(own, world, states)["delta"][0]  # at the first states
    obs = world.observe(states)
    q = np.stack([own.q_values(obs, a) for a in own.actions(obs)], axis=1)  # (C, K, N)
    mean = q.mean(axis=0)[choose_actor(q, "paired"), np.arange(5)]
    assert np.allclose(found, q.max(axis=(0, 1)) - mean, atol=1e-5)


def test_td_target_of_one_value_is_that_value_under_every_rule():
    """The agent hands its value on as (1, 1, B): no rule may change it."""
    q_next = np.random.default_rng(0).normal(size=(1, 1, 7))
    for rule in ("max_min", "single", "paired_min", "selected", "soft"):
        assert np.allclose(next_value(q_next, rule), q_next[0, 0])


def test_a_training_with_an_agent_of_its_own_resumes_bit_for_bit(tmp_path):
    config = Config(**PENDULUM)
    whole = LargestTraining(config)
    assert type(whole.agent) is Largest
    for record in whole:
        if record.kind == "episode" and record.step == 200:
            whole.save(tmp_path / "run.npz")
    again = LargestTraining.load(tmp_path / "run.npz")
    assert type(again.agent) is Largest and again.step == 200
    for _ in again:
        pass
    assert np.array_equal(again.agent.theta, whole.agent.theta)


def test_a_plain_training_does_not_go_on_with_another_agents_run(tmp_path):
    LargestTraining(Config(**PENDULUM)).save(tmp_path / "run.npz")
    with pytest.raises(ValueError, match="LargestTraining and Largest, and this is Tr"):
        Training.load(tmp_path / "run.npz")


def test_a_plain_training_does_not_go_on_with_another_trainings_run(tmp_path):
    """Even if the agent is the same: a Training may store or explore otherwise."""
    class Bold(Training):
        def _explore(self, obs):
            return np.sign(super()._explore(obs))

    Bold(Config(**PENDULUM)).save(tmp_path / "run.npz")
    assert Bold.load(tmp_path / "run.npz").step == 0
    with pytest.raises(ValueError, match="it is of Bold and NumpyAgent, and this"):
        Training.load(tmp_path / "run.npz")


def test_a_numpy_agent_of_ones_own_does_not_stand_in_for_pytorch(tmp_path):
    with pytest.raises(ValueError, match="backend='torch'.*'numpy' for a Largest"):
        LargestTraining(Config(**PENDULUM, backend="torch"))


def test_actors_that_climb_more_rarely_have_a_step_count_of_their_own(tmp_path):
    """Adam corrects its moments by its own number of steps, not by the critics'."""
    pytest.importorskip("torch")
    config = Config(**PENDULUM, dtype="float64")
    mine, torchs = Delayed(config, 3, 1), DelayedTorch(config, 3, 1)
    for i, batch in enumerate(batches()):
        mine.update(batch)
        torchs.update(batch)
        if i == 20:  # and a file keeps it
            torchs.save(tmp_path / "agent.npz")
            torchs = DelayedTorch.load(tmp_path / "agent.npz")
    for agent in (mine, torchs):
        assert (agent.updates, agent.actor_updates) == (40, 20)
    assert np.abs(mine.theta - torchs.arrays()["theta"]).max() < 1e-9


def test_the_first_step_of_a_late_climb_is_as_long_as_adams_first_step():
    agent = Delayed(Config(**PENDULUM, dtype="float64"), 3, 1)
    (first, second) = batches(2)
    agent.update(first)
    before = agent.theta[agent.split:].copy()
    agent.update(second)
    moved = np.abs(agent.theta[agent.split:] - before)
    assert np.isclose(moved.max(), agent.config.actor_lr, rtol=1e-3)


def test_a_file_from_before_the_actors_counted_counts_as_if_they_always_climbed():
    agent = NumpyAgent(Config(**PENDULUM), 3, 1)
    old = agent.arrays() | dict(updates=7)
    del old["climbs"]
    agent.set_arrays(old)
    assert (agent.updates, agent.actor_updates) == (7, 7)


class Strict(gym.Env):
    """A task that looks at its actions: are they of its space, and of its dtype?"""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Box(np.float32([-1, 0]), np.float32([3, 0.7]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), (action, action.dtype)
        return np.zeros(2, np.float32), float(action.sum()), False, False, {}


def test_a_task_that_checks_its_actions_gets_them_in_its_own_dtype():
    gym.register("Strict-v0", entry_point=Strict, max_episode_steps=20)
    try:
        training = Training(Config("Strict-v0", hidden=(8,), batch_size=8, warmup=20,
                                   steps=60, sigma=2.0, evaluate_every=30))
        for record in training:
            if record.kind == "grid":
                bias.evaluate(training)
        assert training.finished
    finally:
        gym.registry.pop("Strict-v0")


class NoPictures(gym.Env):
    """A task whose maker never thought of pictures: no `render_mode`."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self):
        pass

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}


def test_a_task_without_render_mode_can_be_made():
    gym.register("NoPictures-v0", entry_point=NoPictures, max_episode_steps=10)
    try:
        env = make_env(Config("NoPictures-v0"))
        env.reset(seed=0)
        with pytest.raises(ValueError, match="NoPictures"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's, before the refusal
            make_env(Config("NoPictures-v0"), render_mode="rgb_array")
    finally:
        del gym.registry["NoPictures-v0"]


def test_the_closed_forms_refuse_what_they_do_not_know():
    for numbers in (dict(critics=5), dict(actors=3)):
        with pytest.raises(ValueError, match="two of each"):
            bias.predict(1.0, 0.5, 0.5, "max_min", **numbers)
    with pytest.raises(ValueError, match="no limit"):
        bias.accumulated(0.1, 1.0)
    assert np.isclose(bias.accumulated(0.1, 1.0, ends=0.5), 0.1)


GUIDE = Path(__file__).parents[1] / "CONTRIBUTING.md"
RULE, THEIRS = map(textwrap.dedent, re.findall(
    r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL))


def test_the_rule_in_contributing_runs(capsys):
    exec(RULE, {})
    assert abs(float(capsys.readouterr().out.split()[-1])) < 1e-5


def test_somebody_elses_critics_in_contributing_are_measured():
    pytest.importorskip("stable_baselines3", reason="needs the extra dev")
    exec(THEIRS.replace("10_000", "200"), names := {})
    rows = [row for row in names["found"].bias if row["states"] == "start"]
    assert [row["critic"] for row in rows] == ["0", "1", "min"]
    assert all(row["n"] == 100 and abs(row["bias"]) > 1 for row in rows)


@pytest.mark.parametrize("task", ["Pendulum-v1", "Hopper-v5"])
def test_an_agent_that_answers_three_calls_is_measured(task):
    """What CONTRIBUTING asks of somebody else's agent, and no more."""
    config = Config(task, critics=2, actors=1)
    with contextlib.closing(make_env(config)) as env:
        (obs_dim,), (width,) = env.observation_space.shape, env.action_space.shape

    class Theirs:
        def __init__(self):
            self.config, self.obs_dim = config, obs_dim

        def act(self, obs):
            return np.zeros((len(obs), width)) if np.ndim(obs) == 2 else np.zeros(width)

        def actions(self, obs, slow=False):
            return self.act(obs)[None]

        def q_values(self, obs, action):
            return np.array([[5.0], [7.0]]).repeat(len(obs), axis=1)

    found = bias.evaluate(types.SimpleNamespace(
        config=config, agent=Theirs(), step=10, updates=10, kept=[]))
    at = "start" if task == "Pendulum-v1" else "on_policy"
    rows = {row["critic"]: row for row in found.bias if row["states"] == at}
    assert {name: row["q"] for name, row in rows.items()} == {"0": 5, "1": 7, "min": 5}
    for row in rows.values():
        assert np.isclose(row["bias"], row["q"] - row["truth"])


class InPlace(gym.Env):
    """A task that hands out its own state, and changes it in place."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.own = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.out(), {}

    def step(self, action):
        self.own += 0.1 * float(action[0])
        return self.out(), float(self.own.sum()), False, False, {}

    def out(self):
        return self.own


class Copying(InPlace):
    def out(self):
        return self.own.copy()


class Untouched(gym.Wrapper):
    """A wrapper that changes nothing; Gymnasium puts it around the time limit."""


def registered(name, task, **options):
    if name not in gym.registry:
        gym.register(name, task, max_episode_steps=50, **options)
    return Training(Config(name, "DDPG", steps=200, warmup=100, hidden=(8,),
                           batch_size=8))


def test_a_task_that_changes_its_own_observation_in_place_is_learned_as_any_other():
    found = []
    for name, task in (("InPlace-v0", InPlace), ("Copying-v0", Copying)):
        training = registered(name, task)
        list(training)
        obs, *_ = bias.walk(training.env, training.agent.act, seed=0, steps=50)
        found.append((*(array.copy() for array in training.replay.arrays), obs))
    for mine, theirs in zip(*found, strict=True):
        assert np.array_equal(mine, theirs)
    assert not np.array_equal(found[0][0], found[0][3])  # obs, next_obs


def test_the_truth_looks_past_a_time_limit_inside_another_wrapper():
    wrapper = (gym.envs.registration.WrapperSpec("Untouched", f"{__name__}:Untouched",
                                                 {}),)
    truths = []
    for name, options in (("Plain-v0", {}),
                          ("Wrapped-v0", dict(additional_wrappers=wrapper))):
        training = registered(name, Copying, **options)
        list(training)
        row, *_ = bias.evaluate(training, full=False).bias
        truths.append((row["truth"], row["n"]))
    assert truths[0] == truths[1] and truths[0][1] == 10


@pytest.mark.parametrize("task, repeats", [("Hopper-v5", True), ("Ant-v5", False)])
def test_kept_states_that_cannot_be_put_back_have_no_truth(task, repeats):
    training = Training(Config(task, "DDPG", steps=400, warmup=300, hidden=(8,),
                               batch_size=8))
    list(training)
    found = bias.evaluate(training, full=True)
    kept = [row["truth"] for row in found.bias if row["states"] == "recent"]
    assert kept and np.isfinite(kept).all() == repeats
    assert bias.Simulator(training.config).repeats() == repeats


def test_actions_that_are_whole_numbers_are_refused():
    class Whole(InPlace):
        action_space = gym.spaces.Box(-128, 127, (1,), np.int8)

    with pytest.raises(ValueError, match="int8"):
        registered("Whole-v0", Whole)


def test_a_correlation_a_rounding_above_one_predicts_as_one():
    above = np.nextafter(1.0, 2)
    assert bias.predict(1.0, above, above, "max_min") == bias.predict(
        1.0, 1.0, 1.0, "max_min")
