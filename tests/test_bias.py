"""The instrument that says how wrong a critic is, tested where the answer is known."""

import types

import gymnasium as gym
import numpy as np
import pytest

from dnddpg_minimal import (
    Config,
    Training,
    arm,
    make_agent,
    make_env,
    next_value,
    probes,
    stream,
    td_target,
    to_env,
)
from dnddpg_minimal import bias as instrument
from dnddpg_minimal.dnddpg import PROBE_TASKS, simulator_state

pytestmark = pytest.mark.slow

EQUATIONS = ["Pendulum-v1", "MountainCarContinuous-v0", "ArmEasy-v0", "ArmHard-v0"]
MUJOCO = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5"]


class FakeAgent:
    """A hand-made policy (obs -> action) with a hand-made Q (obs, action -> (C, B))."""

    def __init__(self, config, policy, q):
        self.config, self.policy, self.q_values = config, policy, q
        self.obs_dim = make_env(config).observation_space.shape[0]

    def act(self, obs):
        action = self.policy(np.atleast_2d(obs))
        return action if np.ndim(obs) == 2 else action[0]

    def actions(self, obs, slow=False):
        return np.repeat(self.act(obs)[None], self.config.actors, axis=0)

    def q_next(self, obs):
        q = self.q_values(obs, self.act(obs))  # (C, B)
        return np.repeat(q[:, None], self.config.actors, axis=1)

    def next_value(self, q_next):
        return next_value(q_next, self.config.target_rule, self.config.nu)


def fake_training(agent, kept=(), step=1000):
    return types.SimpleNamespace(
        config=agent.config, agent=agent, step=step, updates=0, kept=list(kept)
    )


def swing(obs):
    """A policy for any number of observations: no learning, no branch."""
    return np.tanh(obs.sum(axis=1, keepdims=True)) * 0.9


def random_states(world, rng, n):
    """States anywhere in the ranges that a picture shows; whole counters."""
    states = rng.uniform(world.low, world.high, (n, len(world.low)))
    if len(world.low) == 5:
        states[:, 4] = rng.integers(0, 60, n)
    return states


def keep(world, rng, n):
    """What Training keeps, at random states of a task with equations."""
    states = random_states(world, rng, n)
    action = rng.uniform(-1, 1, (n, world.space.shape[0])).astype(np.float32)
    obs = world.observe(states)
    return [
        {"step": 0, "state": s, "xipos": np.empty((0, 3)), "obs": o, "action": a}
        for s, o, a in zip(states, obs, action, strict=True)
    ]


# --- The tasks' equations ---


@pytest.mark.parametrize(
    "task, options",
    [
        ("Pendulum-v1", {}),
        ("Pendulum-v1", {"g": 9.81}),
        ("MountainCarContinuous-v0", {}),
        ("ArmEasy-v0", {}),
        ("ArmHard-v0", {"reward": "distance_and_bonus", "success_terminates": True}),
    ],
)
def test_the_equations_agree_with_the_task_in_one_step_from_10_000_states(
    task, options
):
    world = instrument.dynamics(Config(task, task_options=options))
    env = make_env(Config(task, task_options=options))
    rng = np.random.default_rng(1)
    states = random_states(world, rng, 10_000)
    action = rng.uniform(-1, 1, (10_000, world.space.shape[0])).astype(np.float32)
    action[:1000] = np.sign(action[:1000])  # the ends of the range, too
    found_states, found_reward, found_end = world.step(states, action)
    found_obs = world.observe(found_states)
    env.reset(seed=0)
    task, seen = env.unwrapped, []
    for n, in_units in enumerate(to_env(action, env.action_space)):
        task.state = states[n]
        obs, reward, terminated, _, _ = task.step(in_units)
        seen.append((obs, task.state, reward, terminated))
    obs, after, reward, terminated = (
        np.array(part) for part in zip(*seen, strict=True)
    )
    assert np.allclose(found_obs, obs, rtol=0, atol=1e-6)
    assert np.allclose(found_states, after, rtol=0, atol=1e-6)
    assert np.allclose(found_reward, reward, rtol=0, atol=1e-6)
    assert np.array_equal(found_end, terminated)
    assert found_obs.dtype == np.float32
    can_end = "goal_position" in vars(task) or options.get("success_terminates")
    assert terminated.any() == bool(can_end)


@pytest.mark.parametrize("task", EQUATIONS)
def test_starts_are_the_tasks_own_and_their_observations_too(task):
    config = Config(task)
    world = instrument.dynamics(config)
    states = world.reset(np.random.default_rng(3), 5)
    env = make_env(config)
    for n, seed in enumerate(np.random.default_rng(3).integers(2**31, size=5)):
        obs, _ = env.reset(seed=int(seed))
        assert np.allclose(world.observe(states[n : n + 1])[0], obs, atol=1e-7)


@pytest.mark.parametrize("task", EQUATIONS)
def test_the_return_is_that_of_an_episode_with_its_time_limit(task):
    config = Config(task)
    world = instrument.dynamics(config)
    width = world.space.shape[0]
    policy = lambda obs: np.full((len(obs), width), 0.3, np.float32)  # noqa: E731
    states = world.reset(np.random.default_rng(5), 3)
    found = instrument.rollout(world, states, policy, 0.99)
    env = make_env(config)
    for n, seed in enumerate(np.random.default_rng(5).integers(2**31, size=3)):
        env.reset(seed=int(seed))
        total, over = 0.0, False
        while not over:
            step = env.step(to_env(np.full(width, 0.3, np.float32), env.action_space))
            total, over = total + step[1], step[2] or step[3]
        assert found["returns"][n] == pytest.approx(total, abs=1e-2)


def test_the_truth_goes_on_beyond_the_time_limit():
    config = Config("Pendulum-v1")
    world = instrument.dynamics(config)
    hang = np.array([[np.pi, 0.0]])  # at rest at the bottom: -pi^2 a step, for ever
    policy = lambda obs: np.zeros((len(obs), 1))  # noqa: E731
    found = instrument.rollout(world, hang, policy, 0.99)
    assert found["returns"][0] == pytest.approx(-(np.pi**2) * 200, rel=1e-6)
    assert found["truth"][0] == pytest.approx(
        -(np.pi**2) * (1 - 0.99**500) / 0.01, rel=1e-6
    )
    endless = -(np.pi**2) / 0.01
    assert found["truth"][0] - endless == pytest.approx(found["tail"], rel=1e-6)


def test_a_small_discount_cuts_the_truth_and_not_the_return():
    world = instrument.dynamics(Config("Pendulum-v1"))
    hang = np.array([[np.pi, 0.0]])
    found = instrument.rollout(world, hang, lambda obs: np.zeros((len(obs), 1)), 0.5)
    assert found["returns"][0] == pytest.approx(-(np.pi**2) * 200, rel=1e-6)
    assert found["truth"][0] == pytest.approx(-(np.pi**2) * 2, rel=1e-6)


def test_a_terminal_state_has_value_zero():
    world = instrument.dynamics(Config("MountainCarContinuous-v0"))
    before_the_goal = np.array([[0.449, 0.05], [-0.5, 0.0]])
    policy = lambda obs: np.ones((len(obs), 1))  # noqa: E731
    found = instrument.rollout(world, before_the_goal, policy, 0.99)
    assert found["truth"][0] == found["returns"][0] == pytest.approx(100 - 0.1)
    assert found["ended"].tolist() == [True, False]
    # The other row goes on alone: -0.1 a step.
    assert found["truth"][1] == pytest.approx(-0.1 * (1 - 0.99**999) / 0.01)


def test_on_the_arm_success_ends_the_return_and_not_the_truth():
    config = Config("ArmEasy-v0")
    world = instrument.dynamics(config)
    states = world.reset(np.random.default_rng(0), 20)
    found = {}
    for option in (False, True):
        terminates = Config("ArmEasy-v0", task_options={"success_terminates": option})
        world = instrument.dynamics(terminates)
        rows = {"states": states}

        def policy(obs, rows=rows, world=world):
            # The reference needs states: follow them beside the rollout.
            states = rows["states"]
            action = arm.reference_action(states)
            after = world.step(states, action)
            rows["states"] = after[0][~after[2]]
            return action

        found[option] = instrument.rollout(world, states, policy, 0.95)
    on, end = found[False], found[True]
    assert on["success"].all() and end["success"].all()
    assert end["ended"].all() and not on["ended"].any()
    assert np.allclose(on["returns"], end["returns"])
    steps = arm.reference_steps(states)
    assert np.array_equal(on["steps_to_goal"], steps)
    # It stays near the centre: what the truth still holds after success is small.
    assert (np.abs(on["truth"] - end["truth"]) < 0.1).all()


# --- The instrument finds what was planted ---


@pytest.mark.parametrize("task", EQUATIONS[:3])
def test_a_planted_bias_of_3_is_found(task):
    config = Config(task, "DCN-DDPG", gamma=0.98, steps=1000)
    world = instrument.dynamics(config)

    def policy(obs):
        return np.repeat(swing(obs), world.space.shape[0], axis=1)

    def q(obs, action):
        # The truth, from the observation alone, with a horizon twice as long.
        if task == "Pendulum-v1":
            states = np.array([np.arctan2(obs[:, 1], obs[:, 0]), obs[:, 2]]).T
        elif task == "MountainCarContinuous-v0":
            states = obs.astype(np.float64)
        else:
            elbow, finger = obs[:, :2] * 2.0, (obs[:, 2:4] - obs[:, :2]) * 2.0
            first = np.arctan2(elbow[:, 1], elbow[:, 0])
            second = np.arctan2(finger[:, 1], finger[:, 0]) - first
            goal = obs[:, 6:8] * 400 + obs[:, 2:4] * 200 + 200
            states = np.column_stack([first, second, goal, np.zeros(len(obs))])
        args = (world, states, policy, 0.98, 2 * world.steps, action)
        truth = instrument.rollout(*args)["truth"]
        return np.array([truth + 3.0, truth + 5.0])

    agent = FakeAgent(config, policy, q)
    kept = keep(world, np.random.default_rng(7), 64)
    found = instrument.evaluate(fake_training(agent, kept))
    rows = {(r["states"], r["action"], r["critic"]): r for r in found.bias}
    assert len(rows) == len(found.bias) == 9
    for states, action in (
        ("start", "policy"),
        ("recent", "policy"),
        ("recent", "replay"),
    ):
        for critic, planted in ("0", 3.0), ("1", 5.0), ("min", 3.0):
            row = rows[states, action, critic]
            error = abs(row["bias"] - planted)
            assert error <= 4 * row["standard_error"] + found.tail + 1e-4
            assert row["bias"] == pytest.approx(row["q"] - row["truth"])
            assert row["n"] == (100 if states == "start" else 60)
    # The critics differ by a constant: one error. The constant itself is no sigma.
    assert found.operator["delta"] == pytest.approx(-1.0, abs=1e-4)
    assert found.operator["sigma"] < 0.3


def test_bias_is_measured_under_both_rules_where_there_are_two_actors():
    training = Training(
        Config("Pendulum-v1", steps=400, warmup=100, evaluate_every=400)
    )
    for _ in training:
        pass
    rows = instrument.evaluate(training).bias
    both = [r for r in rows if (r["states"], r["action"]) == ("start", "policy")]
    assert [r["rule"] for r in both] == ["paired"] * 3 + ["max_min"] * 3
    assert len({tuple(r) for r in rows}) == 1  # the same columns in each row
    # Under max_min nobody's min is higher: its q is at least that of paired.
    assert both[5]["q"] >= both[2]["q"]
    few = instrument.evaluate(training, full=False)
    assert {r["rule"] for r in few.bias} == {"paired"}
    assert np.isnan(few.operator["sigma"]) and np.isfinite(few.operator["delta"])


def test_the_other_rule_is_that_of_an_agent_with_this_rule():
    obs = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    agents = {}
    for rule in ("paired", "max_min", "first"):
        agents[rule] = make_agent(Config("Pendulum-v1", act_rule=rule), 3, 1)
    for rule, agent in agents.items():
        policy = instrument.greedy(agents["first"], rule)
        assert np.allclose(policy(obs), agent.act(obs), atol=1e-6)


# --- Purity ---


def test_evaluate_is_pure_and_leaves_the_training_alone():
    config = Config("Pendulum-v1", "DDPG", steps=400, warmup=100, evaluate_every=200)
    alone = [record for record in Training(config)]
    training = Training(config)
    looked_at = []
    for record in training:
        looked_at.append(record)
        if record.kind == "grid":
            first = instrument.evaluate(training, full=True)
            again = instrument.evaluate(training, full=True)
            assert repr(first) == repr(again)
    assert repr(alone) == repr(looked_at)


def test_evaluation_starts_depend_on_seed_and_step_only():
    def starts(seed, step):
        rng = stream(seed, "evaluation", step)
        return instrument.dynamics(Config("Pendulum-v1")).reset(rng, 4)

    assert np.array_equal(starts(0, 1000), starts(0, 1000))
    assert not np.array_equal(starts(0, 1000), starts(0, 2000))
    assert not np.array_equal(starts(0, 1000), starts(1, 1000))


def test_without_kept_states_the_rows_are_there_and_say_n_0():
    agent = make_agent(Config("Pendulum-v1"), 3, 1)
    found = instrument.evaluate(fake_training(agent), full=True)
    recent = [r for r in found.bias if r["states"] == "recent"]
    assert all(r["n"] == 0 and np.isnan(r["bias"]) for r in recent) and recent
    assert np.isnan(found.operator["delta"])


@pytest.mark.parametrize(
    "steps, every, expected",
    [
        (100_000, 5_000, [25_000, 50_000, 75_000, 100_000]),
        (50_000, 5_000, [15_000, 25_000, 40_000, 50_000]),
        (1_000, 1_000, [1_000]),
    ],
)
def test_kept_states_are_measured_four_times_in_a_run(steps, every, expected):
    config = Config("HalfCheetah-v5", steps=steps, evaluate_every=every)
    grid = range(every, steps + 1, every)
    found = [step for step in grid if instrument._reaches_a_quarter(config, step)]
    assert found == expected


# --- MuJoCo ---


@pytest.mark.parametrize("task", MUJOCO)
def test_a_kept_state_repeats_100_steps_bit_for_bit_in_a_dirtied_simulator(task):
    config = Config(task)
    env = make_env(config)
    width = env.action_space.shape[0]
    rng = np.random.default_rng(0)
    action = rng.uniform(-1, 1, (130, width)).astype(np.float32)
    obs, _ = env.reset(seed=4)
    kept, seen = [], []
    for t in range(130):  # on beyond a fall: only the physics counts here
        if t in (3, 17, 30):
            state, xipos = simulator_state(env)
            kept.append({"state": state, "xipos": xipos, "obs": np.float32(obs)})
        obs, reward, terminated, _, _ = env.unwrapped.step(
            to_env(action[t], env.action_space)
        )
        seen.append((obs, reward, terminated))

    world = instrument.Simulator(config)
    for _ in range(7):  # dirt
        world.task.step(to_env(rng.uniform(-1, 1, width), world.space))
    states = world.pack(kept)
    for k in range(3):
        assert np.array_equal(world.observe(states)[k], kept[k]["obs"])
    # In lock-step: one simulator takes the three states in turn, each step.
    for t in range(100):
        now = np.array([action[start + t] for start in (3, 17, 30)])
        states, reward, terminated = world.step(states, now)
        for k, start in enumerate((3, 17, 30)):
            expected = seen[start + t]
            assert np.array_equal(states[k, world.cuts[1] :], expected[0])
            assert reward[k] == expected[1] and terminated[k] == expected[2]


def test_the_truth_of_a_kept_state_is_what_followed_in_its_own_episode():
    config = Config("Hopper-v5", steps=4)
    agent = make_agent(config, 11, 3)
    env = make_env(config)
    obs, _ = env.reset(seed=0)
    kept, rewards, terminated = [], [], False
    while not terminated:
        state, xipos = simulator_state(env)
        action = agent.act(np.float32(obs))
        row = {"state": state, "xipos": xipos, "obs": np.float32(obs), "action": action}
        kept.append(row)
        step = env.step(to_env(action, env.action_space))
        obs, terminated = step[0], step[2]
        rewards.append(step[1])
    followed = instrument.discounted(rewards, config.gamma)
    found = instrument._truth_of_kept(
        agent, kept[:8], {"replay": np.array([k["action"] for k in kept[:8]])}
    )
    assert np.allclose(found["replay"], followed[:8], rtol=1e-5)


def test_mujoco_evaluates_5_episodes_and_the_kept_states_when_it_is_time():
    config = Config("Hopper-v5", "DDPG", steps=800, warmup=800, evaluate_every=400)
    training = Training(config)
    for record in training:
        if record.kind == "grid" and record.step == 400:
            break
    few = instrument.evaluate(training, full=False)
    assert {(r["states"], r["action"]) for r in few.bias} == {("on_policy", "policy")}
    assert few.evaluation["n"] == few.bias[0]["n"] == 5
    full = instrument.evaluate(training)
    assert full.bias[: len(few.bias)] == few.bias
    recent = full.bias[len(few.bias) :]
    assert [r["action"] for r in recent] == ["policy"] * 2 + ["replay"] * 2
    assert all(r["n"] == len(training.kept) and np.isfinite(r["bias"]) for r in recent)
    assert repr(instrument.evaluate(training)) == repr(full)


# --- Any other task, and the probes ---


class Clock(gym.Env):
    """Reward 1 for ever; no state that could be put back."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 1.0, False, False, {}


def test_on_any_other_task_only_the_on_policy_truth_is_known():
    gym.register("ClockForBias-v0", entry_point=Clock, max_episode_steps=20)
    try:
        config = Config("ClockForBias-v0", "DDPG")
        q = lambda obs, action: np.full((1, len(obs)), 103.0)  # noqa: E731
        agent = FakeAgent(config, lambda obs: np.zeros((len(obs), 1)), q)
        kept = [{"obs": np.zeros(1), "action": np.zeros(1), "state": np.empty(0)}] * 3
        found = instrument.evaluate(fake_training(agent, kept))
    finally:
        gym.registry.pop("ClockForBias-v0")
    assert (found.evaluation["mean"], found.evaluation["n"]) == (20.0, 10)
    on_policy, recent = found.bias[0], found.bias[2]
    assert (on_policy["states"], on_policy["n"]) == ("on_policy", 10)
    # Endless, the clock is worth 1 / (1 - gamma) = 100: bias +3, tail 0.7 % of 100.
    assert on_policy["bias"] == pytest.approx(3.0, abs=found.tail)
    assert found.tail == pytest.approx(100 * 0.99**500)
    assert recent["states"] == "recent" and recent["q"] == 103.0
    assert np.isnan(recent["truth"]) and np.isnan(recent["bias"])


class Late(Clock):
    """Pays only from its 21st step on: no episode of 20 steps ever sees it."""

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return super().reset(seed=seed)

    def step(self, action):
        self.t += 1
        return np.zeros(1, np.float32), float(self.t > 20), False, False, {}


def test_only_states_before_the_time_limit_count_and_what_follows_is_their_truth():
    gym.register("LateForBias-v0", entry_point=Late, max_episode_steps=20)
    try:
        config = Config("LateForBias-v0", "DDPG")
        q = lambda obs, action: np.zeros((1, len(obs)))  # noqa: E731
        agent = FakeAgent(config, lambda obs: np.zeros((len(obs), 1)), q)
        found = instrument.evaluate(fake_training(agent))
    finally:
        gym.registry.pop("LateForBias-v0")
    assert found.evaluation["mean"] == 0.0
    # From state t, 20 - t unpaid steps, then 1 for ever: 0.99^(20 - t) / 0.01
    truth = np.mean([0.99 ** (20 - t) / 0.01 for t in range(20)])
    assert found.bias[0]["truth"] == pytest.approx(truth, abs=found.tail)
    beyond = np.mean([0.99 ** max(20 - t, 0) / 0.01 for t in range(500)])
    assert abs(beyond - truth) > 2 * found.tail  # were later states counted, too


@pytest.mark.parametrize("task", PROBE_TASKS[:4])
def test_on_a_probe_the_measured_error_of_trained_critics_is_the_closed_form(task):
    config = Config(task, "DCN-DDPG", steps=900, warmup=300)
    training = Training(config)
    for _ in training:
        pass
    found = instrument.evaluate(training, full=True)
    world = instrument.dynamics(config)
    obs = world.observe(world.reset(stream(0, "evaluation", 900), 100))
    check_against_closed_form(world.task, training.agent, obs, found, "start", "policy")
    obs = np.array([k["obs"] for k in training.kept])
    check_against_closed_form(
        world.task, training.agent, obs, found, "recent", "policy"
    )
    replayed = np.array([k["action"] for k in training.kept])
    check_against_closed_form(
        world.task, training.agent, obs, found, "recent", "replay", replayed
    )


def check_against_closed_form(
    task, agent, obs, found, states, action_name, action=None, gain=None
):
    action = agent.act(obs) if action is None else action
    error = agent.q_values(obs, action) - task.true_q(
        obs, action, agent.config.gamma, gain
    )
    rows = [
        r for r in found.bias if (r["states"], r["action"]) == (states, action_name)
    ]
    assert len(rows) == len(error) + 1 == 3
    for row, expected in zip(rows, error.mean(axis=1), strict=False):
        margin = 4 * row["standard_error"] + found.tail + 1e-5
        assert abs(row["bias"] - expected) <= margin
        assert row["n"] == len(obs)


def test_on_the_linear_quadratic_probe_the_truth_is_riccatis():
    config = Config("LinearQuadratic-v0", "DCN-DDPG", steps=100)
    world = instrument.dynamics(config)
    gain, _ = probes.riccati(config.gamma)
    critic = make_agent(config, 2, 1)  # any Q will do: the truth is what is tested
    agent = FakeAgent(config, lambda obs: obs @ gain.T, critic.q_values)
    found = instrument.evaluate(fake_training(agent, step=100))
    states = world.reset(stream(0, "evaluation", 100), 100)
    obs = world.observe(states)
    check_against_closed_form(world.task, agent, obs, found, "start", "policy")
    truth = instrument.true_q(world, states, agent.act(obs), agent)
    closed = world.task.true_q(obs, agent.act(obs), config.gamma, gain)
    assert np.allclose(truth, closed, rtol=1e-4)
    picture = instrument.plane(agent, world, "position", "velocity", size=3)
    x, y = picture["x"][2], picture["y"][0]
    obs = np.array([[x, y]], np.float32)
    closed = world.task.true_q(obs, agent.act(obs), config.gamma, gain)
    assert picture["truth"][0, 2] == pytest.approx(closed[0], rel=1e-4)


def test_a_trained_agents_bias_there_is_that_of_steps_made_by_hand():
    config = Config("LinearQuadratic-v0", "DCN-DDPG", steps=900, warmup=300)
    training = Training(config)
    for _ in training:
        pass
    agent, found = training.agent, instrument.evaluate(training)
    world, task = instrument.dynamics(config), probes.LinearQuadratic
    states = world.reset(stream(0, "evaluation", 900), 100)
    truth, now = np.zeros(100), states
    for step in range(200):  # 0.9^200 is nothing
        now, reward, _ = task.dynamics(now, agent.act(task.observe(now)))
        truth += config.gamma**step * reward
    obs = task.observe(states)
    bias = (agent.q_values(obs, agent.act(obs)) - truth).mean(axis=1)
    rows = [r for r in found.bias if (r["states"], r["action"]) == ("start", "policy")]
    assert np.allclose([row["bias"] for row in rows[:2]], bias, atol=1e-4)
    assert np.abs(bias).max() > 1e-3  # there is something to be found


# --- What the bias should be ---


def draw_errors(kappa, rho, n=400_000):
    """e[c, k]: (2, 2, n), correlated: kappa by critic, rho by action."""
    cov = np.kron([[1, kappa], [kappa, 1]], [[1, rho], [rho, 1]])
    rng = np.random.default_rng(11)
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0))
    return (root @ rng.standard_normal((4, n))).reshape(2, 2, n)


def b_of(rho):
    """B(rho) as the book prints it."""
    near = 1 / 4 + np.arcsin((1 + 3 * rho) / (3 + rho)) / (2 * np.pi)
    far = 1 / 4 + np.arcsin((1 - rho) / (3 + rho)) / (2 * np.pi)
    return (-2 + 2 * np.sqrt(1 - rho) * near + 4 * far) / np.sqrt(np.pi)


@pytest.mark.parametrize(
    "kappa, rho", [(0, 0), (0, 0.5), (0, 0.99), (0.5, 0), (0.3, 0.7), (-0.2, 0.4)]
)
@pytest.mark.parametrize(
    "rule", ["single", "paired_min", "max_min", "selected", "soft"]
)
def test_closed_forms_agree_with_sampling_through_td_target(rule, kappa, rho):
    q_next = 2.0 * draw_errors(kappa, rho)
    none = np.zeros(q_next.shape[2])
    y = td_target(none, none, q_next, 1.0, rule=rule, nu=0.1)
    mean, error, _ = instrument.summary(y)
    predicted = instrument.predict(2.0, kappa, rho, rule, nu=0.1)
    assert abs(predicted - mean) < 4 * error


@pytest.mark.parametrize("kappa, rho", [(0, 0), (0, 0.5), (0.5, 0), (0.3, 0.7)])
def test_closed_forms_of_the_maxima_agree_with_sampling(kappa, rho):
    e = draw_errors(kappa, rho)
    for sample, form in [
        (e[0].max(axis=0), instrument.max_of_two_actions(rho)),
        (e[[0, 1], [0, 1]].max(axis=0), instrument.paired_max(kappa, rho)),
        (e.max(axis=(0, 1)), instrument.max_of_all(kappa, rho)),
        (e.min(axis=(0, 1)), instrument.min_of_all(kappa, rho)),
    ]:
        mean, error, _ = instrument.summary(sample)
        assert abs(form - mean) < 4 * error


@pytest.mark.parametrize("rho", [0, 0.1, 0.5, 0.9, 0.99, 0.999999])
def test_max_min_is_b_of_rho_where_the_critics_are_independent(rho):
    assert instrument.max_min(0, rho) == pytest.approx(b_of(rho), abs=1e-9)
    both = -2 / np.sqrt(np.pi) - b_of(rho)
    assert instrument.min_of_all(0, rho) == pytest.approx(both, abs=1e-9)
    half = -(1 + rho) / (2 * np.sqrt(np.pi))
    assert instrument.selected(0, rho) == pytest.approx(half, abs=1e-9)


@pytest.mark.parametrize(
    "value, printed",
    [
        (instrument.max_of_two_actions(0), 0.564),
        (instrument.min_of_two_critics(0), -0.564),
        (instrument.min_of_two_critics(0.9), -0.178),
        (instrument.max_min(0, 0), -0.099),
        (instrument.max_min(0, 0.5), -0.212),
        (instrument.max_min(0, 0.9), -0.395),
        (instrument.max_min(0, 0.99), -0.509),
        (instrument.max_min(0, 1), -1 / np.sqrt(np.pi)),
        (instrument.max_min(0.1, 0), -0.059),
        (instrument.max_min(0.2, 0), -0.018),
        (instrument.max_min(0.25, 0), 0.003),
        (instrument.max_min(0.5, 0), 0.118),
        (instrument.selected(0, 0), -0.282),
        (instrument.selected(0, 0.99), -0.561),
        (instrument.soft(0, 0, 0.1), -0.192),
        (instrument.min_of_all(0, 0), -1.029),
    ],
)
def test_the_table_of_closed_forms(value, printed):
    assert value == pytest.approx(printed, abs=6e-4)


def test_fewer_networks_are_a_limit_of_the_closed_forms():
    nan = np.nan
    for rule in ("single", "paired_min", "max_min", "selected", "soft"):
        assert instrument.predict(5.0, nan, nan, rule) == pytest.approx(0, abs=1e-5)
        one_actor = instrument.predict(1.0, 0.3, nan, rule)
        assert one_actor == pytest.approx(-np.sqrt(0.7 / np.pi), abs=1e-5)
    one_critic = instrument.predict(1.0, nan, 0.3, "max_min")
    assert one_critic == pytest.approx(np.sqrt(0.7 / np.pi), abs=1e-5)
    with pytest.raises(ValueError, match="rule='max-min'.*max_min"):
        instrument.predict(1.0, 0.0, 0.0, "max-min")


def test_the_operators_numbers_are_found_in_planted_errors():
    n, truth = 4000, np.random.default_rng(0).normal(size=(2, 4000))
    e = 3.0 * draw_errors(0.3, 0.6, n)
    e += np.array([[10.0, -4.0], [2.0, 7.0]])[:, :, None]  # a mean of its own each
    config = Config("Pendulum-v1")
    agent = types.SimpleNamespace(
        config=config,
        q_next=lambda obs: truth + e,
        next_value=lambda q_next: next_value(q_next, config.target_rule),
        actions=lambda obs: np.array([np.zeros((n, 2)), np.full((n, 2), 0.3)]),
    )
    found = instrument.measure_operator(agent, np.zeros((n, 3)), truth)
    assert found["sigma"] == pytest.approx(3.0, rel=0.05)
    assert found["kappa"] == pytest.approx(0.3, abs=0.05)
    assert found["rho"] == pytest.approx(0.6, abs=0.05)
    assert found["actor_distance"] == pytest.approx(0.3 * np.sqrt(2))
    q = truth + e
    expected = np.mean(np.max(np.min(q, axis=0), axis=0)) - np.mean(q)
    assert found["delta"] == pytest.approx(expected)
    assert found["n"] == n


def test_a_delta_grows_and_a_debt_shrinks_by_the_targets_that_hold_a_slow_q():
    # A table of 1 000 transitions that all hold one number: 50 of them end the world.
    config, ends, delta = Config("Pendulum-v1", tau=0.05, gamma=0.9), 0.05, -0.3
    terminated = np.arange(1_000) < 50
    updates, offset, late = np.array([0, 400, 900]), 0.0, -7.0
    expected = [(offset, late)]
    for n in range(1, 901):
        for_each = np.where(terminated, 0, 0.9 * (offset + delta))  # of its target
        offset += 0.05 * (for_each.mean() - offset)
        late += 0.05 * (np.where(terminated, 0, 0.9 * late).mean() - late)
        if n in updates:
            expected.append((offset, late))
    grown = instrument.grown(updates, [delta] * 3, config, ends)
    owed = instrument.owed(updates, [7.0] * 3, config, ends)  # V_1 = 7, Q = 0
    assert np.allclose(grown, np.transpose(expected)[0], rtol=0.02)
    assert np.allclose(owed, np.transpose(expected)[1], rtol=0.02, atol=0.01)
    limit = instrument.accumulated(delta, 0.9, ends)
    assert np.isclose(grown[-1], limit, rtol=1e-2)
    assert abs(limit) < abs(instrument.accumulated(delta, 0.9))


def test_owed_is_what_dq_dn_leaves_behind():
    config = Config("Pendulum-v1", tau=0.05, gamma=0.9, target_every=3)
    updates = np.array([0, 600, 1500, 1501, 9000])
    values = np.array([-50.0, 20.0, 40.0, 35.0, 90.0])
    found = instrument.owed(updates, values, config)
    q, value, expected = 0.0, 0.0, []
    parts = 200  # of one update of the slow copies, for a fine Euler step
    for n in range(9000 // 3 + 1):
        for at, v in zip(updates, values, strict=True):
            if at // 3 == n:
                value = v
                expected.append(q - value)
        for _ in range(parts):
            q += 0.05 * (1 - 0.9) * (value - q) / parts
    assert np.allclose(found, expected, atol=1e-3)
    n = updates // 3
    by_formula = [
        -sum(
            np.exp(-0.05 * (1 - 0.9) * (n[m] - n[j]))
            * (values[j] - (values[j - 1] if j else 0))
            for j in range(m + 1)
        )
        for m in range(5)
    ]
    assert np.allclose(found, by_formula)


def test_a_bias_made_anew_in_each_target_grows_a_hundredfold():
    assert instrument.accumulated(1.0, 0.99) == pytest.approx(99.0)
    q = 0.0
    for _ in range(5000):
        q = 0.99 * (q + 1.0)
    assert q == pytest.approx(99.0)


@pytest.mark.parametrize("algorithm", ["DDPG", "DCN-DDPG", "DN-DDPG"])
def test_a_bias_is_the_sum_of_what_eq_5_5_says_term_by_term(algorithm):
    agent = make_agent(Config("Pendulum-v1", algorithm, gamma=0.95, dtype="float64"),
                       obs_dim=3, action_dim=1)
    world = instrument.dynamics(agent.config)
    starts = world.reset(np.random.default_rng(4), 3)
    found = instrument.take_apart(agent, world, starts)

    def look(states):  # the executed action, the critics' mean there, max of the min
        obs = world.observe(states)
        actions = agent.actions(obs)
        q = np.stack([agent.q_values(obs, a) for a in actions], axis=1)  # (C, K, 3)
        picked = [np.argmax([q[k, k, n] for k in range(q.shape[1])]) for n in range(3)]
        action = np.array([actions[k, n] for n, k in enumerate(picked)])
        mean = np.array([q[:, k, n].mean() for n, k in enumerate(picked)])
        return action, mean, q.min(axis=0).max(axis=0)

    above, rule, truth, states = np.zeros(3), np.zeros(3), np.zeros(3), starts
    action, first, _ = look(states)
    mean = first
    for t in range(500):
        states, reward, _ = world.step(states, action)
        action, mean_next, v_next = look(states)
        above += 0.95**t * (mean - reward - 0.95 * v_next)
        rule += 0.95 ** (t + 1) * (v_next - mean_next)
        truth += 0.95**t * reward
        mean = mean_next
    assert np.allclose(found["bias"], first - truth, atol=1e-6)
    assert np.allclose(found["rule"], rule, atol=1e-6)
    assert np.allclose(found["above"], above, atol=1e-6)
    assert (np.abs(found["rule"]).max() > 0.01) == (algorithm != "DDPG")


def test_two_critics_a_constant_apart_make_the_same_delta_at_each_step():
    config = Config("Pendulum-v1", "DCN-DDPG")
    agent = FakeAgent(config, swing, lambda obs, action: np.repeat([[-7.0], [-4.0]],
                                                                   len(obs), axis=1))
    world = instrument.dynamics(config)
    found = instrument.take_apart(agent, world, np.array([[3.0, 0.0], [1.0, 2.0]]))
    assert np.allclose(found["delta"], -1.5)  # half of the distance 3: Eq. (5.4)
    # 499 of endless many terms, from t = 1 on
    assert np.allclose(found["rule"], -1.5 * (0.99 - 0.99**500) / 0.01)


def test_a_bias_is_not_taken_apart_where_the_world_ends():
    config = Config("MountainCarContinuous-v0", "DDPG")
    agent = FakeAgent(config, lambda obs: np.sign(obs[:, 1:]),  # pumps up, and arrives
                      lambda obs, action: np.zeros((1, len(obs))))
    world = instrument.dynamics(config)
    with pytest.raises(ValueError, match="ended"):
        instrument.take_apart(agent, world, np.array([[-0.5, 0.0], [0.4, 0.0]]))


# --- The picture, and the summary ---


def test_a_plane_has_its_axes_y_then_x():
    config = Config("Pendulum-v1")
    agent, world = make_agent(config, 3, 1), instrument.dynamics(config)
    found = instrument.plane(agent, world, x="angle", y="velocity", size=5)
    assert found["q"].shape == (2, 5, 5) and found["action"].shape == (2, 5, 5, 1)
    state = np.array([[found["x"][1], found["y"][3]]])
    obs = world.observe(state)
    action = agent.act(obs)
    expected = instrument.true_q(world, state, action, agent)[0]
    assert found["truth"][3, 1] == pytest.approx(expected, rel=1e-3)
    assert np.allclose(
        found["q"][:, 3, 1], agent.q_values(obs, action)[:, 0], atol=1e-5
    )
    assert np.allclose(found["action"][:, 3, 1], agent.actions(obs)[:, 0], atol=1e-6)
    turned = instrument.plane(agent, world, x=1, y=0, size=5)
    assert np.allclose(turned["truth"], found["truth"].T, rtol=1e-3)


def test_a_plane_holds_the_other_variables_fixed():
    config = Config("ArmHard-v0", "DDPG")
    agent, world = make_agent(config, 9, 2), instrument.dynamics(config)
    seen = []
    world.observe, observe = lambda s: seen.append(s) or observe(s), world.observe
    instrument.plane(agent, world, size=3)
    assert (seen[0][:, 2:] == [100, 100, 0]).all()  # the easy goal
    instrument.plane(agent, world, "goal x", "goal y", fixed=[1, 2, 0, 0, 0], size=4)
    moved = next(s for s in seen if (s[:, :2] == [1, 2]).all())
    assert np.allclose(np.unique(moved[:, 2]), [0, 400 / 3, 800 / 3, 400])


def test_a_summary_says_mean_standard_error_and_n():
    mean, error, n = instrument.summary([1.0, 2.0, 3.0, 6.0])
    assert (mean, n) == (3.0, 4)
    assert error == pytest.approx(np.std([1, 2, 3, 6], ddof=1) / 2)
    assert np.isnan(instrument.summary([])[0]) and instrument.summary([])[2] == 0
    assert np.isnan(instrument.summary([1.0])[1])


@pytest.mark.parametrize("limit", [2, 3])
def test_an_end_counts_within_the_time_limit_only_and_leaves_no_tail(limit):
    """At full force from here the car is at the flag after its third step."""
    world = instrument.dynamics(Config("MountainCarContinuous-v0",
                                       max_episode_steps=limit))
    found = instrument.rollout(world, np.array([[0.3, 0.07]]),
                               lambda obs: np.ones((len(obs), 1)), 0.99)
    assert found["ended"].item() == (limit == 3)
    assert found["truth"].item() == pytest.approx(-0.1 - 0.099 + 0.99**2 * 99.9)
    assert found["tail"] == 0  # nothing more can be earned


@pytest.mark.parametrize("limit, in_time", [(50, False), (200, True)])
def test_a_flag_after_the_time_limit_is_in_the_truth_and_no_success(limit, in_time):
    config = Config("MountainCarContinuous-v0", max_episode_steps=limit)

    def along_the_velocity(obs):  # the flag after about 106 steps
        return np.where(obs[:, 1:] < 0, -1.0, 1.0)

    found = instrument.rollout(instrument.dynamics(config), np.array([[-0.5, 0.0]]),
                               along_the_velocity, gamma=0.99)
    assert found["truth"][0] > 20
    assert found["ended"].tolist() == [in_time]


@pytest.mark.parametrize("limit, success", [(50, False), (51, True), (300, True)])
def test_success_is_more_than_50_steps_on_the_goal_and_then_the_return_is_complete(
    limit, success
):
    """The finger rests inside the goal, off its centre: the same reward each step."""
    config = Config("ArmEasy-v0", max_episode_steps=limit)
    world = instrument.dynamics(config)
    joints = np.array([[0.3, 0.4]])
    centre = arm.locate(joints)[:, 1] + arm.BASE  # of a goal around the finger
    state = np.concatenate([joints, centre + [[4.0, 3.0]], [[0.0]]], axis=1)
    found = instrument.rollout(world, state, lambda obs: np.zeros((len(obs), 2)), 0.95)
    assert found["success"].tolist() == [success]
    assert found["returns"][0] == pytest.approx(-min(limit, 51) * 5 / 400)
    env = make_env(config)
    env.reset(seed=0)
    env.unwrapped.state = state[0]
    steps, total, over = 0, 0.0, False
    while not over:
        _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
        steps, total, over = steps + 1, total + reward, terminated or truncated
    assert steps == min(limit, 51) and info["success"] == success
    assert found["returns"][0] == pytest.approx(total, rel=1e-6)


def test_recent_is_the_last_60_of_the_states_that_a_training_kept():
    agent = make_agent(Config("Pendulum-v1", "DDPG"), 3, 1)
    world = instrument.dynamics(agent.config)
    states = world.reset(np.random.default_rng(6), 64)
    kept = [{"state": state, "obs": obs, "action": np.zeros(1)}
            for state, obs in zip(states, world.observe(states), strict=True)]

    def recent(kept):
        found = instrument.evaluate(fake_training(agent, kept)).bias
        return [row for row in found if row["states"] == "recent"]

    assert {row["n"] for row in recent(kept)} == {60}
    assert recent(kept) == recent(kept[-60:]) != recent(kept[:60])


def test_who_starts_on_the_goal_needs_no_step():
    world = instrument.dynamics(Config("ArmEasy-v0"))
    states = world.reset(stream(0, "evaluation", 7), 2_000)
    there = arm.reference_steps(states) == 0
    assert 0 < there.sum() < 100
    stay = instrument.rollout(world, states, lambda obs: np.zeros((len(obs), 2)), 0.95)
    assert (stay["steps_to_goal"][there] == 0).all()
    assert (stay["steps_to_goal"][~there] > 0).all()


def test_regret_counts_the_goals_that_can_be_reached():
    config = Config("ArmHard-v0", "DDPG", task_options={"goal_area": "window"})
    agent = make_agent(config, 9, 2)
    starts = instrument.dynamics(config).reset(stream(0, "evaluation", 1000), 100)
    assert np.isinf(arm.reference_steps(starts)).any()
    assert np.isfinite(instrument.evaluate(fake_training(agent)).evaluation["regret"])


def test_grown_counts_updates_of_the_slow_copies():
    often = Config("Pendulum-v1", tau=0.05)
    seldom = Config("Pendulum-v1", tau=0.05, target_every=10)
    delta = [1.0, -2.0, 0.5]
    expected = instrument.grown([10, 20, 60], delta, often)
    assert np.array_equal(instrument.grown([100, 200, 600], delta, seldom), expected)
