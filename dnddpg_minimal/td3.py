"""TD3 (Fujimoto et al. 2018): DCN-DDPG with smoothed targets and delayed actors.

The paper stops at the second critic, the first of TD3's three parts. These are the
other two, as chapter 12 explains them, in the way that anybody adds an agent of their
own: a subclass that overrides what differs. No line of dnddpg.py changes.

    from dnddpg_minimal import Config
    from dnddpg_minimal.td3 import TD3Training

    training = TD3Training(Config("Hopper-v5", "DCN-DDPG", target_every=2))

`target_every=2` delays the slow copies, too, as TD3 does.
"""

import numpy as np

from dnddpg_minimal.dnddpg import NumpyAgent, Training


class TD3Agent(NumpyAgent):
    """DCN-DDPG with smoothed targets and delayed actors; Config(target_every=2)."""

    sigma, limit, every = 0.2, 0.5, 2  # in half action ranges; updates

    def q_next(self, next_obs):
        """Slow critics near the slow actors' actions, Eq. (12.5): (C, K, B)."""
        # Fixed by (seed, update): nothing to save, and who measures draws nothing
        rng = np.random.default_rng([self.config.seed, self.updates])
        next_obs = self._rows(next_obs, self.obs_dim, "next_obs")
        actions = self._act(next_obs, slow=True)  # (K, B, A)
        noise = rng.normal(0, self.sigma, actions.shape)
        noise = np.clip(noise, -self.limit, self.limit)
        actions = np.clip(actions + noise, -1, 1).astype(self.dtype)
        return self._q(next_obs, actions, slow=True)

    def update(self, batch, climb=True):
        """As `Agent.update`; the actors climb at every second one only."""
        due = (self.updates + 1) % self.every == 0  # as for the slow copies
        return super().update(batch, climb and due)


class TD3Training(Training):
    """Trains `TD3Agent`. ValueError for another algorithm or target_every."""

    agent_class = TD3Agent

    def __init__(self, config):
        expected = "DCN-DDPG", self.agent_class.every
        if (config.algorithm, config.target_every) != expected:
            raise ValueError(f"TD3 is DCN-DDPG with target_every={expected[1]}; got "
                             f"{config.algorithm!r}, {config.target_every}.")
        super().__init__(config)
