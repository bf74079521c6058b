"""A task that does what a test asks for, registered as `Toy-v0`.

    obs     (steps since the reset, a number drawn at the reset), float32
    reward  1 in each step

`seeds` and `actions` note how it was treated: what `reset` was given, and every
action in environment units.
"""

import math

import gymnasium as gym
import numpy as np

TASK = "Toy-v0"
UNBOUNDED = {"low": [-math.inf], "high": [math.inf]}


class Toy(gym.Env):
    """
    low, high: bounds of the action, one number for each dimension.
    ends_after: steps to the end of the world; None: it never ends.
    bad_step, bad_reward, bad_obs: in that step (of the whole run) they are returned;
    step 0 is the reset.
    obs_shape: to be refused where it is not one axis.
    """

    on_step = None  # a test may set a function of the environment, called at each step

    def __init__(self, low=(-1,), high=(1,), ends_after=None, bad_step=None,
                 bad_reward=1.0, bad_obs=0.0, obs_shape=(2,),
                 render_mode=None):
        self.action_space = gym.spaces.Box(np.float32(low), np.float32(high))
        self.observation_space = gym.spaces.Box(-math.inf, math.inf, obs_shape)
        self.ends_after = ends_after
        self.bad_step, self.bad_reward, self.bad_obs = bad_step, bad_reward, bad_obs
        self.seeds, self.actions = [], []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.length, self.number = 0, self.np_random.uniform()
        bad = self.bad_obs if self.bad_step == 0 else 0
        return np.array([bad, self.number], np.float32), {}

    def step(self, action):
        self.actions.append(np.array(action))
        self.length += 1
        if self.on_step is not None:
            self.on_step()
        obs = np.array([self.length, self.number], np.float32)
        if len(self.actions) == self.bad_step:
            return obs + np.float32(self.bad_obs), self.bad_reward, False, False, {}
        return obs, 1.0, self.length == self.ends_after, False, {}


gym.register(TASK, Toy, max_episode_steps=10)
