"""How wrong is a critic? The true value of a policy, and the error of Q against it.

    bias_c = Q_c(s, a) - Q^pi(s, a)        > 0 overestimates, < 0 underestimates

Q are the online critics. pi is the greedy policy: online actors, `act_rule`, no noise.
Q^pi is what the critic tries to learn: the discounted sum of the rewards that follow
when a is done first and pi is obeyed from then on, for ever. A real end stops the sum
(a terminal state has value 0); a time limit does not.

where the truth comes from                                               horizon
---------------------------------------------------------------------   --------
Pendulum-v1, the Arms,    the task's equations, all states in lock-step  500
the probes
MountainCarContinuous-v0  the same                                       999
MuJoCo, on-policy         the rewards that followed in the same episode  500 or more
MuJoCo, kept states       the simulator, put back and stepped on         500
any other task            on-policy only; what is not known is NaN       500 or more

The sum stops at the horizon H, or earlier where gamma^t < 1e-7 (at gamma = 0.95 after
315 steps: less than float32 can hold). What is left out is at most
gamma^H * max|reward| / (1 - gamma) (`Measurement.tail`): at gamma = 0.99 and H = 500
that is 0.7 % of the largest value that is possible.

call                                    meaning
-------------------------------------   ----------------------------------------------
dynamics(config)                        a task's equations for N states, or None
rollout(world, states, policy, gamma)   truth, return, ends of N states: dict of (N,)
true_q(world, states, action, agent)    Q^pi(s, a): (N,)
evaluate(training)                      one `Measurement` at the present step
plane(agent, world, x, y)               Q and truth over two state variables
summary(values)                         mean, standard error, n
owed(updates, values, config)           the bias that a critic has because it lags
predict(sigma, kappa, rho, rule)        the bias that one target makes, closed form
take_apart(agent, world, states)        a bias as two sums: optimism, the target's rule

Shapes: C critics, K actors, B batch, N states, O observation, A action, S state.
Whom we follow: Fujimoto et al. 2018 (TD3), section 4.1, who compare Q with the returns
of 1 000 episodes. Here the states are fewer and the truth is exact.
"""

from __future__ import annotations

import dataclasses

import gymnasium
import numpy as np
from threadpoolctl import threadpool_limits

from . import arm
from .dnddpg import (
    _TURN,
    PROBE_TASKS,
    choose_actor,
    is_mujoco,
    make_env,
    simulator_state,
    stream,
    to_env,
)

STEPS = 500  # horizon of the truth
NEGLIGIBLE = 1e-7  # a reward of smaller weight is lost in float32: the sum stops there
STARTS = 100  # fresh starts where the dynamics are vectorised
RECENT = 60  # kept states where the dynamics are vectorised (MuJoCo: all 64)
EPISODES_MUJOCO = 5
EPISODES_OTHER = 10
PORTION = 420  # states in one rollout of `true_q`: what the processor's cache holds


# ---------------------------------------------------------------------------
# The tasks' equations, for many states at once
# ---------------------------------------------------------------------------


class Dynamics:
    """The exact equations of the config's task, for N states in lock-step.

    `reset(rng, n) -> states (N, S)`: starts, drawn by the task itself from n seeds.
    `observe(states) -> obs (N, O)` float32.
    `step(states, action) -> (next states, reward (N,), terminated (N,))`, with
    action (N, A) in [-1, 1] and reward in environment units.

    `names`, `low`, `high`, `rest`: the state variables, the range that a picture
    shows, and their values where a picture does not vary them.
    `limit` is the task's time limit: it ends a return, never a truth.
    """

    steps = STEPS

    def __init__(self, config):
        self.env = make_env(config)
        self.task = self.env.unwrapped
        self.space = self.env.action_space
        self.limit = self.env.spec.max_episode_steps or self.steps
        self.rng = np.random.default_rng(0)  # for a task with chance in its steps

    def reset(self, rng, n):
        """n starts (n, S), as the task itself draws them from n seeds of rng."""
        self.rng, starts = rng, []
        for seed in rng.integers(2**31, size=n):
            self.env.reset(seed=int(seed))
            starts.append(np.asarray(self.task.state, np.float64).ravel())
        return np.array(starts)

    def observe(self, states):
        """What an agent sees: states (N, S) → obs (N, O) float32."""
        raise NotImplementedError

    def step(self, states, action):
        """states (N, S), action (N, A) in [-1, 1] → next states, reward, terminated."""
        raise NotImplementedError

    def on_goal(self, states):
        """Steps in a row on the goal, states (N, S) → (N,): only the Arms count."""
        return np.zeros(len(states))


class Pendulum(Dynamics):
    """Pendulum-v1: angle (0 is upright) and velocity. It never terminates."""

    names = ("angle", "velocity")
    low, high = np.array([-np.pi, -8.0]), np.array([np.pi, 8.0])
    rest = np.zeros(2)

    def observe(self, states):
        angle, velocity = states.T
        obs = np.array([np.cos(angle), np.sin(angle), velocity], np.float32)
        return np.ascontiguousarray(obs.T)

    def step(self, states, action):
        task = self.task
        angle, velocity = states.T
        torque = to_env(action, self.space)[:, 0].astype(np.float64)
        folded = (angle + np.pi) % (2 * np.pi) - np.pi  # in [-pi, pi)
        reward = -(folded**2 + 0.1 * velocity**2 + 0.001 * torque**2)
        gravity = 3 * task.g / (2 * task.l) * np.sin(angle)
        velocity = velocity + (gravity + 3 / (task.m * task.l**2) * torque) * task.dt
        velocity = np.clip(velocity, -task.max_speed, task.max_speed)
        angle = angle + velocity * task.dt
        return np.array([angle, velocity]).T, reward, np.zeros(len(states), bool)


class MountainCar(Dynamics):
    """MountainCarContinuous-v0: position and velocity. The goal is a real end."""

    names = ("position", "velocity")
    low, high = np.array([-1.2, -0.07]), np.array([0.6, 0.07])
    rest = np.array([-np.pi / 6, 0.0])  # the bottom of the valley
    steps = 999

    def observe(self, states):
        return states.astype(np.float32)

    def step(self, states, action):
        task = self.task
        position, velocity = states.T
        force = to_env(action, self.space)[:, 0].astype(np.float64)
        velocity = velocity + force * task.power - 0.0025 * np.cos(3 * position)
        velocity = np.clip(velocity, -task.max_speed, task.max_speed)
        position = np.clip(position + velocity, task.min_position, task.max_position)
        # The wall on the left stops the car.
        stopped = (position == task.min_position) & (velocity < 0)
        velocity = np.where(stopped, 0.0, velocity)
        terminated = (position >= task.goal_position) & (velocity >= task.goal_velocity)
        reward = 100.0 * terminated - 0.1 * force**2
        return np.array([position, velocity]).T, reward, terminated


class Arm(Dynamics):
    """The two Arms: two joint angles, the goal, steps in a row on the goal."""

    names = ("joint 1", "joint 2", "goal x", "goal y", "counter")
    low = np.array([0.0, 0.0, 0.0, 0.0, 0.0])
    high = np.array([2 * np.pi, 2 * np.pi, 400.0, 400.0, 50.0])
    rest = np.array([0.0, 0.0, 100.0, 100.0, 0.0])  # the easy goal

    def observe(self, states):
        return arm.observe(states)

    def step(self, states, action):
        states, reward, success = arm.step(states, action, reward=self.task.reward)
        return states, reward, success & self.task.success_terminates

    def on_goal(self, states):
        # An episode may begin on the goal, and its counter still at 0
        return np.maximum(states[:, 4], arm._on_goal(arm._gap(states)))


class Probe(Dynamics):
    """The tiny tasks of `probes.py`, which bring their own equations."""

    def __init__(self, config):
        super().__init__(config)
        self.observe = self.task.observe
        states = self.reset(self.rng, 100)
        self.low, self.high = states.min(axis=0), states.max(axis=0)
        self.rest = np.zeros(states.shape[1])
        self.names = ("position", "velocity")[: len(self.rest)]

    def step(self, states, action):
        return self.task.dynamics(states, to_env(action, self.space), self.rng)


class Simulator(Dynamics):
    """A MuJoCo task: one simulator that takes N states in turn, one step each.

    A row of `states` is all that the next step depends on: MuJoCo's integration state,
    `xipos`, and the observation. The integration state is not enough: Humanoid's
    reward reads `xipos`, which lags one step behind (mj_forward would refresh it, so
    it must not be called), and its observation, read again, would be stale.
    Restored so, a state goes on bit for bit as it did.
    """

    def __init__(self, config):
        import mujoco

        super().__init__(config)
        self.env.reset(seed=0)
        self.model, self.data = self.task.model, self.task.data
        self.integration = mujoco.mjtState.mjSTATE_INTEGRATION
        self.get, self.put = mujoco.mj_getState, mujoco.mj_setState
        size = mujoco.mj_stateSize(self.model, self.integration)
        self.cuts = size, size + self.data.xipos.size  # state | xipos | obs

    def repeats(self):
        """Does a state that was put back go on to the last bit as it did?

        The book's four tasks do. Another task's reward may read more of the simulator
        (Ant's reads `xpos`), or a wrapper may change what the task says.
        """
        action = np.full((1, *self.space.shape), 0.3)
        self.env.reset(seed=1)
        for _ in range(3):
            obs = self.env.step(to_env(action[0], self.space))[0]
        state, xipos = simulator_state(self.env)
        states = self.pack([dict(state=state, xipos=xipos, obs=obs)])
        obs, reward = self.env.step(to_env(action[0], self.space))[:2]
        self.env.reset(seed=2)
        again, repeated, _ = self.step(states, action)
        return reward == repeated[0] and np.array_equal(obs, again[0, self.cuts[1] :])

    def pack(self, kept):
        """The rows of what `Training.kept` holds: (N, S)."""
        rows = [(k["state"], k["xipos"].ravel(), k["obs"]) for k in kept]
        return np.array([np.concatenate(row) for row in rows])

    def observe(self, states):
        return states[:, self.cuts[1] :].astype(np.float32)

    def step(self, states, action):
        state, xipos, obs = np.split(states, self.cuts, axis=1)
        state, xipos, obs = state.copy(), xipos.copy(), obs.copy()
        reward, terminated = np.zeros(len(states)), np.zeros(len(states), bool)
        lagging = self.data.xipos.reshape(-1)  # a view
        for n, one in enumerate(to_env(action, self.space)):
            self.put(self.model, self.data, state[n], self.integration)
            lagging[:] = xipos[n]
            # `task` is unwrapped: a TimeLimit would count on.
            obs[n], reward[n], terminated[n], _, _ = self.task.step(one)
            self.get(self.model, self.data, state[n], self.integration)
            xipos[n] = lagging
        return np.concatenate([state, xipos, obs], axis=1), reward, terminated


VECTORISED = {
    "Pendulum-v1": Pendulum,
    "MountainCarContinuous-v0": MountainCar,
    "ArmEasy-v0": Arm,
    "ArmHard-v0": Arm,
    **dict.fromkeys(PROBE_TASKS, Probe),
}


def dynamics(config):
    """The equations of the config's task for many states, or None without equations."""
    return VECTORISED[config.task](config) if config.task in VECTORISED else None


# ---------------------------------------------------------------------------
# The truth
# ---------------------------------------------------------------------------


def greedy(agent, rule=None):
    """The agent's policy that is measured: obs (B, O) -> action (B, A), no noise.

    `rule` names how one of the K actors is chosen (Eq. (12)); None: `act_rule`.
    """
    if rule is None or rule == agent.config.act_rule:
        return agent.act

    def policy(obs):
        actions = agent.actions(obs)  # (K, B, A)
        q = np.stack([agent.q_values(obs, a) for a in actions], axis=1)  # (C, K, B)
        return actions[choose_actor(q, rule), np.arange(len(obs))]

    return policy


def rollout(world, states, policy, gamma, steps=None, first_action=None):
    """Follow a policy from N states, all in lock-step.

    states (N, S); policy obs (B, O) -> action (B, A) in [-1, 1]; first_action (N, A)
    is done first if it is given. gamma is the discount of one step. A row whose world
    has ended earns nothing more. One rollout serves two quantities; a dict of (N,):
        truth     discounted sum of up to `steps` rewards; time limits are passed over
        returns   plain sum of the first `world.limit` rewards; on Arm up to success
        ended     did the world really end, within `world.limit` steps?
        success   Arm: more than 50 steps in a row on the goal, within the limit
        steps_to_goal  Arm: the first step on the goal; the limit where there is none
    and one number, `tail`: the largest truth that can be missing after the horizon.
    """
    n, limit = len(states), world.limit
    steps = max(world.steps, limit) if steps is None else steps
    truth, returns, largest = np.zeros(n), np.zeros(n), 0.0
    ended, success = np.zeros(n, bool), np.zeros(n, bool)
    steps_to_goal = np.where(world.on_goal(states) > 0, 0, limit)
    rows = np.arange(n)  # the rows whose world goes on; `states` holds only these
    for t in range(steps):
        if t >= limit and gamma**t < NEGLIGIBLE:
            steps = t  # the rest is too small to be seen
            break
        if t == 0 and first_action is not None:
            action = first_action
        else:
            action = policy(world.observe(states))
        states, reward, terminated = world.step(states, action)
        truth[rows] += gamma**t * reward
        largest = max(largest, np.abs(reward).max())
        if t < limit:
            returns[rows] += np.where(success[rows], 0.0, reward)
            counter = world.on_goal(states)
            arrival = np.where(counter > 0, t + 1, limit)
            steps_to_goal[rows] = np.minimum(steps_to_goal[rows], arrival)
            success[rows] |= counter > arm.HOLD
        if terminated.any():
            ended[rows[terminated]] = t < limit
            rows, states = rows[~terminated], states[~terminated]
            if len(rows) == 0:
                break
    tail = largest_tail(gamma, steps, largest) if len(rows) else 0.0
    return {
        "truth": truth,
        "returns": returns,
        "ended": ended,
        "success": success,
        "steps_to_goal": steps_to_goal,
        "tail": tail,
    }


def largest_tail(gamma, steps, largest):
    """The most that rewards up to `largest` can add after `steps` steps, with gamma."""
    return gamma**steps * largest / (1 - gamma) if gamma < 1 else np.inf


def true_q(world, states, action, agent):
    """Q^pi(s, a) of N states (N, S) and actions (N, A) in [-1, 1]: (N,).

    world: of `dynamics`; pi is agent.act.
    """
    gamma, truth = agent.config.gamma, []
    for start in range(0, len(states), PORTION):
        part = slice(start, start + PORTION)
        found = rollout(world, states[part], agent.act, gamma, None, action[part])
        truth.append(found["truth"])
    return np.concatenate(truth)


def walk(env, policy, seed, steps):
    """One episode of a policy in env from the start `seed`, at most `steps` steps.

    Returns obs (T, O), action (T, A) in [-1, 1], reward (T,), terminated.
    """
    obs, _ = env.reset(seed=int(seed))
    observations, actions, rewards = [], [], []
    for _ in range(steps):
        observations.append(np.array(obs, np.float32))  # a copy
        actions.append(policy(observations[-1]))
        action = to_env(actions[-1], env.action_space)
        obs, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(observations), np.array(actions), np.array(rewards), terminated


def discounted(rewards, gamma):
    """The discounted sum of what follows each step: rewards (T,), gamma -> (T,)."""
    sums, following = np.zeros(len(rewards)), 0.0
    for t in reversed(range(len(rewards))):
        following = rewards[t] + gamma * following
        sums[t] = following
    return sums


# ---------------------------------------------------------------------------
# One measurement
# ---------------------------------------------------------------------------


@dataclasses.dataclass
class Measurement:
    """What `evaluate` finds. Bias and values are in units of (discounted) return.

    evaluation  dict: task, algorithm, seed, step, updates, mean, standard_error, n;
                on Arm also success, steps_to_goal, regret; on MountainCar success
    bias        list of dicts: task, algorithm, seed, step, updates, rule, states,
                action, critic, q, truth, bias, standard_error, n
    operator    dict: delta, sigma, kappa, rho, actor_distance, n
    tail        the largest truth that can be missing after the horizon
    """

    evaluation: dict
    bias: list
    operator: dict
    tail: float


def summary(values):
    """Mean, its standard error, and n, of values (n,); NaN where n is too small."""
    values = np.asarray(values, np.float64)
    n = len(values)
    mean = values.mean() if n > 0 else np.nan
    error = values.std(ddof=1) / np.sqrt(n) if n > 1 else np.nan
    return float(mean), float(error), n


def with_min(q):
    """Each critic, and their min: q (C, B) -> (C + 1, B)."""
    return np.concatenate([q, q.min(axis=0, keepdims=True)])


def bias_rows(labels, q, truth):
    """One row for each critic and for the min: q (C + 1, n), truth (n,).

    A row is a dict: labels, and what `Measurement.bias` holds besides.
    """
    names = [str(c) for c in range(len(q) - 1)] + ["min"]
    rows = []
    for name, estimate in zip(names, q, strict=True):
        bias, error, n = summary(estimate - truth)
        row = {"q": summary(estimate)[0], "truth": summary(truth)[0], "bias": bias}
        rows.append(labels | {"critic": name} | row | {"standard_error": error, "n": n})
    return rows


def measure_operator(agent, obs, truth=None):
    """What one target does to the critics' errors. obs (B, O), truth (K, B) or None.

    delta: mean over the states of `agent.next_value(q_next)`, the target's rule, minus
    the mean over critics and actors of q_next. It needs no truth. `y_min` is left out:
    it is no rule over q_next.
    sigma, kappa, rho: e[c, k] = q_next[c, k] - truth[k], less its mean over the states.
    sigma is their standard deviation; kappa the correlation of two critics at the same
    action (NaN with one critic); rho that of two actions within one critic (NaN with
    one actor). All three pool over c and k.
    actor_distance: mean distance of the first two actors' actions, which lie in
    [-1, 1] (NaN with one actor).
    """
    n = len(obs)
    names = ("delta", "sigma", "kappa", "rho", "actor_distance")
    out = dict.fromkeys(names, np.nan) | {"n": n}
    if n < 2:
        return out
    q_next = np.asarray(agent.q_next(obs), np.float64)  # (C, K, B)
    out["delta"] = float(agent.next_value(q_next).mean() - q_next.mean())
    actions = agent.actions(obs)  # (K, B, A)
    if len(actions) > 1:
        gap = np.linalg.norm(actions[0] - actions[1], axis=-1)  # (B,)
        out["actor_distance"] = float(gap.mean())
    if truth is not None:
        error = q_next - truth
        error -= error.mean(axis=2, keepdims=True)
        covariance = np.einsum("ckb,dlb->ckdl", error, error) / (n - 1)
        critics, actors, _ = error.shape
        same_c, same_k = np.eye(critics, dtype=bool), np.eye(actors, dtype=bool)
        by_pair = covariance.transpose(0, 2, 1, 3)  # (c, d, k, l)
        variance = by_pair[same_c][:, same_k].mean()
        out["sigma"] = float(np.sqrt(variance))
        variance = variance if variance > 0 else np.nan  # no error, no correlation
        if critics > 1:
            out["kappa"] = float(by_pair[~same_c][:, same_k].mean() / variance)
        if actors > 1:
            out["rho"] = float(by_pair[same_c][:, ~same_k].mean() / variance)
    return out


def evaluate(training, full=None):
    """Measure return and bias of `training.agent`, now.

    Pure: it depends on the agent, the step, the seed and `training.kept` only, and it
    touches neither the environment of `training` nor its generators. Starts are drawn
    from stream(seed, "evaluation", step).

    `full` says whether what is slow is measured, too: on MuJoCo the bias on the kept
    states; where the equations are known sigma, kappa and rho (else NaN), and with two
    actors the bias under the other rule (else no rows). None: on MuJoCo at the first
    evaluation at or after 25, 50, 75 and 100 % of `config.steps` (never if the run has
    none), on the others always.
    """
    config, agent = training.config, training.agent
    common = {"task": config.task, "algorithm": config.algorithm, "seed": config.seed}
    common |= {"step": training.step, "updates": training.updates}
    rng = stream(config.seed, "evaluation", training.step)
    world = dynamics(config)
    if full is None:
        full = world is not None or _reaches_a_quarter(config, training.step)
    with _TURN, threadpool_limits(1):  # one run, one thread
        if world is None:
            return _by_episodes(agent, common, rng, training.kept, full)
        return _by_equations(agent, common, rng, training.kept, full, world)


def _reaches_a_quarter(config, step):
    """Is this the first evaluation at or after 25, 50, 75 or 100 % of the run?"""
    if config.steps is None:
        return False
    before = max(step - config.evaluate_every, 0)
    return 4 * step // config.steps > 4 * before // config.steps


def _by_equations(agent, common, rng, kept, full, world):
    """100 fresh starts and the last 60 kept states. Standard errors are over states.

    One state is kept from each 156 steps, so the 60 span the last 9 360.

    One rollout holds, side by side: both kinds of states with the policy's own action,
    the kept states with the replayed action, and, if `full`, the kept states with each
    slow actor's action (for sigma, kappa, rho). With two actors and `full` there is a
    second one, for the other rule: the policy's own action only.
    """
    config, kept = agent.config, kept[-RECENT:]
    n, width = len(kept), world.space.shape[0]
    starts = world.reset(rng, STARTS)
    recent = np.array([k["state"] for k in kept]).reshape(n, starts.shape[1])
    replayed = np.array([k["action"] for k in kept]).reshape(n, width)
    obs_recent = world.observe(recent)
    rules = [config.act_rule]
    if full and config.actors > 1:
        rules += [r for r in ("paired", "max_min") if r != config.act_rule]

    rows = []
    for rule in rules:
        policy = greedy(agent, rule)
        parts = {
            ("start", "policy"): (starts, policy(world.observe(starts))),
            ("recent", "policy"): (recent, policy(obs_recent)),
        }
        if rule == config.act_rule:
            parts["recent", "replay"] = recent, replayed
        if rule == config.act_rule and full:
            for k, action in enumerate(agent.actions(obs_recent, slow=True)):
                parts["slow", k] = recent, action
        found = rollout(
            world,
            np.concatenate([states for states, _ in parts.values()]),
            policy,
            config.gamma,
            first_action=np.concatenate([action for _, action in parts.values()]),
        )
        ends = np.cumsum([len(states) for states, _ in parts.values()])
        truth = dict(zip(parts, np.split(found["truth"], ends[:-1]), strict=True))
        for (name, action_name), (states, action) in parts.items():
            if name != "slow":
                q = with_min(agent.q_values(world.observe(states), action))
                labels = common | {"rule": rule, "states": name, "action": action_name}
                rows += bias_rows(labels, q, truth[name, action_name])
        if rule == config.act_rule:
            own, slow = found, [t for (name, _), t in truth.items() if name == "slow"]

    mean, error, n = summary(own["returns"][:STARTS])
    evaluation = common | {"mean": mean, "standard_error": error, "n": n}
    if isinstance(world, MountainCar):
        evaluation["success"] = float(own["ended"][:STARTS].mean())
    if isinstance(world, Arm):
        steps = own["steps_to_goal"][:STARTS]
        regret = steps - arm.reference_steps(starts)
        in_reach = np.isfinite(regret)  # a goal in the window may be out of reach
        evaluation["success"] = float(own["success"][:STARTS].mean())
        evaluation["steps_to_goal"] = float(steps.mean())
        evaluation["regret"] = summary(regret[in_reach])[0]
    operator = measure_operator(agent, obs_recent, np.array(slow) if full else None)
    return Measurement(evaluation, rows, operator, own["tail"])


def _by_episodes(agent, common, rng, kept, full):
    """Whole episodes, and on MuJoCo, if `full`, the kept states.

    On-policy: a state of the first 500 steps, with the discounted rewards that follow
    it in the same episode; the time limit is passed over, so that at least 500 steps
    follow, or a real end. The episode is the unit: n counts episodes, q and truth are
    means over an episode's states, and standard errors are over episodes.
    Kept states: n counts states, and standard errors are over states; NaN on a task
    that cannot be put back (`Simulator.repeats`).
    """
    config = agent.config
    limit = (config.max_episode_steps
             or gymnasium.spec(config.task).max_episode_steps or 2 * STEPS)
    # No time limit in our way; we count the steps of a return ourselves.
    env = make_env(dataclasses.replace(config, max_episode_steps=10**9))
    simulator = is_mujoco(env)

    returns, q_means, truth_means, largest = [], [], [], 0.0
    episodes = EPISODES_MUJOCO if simulator else EPISODES_OTHER
    for seed in rng.integers(2**31, size=episodes):
        walked = walk(env, agent.act, seed, max(limit, 2 * STEPS))
        obs, action, reward, terminated = walked
        returns.append(reward[:limit].sum())
        largest = max(largest, np.abs(reward).max())
        known = len(reward) if terminated else len(reward) - STEPS
        known = min(known, limit, STEPS)
        if known > 0:
            q = with_min(agent.q_values(obs[:known], action[:known]))  # (C + 1, T)
            q_means.append(q.mean(axis=1))
            truth_means.append(discounted(reward, config.gamma)[:known].mean())
    env.close()
    mean, error, n = summary(returns)
    evaluation = common | {"mean": mean, "standard_error": error, "n": n}

    labels = common | {"rule": config.act_rule}
    q = np.array(q_means).reshape(-1, config.critics + 1).T  # (C + 1, episodes)
    on_policy = labels | {"states": "on_policy", "action": "policy"}
    rows = bias_rows(on_policy, q, np.array(truth_means))
    obs = np.array([k["obs"] for k in kept]).reshape(len(kept), agent.obs_dim)
    if len(kept) > 0 and (full or not simulator):
        actions = {"policy": agent.act(obs)}
        actions["replay"] = np.array([k["action"] for k in kept])
        truths = dict.fromkeys(actions, np.full(len(kept), np.nan))
        if simulator:
            truths = _truth_of_kept(agent, kept, actions)
        for name, action in actions.items():
            recent = labels | {"states": "recent", "action": name}
            q = with_min(agent.q_values(obs, action))
            rows += bias_rows(recent, q, truths[name])
    tail = largest_tail(config.gamma, STEPS, largest)
    return Measurement(evaluation, rows, measure_operator(agent, obs), float(tail))


def _truth_of_kept(agent, kept, actions):
    """Q^pi of N kept MuJoCo states at each of some actions (N, A): a dict of (N,)."""
    world = Simulator(agent.config)
    if not world.repeats():
        return {name: np.full(len(kept), np.nan) for name in actions}
    states = np.concatenate([world.pack(kept)] * len(actions))
    first_action = np.concatenate(list(actions.values()))
    gamma = agent.config.gamma
    found = rollout(world, states, agent.act, gamma, STEPS, first_action)
    world.env.close()
    truths = np.split(found["truth"], len(actions))
    return dict(zip(actions, truths, strict=True))


def plane(agent, world, x=0, y=1, fixed=None, size=41):
    """An agent's Q, and the truth, over two state variables of a world.

    x, y: indices or names of state variables (`world.names`); the others stay at
    `fixed` (S,), by default `world.rest`. Returns a dict: x (size,), y (size,),
    q (C, size, size) and truth (size, size) at the policy's action, and each actor's
    action (K, size, size, A) in [-1, 1]. The axes of a picture are [y, x].
    """
    x, y = (world.names.index(v) if isinstance(v, str) else v for v in (x, y))
    along_x = np.linspace(world.low[x], world.high[x], size)
    along_y = np.linspace(world.low[y], world.high[y], size)
    fixed = np.array(world.rest if fixed is None else fixed, np.float64)
    states = np.tile(fixed, (size * size, 1))
    states[:, x] = np.tile(along_x, size)
    states[:, y] = np.repeat(along_y, size)
    obs = world.observe(states)
    action = agent.act(obs)
    q = agent.q_values(obs, action)  # (C, size * size)
    actions = agent.actions(obs)  # (K, size * size, A)
    return {
        "x": along_x,
        "y": along_y,
        "q": q.reshape(len(q), size, size),
        "truth": true_q(world, states, action, agent).reshape(size, size),
        "action": actions.reshape(len(actions), size, size, -1),
    }


# ---------------------------------------------------------------------------
# What the bias should be
# ---------------------------------------------------------------------------


def owed(updates, values, config, ends=0.0):
    """The bias that a critic has only because it lags: (M,), with the config's τ and γ.

    A part of Q that is constant over the states follows
        dQ/dn = tau (1 - gamma) (V(n) - Q),   Q(0) = 0,
    n the updates of the slow copies. updates (M,) are those of M evaluations (of the
    online networks), values (M,) the true mean values V measured there.
        owed(n) = - sum over m of exp(-tau (1 - gamma) (n - n_m)) (V_m - V_(m-1))
    A sketch: what is not constant over the states closes faster, and each jump of V is
    put at the end of its interval. `ends`, a number or (M,), is the share of the
    transitions in memory that end the world: they hold no slow Q, so that the mean
    target has gamma (1 - ends) for gamma.
    """
    n = np.asarray(updates) // config.target_every
    debts, debt = [], 0.0
    jumps = np.diff(np.asarray(values, np.float64), prepend=0.0)
    for jump, kept in zip(jumps, _kept(n, config, ends), strict=True):
        debt = debt * kept - jump
        debts.append(debt)
    return np.array(debts)


def grown(updates, delta, config, ends=0.0):
    """What a bias delta, made anew in each target, has grown to: (M,).

        dB/dn = tau (1 - gamma) (gamma delta / (1 - gamma) - B),   B(0) = 0
    delta (M,) is what was measured at these updates (M,); `ends` as in `owed`. After
    many updates with one delta it is `accumulated(delta, gamma, ends)`.
    """
    n = np.asarray(updates) // config.target_every
    limits = accumulated(np.asarray(delta, np.float64), config.gamma, ends)
    found, now = [], 0.0
    for limit, kept in zip(limits, _kept(n, config, ends), strict=True):
        now = now * kept + limit * (1 - kept)
        found.append(now)
    return np.array(found)


def _kept(n, config, ends):
    """How much of a constant part of Q is left from one evaluation to the next: (M,)"""
    rate = config.tau * (1 - config.gamma * (1 - np.asarray(ends)))
    return np.exp(-rate * np.diff(n, prepend=0))


def take_apart(agent, world, states):
    """A bias taken apart along the path of the policy: Eq. (5.5) of chapter 05.

    From each of N states (N, S) the policy that acts is followed. With q_mean(t) the
    mean of the online critics at the action that it takes at step t, and delta(t) what
    target's rule (`agent.next_value`) says there minus q_mean(t),

        q_mean(0) - truth = sum over t >= 0 of gamma^t [q_mean(t) - r - gamma v(t + 1)]
                          + sum over t >= 1 of gamma^t delta(t),   v = q_mean + delta.

    A dict: `above` (N,), the first sum, how far the critics lie above their own
    targets; `rule` (N,), the second one; `bias` (N,), both together; `delta` (T, N).
    All in units of return. What comes after the horizon counts as the first sum.
    ValueError where some worlds end before others: the sums are of an endless path.
    """
    config, n = agent.config, len(states)
    rows, q_mean, delta = np.arange(n), [], []

    def watched(obs):
        if len(obs) < n:
            raise ValueError(f"a world of {config.task} ended on the way: expected "
                             "a task, or states, without a real end.")
        actions = agent.actions(obs)  # (K, N, A)
        q = np.stack([agent.q_values(obs, a) for a in actions], axis=1)  # (C, K, N)
        q = np.asarray(q, np.float64)
        chosen = choose_actor(q, config.act_rule)  # (N,)
        q_mean.append(q.mean(axis=0)[chosen, rows])  # over C
        delta.append(agent.next_value(q) - q_mean[-1])
        return actions[chosen, rows]

    truth = rollout(world, states, watched, config.gamma)["truth"]
    bias, delta = q_mean[0] - truth, np.array(delta)
    rule = config.gamma ** np.arange(1, len(delta)) @ delta[1:]
    return {"above": bias - rule, "rule": rule, "bias": bias, "delta": delta}



# One target's own bias. e[c, k] is critic c's error at actor k's action: jointly
# normal, mean 0, standard deviation 1, both actions of equal true value. kappa is the
# correlation of two critics at the same action, rho that of two actions within one
# critic, kappa * rho that of both differences. With one critic kappa is 1, with one
# actor rho is 1: two equal errors are one error.


def max_of_two_actions(rho):
    """E max over two actions, one critic. Eq. (5), Thrun and Schwartz 1993."""
    return np.sqrt((1 - rho) / np.pi)


def min_of_two_critics(kappa):
    """E min over two critics at one action: `single`. Eq. (11)."""
    return -np.sqrt((1 - kappa) / np.pi)


def paired_min(kappa, rho):
    """E min of e[1, 1] and e[2, 2]: `paired_min`."""
    return -np.sqrt((1 - kappa * rho) / np.pi)


def paired_max(kappa, rho):
    """E max of e[1, 1] and e[2, 2]: what Eq. (12) believes of its own choice."""
    return np.sqrt((1 - kappa * rho) / np.pi)


def max_of_all(kappa, rho):
    """E max of all four errors.

    E max = sum over pairs i < j of E|e_i - e_j| / 2 * P(both others are smaller, given
    that e_i = e_j); that probability is 1/4 + arcsin(r) / 2 pi, r the correlation of
    the two gaps to the others.
    """
    kappa, rho = min(kappa, 1 - 1e-12), min(rho, 1 - 1e-12)  # no two exactly equal
    critics, actors = np.array([[1, kappa], [kappa, 1]]), np.array([[1, rho], [rho, 1]])
    cov = np.kron(critics, actors)  # (4, 4)
    total = 0.0
    for i in range(4):
        for j in range(i):
            others = [k for k in range(4) if k not in (i, j)]
            gap = np.zeros((3, 4))  # rows: e_i - e_j, and the mean of both - each other
            gap[0, [i, j]] = 1, -1
            gap[1:, [i, j]] = 0.5
            gap[[1, 2], others] = -1
            c = gap @ cov @ gap.T
            c = c[1:, 1:] - np.outer(c[1:, 0], c[0, 1:]) / c[0, 0]  # given a tie
            scale = np.sqrt(max(c[0, 0] * c[1, 1], 0.0))
            r = np.clip(c[0, 1] / scale, -1, 1) if scale > 1e-12 else 1.0
            distance = np.sqrt(2 - 2 * cov[i, j])
            total += distance / np.sqrt(2 * np.pi) * (0.25 + np.arcsin(r) / 2 / np.pi)
    return total


def max_min(kappa, rho):
    """E max over actors of the min over critics. At kappa = 0 this is B(rho).

    max(a, b) = a + b - min(a, b), where a and b are the two mins.
    """
    return 2 * min_of_two_critics(kappa) + max_of_all(kappa, rho)


def min_of_all(kappa, rho):
    """E min over actors and critics."""
    return -max_of_all(kappa, rho)


def soft(kappa, rho, nu):
    """`soft`: (1 - nu) max + nu min over the actors, of the critics' min."""
    return (1 - nu) * max_min(kappa, rho) + nu * min_of_all(kappa, rho)


def selected(kappa, rho):
    """`selected`: the action by Eq. (12), then the min over critics at that action."""
    spread = np.sqrt(np.pi * max(1 - kappa * rho, 1e-12))
    return (1 - rho) * (1 + kappa) / (2 * spread) + min_of_two_critics(kappa)


def predict(sigma, kappa, rho, rule, nu=0.1, critics=2, actors=2):
    """The bias delta that `target_rule` makes in each new target, in closed form.

    sigma, kappa, rho as measured (`Measurement.operator`); NaN for kappa means one
    critic, for rho one actor. nu is the weight ν of `soft`. The operator alone: errors
    of mean 0. Units of sigma. ValueError for an unknown rule, and for more than two
    critics or actors: there is no closed form here.
    """
    if critics > 2 or actors > 2:
        raise ValueError(f"critics={critics}, actors={actors}: the closed forms know "
                         "two of each at most.")
    # Measured correlations may lie a rounding beyond 1
    kappa, rho = (1.0 if np.isnan(c) else np.clip(c, -1, 1) for c in (kappa, rho))
    forms = {
        "single": lambda: min_of_two_critics(kappa),
        "paired_min": lambda: paired_min(kappa, rho),
        "max_min": lambda: max_min(kappa, rho),
        "selected": lambda: selected(kappa, rho),
        "soft": lambda: soft(kappa, rho, nu),
    }
    if rule not in forms:
        raise ValueError(f"rule={rule!r}: expected one of {', '.join(forms)}")
    return float(sigma * forms[rule]())


def accumulated(delta, gamma, ends=0.0):
    """A bias delta made anew in each target grows to gamma delta / (1 - gamma).

    `ends` is the share of transitions that end the world; gamma (1 - ends) stands for
    gamma then. ValueError if that is 1: such a bias has no limit.
    """
    gamma = gamma * (1 - ends)
    if np.any(gamma >= 1):
        raise ValueError("gamma=1 and no ends: a bias made anew in each target has no "
                         "limit; expected gamma below 1.")
    return gamma * delta / (1 - gamma)
