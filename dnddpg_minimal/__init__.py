"""dnddpg_minimal: DDPG, a second critic, a second actor, and how wrong Q is.

The algorithm lies in ``dnddpg_minimal.dnddpg``; its names are repeated here. Importing
the package registers the Arm tasks and the probe tasks with Gymnasium. PyTorch,
MuJoCo, pandas and matplotlib are imported only by the functions that need them.
"""

import gymnasium as _gymnasium

from dnddpg_minimal.dnddpg import (
    ALGORITHMS,
    Batch,
    Config,
    Noise,
    NumpyAgent,
    Record,
    ReplayBuffer,
    TorchAgent,
    Training,
    choose_actor,
    make_agent,
    make_env,
    next_value,
    read_npz,
    stream,
    td_target,
    to_env,
    write_npz,
)

__version__ = "0.1.0"

__all__ = [
    "ALGORITHMS",
    "Batch",
    "Config",
    "Noise",
    "NumpyAgent",
    "Record",
    "ReplayBuffer",
    "TorchAgent",
    "Training",
    "choose_actor",
    "make_agent",
    "make_env",
    "next_value",
    "read_npz",
    "stream",
    "td_target",
    "to_env",
    "write_npz",
]


def _register():
    """Tell Gymnasium our tasks' names. Their modules are imported when made."""
    for goal in ("easy", "hard"):
        _gymnasium.register(
            f"Arm{goal.capitalize()}-v0",
            entry_point="dnddpg_minimal.arm:Arm",
            max_episode_steps=300,
            kwargs={"goal": goal},
        )
    limits = {
        "ConstantReward": 50,
        "RealEnd": None,
        "ObservedReward": 50,
        "TwoSteps": None,
        "LinearQuadratic": 50,
    }
    for name, limit in limits.items():
        _gymnasium.register(
            f"{name}-v0",
            entry_point=f"dnddpg_minimal.probes:{name}",
            max_episode_steps=limit,
        )


_register()
